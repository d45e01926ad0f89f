"""All four steps: exact recovery on every machine, invariance, noise, and what ranks predict."""

from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from fit_sessions import SHIPPED
from hexapod_sessions import (
    disturbed_hexapod,
    extreme_poses,
    nominal_of,
    paper_session,
    with_parameters,
)
from scipy.spatial.transform import Rotation
from staged_sessions import (
    Observed,
    errors,
    exact_session,
    five_millimetres_away,
    noisy_session,
    planned,
    shipped,
    staged,
)
from thinned import thinned

from legcal.calibration.identify.predicted_observations import planned_observations
from legcal.calibration.identify.ranks import Analysis, determined
from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine.leg import LegKind, point_like_legs
from legcal.machine.loader import load_mechanism
from legcal.machine.parameters import from_vector, parametrize, to_vector
from legcal.paper.criteria import Criteria, Transformation
from legcal.paper.four_steps import run_base_steps
from legcal.paper.joints_in_base import build_rigid_base as build_base
from legcal.paper.joints_in_base import build_scalar_products
from legcal.paper.least_squares import IpoptSolution, LeastSquares
from legcal.paper.leg_directions import directions_through_joints, observed_directions
from legcal.paper.offsets import build_consecutive, build_constant_distances, leg_ends
from legcal.paper.platform import RigidProblem, build_rigid_platform
from legcal.paper.platform_pose import build_rays
from legcal.paper.platform_printed import build_mean_distances
from legcal.paper.unknowns import Unknowns
from legcal.simulation.observe import OutlineNoise, TableNoise, shifted_outlines
from legcal.simulation.paper import PAPER_VIEWS, platform_errors

# (14) does not see the length that all rods of an ideal linear Delta have.
MACHINES = [name for name in SHIPPED if name != "linear-delta"]
LIKE_HEXAPOD = ("nategh-agheli", "6-sps")
FULL_RANK = ("3-rpr", "3-spr", "3-upu-tilted")  # of (9): in a plane, or three joints and no axis
EVEN = ("3-rps", "tricept", "hexapod-rod")
TRANSFORMATIONS: tuple[Transformation, ...] = ("points", "cross_product")


# Exact recovery


def open_space(observed: Observed, name: str) -> Array:
    """Return an orthonormal basis (w, p) of what the staged ranks leave open, turns as metres."""
    machine = load_mechanism(name)
    ranks = Analysis(planned_observations(machine, [tuple(range(machine.n_legs))] * 3, 6)).staged
    assert ranks.complete
    nominal = observed.nominal
    names = parametrize(nominal.leg_names, observed.true_legs, nominal.frame_legs).names
    rows = np.zeros((len(ranks.weak), len(names)))
    for row, weak in zip(rows, ranks.weak, strict=True):
        for parameter, component in zip(weak.parameters, weak.components, strict=True):
            row[names.index(parameter)] = component
    return np.linalg.qr(rows.T)[0].T


@pytest.mark.parametrize("name", thinned(MACHINES, lambda name: name not in LIKE_HEXAPOD))
def test_exact_outlines_give_all_that_is_determined_from_3_mm_and_1_degree(name: str) -> None:
    observed = shipped(name)
    is_angle, before = observed.is_angle, observed.errors(observed.nominal.legs)
    assert np.allclose(np.abs(before[~is_angle]), 0.003)
    found = observed.run()
    for T, true in zip(found.base.T_Rb_camera, observed.T_camera_Rb, strict=True):
        assert T is not None
        assert np.linalg.norm((T * true).translation) < 1e-8
        assert (T * true).rotation.magnitude() < 1e-7
    error, basis = observed.errors(found.legs), open_space(observed, name)
    assert len(basis) == len(found.diagnostics) == (6 if name == "3-upu" else 0)
    error -= basis.T @ (basis @ error)
    assert np.abs(error[~is_angle]).max() < 1e-8
    assert np.abs(error[is_angle]).max(initial=0.0) < 1e-7
    for leg, truth in zip(found.legs, observed.true_legs, strict=True):
        assert (leg.kind, leg.type, leg.twist is None) == (
            truth.kind,
            truth.type,
            truth.twist is None,
        )
        if leg.base_joint == "R" and leg.base_axis is not None and truth.base_axis is not None:
            assert leg.base_axis @ truth.base_axis > 0.9
    passive = [leg.kind is LegKind.PASSIVE for leg in observed.true_legs]
    assert np.isnan(found.machine.offsets).tolist() == passive
    assert np.isnan(found.base.base_axes[:, 0]).tolist() == (~observed.nominal.revolute).tolist()


