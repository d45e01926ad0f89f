"""Fixed values, rejections and radii that make a fit suspicious are refused or told."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import MachineSession, machine_session, shifted
from thinned import thinned

from legcal.calibration.joint_fit.choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.errors import DidNotConverge


@pytest.fixture(scope="module")
def session() -> MachineSession:
    exact = machine_session("hexapod", n_poses=16)
    measurements, outlines = exact.noisy(4)
    return replace(exact, measurements=measurements, outlines=outlines)


def fitted(session: MachineSession, choices: Choices = NO_CHOICES) -> Solution:
    return refine(
        session.legs, session.measurements, session.outlines, session.start, choices=choices
    )


def true_values(session: MachineSession) -> dict[str, float]:
    legs = session.legs
    return dict(
        zip(legs.parametrization.names, legs.vector(session.truth.legs).tolist(), strict=True)
    )


def fixed_at(values: dict[str, float]) -> Choices:
    return Choices(fixed=frozenset(values), values=values)


@pytest.mark.parametrize("away", [0.0042, -0.15])
def test_a_wrong_fixed_value_is_refused_with_what_the_measurements_say(
    session: MachineSession, away: float
) -> None:
    true = true_values(session)["leg1.offset"]
    with pytest.raises(DidNotConverge, match=r"fixed value of leg1\.offset contradicts") as found:
        fitted(session, fixed_at({"leg1.offset": true + away}))
    (problem,) = found.value.problems
    assert f"they say about {true:.3g}" in problem


def test_only_the_wrong_one_of_several_fixed_values_is_named(session: MachineSession) -> None:
    true = true_values(session)
    names = ["leg1.offset", "leg2.offset", "leg3.base.x", "leg4.platform.y"]
    values = {name: true[name] for name in names} | {"leg3.base.x": true["leg3.base.x"] + 2e-3}
    with pytest.raises(DidNotConverge) as found:
        fitted(session, fixed_at(values))
    (problem,) = found.value.problems
    assert "leg3.base.x" in problem


def test_a_wrong_fixed_radius_is_refused(session: MachineSession) -> None:
    name = "leg1.radius.leg1_tube"
    wrong = 1.2 * session.legs.radii[0, "leg1_tube"]
    with pytest.raises(DidNotConverge, match=r"fixed value of leg1\.radius\.leg1_tube"):
        fitted(session, fixed_at({name: wrong}))


def test_a_wrong_fixed_intrinsic_is_refused(session: MachineSession) -> None:
    with pytest.raises(DidNotConverge, match=r"fixed value of c1\.fx .*they say about 1290 px"):
        fitted(session, fixed_at({"c1.fx": 1303.0}))


@pytest.mark.parametrize("scale", thinned([1.0, 4.0], [4.0]))
@pytest.mark.parametrize("part", ["offset", "base", "platform", "radius"])
def test_right_fixed_values_are_believed_whatever_outlines_claim(part: str, scale: float) -> None:
    exact = machine_session("hexapod", n_poses=16)
    measurements, outlines = exact.noisy(5)
    claimed = replace(outlines, covariance=outlines.covariance / scale**2)
    session = replace(exact, measurements=measurements, outlines=claimed)
    radii = {f"{exact.legs.names[j]}.radius.{p}": r for (j, p), r in exact.legs.radii.items()}
    values = {n: v for n, v in (true_values(exact) | radii).items() if f".{part}" in n}
    found = fitted(session, fixed_at({n: v for n, v in values.items() if "axis" not in n}))
    assert found.notes == ()


def test_right_fixed_values_are_believed_beside_wrong_outlines(session: MachineSession) -> None:
    rng = np.random.default_rng(7)
    n = len(session.outlines)
    wrong = rng.random(n) < 0.2
    sign = np.where(rng.random(n) < 0.5, 1.0, -1.0)
    offsets = (wrong * sign * rng.uniform(2.0, 30.0, n))[:, None] * np.ones(2)
    outlines = shifted(session, session.outlines, offsets)
    true = true_values(session)
    choices = fixed_at({name: true[name] for name in ("leg1.offset", "leg2.base.x")})
    found = fitted(replace(session, outlines=outlines), choices)
    (note,) = found.notes
    assert note.startswith(f"The fit left out {wrong.sum()} of {n} outlines that disagree")


def test_a_leg_most_of_whose_outlines_disagree_is_named(session: MachineSession) -> None:
    own = np.flatnonzero(session.outlines.leg == 3)
    offsets = np.zeros((len(session.outlines), 2))
    offsets[own[: 2 * len(own) // 3]] = 12.0 * (-1.0) ** np.arange(2 * len(own) // 3)[:, None]
    outlines = shifted(session, session.outlines, offsets)
    choices = Choices(priors={"leg4.offset": Prior(true_values(session)["leg4.offset"], 1e-3)})
    found = fitted(replace(session, outlines=outlines), choices)
    (note,) = found.notes
    assert f"{2 * len(own) // 3} of {len(own)} of leg4" in note
    assert "what was stated of leg4.offset" in note
    assert "leg3" not in note


def test_a_fit_that_priors_keep_from_converging_names_them() -> None:
    session = machine_session("3-upu")
    choices = Choices(
        priors={
            name: Prior(0.0, 1e-4)
            for name in session.legs.parametrization.names
            if ".base." in name
        }
    )
    with pytest.raises(DidNotConverge) as found:
        fitted(session, choices)
    assert "leg2.base.x" in found.value.problems[0]


def test_a_prior_far_off_is_named_with_what_the_measurements_say() -> None:
    session = machine_session("tricept")
    true = true_values(session)["centre.twist"]
    choices = Choices(priors={"centre.twist": Prior(true - 1.4, 2e-4)})
    with pytest.raises(DidNotConverge, match=r"prior of centre\.twist contradicts"):
        fitted(session, choices)


@pytest.mark.parametrize(("factor", "way"), [(0.9, "10 % smaller"), (1.1, "10 % larger")])
def test_a_wrong_encoder_scale_is_told_by_the_radii(factor: float, way: str) -> None:
    session = machine_session("hexapod", n_poses=16)
    measurements, outlines = session.noisy(6)
    measurements = replace(measurements, q=factor * measurements.q)
    found = fitted(replace(session, measurements=measurements, outlines=outlines))
    assert any(note.startswith(f"All radii come out {way}") for note in found.notes)


def test_one_wrong_radius_is_no_wrong_scale(session: MachineSession) -> None:
    radii = {part: r * (1.1 if part[0] == 0 else 1.0) for part, r in session.legs.radii.items()}
    found = fitted(replace(session, legs=replace(session.legs, radii=radii)))
    assert found.notes == ()
