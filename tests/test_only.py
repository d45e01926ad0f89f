"""``--only``: tolerances as priors, one group of parameters, horns on other teeth."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edits import added, keyed
from simulated import settings, simulated

from legcal import (
    Calibration,
    ParameterErrors,
    Spread,
    calibrate,
    identifiability,
    load_dataset,
    load_mechanism,
)
from legcal.calibration.identify.identifiability import identifiability_of_dataset
from legcal.calibration.joint_fit.parameter_choices import Group, choices_of
from legcal.calibration.joint_fit.part_errors import part_errors, with_zeros
from legcal.calibration.joint_fit.platform import WrittenGroup
from legcal.calibration.joint_fit.predicted import read_noise
from legcal.calibration.joint_fit.variables import fitted_legs
from legcal.errors import UsageError
from legcal.machine.parameters import geometries, in_joint_frames, vector_of
from legcal.machine.tolerance import TYPICAL
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import Distribution

TOOTH = 2.0 * np.pi / 25


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three images of a servo hexapod whose fourth horn is a tooth further than it reads."""
    folder = tmp_path_factory.mktemp("only") / "session"
    small = Spread(0.1e-3, Distribution.NORMAL)
    errors = ParameterErrors(base_joints=small, platform_joints=small, lengths=small)
    drawn: dict[str, Any] = {"errors": errors, "poses": 1, "sampling": "workspace", "seed": 4}
    simulated(folder, "servo-hexapod", views=3, **drawn)
    keyed("dataset.yaml", machine_kind="machined", spline_teeth=25)(folder)
    added("measurements.csv", "servo4", -TOOTH)(folder)
    return folder


@pytest.fixture(scope="module")
def found(session: Path) -> Calibration:
    return calibrate(session, only="zeros", output=session / "result")


def test_a_horn_on_another_tooth_is_named(found: Calibration) -> None:
    assert found.group is not None
    assert {z.motor: z.teeth for z in found.group.zeros if z.teeth} == {"servo4": 1}
    assert "servo4 is 14." in found.verdict.sentence
    assert "one tooth of its spline is 14.4 deg; the others are within" in found.verdict.sentence
    document = found.result.document()
    assert document["only"] == "zeros"
    assert [zero["teeth"] for zero in document["zeros"]] == [0, 0, 0, 1, 0, 0]


