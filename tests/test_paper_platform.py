"""Steps 3 and 4: offsets (13), (14), joints and axes on the platform (16) to (19), closures."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hexapod_sessions import nominal_of
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import closed_leg
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation
from staged_sessions import (
    exact_session,
    five_millimetres_away,
    noisy_session,
    planned,
    shipped,
    staged,
)

from legcal.calibration.identify.predicted_observations import planned_observations
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.machine.equations import leg_equations
from legcal.machine.leg import EquationKind, LegKind
from legcal.machine.loader import load_mechanism
from legcal.paper import platform
from legcal.paper.criteria import Transformation
from legcal.paper.four_steps import run_base_steps, run_platform_steps, run_steps
from legcal.paper.gibbs import axis_frames, motion_after
from legcal.paper.least_squares import IpoptSolution, LeastSquares, solve_least_squares
from legcal.paper.leg_directions import LegDirections, directions_through_joints
from legcal.paper.leg_equations import (
    N_UNKNOWNS,
    closure_of_leg,
    constraint_of_leg,
    direction_of_leg,
    length_of_leg,
)
from legcal.paper.offsets import (
    distance_sigma,
    identify_offsets,
    leg_end_covariance,
    leg_ends,
)
from legcal.paper.platform import locate_platform_joints
from legcal.paper.platform_pose import PlatformPoses, locate_platform, register_by_rays
from legcal.paper.platform_printed import fixed_direction, locate_passive_end, revolute_axis
from legcal.simulation.observe import OutlineNoise

TRANSFORMATIONS: tuple[Transformation, ...] = ("points", "cross_product")


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


# Which legs and images take part


def test_a_motor_that_counts_backwards_changes_nothing() -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=8)
    sign = np.array([1, -1, 1, -1, -1, 1])
    backwards = replace(
        session, measurements=replace(session.measurements, q=session.measurements.q * sign)
    )
    legs = tuple(replace(leg, sign=s) for leg, s in zip(nominal.legs, sign.tolist(), strict=True))
    turned = replace(nominal, legs=legs)
    forth = run_steps(nominal, session.axes, session.measurements)
    back = run_steps(turned, backwards.axes, backwards.measurements)
    assert np.allclose(back.parameters.offsets, forth.parameters.offsets, rtol=0.0, atol=1e-12)


def test_poses_that_show_two_legs_or_one_take_part() -> None:
    session = exact_session(n_poses=8)
    axes = session.axes
    two = (axes.row % 8 == 0) & ~np.isin(axes.leg, (0, 3, 4))
    one = (axes.row % 8 == 1) & ~np.isin(axes.leg, (0, 3))
    some = replace(session, axes=axes.choose(np.flatnonzero(~two & ~one)))
    assert set(np.bincount(some.axes.row).tolist()) >= {2, 4}
    found = staged(some, five_millimetres_away(session.machine)).parameters
    true = session.machine.parameters
    assert np.abs(found.platform_joints - true.platform_joints).max() < 1e-9


def test_a_leg_fixed_to_the_platform_has_no_distance_to_others() -> None:
    observed = shipped("tricept")
    legs = list(observed.nominal.legs)
    legs[3] = replace(legs[3], kind=LegKind.ACTUATED, q0=0.1)
    q = np.where(np.isnan(observed.measurements.q), 0.4, observed.measurements.q)
    observed = replace(
        observed,
        nominal=replace(observed.nominal, legs=tuple(legs)),
        measurements=replace(observed.measurements, q=q),
    )
    directions = directions_through_joints(
        observed.axes, observed.measurements, observed.run_base()
    )
    q0 = identify_offsets(observed.nominal, directions, 2e-6).parameters.offsets
    assert q0[3] == 0.1
    assert np.abs(q0[:3] - [leg.q0 for leg in observed.true_legs[:3]]).max() < 1e-9


def test_the_covariance_of_leg_ends_follows_directions_and_readings() -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=8)
    base = run_base_steps(nominal, session.axes, session.measurements)
    directions = directions_through_joints(session.axes, session.measurements, base)
    q0, sigma_q, h = base.machine.parameters.offsets, 1e-3, 1e-6
    u, e = directions.u, np.swapaxes(directions.basis, 0, 1)
    ahead = [replace(directions, u=u + h * each) for each in e]
    ahead.append(replace(directions, reading=directions.reading + h))
    J = np.stack([leg_ends(d, q0) - leg_ends(directions, q0) for d in ahead], axis=2) / h
    C = np.zeros((len(u), 3, 3))
    C[:, :2, :2], C[:, 2, 2] = directions.covariance, sigma_q**2
    found = leg_end_covariance(directions, q0, sigma_q)
    np.testing.assert_allclose(found, J @ C @ np.swapaxes(J, 1, 2), rtol=1e-6, atol=1e-12)
    pairs = np.array([[0, 1], [2, 5]])
    ends = leg_ends(directions, q0)
    n = unit(ends[pairs[:, 0]] - ends[pairs[:, 1]])
    variance = np.einsum("ni,nij,nj->n", n, found[pairs].sum(axis=1), n)
    np.testing.assert_allclose(distance_sigma(ends, found, pairs), np.sqrt(variance), rtol=1e-9)


def test_step_4_corrects_offsets_that_step_3_left_wrong() -> None:
    session = exact_session()
    machine = nominal_of(session.machine)
    base = run_base_steps(machine, session.axes, session.measurements)
    directions = directions_through_joints(session.axes, session.measurements, base)
    wrong = tuple(replace(leg, q0=leg.q0 + 0.002) for leg in base.machine.legs)
    found, _ = locate_platform_joints(replace(base.machine, legs=wrong), base, directions, 2e-6)
    assert np.abs(found.parameters.offsets - machine.parameters.offsets).max() < 1e-9


@pytest.mark.parametrize(
    ("kept", "literal", "words"),
    [
        # leg 5 is never seen without it
        ("leg 6 alone", False, ("fixes that of leg5, leg6",)),
        ("leg 1", False, ("no image shows two legs",)),
        ("first image of each view", True, ("no view shows the same two legs in two images",)),
        ("leg 6 in one image", False, ("fixes that of leg6", "(leg6 ", " in 1 pose)")),
        ("legs 1 and 2, parallel", True, ("leg1 hardly turns against", "in 6 poses")),
        ("legs 1 and 2, one end", False, ("end in different places of it",)),
    ],
)
def test_offsets_that_no_distance_fixes_are_refused_by_leg_with_what_was_seen(
    kept: str, literal: bool, words: tuple[str, ...]
) -> None:
    session = exact_session()
    axes, m, machine = session.axes, session.measurements, nominal_of(session.machine)
    base = run_base_steps(machine, axes, m)
    leg, row, view = axes.leg, axes.row, m.view[axes.row]
    with_leg_6 = np.isin(row, row[leg == 5])
    first = [np.flatnonzero(m.view == v)[0] for v in range(3)]
    keep = {
        "leg 6 alone": ~with_leg_6 | (leg == 5),
        "leg 1": leg == 0,
        "first image of each view": np.isin(row, first),
        "leg 6 in one image": (leg != 5) | (row == row[leg == 5][0]),
    }.get(kept, (view == 0) & np.isin(leg, (0, 1)))
    axes = axes.choose(np.flatnonzero(keep))
    if kept.endswith("parallel"):
        u = np.repeat(axes.u[::2], 2, axis=0)
        axes = replace(axes, u=u, basis=normal_basis(u))
    if kept.endswith("one end"):
        legs = list(base.machine.legs)
        legs[1] = replace(legs[1], B=legs[0].B)
        base = replace(base, machine=replace(base.machine, legs=tuple(legs)))
    with pytest.raises(NotIdentifiable) as refusal:
        run_platform_steps(base, axes, m, criteria="literal" if literal else "default")
    assert all(word in str(refusal.value) for word in words)


@pytest.mark.parametrize(
    ("legs", "words"), [((0,), "no pose shows two legs at once"), ((4, 5), "leg6")]
)
def test_platform_joints_that_images_do_not_tie_together_are_refused(
    legs: tuple[int, ...], words: str
) -> None:
    session = exact_session()
    m, machine = session.measurements, nominal_of(session.machine)
    base = run_base_steps(machine, session.axes, m)
    leg, row = session.axes.leg, session.axes.row
    shown = np.isin(leg, legs) | ((5 in legs) & ~np.isin(row, row[leg == 5]))
    axes = session.axes.choose(np.flatnonzero(shown))
    with pytest.raises(NotIdentifiable, match=words):
        locate_platform_joints(machine, base, directions_through_joints(axes, m, base), 2e-6)


def test_axes_that_no_three_legs_at_once_show_are_refused_in_geometric_words() -> None:
    machine = load_mechanism("3-spr")
    session = planned_observations(machine, ((0, 1), (1, 2), (0, 2)), 8)
    observed = planned(session)
    with pytest.raises(NotIdentifiable, match="no pose shows three legs of known length at once"):
        observed.run("literal")
    words = r"angle \d of platform axis of leg \d can change without any image noticing"
    with pytest.raises(NotIdentifiable, match=words):
        observed.run()


def test_axes_stay_near_nominal_where_step_4_does_not_converge_without_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = list[int]()

    def fails_once(problem: LeastSquares) -> IpoptSolution:
        calls.append(len(problem.terms))
        if len(calls) == 2:
            raise DidNotConverge("The platform joints (step 4) could not be computed.")
        return solve_least_squares(problem)

    observed = shipped("3-upu-tilted")
    monkeypatch.setattr(platform, "solve_least_squares", fails_once)
    found = observed.run()
    assert found.diagnostics == (platform.NEAR_NOMINAL,)
    assert calls == [calls[0], calls[0] - 1, calls[0]]
    error, before = (
        observed.errors(legs)[observed.is_angle] for legs in (found.legs, observed.nominal.legs)
    )
    assert np.linalg.norm(error) < np.linalg.norm(before)


# Eq (18)

B_RE = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.1, 0.25, 0.0], [0.2, 0.1, 0.05]])


def poses(seed: int, n: int = 3) -> list[RigidTransform]:
    rng = np.random.default_rng(seed)
    return [
        RigidTransform.from_components(
            np.array([0.1, -0.1, 1.2]) + rng.uniform(-0.1, 0.1, 3),
            Rotation.from_rotvec(rng.uniform(-1.0, 1.0, 3)),
        )
        for _ in range(n)
    ]


def located(
    ends: Array,
    how: Transformation = "points",
    *,
    B_Re: Array = B_RE,
    centre: Array | None = None,
    weight: Array | None = None,
    on_a_line: bool = False,
) -> PlatformPoses:
    """Locate platforms by ends (n_poses, n_legs, 3)."""
    n_poses, n_legs, _ = ends.shape
    leg: IntArray = np.tile(np.arange(n_legs), n_poses)
    group = np.repeat(np.arange(n_poses), n_legs)
    n, nothing = len(leg), np.zeros((len(leg), 3))
    directions = LegDirections(
        group,
        0 * group,
        leg,
        nothing,
        nothing,
        np.zeros((n, 2, 3)),
        np.zeros((n, 2, 2)),
        np.zeros(n),
        np.zeros(n),
        np.tile(np.eye(3), (n, 1, 1)),
    )
    return locate_platform(
        directions,
        ends.reshape(-1, 3),
        B_Re,
        centre=nothing if centre is None else np.tile(centre, (n, 1)),
        transformation=how,
        weight=weight,
        on_a_line=on_a_line,
    )


def off(found: PlatformPoses, true: list[RigidTransform]) -> float:
    """Return how far poses are from the true ones, rotation or position."""
    R, t = np.array([T.rotation.as_matrix() for T in true]), [T.translation for T in true]
    return max(float(np.abs(found.R - R).max()), float(np.abs(found.t - t).max()))


@pytest.mark.parametrize("how", TRANSFORMATIONS)
def test_exact_ends_give_the_platform(how: Transformation) -> None:
    for seed in range(3):
        true = poses(seed)
        assert off(located(np.array([T.apply(B_RE) for T in true]), how), true) < 1e-9


def test_as_printed_18_uses_rays_from_the_camera_and_not_the_distance_of_an_end() -> None:
    true = poses(1)
    ends = np.array([T.apply(B_RE) for T in true])
    wrong = ends * (1.0 + 0.02 * np.random.default_rng(0).standard_normal((*ends.shape[:2], 1)))
    assert off(located(wrong), true) > 1e-3
    assert off(located(wrong, "cross_product"), true) < 1e-7
    T = RigidTransform.from_components([0.4, -0.3, 0.2], Rotation.from_rotvec([0.3, -0.2, 0.5]))
    elsewhere = np.array([T.apply(e) for e in wrong])
    there = located(elsewhere, "cross_product", centre=np.asarray(T.translation))
    assert off(there, [T * each for each in true]) < 1e-7


def test_as_printed_18_is_what_another_solver_finds_of_noisy_ends() -> None:
    true = poses(3)
    rng = np.random.default_rng(0)
    ends = np.array([T.apply(B_RE) for T in true]) + 0.01 * rng.standard_normal((3, 4, 3))
    found = located(ends, "cross_product")

    def residuals(x: Array, k: int) -> Array:
        placed = Rotation.from_rotvec(x[:3]).apply(B_RE) + x[3:]
        return np.cross(placed, ends[k]).ravel()

    for k, T in enumerate(true):
        start = np.concatenate([T.rotation.as_rotvec(), T.translation])
        other = least_squares(residuals, start, args=(k,), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        assert np.abs(found.R[k] - Rotation.from_rotvec(other[:3]).as_matrix()).max() < 1e-5
        assert np.abs(found.t[k] - other[3:]).max() < 1e-5


def test_a_camera_is_placed_by_the_rays_to_the_base_joints() -> None:
    T = poses(6)[0]
    start = motion_after(np.array([0.01, -0.02, 0.01, 0.02, 0.01, -0.02]), T)
    found = register_by_rays(B_RE, T.apply(B_RE), start)
    assert np.abs(found.as_matrix() - T.as_matrix()).max() < 1e-9
    assert np.abs(start.as_matrix() - T.as_matrix()).max() > 0.01


def test_ends_locate_a_platform_where_three_that_are_known_are_on_no_line() -> None:
    ends = np.array([T.apply(B_RE) for T in poses(7)])
    ends[:, 3] = np.nan
    ends[0, :2] = np.nan
    found = located(ends)
    assert found.pose.tolist() == [-1] * 4 + [0] * 4 + [1] * 4
    assert len(found.R) == 2
    line = B_RE[:3].copy()
    line[2] = [0.15, 0.0, 0.0]
    assert not len(located(ends[:, :3], B_Re=line).R)
    assert len(located(ends[:, :3], B_Re=line, on_a_line=True).R)


def test_weights_decide_between_ends_that_disagree() -> None:
    true = poses(9)
    ends = np.array([T.apply(B_RE) for T in true])
    ends[:, 3] += 0.05
    weight = np.tile([1.0, 1.0, 1.0, 1e-12], 3)
    assert off(located(ends, weight=weight), true) < 1e-9
    assert off(located(ends), true) > 1e-3


# Axes on the platform and passive ends (19)


def lines_through(P: Array, n: int, rng: np.random.Generator) -> tuple[Array, ...]:
    """Return u and A of lines that meet in a point P of a moving body, and its poses R, t."""
    R, t = Rotation.random(n, rng=rng).as_matrix(), rng.standard_normal((n, 3))
    u = unit(rng.standard_normal((n, 3)))
    end = np.einsum("nij,j->ni", R, P) + t
    return u, end - rng.uniform(0.3, 0.6, (n, 1)) * u, R, t


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_eq19_is_the_point_nearest_to_the_axes_in_the_platform(noise: float) -> None:
    rng = np.random.default_rng(1)
    P = rng.standard_normal(3)
    u, A, R, t = lines_through(P, 6, rng)
    A = A + noise * rng.standard_normal(A.shape)
    found = locate_passive_end("strut", u, A, (R, t), np.zeros(3), np.arange(3))
    # u x (R B + t - A) = 0 as (u x R) B = u x (A - t)
    right = np.concatenate([np.cross(d, a - s) for d, a, s in zip(u, A, t, strict=True)])
    crossed = np.concatenate([np.cross(d, r, axisb=0).T for d, r in zip(u, R, strict=True)])
    np.testing.assert_allclose(found, np.linalg.lstsq(crossed, right, rcond=None)[0], atol=1e-12)
    if noise == 0.0:
        np.testing.assert_allclose(found, P, atol=1e-9)


def test_a_passive_leg_that_keeps_its_direction_in_the_platform_is_refused() -> None:
    rng = np.random.default_rng(2)
    P, w = np.array([0.1, 0.0, 0.2]), np.array([0.0, 0.0, 1.0])
    R, t = Rotation.random(5, rng=rng).as_matrix(), rng.standard_normal((5, 3))
    u = R @ w
    A = np.einsum("nij,j->ni", R, P) + t - 0.4 * u
    kept = np.array([9.0, 9.0, 0.7])
    for n, words in ((5, r"leg strut .* two different directions"), (1, "1 pose of the platform")):
        with pytest.raises(NotIdentifiable, match=words):
            locate_passive_end("strut", u[:n], A[:n], (R[:n], t[:n]), kept, np.arange(3))
    found = locate_passive_end("centre", u, A, (R, t), kept, np.arange(2))
    np.testing.assert_allclose(found, [0.1, 0.0, 0.7], atol=1e-12)


@given(st.integers(0, 10**6))
@settings(max_examples=10, deadline=None)
def test_a_revolute_axis_is_normal_to_all_directions_on_the_nominal_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    v = unit(rng.standard_normal(3))
    angle = rng.uniform(0.0, 2.0, 5)
    e1, e2 = normal_basis(v)
    u = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
    nominal = unit(v + 0.3 * rng.standard_normal(3))
    np.testing.assert_allclose(
        revolute_axis("leg1", u, nominal), v * np.sign(v @ nominal), atol=1e-9
    )


def test_axes_on_the_platform_need_enough_directions() -> None:
    u = np.tile([0.0, 0.0, 1.0], (4, 1))
    for n, words in ((0, "no pose that shows"), (1, "in 1 pose"), (4, "in 4 poses")):
        with pytest.raises(NotIdentifiable, match=f"leg1.*{words}"):
            revolute_axis("leg1", u[:n], np.array([1.0, 0.0, 0.0]))
    with pytest.raises(NotIdentifiable, match="direction of leg centre in the platform"):
        fixed_direction("centre", u[:0])
    both = unit(np.array([[0.1, 0.0, 1.0], [-0.1, 0.0, 1.0]]))
    np.testing.assert_allclose(fixed_direction("centre", both), [0.0, 0.0, 1.0], atol=1e-12)


# Equations of legs in CasADi are those of the machine


@pytest.mark.parametrize("met", [True, False])
@pytest.mark.parametrize("joints", ["UU", "U", "RU", "UR", "RR"])
def test_equations_of_a_leg_and_their_derivatives_are_those_of_the_machine(
    joints: str, met: bool
) -> None:
    """z of B is known, and the pose is counted from another one; derivatives where rows are met."""
    rng = np.random.default_rng(3)
    R, t, step = Rotation.random(rng=rng).as_matrix(), rng.standard_normal(3), np.zeros(6)
    step[:3] = 0.1 * rng.standard_normal(3)
    leg = closed_leg(joints, R, t + step[:3], rng)
    if not met:
        leg = replace(leg, A=leg.A + 0.1 * rng.standard_normal(3), q0=0.3)
    assert leg.base_axis is not None
    assert leg.platform_axis is not None
    a, b = (axis_frames(v[None])[0] for v in (leg.base_axis, leg.platform_axis))
    local = np.concatenate([leg.B[:2], [0.0, leg.q0], np.zeros(5), step])
    known = np.array([0.0, 0.0, leg.B[2]]), R, t, leg.A
    kind, twist = (leg.base_joint, leg.platform_joint), float(leg.twist or 0.0)
    expected = leg_equations(leg, R[None], (t + step[:3])[None])
    x = ca.SX.sym("x", N_UNKNOWNS)
    for row, about in enumerate(expected.kinds):
        if about in (EquationKind.BASE_AXIS, EquationKind.DIRECTION_2):
            continue
        function = constraint_of_leg(about, *kind) if row else length_of_leg()
        arguments = (*known, a, b, twist, 1.0) if row else (*known, 0.0, 1.0)
        rows = slice(row, row + (2 if about is EquationKind.DIRECTION_1 else 1))
        value = function(local, *arguments).full().ravel()
        np.testing.assert_allclose(value, expected.values[0, rows], atol=1e-12)
        if about is EquationKind.TWIST:
            u = unit(R @ leg.B + t + step[:3] - leg.A)
            closure = closure_of_leg(*kind)(np.zeros(5), u, R, a, b, twist, 0.5)
            np.testing.assert_allclose(float(closure), 2.0 * value[0], atol=1e-12)
        if met:
            slope = ca.Function("slope", [x], [ca.jacobian(function(x, *arguments), x)])
            J, by_pose = slope(local).full(), expected.by_pose[0, rows]
            np.testing.assert_allclose(J[:, :9], expected.by_local[0, rows, 3:12], atol=1e-9)
            # A step is a displacement, then a Gibbs vector: half a rotation.
            np.testing.assert_allclose(J[:, 9:12], by_pose[:, 3:], atol=1e-9)
            np.testing.assert_allclose(J[:, 12:], 2.0 * by_pose[:, :3], atol=1e-9)


def test_the_direction_of_a_leg_is_compared_across_the_observed_one() -> None:
    rng = np.random.default_rng(3)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.standard_normal(3)
    leg = closed_leg("UU", R, t, rng)
    u = unit(R @ leg.B + t - leg.A)
    basis = normal_basis(u)
    seen = unit(u - 1e-4 * basis[0] + 2e-4 * basis[1])
    local = np.concatenate([leg.B, np.zeros(12)])
    W = np.diag([1e4, 1e4])
    value = direction_of_leg()(local, np.zeros(3), R, t, leg.A, seen, normal_basis(seen), W)
    shown = normal_basis(seen).T @ value.full().ravel() * 1e-4
    np.testing.assert_allclose(shown, u - seen, atol=1e-7)
