"""Fixed, freed and prior values act in the fit; those that contradict measurements are refused."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fit_sessions import BOARD_SCALE, MachineSession, corners_of, machine_session, with_board

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.parameter_choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.scale import RADII, TRAVEL, NominalSize, compare_scales
from legcal.calibration.joint_fit.solution import Solution
from legcal.errors import DidNotConverge, NotIdentifiable


@pytest.fixture(scope="module")
def session() -> MachineSession:
    return machine_session("hexapod", n_poses=6)


@pytest.fixture(scope="module")
def noisy() -> MachineSession:
    return machine_session("hexapod", n_poses=6).noisy(4)


def fitted(session: MachineSession, choices: Choices = NO_CHOICES) -> Solution:
    return session.fit(choices=choices)


def fixed_at(values: dict[str, float]) -> Choices:
    return Choices(fixed=frozenset(values), values=values)


def test_fixed_parameters_stay_at_nominal_or_at_their_values(session: MachineSession) -> None:
    names = frozenset({"leg2.offset", "leg4.base.x", "leg1.radius.leg1_tube"})
    at_truth = replace(session, legs=replace(session.legs, nominal=session.truth.legs))
    found, true = fitted(at_truth, Choices(fixed=names)), at_truth.true_values
    assert at_truth.off(found.legs) < 1e-8
    for name in ("leg2.offset", "leg4.base.x"):
        assert found.estimates.values[name] == true[name]
    assert found.radii[0, "leg1_tube"] == session.legs.radii[0, "leg1_tube"]
    assert all(found.estimates.status[name] == "fixed" for name in names)
    assert names.isdisjoint(found.estimates.names)
    parameters = session.legs.parametrization.names
    at = [parameters.index("leg2.offset"), parameters.index("leg4.base.x")]
    assert not found.kinematic.covariance[at].any()
    assert found.kinematic.covariance[parameters.index("leg1.offset")].any()
    value = session.true_values["leg3.offset"]
    found = fitted(session, fixed_at({"leg3.offset": value}))
    assert found.estimates.values["leg3.offset"] == pytest.approx(value, abs=1e-15)
    assert session.off(found.legs) < 1e-8


def test_a_tight_prior_pins_and_a_loose_one_adds_information(noisy: MachineSession) -> None:
    plain = fitted(noisy)
    at = plain.estimates.names.index("leg1.offset")
    mean, sigma = plain.estimates.values["leg1.offset"], float(plain.estimates.sigma[at])
    pinned = fitted(noisy, Choices(priors={"leg1.offset": Prior(mean + sigma, 1e-9)}))
    assert pinned.estimates.values["leg1.offset"] == pytest.approx(mean + sigma, abs=1e-10)
    assert pinned.estimates.sigma[at] == pytest.approx(1e-9, rel=1e-3)
    # A prior as good as the data goes half the way, and the variance is half.
    half = fitted(noisy, Choices(priors={"leg1.offset": Prior(mean + sigma, sigma)}))
    assert half.estimates.values["leg1.offset"] == pytest.approx(
        mean + 0.5 * sigma, abs=0.1 * sigma
    )
    assert half.estimates.sigma[at] == pytest.approx(np.sqrt(0.5) * sigma, rel=0.02)
    assert half.quality.dof == plain.quality.dof + 1


def test_a_freed_radius_has_no_prior(session: MachineSession) -> None:
    radii = {part: 1.04 * r for part, r in session.legs.radii.items()}
    wrong = replace(session, legs=replace(session.legs, radii=radii))
    names = [f"{session.legs.names[j]}.radius.{part}" for j, part in radii]
    found = fitted(wrong, Choices(free=frozenset(names)))
    for part, radius in session.legs.radii.items():
        assert found.radii[part] == pytest.approx(radius, abs=1e-9)
    # With the priors, two hundredths and two sigmas off, a little of them is left.
    with_priors = fitted(wrong)
    off = [abs(with_priors.radii[part] - r) for part, r in session.legs.radii.items()]
    assert min(off) > 1e-9
    sigmas = [(with_priors.radii[part] / r - 1.0) / 0.02 for part, r in radii.items()]
    assert with_priors.quality.chi2 == pytest.approx(np.sum(np.square(sigmas)), rel=1e-3)
    much = {part: 2.2 * r for part, r in session.legs.radii.items()}
    with pytest.raises(DidNotConverge, match="mm, and they must agree to 50 %"):
        fitted(
            replace(wrong, legs=replace(session.legs, radii=much)), Choices(free=frozenset(names))
        )


def test_a_freed_intrinsic_that_nothing_determines_is_refused(session: MachineSession) -> None:
    for names, n_open in (
        (("k3",), 1),
        (("k1", "k2", "k3", "fx", "fy", "p1", "p2", "cx", "cy"), 2),
    ):
        with pytest.raises(NotIdentifiable, match=rf"{n_open} of \d+ combinations .*of camera c1"):
            fitted(session, Choices(free=frozenset(f"c1.{name}" for name in names)))


@pytest.mark.system
def test_two_priors_that_contradict_each_other_are_refused() -> None:
    session = machine_session("3-upu", n_poses=4)
    found = [session.true_values[n] for n in ("leg2.base.x", "leg3.base.y")]
    choices = Choices(
        priors={
            "leg2.base.x": Prior(found[0], 1e-5),
            "leg3.base.y": Prior(found[1] + 0.005, 1e-5),
        }
    )
    with pytest.raises(DidNotConverge, match=r"prior of leg\d\.base\.\w contradicts"):
        fitted(session, choices)


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({"leg1.offset": 0.0042}, "measured about {true:.3g}"),
        ({"leg2.offset": 0.0, "leg3.base.x": 2e-3, "leg4.platform.y": 0.0}, "leg3.base.x"),
    ],
)
def test_wrong_fixed_values_are_refused_with_those_of_the_measurements(
    noisy: MachineSession, values: dict[str, float], found: str
) -> None:
    true = noisy.true_values
    with pytest.raises(DidNotConverge) as refusal:
        fitted(noisy, fixed_at({name: true[name] + away for name, away in values.items()}))
    (problem,) = refusal.value.problems
    wrong = max(values, key=lambda name: abs(values[name]))
    assert problem.startswith(f"The fixed value of {wrong} contradicts the measurements")
    assert found.format(true=true[wrong]) in problem


def test_right_fixed_values_are_accepted_whatever_outlines_claim() -> None:
    session = machine_session("hexapod", n_poses=10).noisy(5)
    claimed = replace(session.outlines, covariance=session.outlines.covariance / 4.0**2)
    session = replace(session, outlines=claimed)
    values = {n: v for n, v in session.true_values.items() if ".platform" in n}
    found = fitted(session, fixed_at({n: v for n, v in values.items() if "axis" not in n}))
    assert found.notes == ()


def test_a_wrong_encoder_scale_shows_in_the_radii() -> None:
    session = machine_session("hexapod", n_poses=10).noisy(6)
    found = session.with_readings(1.1 * session.measurements.q).fit()
    n = len(found.posterior.problem.legs.parametrization)
    scale = compare_scales(found.posterior, NominalSize(np.zeros(n), 0.0, 1.0))
    assert scale is not None
    (pair,) = scale.disagreements
    larger, smaller = (scale.witnesses[i] for i in (pair.larger, pair.smaller))
    assert (larger, smaller) == (TRAVEL, RADII)
    assert pair.ratio == pytest.approx(0.1, abs=0.02)


def _sized(seen: BoardCorners, factor: float) -> BoardCorners:
    (fixed,) = seen.boards
    other = replace(fixed, board=replace(fixed.board, side=factor * fixed.board.side))
    return replace(seen, boards=(other,))


@pytest.mark.parametrize("of_photographs", [False, True])
def test_a_board_of_other_dimensions_is_refused(*, of_photographs: bool) -> None:
    session = machine_session("hexapod")
    seen, start = with_board(session, corners_of(session, seed=8))
    wrong = _sized(seen, 1.02)
    with pytest.raises(DidNotConverge, match=r"board contradict .* measure the bo") as refusal:
        session.noisy(7).fit(start, board=wrong, choices=Choices(of_photographs=of_photographs))
    size = float(str(refusal.value).split("the board is ")[1].split(" times")[0])
    assert size == pytest.approx(1.0 / 1.02, rel=3e-3)


def test_the_size_of_a_board_can_be_left_to_the_fit_or_known_or_fixed() -> None:
    session = machine_session("hexapod")
    seen, start = with_board(session, corners_of(session, seed=10))
    wrong = _sized(seen, 0.98)
    fit = partial(session.noisy(9).fit, start)
    found = fit(board=wrong, choices=Choices(free=frozenset({BOARD_SCALE})))
    assert found.estimates.values[BOARD_SCALE] == pytest.approx(1.0 / 0.98, abs=2e-3)
    known = Choices(priors={BOARD_SCALE: Prior(1.0 / 0.98, 1e-4)})
    found = fit(board=wrong, choices=known)
    assert found.estimates.values[BOARD_SCALE] == pytest.approx(1.0 / 0.98, abs=3e-4)
    fixed = Choices(fixed=frozenset({BOARD_SCALE}))
    held = fit(board=seen, choices=fixed)
    assert BOARD_SCALE not in held.estimates.names
    assert "base" in held.T_frame_board
    stated = Choices(priors={BOARD_SCALE: Prior(1.0, 1e-3)})
    with pytest.raises(DidNotConverge, match=rf"prior of {BOARD_SCALE} contradicts"):
        fit(board=wrong, choices=stated)