@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"noise": TableNoise()}),
        (5, {"coplanar": True}),
        (0, {"legs": ((0, 1, 2, 3, 4, 5),) * 3, "share_poses": True}),
    ],
)
def test_exact_recovery_of_hexapods_from_5_mm(seed: int, options: dict[str, Any]) -> None:
    session = exact_session(seed, **options)
    nominal = five_millimetres_away(session.machine, seed)
    assert errors(nominal.parameters, session.machine).min() > 0.00499
    found = staged(session, nominal)
    assert errors(found.parameters, session.machine).max() < 1e-9
    assert found.diagnostics == ()


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_legs_that_meet_in_one_platform_joint_are_no_pair(criteria: Criteria) -> None:
    drawn = disturbed_hexapod()
    true, wrong = (
        replace(p, platform_joints=p.platform_joints[[0, 0, 2, 2, 4, 4]])
        for p in (drawn.parameters, five_millimetres_away(drawn).parameters)
    )
    machine = with_parameters(drawn, true)
    nominal = replace(nominal_of(machine), legs=point_like_legs(wrong))
    found = staged(paper_session(machine, OutlineNoise()), nominal, criteria).parameters
    assert np.abs(found.offsets - machine.parameters.offsets).max() < 1e-8
    if criteria == "default":
        assert errors(found, machine).max() < 1e-9


@pytest.mark.parametrize("transformation", TRANSFORMATIONS)
@pytest.mark.parametrize("name", [*FULL_RANK, "3-upu"])
def test_literal_steps_are_exact_where_their_equations_have_full_rank(
    name: str, transformation: Transformation
) -> None:
    observed = shipped(name)
    found = observed.run("literal", transformation=transformation)
    as_printed = observed.run("literal")
    if transformation == "cross_product":  # which the literal steps take by themselves
        assert np.array_equal(observed.errors(as_printed.legs), observed.errors(found.legs))
    basis = open_space(observed, name)
    assert len(found.diagnostics) == len(basis)
    error = observed.errors(found.legs)
    assert np.abs(error - basis.T @ (basis @ error)).max() < 1e-8


def test_ranks_of_9_tell_where_it_is_exact_and_offsets_are_so_everywhere() -> None:
    for name in (*FULL_RANK, *EVEN):
        machine = load_mechanism(name)
        ranks = Analysis(
            planned_observations(machine, [tuple(range(machine.n_legs))], 4)
        ).step_ranks
        (rank,) = [r for r in ranks if (r.name, r.criteria) == ("base_joints", "literal")]
        assert (rank.rank == rank.of) == (name in FULL_RANK)
        if name in EVEN:  # 3 mm in z, or 1 degree in the axes, are not seen by even equations
            observed = shipped(name)
            found = observed.run("literal")
            q0 = np.array([leg.q0 for leg in observed.true_legs])
            assert np.nanmax(np.abs(found.machine.offsets - q0)) < 1e-8
            assert np.abs(found.base.A_Rb - observed.A_Rb).max() > 1e-7


def test_literal_steps_find_a_passive_leg_where_base_and_platform_are_known() -> None:
    """(9) is even in z of the fourth base joint of a Tricept: it starts there at the truth."""
    observed = shipped("tricept")
    start = tuple(
        replace(leg, A=np.append(leg.A[:2], true.A[2]))
        for leg, true in zip(observed.nominal.legs, observed.true_legs, strict=True)
    )
    observed = replace(observed, nominal=replace(observed.nominal, legs=start))
    assert np.abs(observed.errors(start)).max() > 0.002
    for transformation in TRANSFORMATIONS:
        found = observed.run("literal", transformation=transformation)
        assert np.abs(observed.errors(found.legs)).max() < 1e-7


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_twists_are_found_on_request(criteria: Criteria) -> None:
    observed = shipped("3-upu-tilted")
    start = tuple(
        replace(leg, twist=float(leg.twist or 0.0) + 0.01) for leg in observed.nominal.legs
    )
    observed = replace(observed, nominal=replace(observed.nominal, legs=start))
    assert [leg.twist for leg in observed.run(criteria).legs] == [leg.twist for leg in start]
    freed = observed.run(criteria, free_twists=True)
    assert np.abs(observed.errors(freed.legs, twists=True)).max() < 1e-7


