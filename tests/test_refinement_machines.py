"""Every shipped machine is found from far away, and known as well as its Fisher matrix says."""

import dataclasses

import numpy as np
import pytest
from dense_fit import allowed, by_differences, kept_move, residuals
from machine_session import SHIPPED, MachineSession, machine_session

from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.session import Session
from legcal.calibration.joint_fit.choices import Choices, Prior
from legcal.calibration.joint_fit.determinacy import open_directions
from legcal.calibration.joint_fit.fit import bound, refine
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.rounds import first_minimum
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import DEFAULT_SETTINGS, FittedLegs, State, with_values
from legcal.estimation import Frames, information, linearize
from legcal.geometry.types import Array
from legcal.machine import parametrize, radius_name


def session_as_identify_sees_it(session: MachineSession, legs: FittedLegs) -> Session:
    """Return what was measured as the analysis of identifiability takes it."""
    R, t = Frames.of(session.truth.T_Rb_Re)
    cameras = session.truth.T_camera_Rb
    radius = [max(r for (j, _), r in legs.radii.items() if j == k) for k in range(len(legs.names))]
    return Session(
        leg_names=legs.names,
        legs=session.truth.legs,
        frame_legs=legs.frame_legs,
        parametrization=parametrize(legs.names, session.truth.legs, legs.frame_legs),
        radius=np.array(radius),
        R=R,
        t=t,
        R_reached=R,
        t_reached=t,
        view=session.measurements.view,
        pose=session.measurements.pose,
        seen=np.ones((len(cameras), len(legs.names)), dtype=np.bool_),
        board=np.zeros(len(cameras), dtype=np.bool_),
        camera=np.array([T.inv().translation for T in cameras]),
        focal=np.full(len(cameras), session.measurements.views[0].camera.K[0, 0]),
        sigma_q=session.measurements.sigma_q,
    )


def true_values(session: MachineSession) -> dict[str, float]:
    """Return the true kinematic parameters, counted from the nominal legs, and radii."""
    legs = session.legs
    kinematic = legs.vector(session.truth.legs).tolist()
    values = dict(zip(legs.parametrization.names, kinematic, strict=True))
    return values | {radius_name(legs.names[j], part): r for (j, part), r in legs.radii.items()}


def errors(session: MachineSession, found: Solution) -> dict[str, float]:
    truth = true_values(session)
    return {name: abs(found.values[name] - truth[name]) for name in found.names}


def shaken_radii(session: MachineSession) -> FittedLegs:
    """Return the nominal legs with radii that are 2 % wrong."""
    signs = np.random.default_rng(1).choice([-1.0, 1.0], len(session.legs.radii))
    radii = {
        part: r * (1.0 + 0.02 * sign)
        for (part, r), sign in zip(session.legs.radii.items(), signs.tolist(), strict=True)
    }
    return dataclasses.replace(session.legs, radii=radii)


def fit_of_everything(session: MachineSession, *, known_radii: bool) -> Solution:
    """Return the fit with true radii, or without knowing any: a prior would pull on them."""
    legs = session.legs if known_radii else shaken_radii(session)
    names = frozenset(radius_name(legs.names[j], part) for j, part in legs.radii)
    choices = Choices(fixed=names) if known_radii else Choices(free=names)
    return refine(legs, session.measurements, session.outlines, session.start, choices=choices)


def far_session(name: str) -> MachineSession:
    """Return a session that starts 3 mm and 1 deg away, the cameras 1 cm and 2 deg."""
    return machine_session(name, camera_shift=0.01, camera_turn=float(np.deg2rad(2.0)))


