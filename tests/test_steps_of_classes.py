"""All four steps on every shipped machine: what ranks call determined is found, and no more."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import SHIPPED
from scipy.spatial.transform import Rotation
from staged_hexapods import errors, five_millimetres_away
from staged_machines import Observed, planned, shipped, three_steps

from legcal.calibration.identify.planning import planned_session
from legcal.calibration.identify.ranks import Analysis, determined
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import (
    Leg,
    LegKind,
    Parametrization,
    load_mechanism,
    parametrize,
    vector_of,
)
from legcal.paper import platform
from legcal.paper.four_steps import StagedResult, run_steps
from legcal.paper.least_squares import LeastSquares, Solution, solve_least_squares
from legcal.paper.nominal import Criteria, Transformation
from legcal.paper.platform import RigidProblem, build_rigid
from legcal.paper.platform_unknowns import PlatformUnknowns
from legcal.simulation.hexapod import PAPER_VIEWS, cameras_around, hexapod, hexapod_session, perturb
from legcal.simulation.observe import OutlineNoise
from legcal.simulation.paper import nominal_of

LIKE_HEXAPOD = ("nategh-agheli", "6-sps", "hexapod-strut", "hexapod-rod")
WITH_AXES = ("3-spr", "3-upu-tilted", "tricept")


def run(
    observed: Observed,
    criteria: Criteria = "default",
    transformation: Transformation | None = None,
    *,
    free_twists: bool = False,
) -> StagedResult:
    return run_steps(
        observed.nominal,
        observed.axes,
        observed.measurements,
        criteria=criteria,
        transformation=transformation,
        free_twists=free_twists,
    )


def parameters_of(observed: Observed, *, twists: bool = False) -> Parametrization:
    nominal = observed.nominal
    return parametrize(nominal.leg_names, observed.true_legs, nominal.frame_legs, twists=twists)


def off(observed: Observed, legs: tuple[Leg, ...], *, twists: bool = False) -> Array:
    """Return by how much legs differ from the truth in every parameter [m, rad]."""
    parametrization, true = parameters_of(observed, twists=twists), observed.true_legs
    return vector_of(parametrization, legs, true) - vector_of(parametrization, true, true)


def open_space(name: str, parametrization: Parametrization) -> Array:
    """Return an orthonormal basis (w, p) of what the staged ranks leave open, turns as metres."""
    machine = load_mechanism(name)
    views = [tuple(range(machine.n_legs))] * 3
    ranks = Analysis(planned_session(machine, views, 6)).staged
    assert ranks.complete
    rows = np.zeros((len(ranks.weak), len(parametrization)))
    for row, weak in zip(rows, ranks.weak, strict=True):
        for parameter, component in zip(weak.parameters, weak.components, strict=True):
            row[parametrization.names.index(parameter)] = component
    return np.linalg.qr(rows.T)[0].T


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LIKE_HEXAPOD else n for n in SHIPPED]
)
def test_exact_outlines_give_all_that_is_determined_from_3_mm_and_1_degree(name: str) -> None:
    observed = shipped(name)
    away = np.abs(off(observed, observed.nominal.legs))
    is_angle = np.array([unit == "rad" for unit in parameters_of(observed).units])
    assert np.allclose(away[~is_angle], 0.003)
    found = run(observed)
    error = off(observed, found.legs)
    basis = open_space(name, parameters_of(observed))
    assert len(basis) == (6 if name == "3-upu" else 0)
    assert len(found.diagnostics) == len(basis)
    error -= basis.T @ (basis @ error)
    assert np.abs(error[~is_angle]).max() < 1e-8
    assert np.abs(error[is_angle]).max(initial=0.0) < 1e-7
    for leg, true in zip(found.legs, observed.true_legs, strict=True):
        assert (leg.kind, leg.base_joint, leg.platform_joint) == (
            true.kind,
            true.base_joint,
            true.platform_joint,
        )
        assert (leg.twist is None) == (true.twist is None)
    assert np.isnan(found.parameters.offsets).tolist() == [
        leg.kind is LegKind.PASSIVE for leg in observed.true_legs
    ]


@pytest.mark.parametrize("name", WITH_AXES)
def test_the_default_ends_in_one_place_however_the_platform_was_located(name: str) -> None:
    first, second = (run(shipped(name, noise=0.2), transformation=t) for t in TRANSFORMATIONS)
    apart = off(shipped(name, noise=0.2), first.legs) - off(shipped(name, noise=0.2), second.legs)
    assert np.abs(apart).max() < 1e-4  # of outliers each has lost a bit more or less weight


TRANSFORMATIONS: tuple[Transformation, ...] = ("points", "cross_product")


@pytest.mark.parametrize("transformation", TRANSFORMATIONS)
@pytest.mark.parametrize("name", ["3-rpr", "3-spr", "3-upu", "3-upu-tilted"])
def test_literal_steps_are_exact_where_their_equations_have_full_rank(
    name: str, transformation: Transformation
) -> None:
    observed = shipped(name)
    found = run(observed, "literal", transformation)
    basis = open_space(name, parameters_of(observed))
    assert len(found.diagnostics) == len(basis)
    error = off(observed, found.legs)
    error -= basis.T @ (basis @ error)
    assert np.abs(error).max() < 1e-8


def test_literal_steps_find_a_passive_leg_where_base_and_platform_are_known() -> None:
    """(9) is even in z of the fourth base joint of a Tricept: it starts there at the truth."""
    observed = shipped("tricept")
    true = observed.true_legs
    start = tuple(
        replace(leg, A=np.append(leg.A[:2], t.A[2]))
        for leg, t in zip(observed.nominal.legs, true, strict=True)
    )
    observed = replace(observed, nominal=replace(observed.nominal, legs=start))
    assert np.abs(off(observed, start)).max() > 0.002
    found = run(observed, "literal", "points")
    assert np.abs(off(observed, found.legs)).max() < 1e-7
    assert np.abs(off(observed, run(observed, "literal").legs)).max() < 1e-7


@pytest.mark.parametrize("criteria", ["default", "literal"])
def test_twists_are_found_on_request(criteria: Criteria) -> None:
    observed = shipped("3-upu-tilted")
    start = tuple(
        replace(leg, twist=float(leg.twist or 0.0) + 0.01) for leg in observed.nominal.legs
    )
    observed = replace(observed, nominal=replace(observed.nominal, legs=start))
    held = run(observed, criteria)
    assert [leg.twist for leg in held.legs] == [leg.twist for leg in start]
    freed = run(observed, criteria, free_twists=True)
    assert np.abs(off(observed, freed.legs, twists=True)).max() < 1e-7


VIEWS = [
    ("3-spr", ((0, 1, 2), (0, 1))),
    ("3-spr", ((0, 1), (1, 2), (0, 2))),
    ("3-rpr", ((0, 1), (1, 2))),
    ("tricept", ((0, 1, 2), (1, 2, 3))),
    ("tricept", ((0, 1, 2, 3),)),
]


@pytest.mark.parametrize(("name", "views"), VIEWS)
def test_steps_find_what_ranks_call_determined_and_refuse_the_rest(
    name: str, views: tuple[tuple[int, ...], ...]
) -> None:
    machine = load_mechanism(name)
    session = planned_session(machine, views, 8)
    ranks = Analysis(session).staged
    observed = planned(session, machine.sign)
    if ranks.complete:
        assert np.abs(off(observed, run(observed).legs)).max() < 1e-7
    else:
        with pytest.raises(NotIdentifiable):
            run(observed)


@pytest.mark.parametrize("name", ["3-rpr", "3-spr", "3-upu", "3-upu-tilted", "tricept"])
def test_the_rigid_criterion_has_the_rank_that_is_predicted(name: str) -> None:
    machine = load_mechanism(name)
    session = planned_session(machine, [tuple(range(machine.n_legs))], 8)
    (rank,) = [
        r
        for r in Analysis(session).step_ranks
        if (r.name, r.criteria) == ("platform_joints", "default")
    ]
    observed = planned(session, machine.sign)
    observed = replace(observed, nominal=replace(observed.nominal, legs=session.legs))
    steps = three_steps(observed)
    unknowns = PlatformUnknowns.of(observed.nominal)
    rigid = RigidProblem.of(
        observed.nominal, unknowns, steps.joints, steps.base, steps.directions, session.sigma_q
    )
    problem = build_rigid(rigid)
    J, residuals = problem.jacobian(problem.start), problem.residuals(problem.start)
    n = len(rigid.unknowns)
    found = Solution(problem.start, residuals, J, n, 0, "").information()
    kept = [i for i, name in enumerate(rigid.unknowns.names) if "offset" not in name]
    unit = np.where(rigid.unknowns.is_angle, 1.0 / session.mean_length, 1.0)
    assert len(kept) == rank.of
    assert determined(session, (found * unit)[:, kept]) == rank.rank


def test_two_platform_joints_at_one_place_are_found() -> None:
    rng = np.random.default_rng(0)
    machine = perturb(hexapod(), rng, 0.002)
    nominal = five_millimetres_away(machine)
    merged = []
    for parameters in (machine.parameters, nominal.parameters):
        B = parameters.platform_joints.copy()
        B[[1, 3, 5]] = B[[0, 2, 4]]
        merged.append(replace(parameters, platform_joints=B))
    machine, nominal = (
        replace(m, parameters=p) for m, p in zip((machine, nominal), merged, strict=True)
    )
    session = hexapod_session(
        machine,
        cameras_around(machine, rng, legs=PAPER_VIEWS),
        rng,
        noise=OutlineNoise(),
        noisy=False,
        n_poses=6,
    )
    found = run_steps(nominal_of(nominal), session.axes, session.measurements)
    assert errors(found.parameters, machine).max() < 1e-9


def test_what_a_translating_platform_does_not_show_stays_at_nominal_and_is_named() -> None:
    observed = shipped("3-upu")
    found = run(observed)
    assert all("the platform does not move with it" in text for text in found.diagnostics)
    assert "angle 1 of base axis of leg 1 and angle 1 of platform axis of leg 1" in "".join(
        found.diagnostics
    )
    for leg, nominal in zip(found.legs, observed.nominal.legs, strict=True):
        a, b, a_nominal, b_nominal = (
            np.asarray(v)
            for v in (leg.base_axis, leg.platform_axis, nominal.base_axis, nominal.platform_axis)
        )
        R = found_rotation(observed)
        assert np.linalg.norm(np.cross(a, R @ b)) < 1e-7
        middle = a_nominal + R @ b_nominal
        assert np.linalg.norm(np.cross(a, middle / np.linalg.norm(middle))) < 1e-3


def found_rotation(observed: Observed) -> Array:
    """Return the rotation of a platform that only translates, with which its axes are parallel."""
    rows = [
        (np.asarray(leg.base_axis), np.asarray(leg.platform_axis)) for leg in observed.true_legs
    ]
    a, b = (np.array(part) for part in zip(*rows, strict=True))
    a *= np.sign(np.sum(a * b, axis=1))[:, None]
    return np.asarray(Rotation.align_vectors(a, b)[0].as_matrix())


def test_axes_that_no_three_legs_at_once_show_are_refused_in_geometric_words() -> None:
    machine = load_mechanism("3-spr")
    session = planned_session(machine, ((0, 1), (1, 2), (0, 2)), 8)
    observed = planned(session, machine.sign)
    with pytest.raises(NotIdentifiable, match="no pose shows three legs of known length at once"):
        run(observed, "literal")
    words = r"angle \d of platform axis of leg \d can change without any image noticing"
    with pytest.raises(NotIdentifiable, match=words):
        run(observed)


def test_axes_stay_near_nominal_where_step_4_does_not_converge_without_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls = list[int]()

    def fails_once(problem: LeastSquares) -> Solution:
        calls.append(len(problem.terms))
        if len(calls) == 2:
            raise DidNotConverge("The platform joints (step 4) could not be computed.")
        return solve_least_squares(problem)

    observed = shipped("3-upu-tilted")
    monkeypatch.setattr(platform, "solve_least_squares", fails_once)
    found = run(observed)
    assert found.diagnostics == (platform.KEPT_NEAR,)
    assert calls == [calls[0], calls[0] - 1, calls[0]]
    is_angle = np.array([unit == "rad" for unit in parameters_of(observed).units])
    error, before = off(observed, found.legs), off(observed, observed.nominal.legs)
    assert np.linalg.norm(error[is_angle]) < np.linalg.norm(before[is_angle])