# What (9) and (16) do not decide


def test_literal_criteria_never_move_z_from_a_coplanar_nominal_model() -> None:
    session = exact_session()
    true = session.machine.parameters
    assert np.abs(true.base_joints[:, 2]).max() > 5e-4
    flat = nominal_of(load_mechanism("hexapod"))
    literal = staged(session, flat, "literal").parameters
    for joints in (literal.base_joints, literal.platform_joints):
        assert np.abs(joints[:, 2]).max() < 1e-9
    assert errors(literal, session.machine).max() > 5e-4
    assert errors(staged(session, flat).parameters, session.machine).max() < 1e-9


def test_literal_criteria_accept_a_mirror_image_that_the_rigid_ones_correct() -> None:
    session = exact_session()
    true, up = session.machine.parameters, np.array([1.0, 1.0, -1.0])
    mirrored = replace(
        true, base_joints=true.base_joints * up, platform_joints=true.platform_joints * up
    )
    nominal = replace(nominal_of(session.machine), legs=point_like_legs(mirrored))
    literal = staged(session, nominal, "literal").parameters
    assert errors(literal, nominal).max() < 1e-6
    assert errors(staged(session, nominal).parameters, session.machine).max() < 1e-9


def test_what_a_translating_platform_does_not_show_stays_at_nominal_and_is_named() -> None:
    observed = shipped("3-upu")
    found = observed.run()
    assert all("the platform does not move with it" in text for text in found.diagnostics)
    assert "angle 1 of base axis of leg 1 and angle 1 of platform axis of leg 1" in "".join(
        found.diagnostics
    )
    (a, b), (found_a, found_b), (nominal_a, nominal_b) = (
        np.array([[leg.base_axis for leg in legs], [leg.platform_axis for leg in legs]])
        for legs in (observed.true_legs, found.legs, observed.nominal.legs)
    )
    a *= np.sign(np.sum(a * b, axis=1))[:, None]
    R = Rotation.align_vectors(a, b)[0].as_matrix()  # with which axes are parallel
    assert np.linalg.norm(np.cross(found_a, found_b @ R.T), axis=1).max() < 1e-7
    middle = nominal_a + nominal_b @ R.T
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    assert np.linalg.norm(np.cross(found_a, middle), axis=1).max() < 1e-3


# Ranks decide

VIEWS = [
    ("hexapod", ((0, 1, 2, 3), (3, 4, 5))),
    ("3-rpr", ((0, 1, 2),)),
    ("3-rpr", ((0, 1), (1, 2))),
    ("3-rps", ((0, 1, 2), (0, 1))),
    ("3-rps", ((0, 1), (1, 2))),
    ("3-spr", ((0, 1, 2), (0, 1))),
    ("3-spr", ((0, 1), (1, 2), (0, 2))),
    ("tricept", ((0, 1, 2), (1, 2, 3))),
    ("tricept", ((0, 1, 2, 3),)),
]


@pytest.mark.parametrize(("name", "views"), VIEWS)
def test_steps_find_what_ranks_call_determined_and_refuse_the_rest(
    name: str, views: tuple[tuple[int, ...], ...]
) -> None:
    machine = load_mechanism(name)
    session = planned_observations(machine, views, 8)
    analysis, observed = Analysis(session), planned(session)
    full = {r.name: r.rank == r.of for r in analysis.step_ranks if r.criteria == "default"}
    assert full["joints_in_cameras"]
    if full["base_joints"]:
        base = observed.run_base()
        assert np.abs(base.A_Rb - observed.A_Rb).max() < 1e-8
        revolute = observed.nominal.revolute
        assert np.abs(np.cross(base.base_axes, observed.v_Rb)[revolute]).max(initial=0.0) < 1e-7
    else:
        with pytest.raises(NotIdentifiable, match="could not be tied together"):
            observed.run_base()
    if analysis.staged.complete:
        assert np.abs(observed.errors(observed.run().legs)).max() < 1e-7
    else:
        with pytest.raises(NotIdentifiable):
            observed.run()