def starts_far_away(session: MachineSession) -> bool:
    """Say whether no parameter that is sought, and no camera, begins near the truth."""
    parametrization, true_legs = session.legs.parametrization, session.truth.legs
    away = np.abs(session.legs.vector(session.start.legs) - session.legs.vector(true_legs))
    least = {"m": 0.0029, "rad": np.deg2rad(0.7)}  # axes turn by 1 deg, both angles by 0.7
    far = [
        by > least[unit]
        for name, unit, by in zip(parametrization.names, parametrization.units, away, strict=True)
        if not name.endswith(".twist")
    ]
    cameras = zip(session.start.T_camera_Rb, session.truth.T_camera_Rb, strict=True)
    changes = [start * true.inv() for start, true in cameras]
    turned = [T.rotation.magnitude() > np.deg2rad(1.9) for T in changes]
    shifts = zip(session.start.T_camera_Rb, session.truth.T_camera_Rb, strict=True)
    shifted = [np.linalg.norm(a.translation - b.translation) > 0.009 for a, b in shifts]
    return all((*far, *turned, *shifted))


@pytest.mark.parametrize(
    ("name", "known_radii"), [*((name, False) for name in SHIPPED), ("3-upu", True)]
)
def test_exact_outlines_give_the_truth_from_3_mm_and_1_degree_away(
    name: str, known_radii: bool
) -> None:
    session = far_session(name)
    assert starts_far_away(session)
    found = fit_of_everything(session, known_radii=known_radii)
    assert {found.units[n] for n in found.names} <= {"m", "rad"}
    for parameter, error in errors(session, found).items():
        assert error < {"m": 1e-8, "rad": 1e-7}[found.units[parameter]], parameter
    # What is not held is known to a hundredth of a leg at least, some 5 mm. Parameters that far
    # from any that explain all measurements would cost 1; 1e-12 are 5e-9 m and 1e-8 rad.
    assert found.chi2 < 1e-12
    first, true_first = found.T_Rb_Re[0], session.truth.T_Rb_Re[0]
    for pose, true in zip(found.T_Rb_Re, session.truth.T_Rb_Re, strict=True):
        # Where joint centres are held, R_e stands otherwise on the platform, and R_b on the base.
        miss = pose.inv() * true
        if found.held:
            miss = (pose * first.inv()).inv() * (true * true_first.inv())
        assert np.linalg.norm(miss.translation) < 1e-8
        assert miss.rotation.magnitude() < 1e-7


@pytest.mark.parametrize("name", SHIPPED)
def test_all_that_identify_calls_determined_is_estimated(name: str) -> None:
    session = machine_session(name)
    ranks = Analysis(session_as_identify_sees_it(session, session.legs)).full
    open_to_identify = {p for direction in ranks.weak for p in direction.parameters}
    assert ranks.rank == (15 if name == "3-upu" else ranks.of)
    known = frozenset(true_values(session)) - set(session.legs.parametrization.names)  # radii
    everything = session.legs, session.measurements, session.outlines
    problem = build_fit(*everything, choices=Choices(fixed=known))
    state = problem.begin(session.truth)
    linear = linearize(problem, state)
    held = open_directions(problem, state, information(problem, state, linear))
    assert len(held.directions) == ranks.of - ranks.rank
    assert set(held.names) == open_to_identify


@pytest.mark.parametrize("known_radii", [False, True])
def test_of_a_3_upu_that_only_translates_all_is_found_that_images_and_readings_show(
    known_radii: bool,
) -> None:
    session = far_session("3-upu")
    found = fit_of_everything(session, known_radii=known_radii)
    assert len(found.held) == (6 if known_radii else 7)  # turns of both axes; without radii, size
    legs, true_legs = found.legs, session.truth.legs
    R, true_R = (Frames.of(poses)[0] for poses in (found.T_Rb_Re, session.truth.T_Rb_Re))
    size = np.linalg.norm(legs[1].A) / np.linalg.norm(true_legs[1].A)
    assert abs(size - 1.0) < 1e-8 if known_radii else abs(size - 1.0) > 1e-3
    turned = []
    for leg, true in zip(legs, true_legs, strict=True):
        assert abs(leg.q0 - true.q0) < 1e-8
        np.testing.assert_allclose(leg.A / size, true.A, rtol=0, atol=1e-8)
        arms = R @ leg.B - leg.A, true_R @ true.B - true.A
        np.testing.assert_allclose(*arms, rtol=0, atol=1e-8)
        a, b = np.asarray(leg.base_axis), R @ np.asarray(leg.platform_axis)
        turned.append(np.arccos(abs(a @ np.asarray(true.base_axis))))
        between = np.linalg.norm(np.cross(a, b), axis=1)
        assert between.max() < 1e-6  # as far as the written model has them from parallel
    assert max(turned) > np.deg2rad(0.5)  # held where the nominal ones are, and harmless


