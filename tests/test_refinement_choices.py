"""What is fixed, freed or known beforehand acts in the fit; contradictions are refused."""

from dataclasses import replace

import numpy as np
import pytest
from machine_session import LENS, MachineSession, machine_session

from legcal.calibration.joint_fit.choices import NO_CHOICES, Choices, Prior
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.solution import Solution
from legcal.data.measurements import View
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.vision.camera import with_intrinsics


@pytest.fixture(scope="module")
def session() -> MachineSession:
    return machine_session("hexapod", n_poses=8)


def seen_by(session: MachineSession, number: float, key: str = "fx") -> MachineSession:
    """Return a session whose cameras are believed to have another number."""
    measurements = session.measurements
    camera = with_intrinsics(LENS, {key: number})
    views = tuple(View(v.name, camera) for v in measurements.views)
    # The outlines are where they are in the image, and on the sensor plane where it is believed.
    outlines = replace(session, measurements=replace(measurements, views=views))
    xy = camera.undistort(session.outlines.ends)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    h = np.cross(rays[:, 0], rays[:, 1])
    h *= np.sign(np.sum(h * session.outlines.h, axis=1, keepdims=True))
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    return replace(outlines, outlines=replace(session.outlines, h=h))


def fitted(session: MachineSession, choices: Choices = NO_CHOICES) -> Solution:
    return refine(
        session.legs, session.measurements, session.outlines, session.start, choices=choices
    )


def truth(session: MachineSession, name: str) -> float:
    legs = session.legs
    values = legs.vector(session.truth.legs)
    return float(values[legs.parametrization.names.index(name)])


def test_a_fixed_parameter_stays_exactly_at_nominal(session: MachineSession) -> None:
    names = frozenset({"leg2.offset", "leg4.base.x", "leg1.radius.leg1_tube"})
    right = replace(session.legs, nominal=session.truth.legs)
    found = fitted(replace(session, legs=right), Choices(fixed=names))
    for name in ("leg2.offset", "leg4.base.x"):
        assert found.values[name] == truth(session, name)
    assert found.radii[0, "leg1_tube"] == session.legs.radii[0, "leg1_tube"]
    assert all(found.status[name] == "fixed" for name in names)
    assert names.isdisjoint(found.names)
    p = session.legs.parametrization.names
    at = [p.index("leg2.offset"), p.index("leg4.base.x")]
    assert not found.kinematic_covariance[at].any()
    assert found.kinematic_covariance[p.index("leg1.offset")].any()
    away = session.legs.vector(found.legs) - session.legs.vector(session.truth.legs)
    assert np.abs(away).max() < 1e-8


def test_a_parameter_fixed_at_a_value_stands_there(session: MachineSession) -> None:
    value = truth(session, "leg3.offset")
    choices = Choices(fixed=frozenset({"leg3.offset"}), values={"leg3.offset": value})
    found = fitted(session, choices)
    assert found.values["leg3.offset"] == pytest.approx(value, abs=1e-15)
    away = session.legs.vector(found.legs) - session.legs.vector(session.truth.legs)
    assert np.abs(away).max() < 1e-8


@pytest.mark.parametrize("name", ["leg2.base_axis.1", "leg1.platform_axis.2"])
def test_an_axis_fixed_at_an_angle_stands_there(name: str) -> None:
    session = machine_session("3-rps" if "base" in name else "3-spr")
    choices = Choices(fixed=frozenset({name}), values={name: truth(session, name)})
    found = fitted(session, choices)
    assert found.values[name] == pytest.approx(truth(session, name), abs=1e-12)
    assert found.status[name] == "fixed"
    away = session.legs.vector(found.legs) - session.legs.vector(session.truth.legs)
    assert np.abs(away).max() < 1e-7


def test_a_tight_prior_pins_and_a_loose_one_adds_what_it_says(session: MachineSession) -> None:
    measurements, outlines = session.noisy(0)
    noisy = replace(session, measurements=measurements, outlines=outlines)
    plain = fitted(noisy)
    at = plain.names.index("leg1.offset")
    mean, sigma = plain.values["leg1.offset"], float(plain.sigma[at])
    pinned = fitted(noisy, Choices(priors={"leg1.offset": Prior(mean + sigma, 1e-9)}))
    assert pinned.values["leg1.offset"] == pytest.approx(mean + sigma, abs=1e-10)
    assert pinned.sigma[at] == pytest.approx(1e-9, rel=1e-3)
    # A prior as good as the data goes half the way, and the variance is half.
    half = fitted(noisy, Choices(priors={"leg1.offset": Prior(mean + sigma, sigma)}))
    assert half.values["leg1.offset"] == pytest.approx(mean + 0.5 * sigma, abs=0.1 * sigma)
    assert half.sigma[at] == pytest.approx(np.sqrt(0.5) * sigma, rel=0.02)
    assert half.dof == plain.dof + 1


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