def test_zeros_of_rails_are_told_relative_to_each_other(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    small = Spread(0.2e-3, Distribution.NORMAL)
    errors = ParameterErrors(base_joints=small, platform_joints=small, lengths=small)
    simulate("linear-delta", folder, settings(poses=3, views=3, errors=errors))
    keyed("dataset.yaml", machine_kind="bought")(folder)
    rails = calibrate(folder, only="zeros")
    assert rails.group is not None
    assert all(zero.sigma > 0.55 * zero.tolerance for zero in rails.group.zeros)
    assert "relative to each other" in rails.group.sentence
    apart = re.search(r"± ([0-9.]+) mm; their common part", rails.group.sentence)
    assert apart is not None
    assert float(apart[1]) < 0.6 * 1e3 * rails.group.zeros[0].sigma + 0.05


def test_zeros_are_within_three_of_their_sigma(found: Calibration) -> None:
    assert found.group is not None
    true = {"servo4": TOOTH}
    for zero in found.group.zeros:
        assert abs(zero.value - true.get(zero.motor, 0.0)) < 3.0 * zero.sigma


def test_the_written_model_keeps_all_but_zeros(session: Path, found: Calibration) -> None:
    assert found.group is not None
    written = load_mechanism(session / "result" / "calibrated.yaml")
    zeros = {zero.motor: zero.written for zero in found.group.zeros}
    expected = with_zeros(load_dataset(session).machine.legs, zeros)
    for leg, other in zip(written.legs, expected, strict=True):
        np.testing.assert_allclose(leg.A, other.A, atol=1e-11)
        np.testing.assert_allclose(leg.B, other.B, atol=1e-11)
        assert leg.q0 == pytest.approx(other.q0, abs=1e-11)
        assert leg.actuator is not None
        assert other.actuator is not None
        np.testing.assert_allclose(leg.actuator.axis, other.actuator.axis, atol=1e-11)


def test_without_tolerances_it_is_refused(session: Path) -> None:
    dataset = load_dataset(session)
    machine = replace(dataset.machine, tolerance=type(dataset.machine.tolerance)())
    with pytest.raises(UsageError, match="machine_kind"):
        calibrate(replace(dataset, machine=machine), only="zeros")


@pytest.mark.parametrize("model", ["servo-hexapod", "tricept"])
def test_zeros_move_parameters_as_the_prior_says(model: str) -> None:
    machine = load_mechanism(model)
    legs = fitted_legs(machine)
    errors, rng = part_errors(legs, TYPICAL["bought"]), np.random.default_rng(1)
    at, motors = errors.of("zeros"), [machine.legs[j].motor_label for j in machine.motors]
    drawn = 0.01 * errors.sigma[at] * rng.normal(size=len(at))
    moved = with_zeros(legs.nominal, dict(zip(motors, drawn.tolist(), strict=True)))
    framed = in_joint_frames(moved, machine.frame_legs)
    x = vector_of(legs.parametrization, framed, geometries(machine))
    change = errors.J[:, at] @ drawn
    np.testing.assert_allclose(x - errors.centre, change, atol=2e-3 * np.abs(change).max())


def test_the_posterior_of_parts_is_bayes_rule() -> None:
    """Errors given parameters measured with noise: as of their joint Gaussian."""
    errors = part_errors(fitted_legs(load_mechanism("3-rpr")), TYPICAL["bought"])
    some = np.diagonal(errors.covariance) > 0.0
    noise = 0.3 * np.diag(np.diagonal(errors.covariance))[np.ix_(some, some)]
    prior, J = errors.covariance[np.ix_(some, some)], errors.J[some]
    true = np.random.default_rng(3).multivariate_normal(np.zeros(len(prior)), prior)
    S = np.diag(errors.sigma**2)
    G = S @ J.T @ np.linalg.inv(J @ S @ J.T + noise)
    C = prior - prior @ np.linalg.inv(prior + noise) @ prior  # of the parameters, after the fit
    x = errors.centre.copy()
    x[some] += prior @ np.linalg.inv(prior + noise) @ true
    wide = np.zeros((len(x), len(x)))
    wide[np.ix_(some, some)] = C
    value, covariance = errors.posterior(x, wide)
    np.testing.assert_allclose(value, G @ true, atol=1e-9)
    np.testing.assert_allclose(covariance, S - G @ J @ S, atol=1e-12)


@pytest.mark.parametrize("only", ["zeros", "lengths"])
def test_identify_says_how_well_a_group_will_be_known(only: Group) -> None:
    machine = replace(load_mechanism("3-rpr"), tolerance=TYPICAL["bought"])
    report = identifiability(machine, [machine.leg_names], 2, only=only)
    n, parts = len(machine.motors) if only == "zeros" else 0, report.parts or ()
    assert [one.part for one in parts] == list(machine.leg_names)[:n]
    assert all(0.0 < one.sigma < one.tolerance for one in parts)
    assert sum("Expected of the zeros" in note for note in report.notes) == bool(n)


def test_the_platform_error_is_predicted_as_it_is_stated(tmp_path: Path) -> None:
    folder, small = tmp_path / "session", Spread(0.5e-3, Distribution.NORMAL)
    errors = ParameterErrors(base_joints=small, platform_joints=small, lengths=small)
    drawn: dict[str, Any] = {"errors": errors, "poses": 2, "sampling": "workspace", "seed": 0}
    simulated(folder, "servo-hexapod", views=3, **drawn)
    keyed("dataset.yaml", machine_kind="printed")(folder)
    found = calibrate(folder, only="zeros", output=folder / "result")
    choices, noise = choices_of(found.dataset, only="zeros"), read_noise(folder / "result")
    sizes = []
    for some in (choices, replace(choices, only="all")):
        report = identifiability_of_dataset(found.dataset, some, noise)
        assert report.platform_sigma is not None
        sizes.append(report.platform_sigma.dX_m)
    assert found.platform is not None
    assert sizes[0] == pytest.approx(found.platform.sigma.rms[0], rel=0.25)
    assert sizes[0] > 2.0 * sizes[1]


def test_what_a_group_leaves_is_that_of_machines_with_these_tolerances() -> None:
    machine = replace(load_mechanism("servo-hexapod"), tolerance=TYPICAL["machined"])
    legs, rng = fitted_legs(machine), np.random.default_rng(1)
    errors = part_errors(legs, machine.tolerance.completed(machine.size))
    J, S, n = errors.J, np.diag(errors.sigma**2), 4000
    rows = rng.normal(size=(12, len(J))) @ J  # of images that tell a few combinations
    rows /= np.linalg.norm(rows * errors.sigma, axis=1)[:, None]
    gain = S @ rows.T @ np.linalg.inv(rows @ S @ rows.T + 0.01 * np.eye(12))
    posterior = S - gain @ rows @ S
    true = rng.normal(size=(n, len(S))) * errors.sigma
    value = (true @ rows.T + 0.1 * rng.normal(size=(n, 12))) @ gain.T
    framed = in_joint_frames(legs.nominal, legs.frame_legs)
    group = WrittenGroup.of(machine, framed, J, errors.of_group("zeros"))
    held = value - value @ group.left.T
    assert not held[:, ~errors.of_group("zeros")].any()
    found = (true - held) @ J.T
    predicted = np.diagonal(group.covariance(posterior, S - posterior))
    some = predicted > 0.0
    np.testing.assert_allclose((found**2).mean(axis=0)[some], predicted[some], rtol=0.15)