@pytest.mark.parametrize("seed", [1, 4])
def test_a_first_fit_stays_near_the_nominal_model_where_nothing_is_known(seed: int) -> None:
    session = machine_session("3-upu")
    problem = build_fit(session.legs, *session.noisy(seed))
    begin = problem.begin(session.start)
    first = first_minimum(problem, begin, DEFAULT_SETTINGS)
    turned = [
        np.arccos(abs(np.asarray(leg.base_axis) @ np.asarray(nominal.base_axis)))
        for leg, nominal in zip(first.state.legs, session.legs.nominal, strict=True)
    ]
    assert max(turned) < np.deg2rad(3.0)
    held = open_directions(problem, first.state, information(problem, first.state, first.linear))
    assert len(held.directions) == 7
    # The knowledge that keeps it there is no measurement, and is not counted.
    assert len(first.linear.prior_r) == len(problem.priors.mean) < len(problem.named)


def fisher_covariance(session: MachineSession, choices: Choices) -> tuple[Array, Array]:
    """Return the covariance of the named unknowns at the truth, and the same by differences."""
    problem = build_fit(session.legs, session.measurements, session.outlines, choices=choices)
    state = problem.begin(session.truth)
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    steps = allowed(problem, state).T

    def at(moved: State) -> Array:
        values = problem.coordinates(moved)
        return np.concatenate([values, residuals(problem, moved, whitening)])

    by = by_differences(problem, state, at, steps, kept_move)
    values, J = by[: len(problem.named)], by[len(problem.named) :]
    unit = np.linalg.norm(J, axis=0)
    R = np.asarray(np.linalg.qr(J / unit, mode="r"))
    root = np.linalg.solve(np.swapaxes(R, 0, 1), (values / unit).T)
    expected = root.T @ root
    return bound(problem, session.truth), expected


@pytest.mark.parametrize(
    ("name", "choices"),
    [
        ("hexapod", Choices(free=frozenset({"c1.fx", "c1.cx"}), fixed=frozenset({"leg2.offset"}))),
        pytest.param(
            "3-rps",
            Choices(priors={"leg2.base_axis.1": Prior(0.0, 1e-3)}),
            marks=pytest.mark.slow,
        ),
        ("tricept", Choices(free=frozenset({"leg1.radius.leg1_rod"}))),
        pytest.param(
            "hexapod-rod",
            Choices(priors={"leg6.length": Prior(0.4, 1e-4)}),
            marks=pytest.mark.slow,
        ),
        ("3-rpr", Choices()),
    ],
)
def test_the_covariance_is_the_inverse_of_the_fisher_matrix_by_differences(
    name: str, choices: Choices
) -> None:
    found, expected = fisher_covariance(machine_session(name, n_poses=3), choices)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(sigma, sigma)).max() < 1e-4


def test_values_are_where_they_are_asked_for_whatever_basis_an_axis_has() -> None:
    session = machine_session("3-upu")
    legs, truth = session.legs, session.legs.vector(session.truth.legs)
    at = dict(enumerate(truth.tolist()))
    # Nominal axes near the place where the basis of their angles changes.
    moved = with_values(legs.nominal, legs, at)
    np.testing.assert_allclose(legs.vector(moved), truth, rtol=0, atol=1e-15)
    for leg, true in zip(moved, session.truth.legs, strict=True):
        np.testing.assert_allclose(
            np.asarray(leg.base_axis), np.asarray(true.base_axis), rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(
            np.asarray(leg.platform_axis), np.asarray(true.platform_axis), rtol=0, atol=1e-12
        )