@pytest.mark.parametrize("name", ["3-rpr", "3-spr", "3-upu", "3-upu-tilted", "tricept"])
def test_the_rigid_criterion_has_the_rank_that_is_predicted(name: str) -> None:
    machine = load_mechanism(name)
    session = planned_observations(machine, [tuple(range(machine.n_legs))], 8)
    (rank,) = [
        r
        for r in Analysis(session).step_ranks
        if (r.name, r.criteria) == ("platform_joints", "default")
    ]
    observed = planned(session)
    rigid = rigid_problem(observed)
    problem = build_rigid_platform(rigid)
    J, residuals = problem.jacobian(problem.start), problem.residuals(problem.start)
    information = IpoptSolution(problem.start, residuals, J, len(rigid.unknowns), "").information()
    kept = [i for i, name in enumerate(rigid.unknowns.names) if "offset" not in name]
    metre = np.where(rigid.unknowns.is_angle, 1.0 / session.mean_length, 1.0)
    assert len(kept) == rank.of
    assert determined(session, (information * metre)[:, kept]) == rank.rank


def rigid_problem(observed: Observed) -> RigidProblem:
    """Return what the default criterion of step 4 is built of at the truth."""
    machine = replace(observed.nominal, legs=observed.true_legs)
    base = run_base_steps(machine, observed.axes, observed.measurements)
    directions = directions_through_joints(observed.axes, observed.measurements, base)
    return RigidProblem.of(machine, Unknowns.of_platform(machine), base, directions, 2e-6)


# Invariance


def in_other_frames(axes: LegAxes, R: Array) -> LegAxes:
    """Return axes whose camera frames are turned by R (n, 3, 3)."""
    return replace(
        axes,
        u=np.einsum("nij,nj->ni", R, axes.u),
        M=np.einsum("nij,nj->ni", R, axes.M),
        basis=np.einsum("nij,nkj->nki", R, axes.basis),
    )


@pytest.mark.parametrize("criteria", ["default", "literal"])
@pytest.mark.parametrize(
    ("name", "change"),
    [
        *(("3-rps", change) for change in ("cameras", "legs", "views", "images")),
        ("3-rpr", "legs"),
        ("3-spr", "cameras"),
    ],
)
def test_turned_cameras_and_other_orders_change_nothing(
    name: str, change: str, criteria: Criteria
) -> None:
    observed = shipped(name, noise=0.1)
    nominal, axes, m = observed.nominal, observed.axes, observed.measurements
    order, legs = np.array([1, 2, 0]), np.arange(3)
    rng = np.random.default_rng(0)
    if change == "cameras":
        turns = np.array([T.rotation.as_matrix() for T in observed.T_camera_Rb])
        axes = in_other_frames(axes, turns[m.view[axes.row]])
    elif change == "legs":
        legs, place = order, np.argsort(order)
        axes, m = replace(axes, leg=place[axes.leg]), replace(m, q=m.q[:, order])
        nominal = replace(
            nominal,
            leg_names=tuple(nominal.leg_names[j] for j in order),
            legs=tuple(nominal.legs[j] for j in order),
            frame_legs=tuple(int(place[j]) for j in nominal.frame_legs),
        )
    elif change == "views":
        m = replace(m, views=tuple(m.views[v] for v in order), view=np.argsort(order)[m.view])
    else:  # of each view alone: (14) compares consecutive ones
        rows = np.concatenate([np.flatnonzero(m.view == v) for v in (2, 0, 1)])
        m = replace(m, view=m.view[rows], pose=m.pose[rows], q=m.q[rows])
        axes = replace(axes, row=np.argsort(rows)[axes.row]).choose(rng.permutation(len(axes)))
    first = observed.run(criteria)
    second = replace(observed, nominal=nominal, axes=axes, measurements=m).run(criteria)
    for one, other in zip([first.legs[j] for j in legs], second.legs, strict=True):
        for a, b in ((one.A, other.A), (one.B, other.B), (one.q0, other.q0)):
            assert np.allclose(a, b, rtol=0.0, atol=1e-7)
        for key in ("base_axis", "platform_axis"):
            a, b = getattr(one, key), getattr(other, key)
            assert (a is None) == (b is None)
            assert a is None or np.allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_scaling_all_lengths_scales_the_result(scale: float) -> None:
    session, nominal = noisy_session(0, OutlineNoise(), n_poses=6)
    axes, m = session.axes, session.measurements
    by = np.array([1.0, 1.0, scale, scale])
    larger = replace(
        session,
        axes=replace(axes, M=scale * axes.M, covariance=axes.covariance * np.outer(by, by)),
        measurements=replace(m, q=scale * m.q, sigma_q=scale * m.sigma_q),
    )
    vector = partial(to_vector, frame_legs=nominal.frame_legs)
    scaled = from_vector(scale * vector(nominal.parameters), 6, nominal.frame_legs)
    first = staged(session, nominal)
    second = staged(larger, replace(nominal, legs=point_like_legs(scaled)))
    apart = scale * vector(first.parameters) - vector(second.parameters)
    assert np.abs(apart).max() < 1e-8 * scale