@pytest.mark.parametrize(
    ("key", "wrong", "true"), [("fx", 1303.0, 1290.0), ("cx", 520.0, 518.0), ("k1", -0.10, -0.12)]
)
def test_a_freed_intrinsic_is_found(
    session: MachineSession, key: str, wrong: float, true: float
) -> None:
    believed = seen_by(session, wrong, key)
    found = fitted(believed, Choices(free=frozenset({f"c1.{key}"})))
    assert found.status[f"c1.{key}"] == "estimated"
    assert found.values[f"c1.{key}"] == pytest.approx(true, rel=1e-6)
    away = session.legs.vector(found.legs) - session.legs.vector(session.truth.legs)
    assert np.abs(away).max() < 1e-7
    # Equal cameras are one camera.
    assert len({camera.K[0, 0] for camera in found.cameras}) == 1


def test_an_intrinsic_fixed_at_its_value_is_used(session: MachineSession) -> None:
    believed = seen_by(session, 1303.0)
    choices = Choices(fixed=frozenset({"c1.fx"}), values={"c1.fx": 1290.0})
    found = fitted(believed, choices)
    assert found.cameras[0].K[0, 0] == 1290.0
    away = session.legs.vector(found.legs) - session.legs.vector(session.truth.legs)
    assert np.abs(away).max() < 1e-8


def test_a_freed_intrinsic_that_nothing_determines_is_refused(session: MachineSession) -> None:
    with pytest.raises(NotIdentifiable, match=r"leave open .*of camera c1"):
        fitted(session, Choices(free=frozenset({"c1.k1", "c1.k2", "c1.k3", "c1.fx", "c1.fy",
                                                "c1.p1", "c1.p2", "c1.cx", "c1.cy"})))  # fmt: skip


def test_priors_determine_what_images_do_not() -> None:
    session = machine_session("3-upu")
    free = fitted(session)
    assert free.status["leg2.base.x"] == "weak"
    name = "leg2.base.x"
    known = Choices(priors={name: Prior(truth(session, name), 1e-5)})
    found = fitted(session, known)
    assert len(found.held) == len(free.held) - 1
    assert found.status[name] == "estimated"
    assert found.values[name] == pytest.approx(truth(session, name), abs=1e-5)


def test_what_is_held_stays_at_nominal() -> None:
    session = machine_session("3-upu")
    found = fitted(session)
    legs = session.legs
    names = legs.parametrization.names
    change = legs.vector(found.legs) - legs.vector(legs.nominal)
    pairs = [
        [names.index(f"leg{j}.{side}_axis.{angle}") for side in ("base", "platform")]
        for j in (1, 2, 3)
        for angle in (1, 2)
    ]
    # Base and platform axes part, as the truth wants, and their means stay.
    assert np.abs(change[pairs].sum(axis=1)).max() < 1e-3
    assert np.abs(change[pairs]).max() > 5e-3
    assert sum("axis" in words for words in found.held) == 6
    weak = {name for name, status in found.status.items() if status == "weak"}
    assert weak.isdisjoint(found.names)


def test_a_prior_that_contradicts_the_measurements_is_refused(session: MachineSession) -> None:
    far = truth(session, "leg1.offset") + 0.01
    choices = Choices(priors={"leg1.offset": Prior(far, 1e-4)})
    with pytest.raises(DidNotConverge, match=r"prior of leg1\.offset contradicts the measurements"):
        fitted(session, choices)


def test_two_priors_that_contradict_each_other_are_refused() -> None:
    session = machine_session("3-upu")
    found = truth(session, "leg2.base.x"), truth(session, "leg3.base.y")
    choices = Choices(
        priors={
            "leg2.base.x": Prior(found[0], 1e-5),
            "leg3.base.y": Prior(found[1] + 0.005, 1e-5),
        }
    )
    with pytest.raises(DidNotConverge, match=r"prior of leg\d\.base\.\w contradicts"):
        fitted(session, choices)
