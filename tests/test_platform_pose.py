"""Eq (18): the transformation between camera and platform, by points and as printed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry import register_groups, register_in_plane
from legcal.geometry.types import Array, IntArray
from legcal.paper.leg_directions import LegDirections
from legcal.paper.motions import moved, turned_axis, turns_of
from legcal.paper.platform import chosen_transformation
from legcal.paper.platform_pose import (
    PlatformPoses,
    build_rays,
    check_located,
    locate_platform,
    register_by_rays,
)

B_RE = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.1, 0.25, 0.0], [0.2, 0.1, 0.05]])
N_POSES = 3


def poses(seed: int) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    return [
        RigidTransform.from_components(
            np.array([0.1, -0.1, 1.2]) + rng.uniform(-0.1, 0.1, 3),
            Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3)),
        )
        for _ in range(N_POSES)
    ]


def directions_to(legs: IntArray, group: IntArray) -> LegDirections:
    """Return directions of which only legs and groups are looked at."""
    n = len(legs)
    nothing = np.zeros((n, 3))
    return LegDirections(
        group,
        0 * group,
        legs,
        nothing,
        nothing,
        np.zeros((n, 2, 3)),
        np.zeros((n, 2, 2)),
        np.zeros(n),
    )


def seen(seed: int, legs: tuple[int, ...] = (0, 1, 2, 3)) -> tuple[LegDirections, Array]:
    """Return what legs and groups there are, and the ends in the camera."""
    ends = np.concatenate([T.apply(B_RE[list(legs)]) for T in poses(seed)])
    group = np.repeat(np.arange(N_POSES), len(legs))
    return directions_to(np.tile(np.array(legs, dtype=np.intp), N_POSES), group), ends


def off(found: PlatformPoses, seed: int) -> float:
    """Return how far poses are from the true ones, rotation or position."""
    true = poses(seed)
    return max(
        float(np.abs(found.R - [T.rotation.as_matrix() for T in true]).max()),
        float(np.abs(found.t - [T.translation for T in true]).max()),
    )


@pytest.mark.parametrize("transformation", ["points", "cross_product"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=4, deadline=None)
def test_exact_ends_give_the_platform(transformation: str, seed: int) -> None:
    directions, ends = seen(seed)
    found = locate_platform(
        directions,
        ends,
        B_RE,
        centre=np.zeros_like(ends),
        transformation="points" if transformation == "points" else "cross_product",
    )
    assert found.pose.tolist() == np.repeat(np.arange(N_POSES), 4).tolist()
    assert off(found, seed) < 1e-9


def test_as_printed_the_distance_of_an_end_counts_for_nothing() -> None:
    """Ends moved along their rays spoil point equality; the rays are right still."""
    directions, ends = seen(1)
    wrong = ends * (1.0 + 0.02 * np.random.default_rng(0).standard_normal((len(ends), 1)))
    centre = np.zeros_like(ends)
    points = locate_platform(directions, wrong, B_RE, centre=centre, transformation="points")
    printed = locate_platform(
        directions, wrong, B_RE, centre=centre, transformation="cross_product"
    )
    assert off(points, 1) > 1e-3
    assert off(printed, 1) < 1e-7


def test_as_printed_rays_begin_at_the_camera_in_whatever_frame_ends_are_given() -> None:
    directions, ends = seen(2)
    wrong = ends * (1.0 + 0.02 * np.random.default_rng(0).standard_normal((len(ends), 1)))
    T = RigidTransform.from_components([0.4, -0.3, 0.2], Rotation.from_rotvec([0.3, -0.2, 0.5]))
    found = locate_platform(
        directions,
        T.apply(wrong),
        B_RE,
        centre=np.tile(T.translation, (len(ends), 1)),
        transformation="cross_product",
    )
    back = PlatformPoses(
        found.pose,
        T.inv().rotation.as_matrix() @ found.R,
        np.asarray(T.inv().apply(found.t)),
    )
    assert off(back, 2) < 1e-7


def test_as_printed_it_is_the_minimum_that_another_solver_finds() -> None:
    directions, ends = seen(3)
    rng = np.random.default_rng(5)
    noisy = ends + 1e-3 * rng.standard_normal(ends.shape)
    found = locate_platform(
        directions, noisy, B_RE, centre=0.0 * ends, transformation="cross_product"
    )

    def residuals(x: Array, k: int) -> Array:
        placed = Rotation.from_rotvec(x[:3]).apply(B_RE) + x[3:]
        return np.cross(placed, noisy[directions.group == k]).ravel()

    for k, T in enumerate(poses(3)):
        start = np.concatenate([T.rotation.as_rotvec(), T.translation])
        other = least_squares(residuals, start, args=(k,), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        R = Rotation.from_rotvec(other[:3]).as_matrix()
        assert np.abs(found.R[k] - R).max() < 1e-5
        assert np.abs(found.t[k] - other[3:]).max() < 1e-5


def test_derivatives_of_18_are_those_by_differences() -> None:
    directions, ends = seen(4)
    group = directions.group
    R, t = register_groups(B_RE[directions.leg], ends, group)
    noisy = ends + 0.01 * np.random.default_rng(0).standard_normal(ends.shape)
    problem = build_rays(B_RE[directions.leg], noisy, 0.0 * ends, group, (R, t))
    x = 0.1 * np.random.default_rng(1).standard_normal(len(problem.start))
    J = problem.jacobian(x).toarray()
    step = 1e-6
    for i in range(len(x)):
        e = step * np.eye(len(x))[i]
        ahead, behind = (problem.residuals(x + s * e) for s in (1, -1))
        assert np.abs((ahead - behind) / (2.0 * step) - J[:, i]).max() < 1e-8


def test_a_camera_is_placed_by_the_rays_to_the_base_joints() -> None:
    T = poses(6)[0]
    start = moved(np.array([0.01, -0.02, 0.01, 0.02, 0.01, -0.02]), T)
    found = register_by_rays(B_RE, T.apply(B_RE), start)
    assert np.abs(found.as_matrix() - T.as_matrix()).max() < 1e-9
    assert np.abs(start.as_matrix() - T.as_matrix()).max() > 0.01


def test_passive_legs_and_groups_of_two_ends_tell_no_pose() -> None:
    directions, ends = seen(7)
    ends[directions.leg == 3] = np.nan
    ends[:2] = np.nan
    found = locate_platform(directions, ends, B_RE, centre=0.0 * ends, transformation="points")
    assert found.pose.tolist() == [-1] * 4 + [0] * 4 + [1] * 4
    assert len(found.R) == 2


def test_ends_in_one_line_are_refused_in_geometric_words() -> None:
    directions, ends = seen(8, (0, 1, 2))
    line = B_RE.copy()
    line[2] = [0.15, 0.0, 0.0]
    found = locate_platform(directions, ends, line, centre=0.0 * ends, transformation="points")
    with pytest.raises(NotIdentifiable) as refusal:
        check_located(found, "Axes", "leg strut", spatial=True)
    assert "three legs of known length at once with ends that do not lie on one line" in str(
        refusal.value
    )
    allowed = locate_platform(
        directions, ends, line, centre=0.0 * ends, transformation="points", on_a_line=True
    )
    check_located(allowed, "Axes", "leg strut", spatial=True)


def test_two_ends_place_a_planar_platform() -> None:
    rng = np.random.default_rng(0)
    angle, t = 0.7, np.array([0.1, 0.2, 0.0])
    points = np.column_stack([rng.uniform(-0.3, 0.3, (2, 2)), [0.0, 0.02]])
    T = RigidTransform.from_components(t, Rotation.from_rotvec([0.0, 0.0, angle]))
    ends = np.asarray(T.apply(points))
    ends[:, 2] += 0.005  # heights are not looked at
    R, found = register_in_plane(points, ends, np.zeros(2, dtype=np.intp))
    np.testing.assert_allclose(R[0], T.rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found[0], t, atol=1e-12)


def test_weights_decide_between_points_that_disagree() -> None:
    directions, ends = seen(9, (0, 1, 2, 3))
    wrong = ends.copy()
    wrong[directions.leg == 3] += 0.05
    weight = np.where(directions.leg == 3, 1e-12, 1.0)
    found = locate_platform(
        directions, wrong, B_RE, centre=0.0 * ends, transformation="points", weight=weight
    )
    assert off(found, 9) < 1e-9
    plain = locate_platform(directions, wrong, B_RE, centre=0.0 * ends, transformation="points")
    assert off(plain, 9) > 1e-3


def test_point_equality_is_the_default_and_the_literal_steps_are_as_printed() -> None:
    assert chosen_transformation(None, "default") == "points"
    assert chosen_transformation(None, "literal") == "cross_product"
    assert chosen_transformation("points", "literal") == "points"


@given(
    st.tuples(*[st.floats(-1.0, 1.0)] * 2),
    st.integers(0, 10**6),
)
@settings(max_examples=30, deadline=None)
def test_turns_of_an_axis_and_the_axis_after_them_undo_each_other(
    turns: tuple[float, float], seed: int
) -> None:
    nominal = np.random.default_rng(seed).standard_normal(3)
    nominal /= np.linalg.norm(nominal)
    axis = turned_axis(nominal, np.array(turns))
    assert np.linalg.norm(axis) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(turns_of(axis, nominal), turns, atol=1e-9)
    np.testing.assert_allclose(turns_of(-axis, nominal), turns, atol=1e-9)
    angle = np.arccos(np.clip(axis @ nominal, -1.0, 1.0))
    assert angle == pytest.approx(2.0 * np.arctan(0.5 * np.hypot(*turns)), abs=1e-7)
