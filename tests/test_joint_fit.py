"""The joint fit finds the truth: exactly without noise, at the Cramer-Rao bound with it.

Nothing that does not matter shows in the result: the start, names and order, the unit of length.
What cannot be fitted is refused.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dense_fit import allowed, by_differences, projected_move, residuals
from fit_sessions import (
    PINHOLE,
    MachineSession,
    disturbed_start,
    irregular_hexapod,
    machine_session,
)
from thinned import thinned

from legcal.calibration.joint_fit import fit
from legcal.calibration.joint_fit.determinacy import undetermined_directions
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import RefinementSettings, Start, State
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError, DidNotConverge, LegcalError, NotIdentifiable
from legcal.estimation.problem import Frames, linearize
from legcal.estimation.solver import information
from legcal.estimation.uncertainty import named_covariance
from legcal.geometry.types import Array
from legcal.machine.leg import ARMS, ParameterId, radius_name
from legcal.simulation.observe import moved_outlines


def errors(session: MachineSession, found: Solution) -> dict[str, float]:
    legs = session.legs
    radii = {radius_name(legs.names[j], part): r for (j, part), r in legs.radii.items()}
    truth = session.true_values | radii
    return {
        name: abs(found.estimates.values[name] - truth[name])
        for name in found.estimates.names
        if name in truth
    }


@cache
def fit_of_everything(session: MachineSession, *, known_radii: bool) -> Solution:
    """Return the fit with true radii, or without knowing any: a prior would pull on them."""
    legs = session.legs
    if not known_radii:  # they begin 2 % wrong
        wrong = 1.0 + 0.02 * np.random.default_rng(1).choice([-1.0, 1.0], len(legs.radii))
        shaken = wrong * np.array(list(legs.radii.values()))
        legs = replace(legs, radii=dict(zip(legs.radii, shaken.tolist(), strict=True)))
    names = frozenset(radius_name(legs.names[j], part) for j, part in legs.radii)
    every = legs.parametrization.names
    arms = frozenset(name for name in every if ParameterId.parse(name).kind in ARMS)
    choices = Choices(fixed=names, free=arms) if known_radii else Choices(free=names | arms)
    return replace(session, legs=legs).fit(choices=choices)


def far_session(name: str, n_poses: int = 6) -> MachineSession:
    """Return a session that starts 3 mm and 1 deg away, the cameras 1 cm and 2 deg."""
    turn = float(np.deg2rad(2.0))
    return machine_session(name, camera_shift=0.01, camera_turn=turn, n_poses=n_poses)


def starts_far_away(session: MachineSession) -> bool:
    """Say whether no parameter that is sought, and no camera, begins near the truth."""
    parametrization, away = session.legs.parametrization, session.errors(session.start.legs)
    least = {"m": 0.0029, "rad": np.deg2rad(0.7)}  # axes turn by 1 deg, both angles by 0.7
    far = [
        abs(by) > least[unit]
        for name, unit, by in zip(parametrization.names, parametrization.units, away, strict=True)
        if not name.endswith((".twist", ".gain"))
    ]
    for start, true in zip(session.start.T_camera_Rb, session.truth.T_camera_Rb, strict=True):
        far.append((start * true.inv()).rotation.magnitude() > np.deg2rad(1.9))
        far.append(np.linalg.norm(start.translation - true.translation) > 0.009)
    return all(far)


@pytest.mark.parametrize(
    ("name", "known_radii"),
    [("hexapod-rod", False), ("3-rps", False), ("tricept", False), ("delta-round-arms", True)],
)
def test_exact_outlines_give_the_truth_from_3_mm_and_1_degree_away(
    name: str, known_radii: bool
) -> None:
    session = far_session(name)
    assert starts_far_away(session)
    found = fit_of_everything(session, known_radii=known_radii)
    assert {found.estimates.units[n] for n in found.estimates.names} <= {"m", "rad"}
    for parameter, error in errors(session, found).items():
        assert error < {"m": 1e-8, "rad": 1e-7}[found.estimates.units[parameter]], parameter
    # What is not held is known to a hundredth of a leg at least, some 5 mm. Parameters that far
    # from any that explain all measurements would cost 1; 1e-12 are 5e-9 m and 1e-8 rad.
    assert found.quality.chi2 < 1e-12
    first, true_first = found.T_Rb_Re[0], session.truth.T_Rb_Re[0]
    for pose, true in zip(found.T_Rb_Re, session.truth.T_Rb_Re, strict=True):
        # Where joint centres are held, R_e stands otherwise on the platform, and R_b on the base.
        miss = pose.inv() * true
        if found.kinematic.held:
            miss = (pose * first.inv()).inv() * (true * true_first.inv())
        assert np.linalg.norm(miss.translation) < 1e-8
        assert miss.rotation.magnitude() < 1e-7


@pytest.mark.system
def test_an_arm_that_is_no_cylinder_is_left_out_as_a_whole_and_bends_nothing() -> None:
    session, rng = far_session("delta-round-arms", n_poses=4), np.random.default_rng(5)
    seen, legs = session.outlines, session.legs
    bent = np.array(seen.part) == "arm2_link"
    offsets = 20.0 * bent[:, None] * rng.choice([-1.0, 1.0], (len(seen), 2))
    radii = frozenset(radius_name(legs.names[j], part) for j, part in legs.radii)
    arms = [n for n in legs.parametrization.names if ParameterId.parse(n).kind in ARMS]
    straight = frozenset(n for n in arms if not n.startswith("arm2"))
    choices = Choices(fixed=radii, free=straight)
    found = session.moved(offsets).fit(choices=choices)
    np.testing.assert_array_equal(found.outlines.used, ~bent)
    (note,) = [n for n in found.notes if "left out as a whole" in n]
    assert "arm2" in note
    assert "arm1" not in note
    for parameter, error in errors(session, found).items():
        assert error < {"m": 1e-8, "rad": 1e-7}[found.estimates.units[parameter]], parameter


def test_of_a_3_upu_that_only_translates_all_is_found_that_images_and_readings_show() -> None:
    session = far_session("3-upu")
    found = fit_of_everything(session, known_radii=False)
    assert len(found.kinematic.held) == 7  # turns of both axes; without radii, size
    legs, true_legs = found.legs, session.truth.legs
    R, true_R = (Frames.of(poses)[0] for poses in (found.T_Rb_Re, session.truth.T_Rb_Re))
    size = np.linalg.norm(legs[1].A) / np.linalg.norm(true_legs[1].A)
    assert abs(size - 1.0) > 1e-3
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
    assert found.estimates.status["leg1.base_axis.1"] == "weak"
    spread = found.kinematic.held_covariance  # along what is held alone, as far as nominal errs
    rank = np.linalg.matrix_rank(spread, tol=1e-9 * np.abs(spread).max())
    assert rank == len(found.kinematic.held_basis)
    change = session.legs.vector(legs) - session.legs.vector(session.legs.nominal)
    is_length = np.array(session.legs.parametrization.units) == "m"
    largest = np.sqrt(np.diagonal(spread)[is_length].max())
    assert largest < 2.0 * np.abs(change[is_length]).max()


def fisher_covariance(session: MachineSession, choices: Choices) -> tuple[Array, Array]:
    """Return the covariance of the named unknowns at the truth, and the same by differences."""
    problem = build_fit(session.legs, session.measurements, session.outlines, choices=choices)
    state = problem.begin(session.truth)
    steps = allowed(problem, state).T

    def at(moved: State) -> Array:
        values = problem.coordinates(moved)
        return np.concatenate([values, residuals(problem, moved)])

    by = by_differences(problem, state, at, steps, projected_move)
    values, J = by[: len(problem.named)], by[len(problem.named) :]
    unit = np.linalg.norm(J, axis=0)
    R = np.asarray(np.linalg.qr(J / unit, mode="r"))
    root = np.linalg.solve(np.swapaxes(R, 0, 1), (values / unit).T)
    expected = root.T @ root
    normal = information(linearize(problem, state))
    undetermined_directions(normal)
    return named_covariance(normal.linear, normal.kept_covariance()), expected


@pytest.mark.parametrize(
    ("name", "choices"),
    thinned([
        ("hexapod", Choices(free=frozenset({"c1.fx", "c1.cx"}), fixed=frozenset({"leg2.offset"}))),
        ("3-rps", Choices(priors={"leg2.base_axis.1": Prior(0.0, 1e-3)})),
        ("tricept", Choices(free=frozenset({"leg1.radius.leg1_rod"}))),
        ("hexapod-rod", Choices(priors={"leg6.length": Prior(0.4, 1e-4)})),
        ("3-rpr", Choices()),
    ], lambda name, _: name in ("hexapod", "3-rpr")),
)  # fmt: skip
def test_the_covariance_is_the_inverse_of_the_fisher_matrix_by_differences(
    name: str, choices: Choices
) -> None:
    found, expected = fisher_covariance(machine_session(name, n_poses=3), choices)
    sigma = np.sqrt(np.diag(expected))
    assert np.abs((found - expected) / np.outer(sigma, sigma)).max() < 1e-4


@pytest.fixture(scope="module")
def session() -> MachineSession:
    return irregular_hexapod(6, legs_seen=5)


def test_a_leg_that_no_image_shows_is_found_from_its_encoder_whatever_its_sign() -> None:
    session, sign = irregular_hexapod(12), np.array([1, -1, 1, 1, -1, 1])
    shown = replace(session.outlines, used=session.outlines.leg != 2)
    nominal = zip(session.legs.nominal, sign.tolist(), strict=True)
    legs = replace(session.legs, nominal=tuple(replace(leg, sign=s) for leg, s in nominal))
    other = replace(session, legs=legs, outlines=shown)
    found = other.with_readings(sign * session.measurements.q).fit()
    assert session.off(found.legs) < 1e-9
    assert (2, "leg3_tube") not in found.radii


def test_errors_agree_with_the_covariance(session: MachineSession) -> None:
    normalised, z, scales, chi2, n = [], [], [], [], 12
    for seed in range(n):
        found = session.noisy(seed).fit()
        error = session.errors(found.legs)
        normalised.append(session.squares(found))
        z.append(error / found.estimates.sigma[: len(error)])
        scales.append(found.quality.noise.scale)
        chi2.append(found.quality.chi2 / found.quality.dof)
    # The mean of n chi-squares of 30 degrees, over 30: 1 with standard deviation 0.26 / sqrt(n);
    # the noise is estimated from some 200 residuals a run, which widens it a little.
    assert np.mean(normalised) == pytest.approx(1.0, abs=1.1 / np.sqrt(n))
    assert 0.75 < np.mean(np.square(z)) < 1.3
    assert np.mean(scales) == pytest.approx(1.0, abs=0.05)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.08)


def test_the_better_start_wins_and_between_equal_ones_the_first(
    session: MachineSession,
) -> None:
    noisy, good = session.noisy(5), session.start
    bad = replace(disturbed_start(session, joints=0.1, camera=0.5, angle=2.0), label="staged")
    settings = RefinementSettings(max_iterations=40)
    for starts in ([good, bad], [bad, good]):
        found = noisy.fit(starts, settings)
        assert found.start == "nominal"
        assert any("the four steps" in note for note in (*found.notes, *found.details))
    equal = replace(disturbed_start(session, seed=9), label="staged")
    assert noisy.fit([good, equal]).start == "nominal"
    assert noisy.fit([equal, good]).start == "staged"


def test_a_leg_that_one_view_takes_for_another_is_left_out_and_named(
    session: MachineSession,
) -> None:
    o = session.outlines
    wrong = (o.leg == 0) & (session.measurements.view[o.row] == 1)
    away = np.random.default_rng(0).uniform(5.0, 20.0, session.measurements.n_rows)
    by = np.where(wrong, away[o.row], 0.0)[:, None] * np.ones(2)
    found = session.moved(by).fit()
    assert any(f"of {wrong.sum()} of leg1 in view c2" in note for note in found.notes)
    assert not found.left_out  # other starts confirm it
    assert session.off(found.legs) < 1e-4
    found = session.moved(by * (o.row == o.row[wrong].min())[:, None]).fit()  # in one image
    assert not found.outlines.used.all()
    assert not found.left_out


# Refusals


Change = Callable[[Outlines], Outlines]


def scattered(o: Outlines) -> Outlines:
    by = np.random.default_rng(0).uniform(-15.0, 15.0, (len(o), 2))
    return moved_outlines(o, PINHOLE, by)


@pytest.mark.parametrize(
    ("change", "error", "found"),
    [
        (lambda o: replace(o, used=o.row < 0), NotIdentifiable, "0 outlines and 108 readings"),
        (
            lambda o: replace(o, edge=3 - o.edge),
            DidNotConverge,
            "right legs and edges|outlines rejected",
        ),
        (scattered, DidNotConverge, r"outlines rejected and an error of \d+.\d px"),
        (
            lambda o: replace(o, covariance=o.covariance @ np.diag([1.0, -1.0])),
            DatasetError,
            r"leg\d in c1_000.png .* not positive definite",
        ),
        (lambda o: replace(o, part=("pipe", *o.part[1:])), DatasetError, r"leg\d\.pipe"),
        (
            lambda o: replace(o, gamma=np.where(o.row == 5, 2.2, 1.0), by_gamma=0.0 * o.row + 1.0),
            DatasetError,
            r"view c1 could not be used.*1 and 2\.2",
        ),
    ],
    ids=["none", "swapped edges", "scattered", "covariance", "part", "gammas"],
)
def test_outlines_that_cannot_be_fitted_are_refused(
    session: MachineSession, change: Change, error: type[LegcalError], found: str
) -> None:
    m = session.measurements
    camera = replace(PINHOLE, gamma_is_given=False)
    m = replace(m, views=tuple(replace(view, camera=camera) for view in m.views))
    with pytest.raises(error, match=found):
        replace(session, measurements=m, outlines=change(session.outlines)).fit()


@pytest.mark.parametrize(
    ("few", "found"),
    [
        (
            irregular_hexapod(1, n_views=2),
            r"2 images with 16 outlines and 12 readings give \d+ equations",
        ),
        (irregular_hexapod(10), r"\d+ of \d+ combinations .* with a prior"),
    ],
    ids=["two images", "one leg"],
)
def test_images_that_do_not_determine_the_parameters_are_refused(
    few: MachineSession, found: str
) -> None:
    shown = few.outlines
    if "prior" in found:
        shown = few.noisy(0).outlines
        shown = replace(shown, used=shown.leg == 0)
    with pytest.raises(NotIdentifiable, match=found):
        replace(few, outlines=shown).fit(few.truth)


def test_a_start_far_away_is_refused(session: MachineSession) -> None:
    far = disturbed_start(session, joints=0.1, camera=0.5, angle=2.0)
    with pytest.raises(DidNotConverge, match=r"still falls by|outlines rejected"):
        session.fit(far)
    with pytest.raises(DidNotConverge, match=r"still falls|outlines rejected") as refused:
        session.fit([far, far])
    assert len(refused.value.problems) == 1
    with pytest.raises(DidNotConverge, match="needs at least one"):
        session.fit([])


def test_the_start_of_the_lowest_cost_is_refined_wherever_it_stands(
    session: MachineSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = [replace(session.truth, label=label) for label in ("second", "first", "third")]
    costs = {"first": 1.0, "second": 2.0, "third": 3.0}
    unwatched = fit._first_minimum

    def with_cost(problem: FitProblem, start: Start) -> object:
        return replace(unwatched(problem, start), cost=costs[start.label])

    monkeypatch.setattr(fit, "_first_minimum", with_cost)
    assert session.fit(starts).start == "first"