@pytest.mark.parametrize("name", ["3-upu-tilted", "tricept"])
def test_the_default_ends_in_one_place_however_the_platform_was_located(name: str) -> None:
    observed = shipped(name, noise=0.2)
    first, second = (
        observed.errors(observed.run(transformation=how).legs) for how in TRANSFORMATIONS
    )
    assert np.abs(first - second).max() < 1e-4  # outliers have lost a bit more or less weight


# Noise


@pytest.mark.parametrize(
    ("noise", "criteria", "low", "high"),
    [
        (TableNoise(), "default", 5.0, np.inf),
        (TableNoise(), "literal", 0.0, 1.0),  # worse than the nominal model
        (OutlineNoise(0.25, 100), "default", 5.0, np.inf),  # thin distant legs
    ],
)
def test_the_default_improves_the_model_fivefold_and_the_literal_criteria_make_it_worse(
    noise: OutlineNoise | TableNoise, criteria: Criteria, low: float, high: float
) -> None:
    means = np.zeros(2)
    for seed in range(2):
        session, nominal = noisy_session(seed, noise)
        machine = session.machine
        poses = extreme_poses(machine, 5, 99)
        found = staged(session, nominal, criteria)
        for k, legs in enumerate((nominal.legs, found.legs)):
            means[k] += platform_errors(machine, legs, poses).dX
    assert low < means[0] / means[1] < high


def test_wrong_outlines_are_named_and_hardly_matter() -> None:
    session, nominal = noisy_session(0, OutlineNoise())
    offsets = np.zeros((len(session.outlines), 2))
    offsets[::40] = 15.0
    camera = session.measurements.views[0].camera
    h, ends = shifted_outlines(camera, session.outlines.h, session.outlines.ends, offsets)
    wrong = replace(session.outlines, h=h, ends=ends)
    axes = axes_from_outlines(wrong, session.measurements, session.radii)
    result = staged(replace(session, axes=axes), nominal)
    assert len(result.diagnostics) == 9
    assert "Leg leg1 in image 1 was left out of steps 3 and 4" in result.diagnostics[0]
    clean = errors(staged(session, nominal).parameters, session.machine).max()
    assert errors(result.parameters, session.machine).max() < 2.0 * clean + 1e-4


def test_an_axis_off_the_plane_of_its_revolute_leg_is_named() -> None:
    observed = shipped("3-rps", n_poses=10, noise=0.1)
    axes, m = observed.axes, observed.measurements
    joints = observed.run_base().in_cameras
    A, v = (part[m.view[axes.row[7]], axes.leg[7]] for part in (joints.A_camera, joints.v_camera))
    turn = Rotation.from_rotvec(0.1 * np.cross(axes.u[7], v))
    u, M, basis = axes.u.copy(), axes.M.copy(), axes.basis.copy()
    u[7], M[7], basis[7] = turn.apply(u[7]), A + turn.apply(M[7] - A), turn.apply(basis[7])
    assert observed.run().diagnostics == ()
    wrong = replace(observed, axes=replace(axes, u=u, M=M, basis=basis))
    (sentence,) = wrong.run().diagnostics
    name = observed.nominal.leg_names[axes.leg[7]]
    assert f"Leg {name} in image {m.image[axes.row[7]]} was left out" in sentence


