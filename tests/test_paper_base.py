"""Steps 1 and 2: base joints and axes in the cameras, (6) and (7), and in R_b, (8) and (9)."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from fit_sessions import PINHOLE
from hexapod_sessions import nominal_of
from scipy.spatial.transform import RigidTransform, Rotation
from staged_sessions import Observed, exact_session, made_up_base, noisy_session, seen_from, shipped

from legcal.data.axes import LegAxes
from legcal.data.measurements import Measurements, View
from legcal.errors import NotIdentifiable
from legcal.geometry.axes import turned_axis
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import JointType, Leg, LegKind
from legcal.paper import joints_in_camera
from legcal.paper.camera_poses import candidate_camera_poses
from legcal.paper.criteria import Criteria
from legcal.paper.four_steps import run_base_steps
from legcal.paper.joints_in_base import locate_joints_in_base
from legcal.paper.joints_in_camera import (
    joint_residuals,
    locate_joints_in_cameras,
    oriented,
    residual_jacobian,
)
from legcal.paper.leg_directions import directions_through_joints, observed_directions
from legcal.paper.nominal import NominalMachine
from legcal.simulation.observe import OutlineNoise

# Step 1: joints and axes in the cameras


def as_observed(seed: int, *, noise: OutlineNoise | None = None, n_poses: int = 6) -> Observed:
    """Return a hexapod of which every camera shows four legs; without noise an exact session."""
    if noise is None:
        session = exact_session(seed, n_poses=n_poses)
    else:
        session, _ = noisy_session(seed, noise, n_poses=n_poses)
    machine = nominal_of(session.machine)
    return Observed(machine, session.axes, session.measurements, machine.legs, session.T_camera_Rb)


@pytest.mark.parametrize("criteria", ["default", "literal"])
@pytest.mark.parametrize("name", ["hexapod", "3-rps", "3-rpr"])
def test_exact_axes_meet_in_the_joint_centre_and_are_normal_to_the_revolute_axis(
    name: str, criteria: Criteria
) -> None:
    observed = as_observed(0) if name == "hexapod" else shipped(name)
    joints = observed.run_base(criteria).in_cameras
    assert joints.located.sum() == (12 if name == "hexapod" else 9)
    assert joints.axis_located.all() == (name != "hexapod")
    for k, T in enumerate(observed.T_camera_Rb):
        there = joints.located[k]
        assert np.abs(joints.A_camera[k] - T.apply(observed.A_Rb))[there].max() < 1e-9
        if name != "hexapod":
            assert np.abs(joints.v_camera[k] - T.rotation.apply(observed.v_Rb)).max() < 1e-7


@pytest.mark.parametrize("name", ["hexapod", "3-rps", "3-rpr"])
def test_weights_make_joints_far_better_axes_no_worse_and_their_covariance_true(name: str) -> None:
    squares: dict[Criteria, list[Array]] = {"default": [], "literal": []}
    normalised = []
    for seed in range(6):
        observed = (
            as_observed(seed, noise=OutlineNoise(0.2, 100), n_poses=10)
            if name == "hexapod"
            else shipped(name, n_poses=10, noise=0.2, seed=seed)
        )
        for criteria, found in squares.items():
            joints = locate_joints_in_cameras(
                observed.nominal, observed.axes, observed.measurements, criteria=criteria
            )
            for k, j in np.argwhere(joints.located):
                T = observed.T_camera_Rb[k]
                error = joints.A_camera[k, j] - T.apply(observed.A_Rb[j])
                turns = np.zeros(0)
                if name != "hexapod":
                    v = T.rotation.apply(observed.v_Rb[j])
                    turns = normal_basis(joints.v_camera[k, j]) @ np.cross(v, joints.v_camera[k, j])
                found.append(np.array([error @ error, turns @ turns]))
                if criteria == "default":
                    both = np.concatenate([error, turns])
                    C = joints.covariance[k, j, : len(both), : len(both)]
                    normalised.append(both @ np.linalg.solve(C, both) / len(both))
    total = {criteria: np.sum(found, axis=0) for criteria, found in squares.items()}
    gain = total["default"] / np.maximum(total["literal"], 1e-30)
    assert gain[0] < (0.25 if name == "hexapod" else 0.05)
    assert gain[1] < 1.0
    assert 0.6 < np.mean(normalised) < 1.7  # 1 by rights; outlier weights cost a little


def test_all_legs_of_a_planar_machine_have_one_normal_in_a_view() -> None:
    joints = shipped("3-rpr", noise=0.3).run_base().in_cameras
    assert np.array_equal(joints.v_camera, joints.v_camera[:, :1] + np.zeros((1, 3, 1)))
    assert np.allclose(joints.covariance[:, :, 3:, 3:], joints.covariance[:, :1, 3:, 3:])


def test_a_wrong_outline_hardly_moves_the_centre() -> None:
    observed = as_observed(0, n_poses=10)
    M = observed.axes.M.copy()
    M[0] += 0.02 * observed.axes.basis[0].sum(axis=0)
    joints = replace(observed, axes=replace(observed.axes, M=M)).run_base().in_cameras
    A = np.array([T.apply(observed.A_Rb) for T in observed.T_camera_Rb])
    assert np.abs(joints.A_camera - A)[joints.located].max() < 2e-5


def test_weights_are_computed_again_until_joints_and_axes_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observed = shipped("3-rps", n_poses=10, noise=3.0, seed=1)
    inputs = observed.nominal, observed.axes, observed.measurements
    found = locate_joints_in_cameras(*inputs)
    monkeypatch.setattr(joints_in_camera, "MAX_REWEIGHTINGS", 1000)
    monkeypatch.setattr(joints_in_camera, "_CONVERGED", 1e-9)
    longer = locate_joints_in_cameras(*inputs)
    assert np.array_equal(found.axis_located, longer.axis_located)
    sigma = np.sqrt(np.einsum("vlii->vli", found.covariance))[found.axis_located]
    turn = np.cross(found.v_camera, longer.v_camera)[found.axis_located]
    move = (found.A_camera - longer.A_camera)[found.axis_located]
    assert np.linalg.norm(turn, axis=1).max() < 1e-4 * sigma[:, 3:].min()
    assert np.all(np.abs(move) < 1e-4 * sigma[:, :3])


def stopped(axes: LegAxes, rows: IntArray, size: float = 0.0) -> LegAxes:
    """Return axes of which some have the direction of their first, or nearly, and go through A."""
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    u[rows] = axes.u[rows[0]] + size * (axes.u[rows] - axes.u[rows[0]])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    if size == 0.0:
        M[rows], basis[rows] = M[rows[0]], basis[rows[0]]
    return replace(axes, u=u, M=M, basis=basis if size == 0.0 else normal_basis(u))


def test_joints_and_axes_that_a_view_leaves_open_are_left_out_of_it_with_the_reason() -> None:
    hexapod, tripod = as_observed(0), shipped("3-rps")

    def rows(observed: Observed, view: int, leg: int) -> IntArray:
        here = observed.measurements.view[observed.axes.row] == view
        return np.flatnonzero(here & (observed.axes.leg == leg))

    once = np.setdiff1d(np.arange(len(hexapod.axes)), rows(hexapod, 0, 2)[1:])
    still = stopped(tripod.axes, rows(tripod, 1, 0))
    coarse = replace(tripod.axes, covariance=30.0**2 * tripod.axes.covariance)
    for observed, axes, words in (
        (hexapod, hexapod.axes.choose(once), ("leg3 in view c1", "found in one image")),
        (tripod, still, ("leg1 in view c2", "same in all")),
        (tripod, coarse, ("revolute axis of leg leg", "deg)")),
    ):
        joints = locate_joints_in_cameras(observed.nominal, axes, observed.measurements)
        assert any(all(word in d for word in words) for d in joints.diagnostics)
        if axes is not coarse:
            assert len(joints.diagnostics) == 1
            base = replace(observed, axes=axes).run_base()
            assert np.abs(base.A_Rb - observed.A_Rb).max() < 1e-7


@pytest.mark.parametrize(("name", "noise"), [("3-rpr", 10.0), ("3-rps", 30.0)])
def test_legs_that_say_nothing_of_their_joint_do_not_stop_the_others(
    name: str, noise: float
) -> None:
    observed = shipped(name, n_poses=10, noise=noise, seed=3)
    joints = locate_joints_in_cameras(observed.nominal, observed.axes, observed.measurements)
    assert not joints.located.all()
    assert joints.located.any(axis=0).all()
    assert np.all(np.isfinite(joints.A_camera))
    assert np.all(np.isfinite(joints.covariance))


@pytest.mark.parametrize(
    ("size", "criteria", "words"),
    [
        (0.0, "default", "same in all 6 images"),
        (0.0, "literal", "same in all 6 images"),
        (2e-4, "default", "directions differ too little"),
        (None, "default", "found no view"),
    ],
)
def test_a_leg_that_no_view_locates_is_refused_by_name(
    size: float | None, criteria: Criteria, words: str
) -> None:
    observed = as_observed(0)
    axes, view = observed.axes, observed.measurements.view[observed.axes.row]
    if size is None:
        axes = axes.choose(np.flatnonzero(axes.leg != 4))
    else:
        for v in (1, 2):
            axes = stopped(axes, np.flatnonzero((axes.leg == 4) & (view == v)), size)
    with pytest.raises(NotIdentifiable, match="leg leg5 could not be located") as refusal:
        replace(observed, axes=axes).run_base(criteria)
    assert words in str(refusal.value)


def test_the_jacobian_of_axes_about_a_joint_is_that_of_differences() -> None:
    axes = shipped("3-rps").axes
    here, h = np.arange(len(axes)), 1e-6
    rng = np.random.default_rng(0)
    A = axes.M + 0.1 * rng.normal(size=axes.M.shape)
    v = np.cross(axes.u, rng.normal(size=axes.u.shape))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    found = residual_jacobian(axes, here, v, np.zeros((len(axes), 2)))
    for k, e in enumerate(h * np.eye(5)):
        turns = np.tile(e[3:], (len(axes), 1))
        ahead, behind = (
            joint_residuals(axes, here, A + s * e[:3], turned_axis(v, s * turns))[0]
            for s in (1.0, -1.0)
        )
        assert np.allclose((ahead - behind) / (2.0 * h), found[:, :, k], atol=1e-8)


@pytest.mark.parametrize("name", ["hexapod", "3-rps", "3-rpr"])
def test_directions_through_joints_are_better_than_those_of_single_images(name: str) -> None:
    observed = (
        as_observed(1, noise=OutlineNoise(0.2, 100), n_poses=10)
        if name == "hexapod"
        else shipped(name, n_poses=10, noise=0.3)
    )
    axes, m, base = observed.axes, observed.measurements, observed.run_base()
    R = np.array([T.rotation.inv().as_matrix() for T in observed.T_camera_Rb])
    single = observed_directions(axes, m, observed.nominal, base.in_cameras)
    better = directions_through_joints(axes, m, base)
    turned_to_base = np.einsum("nij,nj->ni", R[single.view], single.u)
    B = np.array([leg.B for leg in observed.true_legs])
    errors = []
    for directions, u in ((single, turned_to_base), (better, better.u)):
        # Ends of legs of one pose are as far apart as platform joints.
        ends = (
            observed.A_Rb[directions.leg]
            + (
                directions.reading
                + np.array([leg.q0 for leg in observed.true_legs])[directions.leg]
            )[:, None]
            * u
        )
        error = []
        for rows in directions.groups():
            for a, b in pairwise(rows):
                apart = np.linalg.norm(B[directions.leg[a]] - B[directions.leg[b]])
                error.append(np.linalg.norm(ends[a] - ends[b]) - apart)
        errors.append(np.std(error))
    assert errors[1] < 0.5 * errors[0]
    assert np.all(np.linalg.eigvalsh(better.covariance)[:, 0] > 0.0)
    if name != "hexapod":
        off = [
            np.std(np.sum(u * observed.v_Rb[d.leg], axis=1))
            for d, u in ((single, turned_to_base), (better, better.u))
        ]
        assert off[1] < 0.7 * off[0]


# Step 2: a made-up base before cameras anywhere

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
ACROSS = np.array([[0.3, 1.0, 0.0], [-0.2, 1.0, 0.1], [1.0, 0.2, 0.0], [0.1, 0.4, 1.0]])
ACROSS /= np.linalg.norm(ACROSS, axis=1, keepdims=True)
SYMMETRIC = np.array([[1.0, -1.0, 0.0], [1.0, 1.0, 0.0]] * 2) / np.sqrt(2.0)
ALL = (0, 1, 2, 3)
Views = Sequence[tuple[int, ...]]


def legs_seen(views: Views, n_legs: int = 4) -> BoolArray:
    seen = np.zeros((len(views), n_legs), dtype=np.bool_)
    for row, legs in zip(seen, views, strict=True):
        row[list(legs)] = True
    return seen


def away(A_Rb: Array, v_Rb: Array, seed: int = 0) -> tuple[Array, Array]:
    """Return joints 3 mm and axes 1 degree off; R_b is still on the first three joints."""
    rng = np.random.default_rng(seed)
    step = 0.003 * rng.choice([-1.0, 1.0], A_Rb.shape)
    step[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] = 0.0
    turn = np.deg2rad(1.0) * normal_basis(v_Rb)[:, 0]
    return A_Rb + step, Rotation.from_rotvec(turn).apply(v_Rb)


@pytest.mark.parametrize(
    ("A", "v", "views", "placed"),
    [
        (SQUARE, ACROSS, [(0, 1), (1, 2), (2, 3), (3, 0)], "yyyy"),
        # Half a turn about the line of opposite legs lays joints and axes, as lines, on themselves.
        ((SQUARE, 3), SYMMETRIC, [ALL, (0, 2), (1, 3)], "yy?"),
        (SQUARE, SYMMETRIC, [ALL, (0, 2)], "yn"),
        (SQUARE, SYMMETRIC, [*[(0, 2)] * 6, ALL], "??????y"),
        (SQUARE, np.tile([1.0, 0.0, 0.0], (4, 1)), [ALL, (0, 1)], "yn"),  # axes along the line
        (SQUARE[[0, 1, 2, 2]], np.full((4, 3), np.nan), [ALL, (2, 3)], "yn"),  # joints in one place
    ],
    ids=["pairs", "symmetric", "alike", "several alike", "along", "one place"],
)
def test_axes_across_the_line_of_two_joints_place_a_camera_unless_two_places_fit_alike(
    A: Array | tuple[Array, int], v: Array, views: Views, placed: str
) -> None:
    if isinstance(A, tuple):  # the nominal base is the symmetric one
        nominal, (true_A, true_v) = made_up_base(A[0], v), away(A[0], v, seed=A[1])
    else:
        true_A, true_v = A, v
        nominal = made_up_base(*(away(A, v) if np.isfinite(v).all() else (A, v)))
    joints, cameras = seen_from(true_A, true_v, legs_seen(views), sigma=1e-5)
    base = locate_joints_in_base(nominal, joints)
    assert np.abs(base.A_Rb - true_A).max() < 1e-8
    if np.isfinite(v).all():
        assert np.abs(base.base_axes - true_v).max() < 1e-7
    for T, true, expected in zip(base.T_Rb_camera, cameras, placed, strict=True):
        assert expected == "?" or (T is not None) == (expected == "y")
        assert T is None or (T.inv() * true).rotation.magnitude() < 1e-7
        assert T is None or np.linalg.norm((T.inv() * true).translation) < 1e-7


def test_opposite_legs_of_a_symmetric_base_leave_two_candidates_of_a_camera() -> None:
    A, v = SQUARE[[0, 2]], SYMMETRIC[[0, 2]]
    poses, fixed = candidate_camera_poses(A, v, A, v)
    assert (len(poses), fixed) == (2, True)


def test_axes_take_the_side_of_the_nominal_ones_whatever_their_signs_were() -> None:
    seen = legs_seen([ALL, (0, 1), (2, 3)])
    joints, cameras = seen_from(SQUARE, ACROSS, seen)
    found = oriented(made_up_base(*away(SQUARE, ACROSS)), joints)
    for v, T in enumerate(cameras):
        expected = T.rotation.inv().apply(ACROSS)[seen[v]]
        assert np.allclose(found.v_camera[v, seen[v]], expected, atol=1e-12)
    assert np.any(found.v_camera != joints.v_camera)


def test_the_covariance_turns_with_the_sign_of_an_axis() -> None:
    observed = shipped("3-rps", noise=0.3)
    legs = tuple(
        replace(leg, base_axis=-axis)
        for leg, axis in zip(observed.nominal.legs, observed.nominal.base_axes, strict=True)
    )
    other = replace(observed, nominal=replace(observed.nominal, legs=legs))
    first, second = observed.run_base(), other.run_base()
    assert np.allclose(first.A_Rb, second.A_Rb, atol=1e-9)
    assert np.allclose(first.base_axes, -second.base_axes, atol=1e-8)
    assert np.allclose(first.axis_covariance, second.axis_covariance, rtol=1e-5, atol=0.0)


def test_the_covariance_of_axes_agrees_with_monte_carlo() -> None:
    seen, nominal = legs_seen([(0, 1, 2), (1, 2, 3), (0, 3)]), made_up_base(SQUARE, ACROSS)
    normalised = []
    for seed in range(20):
        joints, _ = seen_from(SQUARE, ACROSS, seen, sigma=1e-3, seed=seed)
        base = locate_joints_in_base(nominal, joints)
        for axis, v, C in zip(base.base_axes, ACROSS, base.axis_covariance, strict=True):
            e = normal_basis(v)
            turned_by = e @ axis
            normalised.append(turned_by @ np.linalg.solve(e @ C @ e.T, turned_by))
    assert np.mean(normalised) == pytest.approx(2.0, rel=0.3)


@pytest.mark.parametrize(
    ("views", "axes_left_out", "criteria", "words"),
    [
        ([ALL, (0, 1, 2)], [(0, 2), (1, 2)], "default", ("leg3 can turn", "axes: 3, 2")),
        ([ALL, (2,)], [(0, 2)], "literal", ("locates the revolute axes of leg3 together",)),
        (
            [(0, 1, 2), (2,), (3,)],
            [],
            "default",
            ("leg4 can move", "axes of leg4 can turn", "across the line", "calibration board"),
        ),
        ([(0,), (1,), (2,)], [], "default", ("by view: 1, 1, 1",)),
    ],
)
def test_joints_and_axes_that_views_do_not_tie_together_are_refused_by_name(
    views: Views, axes_left_out: list[tuple[int, int]], criteria: Criteria, words: tuple[str, ...]
) -> None:
    joints, _ = seen_from(SQUARE, ACROSS, legs_seen(views))
    axis_located = joints.axis_located.copy()
    for view, leg in axes_left_out:
        axis_located[view, leg] = False
    with pytest.raises(NotIdentifiable) as refusal:
        locate_joints_in_base(
            made_up_base(SQUARE, ACROSS),
            replace(joints, axis_located=axis_located),
            criteria=criteria,
        )
    assert all(word in str(refusal.value) for word in words)


def test_joints_known_worse_than_the_size_of_the_base_are_refused() -> None:
    seen, nominal = legs_seen([ALL, ALL]), made_up_base(SQUARE, ACROSS)
    locate_joints_in_base(nominal, seen_from(SQUARE, ACROSS, seen, sigma=0.1)[0])
    with pytest.raises(NotIdentifiable, match="can move"):
        locate_joints_in_base(nominal, seen_from(SQUARE, ACROSS, seen, sigma=5.0)[0])


# Step 2: what cameras show of hexapods


@pytest.mark.parametrize(
    ("legs", "criteria", "words"),
    [
        # (12) counts enough, but leg 6 hangs on one distance
        (((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (4, 5)), "default", ("leg6 can move", "5, 5, 2")),
        (((0, 1), (2, 3), (4, 5)), "default", ("could not be tied together", "2, 2, 2")),
        (((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (5,)), "literal", ("base joints of leg6", "5, 5, 1")),
        (((0, 1), (2, 3), (4, 5)), "literal", ("3 scalar products", "12 unknowns", "2, 2, 2")),
    ],
)
def test_views_that_share_too_few_legs_are_refused(
    legs: tuple[tuple[int, ...], ...], criteria: Criteria, words: tuple[str, ...]
) -> None:
    session = exact_session(legs=legs)
    with pytest.raises(NotIdentifiable) as refusal:
        run_base_steps(
            nominal_of(session.machine), session.axes, session.measurements, criteria=criteria
        )
    assert all(word in str(refusal.value) for word in words)


def test_a_view_of_two_joints_gives_their_distance_and_no_camera() -> None:
    session = exact_session(legs=((0, 1, 2, 3, 4), (0, 2, 4, 5), (1, 5)))
    nominal = nominal_of(session.machine)
    A = nominal.parameters.base_joints
    lifted = [leg.A + np.array([0.0, 0.0, 0.003 * (j % 2)]) for j, leg in enumerate(nominal.legs)]
    moved = [replace(leg, A=A) for leg, A in zip(nominal.legs, lifted, strict=True)]
    base = run_base_steps(replace(nominal, legs=tuple(moved)), session.axes, session.measurements)
    assert np.abs(base.A_Rb - A).max() < 1e-9
    assert [T is None for T in base.T_Rb_camera] == [False, False, True]


# A plane


def test_two_joints_of_a_plane_take_their_side_from_the_lengths_of_legs() -> None:
    observed = shipped("3-rpr")
    axes, view = observed.axes, observed.measurements.view[observed.axes.row]
    some = axes.choose(np.flatnonzero((view > 0) | (axes.leg < 2)))
    base = replace(observed, axes=some).run_base()
    assert base.in_cameras.sided.tolist() == [True, False, False]  # the others see three joints
    for T, true in zip(base.T_Rb_camera, observed.T_camera_Rb, strict=True):
        assert T is not None
        assert (T * true).rotation.magnitude() < 1e-7


def plane_with_joints_on_a_line(A: Array, B: Array, nominal_A: Array) -> Observed:
    """Return a 3-RPR whose base joints are nearly collinear, seen from both sides."""
    rng = np.random.default_rng(0)
    rows = np.arange(12)
    R = Rotation.from_rotvec(np.outer(rng.uniform(-0.4, 0.4, 12), [0.0, 0.0, 1.0])).as_matrix()
    t = np.column_stack([rng.uniform(0.2, 0.5, (12, 2)), np.zeros(12)])
    legs = np.einsum("nij,kj->nki", R, B) + t[:, None] - A
    length = np.linalg.norm(legs, axis=2)
    view, leg = rows // 6, np.tile(np.arange(3), 12)
    T = [
        RigidTransform.from_components([-0.4, 0.2, 1.5], Rotation.from_rotvec([2.8, 0.3, 0.1])),
        RigidTransform.from_components([-0.4, -0.3, 1.4], Rotation.from_rotvec([-0.3, 0.1, 0.4])),
    ]
    u, M = legs / length[..., None], np.broadcast_to(A, legs.shape)
    u = np.array([T[v].rotation.apply(d) for v, d in zip(view, u, strict=True)]).reshape(-1, 3)
    M = np.array([T[v].apply(p) for v, p in zip(view, M, strict=True)]).reshape(-1, 3)
    covariance = np.tile(np.diag([1e-6, 1e-6, 1e-8, 1e-8]), (36, 1, 1))
    nominal, true = (
        tuple(
            Leg(JointType("R"), JointType("R"), LegKind.ACTUATED, a, b, 0.1)
            for a, b in zip(P, B, strict=True)
        )
        for P in (nominal_A, A)
    )
    return Observed(
        NominalMachine(("leg1", "leg2", "leg3"), nominal, (0, 1)),
        LegAxes(np.repeat(rows, 3), leg, u, M, normal_basis(u), covariance),
        Measurements(
            (View("c1", PINHOLE), View("c2", PINHOLE)), ("",) * 12, view, rows, length - 0.1, 2e-6
        ),
        true,
        tuple(T),
    )


@pytest.mark.parametrize(("height", "tip"), [(0.002, 0.15), (0.0, 0.0)])
def test_collinear_joints_of_a_plane_take_their_side_from_the_platform_if_it_has_one(
    height: float, tip: float
) -> None:
    A = np.array([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.4, height, 0.0]])
    B = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.1, tip, 0.0]])
    step = np.array([[0.0, 0.0, 0.0], [3e-3, 0.0, 0.0], [0.0, -3e-3, 0.0]])
    if tip == 0.0:  # nothing tells left from right
        with pytest.raises(NotIdentifiable, match="those of leg3 can move"):
            plane_with_joints_on_a_line(A, B, A).run_base()
        return
    base = plane_with_joints_on_a_line(A, B, A + step).run_base()
    assert base.in_cameras.sided.all()
    assert np.abs(base.A_Rb - A).max() < 1e-8
    assert all(T is not None for T in base.T_Rb_camera)


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_heights_of_a_plane_stay_nominal(criteria: Criteria) -> None:
    observed = shipped("3-rpr")
    heights = np.array([0.0, 0.05, -0.03])
    M, view = observed.axes.M.copy(), observed.measurements.view[observed.axes.row]
    up = np.array([T.rotation.apply([0.0, 0.0, 1.0]) for T in observed.T_camera_Rb])
    M += heights[observed.axes.leg, None] * up[view]
    legs = tuple(
        replace(leg, A=leg.A + np.array([0.0, 0.0, z]))
        for leg, z in zip(observed.nominal.legs, heights, strict=True)
    )
    nominal = replace(observed.nominal, legs=legs)
    base = replace(observed, nominal=nominal, axes=replace(observed.axes, M=M)).run_base(criteria)
    assert np.allclose(base.A_Rb[:, 2], heights, rtol=0.0, atol=1e-15)
    assert np.abs(base.A_Rb[:, :2] - observed.A_Rb[:, :2]).max() < 1e-8
