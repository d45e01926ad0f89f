"""Axes on the platform, passive ends (19) and the closure, each by a second route."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine import Demand, Leg, LegKind, linearize
from legcal.paper.leg_demands import (
    closure_of_leg,
    fixed_on_platform,
    length_of_leg,
    revolute_on_platform,
    twist_of_leg,
)
from legcal.paper.motions import axis_frames, moved_points, turned_axis
from legcal.paper.platform_printed import fixed_direction, locate_passive_end, revolute_axis

KINDS = [("U", "U"), ("U", ""), ("R", "U"), ("U", "R"), ("R", "R")]


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def lines_through(P: Array, n: int, rng: np.random.Generator) -> tuple[Array, ...]:
    """Return u and A of lines that meet in a point P of a moving body, and its poses R, t."""
    R, t = Rotation.random(n, rng=rng).as_matrix(), rng.standard_normal((n, 3))
    u = unit(rng.standard_normal((n, 3)))
    end = np.einsum("nij,j->ni", R, P) + t
    return u, end - rng.uniform(0.3, 0.6, (n, 1)) * u, R, t


@given(st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_eq19_gives_the_point_in_which_the_axes_meet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P = rng.standard_normal(3)
    u, A, R, t = lines_through(P, 4, rng)
    found = locate_passive_end("strut", u, A, (R, t), np.zeros(3), np.arange(3))
    np.testing.assert_allclose(found, P, atol=1e-9)


def test_eq19_is_the_point_nearest_to_the_axes_in_the_platform() -> None:
    rng = np.random.default_rng(1)
    u, A, R, t = lines_through(np.array([0.1, 0.2, 0.3]), 6, rng)
    A = A + 0.01 * rng.standard_normal(A.shape)
    found = locate_passive_end("strut", u, A, (R, t), np.zeros(3), np.arange(3))
    right = np.concatenate([np.cross(d, a - s) for d, a, s in zip(u, A, t, strict=True)])
    # u x (R B + t - A) = 0 as (u x R) B = u x (A - t)
    crossed = np.concatenate([np.cross(d, r, axisb=0).T for d, r in zip(u, R, strict=True)])
    expected = np.linalg.lstsq(crossed, right, rcond=None)[0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_passive_leg_that_keeps_its_direction_in_the_platform_is_refused() -> None:
    rng = np.random.default_rng(2)
    P, w = np.array([0.1, 0.0, 0.2]), np.array([0.0, 0.0, 1.0])
    R, t = Rotation.random(5, rng=rng).as_matrix(), rng.standard_normal((5, 3))
    u = R @ w
    A = np.einsum("nij,j->ni", R, P) + t - 0.4 * u
    with pytest.raises(NotIdentifiable, match=r"leg strut .* two different directions"):
        locate_passive_end("strut", u, A, (R, t), np.zeros(3), np.arange(3))
    kept = np.array([9.0, 9.0, 0.7])
    found = locate_passive_end("centre", u, A, (R, t), kept, np.arange(2))
    np.testing.assert_allclose(found, [0.1, 0.0, 0.7], atol=1e-12)
    with pytest.raises(NotIdentifiable, match="found 1 pose of the platform that shows it"):
        locate_passive_end("strut", u[:1], A[:1], (R[:1], t[:1]), kept, np.arange(3))


@given(st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_a_revolute_axis_is_normal_to_all_directions_on_the_nominal_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    v = unit(rng.standard_normal(3))
    angle = rng.uniform(0.0, 2.0, 5)
    e1, e2 = normal_basis(v)
    u = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    nominal = unit(v + 0.3 * rng.standard_normal(3))
    found = revolute_axis("leg1", u, nominal)
    np.testing.assert_allclose(found, v * np.sign(v @ nominal), atol=1e-9)


@pytest.mark.parametrize(
    ("n", "words"),
    [(0, "no pose that shows its direction"), (1, "one direction in 1 pose"), (4, "in 4 poses")],
)
def test_one_direction_tells_no_revolute_axis(n: int, words: str) -> None:
    u = np.tile([0.0, 0.0, 1.0], (n, 1))
    with pytest.raises(NotIdentifiable, match=words):
        revolute_axis("leg1", u, np.array([1.0, 0.0, 0.0]))


def test_a_fixed_direction_is_the_mean_and_needs_a_pose() -> None:
    u = unit(np.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0]]))
    np.testing.assert_allclose(fixed_direction("centre", u), [0.0, 0.0, 1.0], atol=1e-12)
    with pytest.raises(NotIdentifiable, match="direction of leg centre in the platform"):
        fixed_direction("centre", u[:0])


def a_leg(base: str, platform: str, rng: np.random.Generator) -> Leg:
    """Return a leg with any axes and a twist that nothing meets."""
    assert base in ("R", "U")
    assert platform in ("R", "U", "")
    return Leg(
        "R" if base == "R" else "U",
        "R" if platform == "R" else "U" if platform == "U" else "",
        LegKind.ACTUATED,
        rng.standard_normal(3),
        rng.standard_normal(3),
        0.3,
        unit(rng.standard_normal(3)),
        unit(rng.standard_normal(3)),
        0.4,
    )


def frame_of(v: Array) -> Array:
    return np.asarray(axis_frames(v[None])[0])


def known_of(leg: Leg, R: Array, t: Array) -> tuple[Array, Array, Array, Array]:
    return np.array([0.0, 0.0, leg.B[2]]), R, t, leg.A


@pytest.mark.parametrize("joints", KINDS)
def test_demands_are_those_of_the_mechanism_at_poses_after_a_step(joints: tuple[str, str]) -> None:
    """z of B is held, and the pose is counted from another one."""
    rng = np.random.default_rng(3)
    leg = a_leg(*joints, rng)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.standard_normal(3)
    step = 0.1 * rng.standard_normal(6)
    points = np.column_stack([np.zeros(3), np.eye(3)])
    symbol = ca.SX.sym("step", 6)
    move = ca.Function(
        "move", [symbol], [moved_points(symbol, ca.SX(R), ca.SX(t), ca.SX(ca.DM(points)))]
    )
    placed = np.asarray(move(step).full())
    R_moved, t_moved = placed[:, 1:] - placed[:, :1], placed[:, 0]
    expected = dict(
        zip(leg.demands, linearize(leg, R_moved[None], t_moved[None]).values[0], strict=True)
    )
    local = np.concatenate([leg.B[:2], [0.0], step])
    known = known_of(leg, R, t)
    a, b = (frame_of(v) for v in (leg.base_axis, leg.platform_axis) if v is not None)
    length = length_of_leg()(np.append(local, leg.q0), *known, 0.0, 1.0)
    assert float(length) == pytest.approx(expected[Demand.LENGTH], abs=1e-12)
    none = np.zeros(2)
    x = np.concatenate([local, none, none, [0.0]])
    twist = twist_of_leg(*joints)(x, *known, a, b, 0.4, 1.0)
    assert float(twist) == pytest.approx(expected[Demand.TWIST], abs=1e-12)
    with_turns = np.concatenate([local, none])
    if joints[1] == "R":
        value = revolute_on_platform()(with_turns, *known, b, 1.0)
        assert float(value) == pytest.approx(expected[Demand.PLATFORM_AXIS], abs=1e-12)
    if joints[1] == "":
        both = fixed_on_platform()(with_turns, *known, b, 1.0).full().ravel()
        wanted = [expected[d] for d in (Demand.ALONG_1, Demand.ALONG_2)]
        assert both == pytest.approx(wanted, abs=1e-12)
    u = unit(R_moved @ leg.B + t_moved - leg.A)
    closure = closure_of_leg(*joints)(np.zeros(5), u, R_moved, a, b, 0.4, 0.5)
    assert float(closure) == pytest.approx(2.0 * expected[Demand.TWIST], abs=1e-12)


@pytest.mark.parametrize("joints", KINDS)
def test_the_twist_follows_all_its_unknowns_as_by_differences(joints: tuple[str, str]) -> None:
    rng = np.random.default_rng(4)
    leg = a_leg(*joints, rng)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.standard_normal(3)
    assert leg.base_axis is not None
    assert leg.platform_axis is not None
    given_ = (
        *known_of(leg, R, t),
        frame_of(leg.base_axis),
        frame_of(leg.platform_axis),
        0.4,
        1.0,
    )
    function = twist_of_leg(*joints)
    x = np.concatenate([leg.B, 0.1 * rng.standard_normal(11)])
    symbol = ca.SX.sym("x", 14)
    slope = ca.Function("slope", [symbol], [ca.jacobian(function(symbol, *given_), symbol)])
    J = slope(x).full().ravel()
    step = 1e-6
    for i in range(14):
        e = step * np.eye(14)[i]
        ahead, behind = (float(function(x + s * e, *given_)) for s in (1.0, -1.0))
        assert J[i] == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-7)


def test_turned_axes_inside_problems_are_those_of_results() -> None:
    rng = np.random.default_rng(5)
    v, turns = unit(rng.standard_normal(3)), np.array([0.3, -0.2])
    leg = Leg("S", "R", LegKind.ACTUATED, np.zeros(3), np.array([0.0, 0.0, 0.4]), 0.0)
    local = np.concatenate([leg.B, np.zeros(6), turns])
    known = (np.zeros(3), np.eye(3), np.zeros(3), leg.A)
    value = float(revolute_on_platform()(local, *known, frame_of(v), 1.0))
    axis = turned_axis(v, turns)
    assert value == pytest.approx(float(axis[2]), abs=1e-12)