# Problems


def problems(name: str) -> dict[str, LeastSquares]:
    """Return all problems of the steps on a session with noise."""
    observed = shipped(name, noise=0.3) if name != "hexapod" else shipped("hexapod", n_poses=3)
    machine, axes, m = observed.nominal, observed.axes, observed.measurements
    base = run_base_steps(machine, axes, m)
    known, joints = base.machine, base.in_cameras
    directions = directions_through_joints(axes, m, base)
    single = observed_directions(axes, m, known, joints)
    rigid = RigidProblem.of(known, Unknowns.of_platform(known), base, directions, 2e-6)
    R, t = rigid.poses.R, rigid.poses.t
    group, B = rigid.poses.pose, known.parameters.platform_joints[directions.leg]
    centre = np.array([0.0, 0.0, -1.0]) + 0.0 * B
    ends = np.einsum("nij,nj->ni", R[group], B) + t[group] + 0.01
    placed = [T if v else None for v, T in enumerate(base.T_Rb_camera)]
    q0 = known.parameters.offsets
    return {
        "step 2": build_base(machine, joints, placed),
        "(9)": build_scalar_products(machine, joints),
        "step 3": build_constant_distances(known, directions, q0, 2e-6),
        "(14)": build_consecutive(known, single),
        "step 4": build_rigid_platform(rigid),
        "(16)": build_mean_distances(known, rigid.unknowns, single),
        "(18)": build_rays(B, ends, centre, group, (R, t)),
    }


@pytest.mark.parametrize("name", ["3-rpr", "3-rps", "3-upu-tilted", "tricept"])
def test_derivatives_of_all_problems_are_those_of_differences(name: str) -> None:
    rng = np.random.default_rng(0)
    for problem in problems(name).values():
        x = problem.start + 0.01 * rng.normal(size=len(problem.start))
        J, h = problem.jacobian(x), 1e-6
        for d in rng.normal(size=(4, len(x))):
            numeric = (problem.residuals(x + h * d) - problem.residuals(x - h * d)) / (2.0 * h)
            assert np.allclose(J @ d, numeric, rtol=0.0, atol=1e-6 * np.abs(numeric).max())


def test_printed_criteria_have_the_equations_that_the_paper_counts() -> None:
    session = exact_session(n_poses=6)
    machine = five_millimetres_away(session.machine)
    base = run_base_steps(machine, session.axes, session.measurements)
    single = observed_directions(session.axes, session.measurements, machine, base.in_cameras)
    unknowns = Unknowns.of_platform(machine)
    built = (
        build_scalar_products(machine, base.in_cameras),
        build_consecutive(machine, single),
        build_mean_distances(machine, unknowns, single),
    )
    counts = [(problem.n_residuals, len(problem.start)) for problem in built]
    # (16) compares means in metres, each with the same weight
    ends, B = leg_ends(single, machine.parameters.offsets), machine.parameters.platform_joints
    expected = []
    for view, legs in enumerate(PAPER_VIEWS):
        for j, g in combinations(legs, 2):
            of_j, of_g = (ends[(single.view == view) & (single.leg == leg)] for leg in (j, g))
            mean = np.linalg.norm(of_j - of_g, axis=1).mean()
            expected.append(np.linalg.norm(B[j] - B[g]) - mean)
    found = built[2].residuals(built[2].start)
    assert np.allclose(sorted(found), sorted(expected), rtol=0.0, atol=1e-12)
    assert np.abs(found).max() > 1e-3
    # Four legs have 6 pairs: 21 products, 6 distances; consecutive ones of 6 poses are 5
    assert counts == [(3 * 21, 12), (3 * 6 * 5, 6), (3 * 6, 12)]
