"""Cameras of which nobody told how they encode light: their outlines tell it."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from dataset_folder import Folder, folder
from hexapod_session import (
    PINHOLE,
    Session,
    disturbed_start,
    joint_errors,
    moved_outlines,
    noisy_outlines,
    simulate,
)
from simulated import settings

import legcal
from legcal.calibration.joint_fit.factors import known_gammas
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.outline_errors import (
    GAMMA_RANGE,
    GAMMA_TOLERANCE,
    LIMB_SIGMA,
    MAX_GAMMA_STEP,
    RECOVERED_SHARE,
    EstimatedGamma,
    next_gammas,
)
from legcal.calibration.outline_detection import detect
from legcal.data.dataset import load_dataset
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError
from legcal.simulation.dataset import simulate as simulate_folder
from legcal.vision.cylinder import EPSILON

__all__ = ["folder"]
LOG_GAMMA = 0.6


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(8, legs_seen=5, sigma_px=0.05)


def untold(measurements: Measurements) -> Measurements:
    """Return measurements of views of one camera whose gamma is not told."""
    camera = dataclasses.replace(PINHOLE, gamma_is_given=False)
    views = tuple(dataclasses.replace(view, camera=camera) for view in measurements.views)
    return dataclasses.replace(measurements, views=views)


def encoded(session: Session, log_gamma: float = LOG_GAMMA, seed: int = 3) -> Outlines:
    """Return noisy outlines that were measured with a gamma of one, of a camera with another."""
    rng = np.random.default_rng(seed)
    outlines = noisy_outlines(session, rng)
    by_gamma = rng.normal(0.0, 0.2, len(outlines))
    inward = -by_gamma * log_gamma * EPSILON[outlines.edge - 1]
    # Normals of moved_outlines point to one side of the leg: to the inside of one of both edges.
    small = moved_outlines(outlines, PINHOLE, np.full((len(outlines), 2), 1e-3))
    xy = PINHOLE.undistort(small.ends[:, 0])
    side = np.sign(np.sum(outlines.h * np.column_stack([xy, np.ones(len(xy))]), axis=1))
    moved = moved_outlines(outlines, PINHOLE, np.repeat((side * inward)[:, None], 2, axis=1))
    return dataclasses.replace(moved, gamma=np.ones(len(moved)), by_gamma=by_gamma)


def test_gamma_of_a_camera_is_found_by_its_outlines(session: Session) -> None:
    measurements = untold(session.measurements)
    outlines = encoded(session)
    start = disturbed_start(session)
    found = refine(session.legs, measurements, outlines, start)
    (gamma,) = found.gammas
    assert gamma.views == ("c1", "c2", "c3")
    assert gamma.measured_with == 1.0
    assert gamma.fitted_sigma < 0.02
    of_fit, unseen = gamma.fitted_sigma / RECOVERED_SHARE, np.log(gamma.gamma)  # as much again
    assert gamma.sigma == pytest.approx(np.sqrt(of_fit**2 + unseen**2 + LIMB_SIGMA**2))
    assert np.log(gamma.gamma) == pytest.approx(LOG_GAMMA, abs=0.06)  # the fit's own three sigmas
    assert any("The gamma of the camera of views c1, c2, c3 is not told" in n for n in found.notes)
    assert not any("gamma" in name for name in found.biases)
    as_linear = refine(session.legs, session.measurements, outlines, start)
    right, wrong = (np.sqrt(np.mean(joint_errors(s.parameters) ** 2)) for s in (found, as_linear))
    assert right < wrong
    assert found.rms_px is not None
    assert as_linear.rms_px is not None
    assert found.rms_px < 0.7 * as_linear.rms_px


def test_view_whose_gamma_is_given_keeps_it(session: Session) -> None:
    views = untold(session.measurements).views
    told = dataclasses.replace(views[0], camera=PINHOLE)
    measurements = dataclasses.replace(session.measurements, views=(told, *views[1:]))
    found = refine(session.legs, measurements, encoded(session), disturbed_start(session))
    (gamma,) = found.gammas
    assert gamma.views == ("c2", "c3")


def test_outlines_that_are_kept_tell_with_which_gamma_to_measure_others(session: Session) -> None:
    outlines = encoded(session)
    outlines = dataclasses.replace(outlines, gamma=np.full(len(outlines), 1.8))
    found = known_gammas(outlines, untold(session.measurements))
    assert found == dict.fromkeys(("c1", "c2", "c3"), 1.8)
    assert known_gammas(outlines, session.measurements) == {}
    rejected = dataclasses.replace(outlines, used=np.zeros(len(outlines), dtype=np.bool_))
    assert known_gammas(rejected, untold(session.measurements)) == {}


def test_pull_of_a_gamma_is_that_of_its_sigma(session: Session) -> None:
    measurements = untold(session.measurements)
    start, pulls = disturbed_start(session, joints=0.0, camera=0.0, angle=0.0), []
    for seed in range(6):
        found = refine(session.legs, measurements, encoded(session, seed=seed), start).gammas[0]
        pulls.append((np.log(found.gamma) - LOG_GAMMA) / found.fitted_sigma)
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.8


def test_told_gamma_is_not_touched(session: Session) -> None:
    outlines = encoded(session, log_gamma=0.0)
    bare = dataclasses.replace(outlines, gamma=np.zeros(0), by_gamma=np.zeros(0))
    start = disturbed_start(session)
    told = refine(session.legs, session.measurements, outlines, start)
    without = refine(session.legs, session.measurements, bare, start)
    assert told.gammas == without.gammas == ()
    np.testing.assert_array_equal(told.covariance, without.covariance)
    assert told.values == without.values


def test_table_that_knows_nothing_of_gamma_is_fitted_as_before(session: Session) -> None:
    outlines, start = noisy_outlines(session, np.random.default_rng(0)), disturbed_start(session)
    unknown = untold(session.measurements)
    with_unknown = refine(session.legs, unknown, outlines, start)
    as_before = refine(session.legs, session.measurements, outlines, start)
    assert with_unknown.gammas == ()
    assert with_unknown.values == as_before.values
    np.testing.assert_array_equal(with_unknown.covariance, as_before.covariance)


def test_each_camera_has_its_own_gamma(session: Session) -> None:
    cameras = [
        dataclasses.replace(
            PINHOLE, K=PINHOLE.K + 1e-9 * np.diag([k, k, 0.0]), gamma_is_given=k < 2
        )
        for k in range(3)
    ]
    views = tuple(
        dataclasses.replace(view, camera=camera)
        for view, camera in zip(session.measurements.views, cameras, strict=True)
    )
    measurements = dataclasses.replace(session.measurements, views=views)
    of_last = measurements.view[session.outlines.row] == 2
    outlines = encoded(session)
    linear = encoded(session, log_gamma=0.0)
    h = np.where(of_last[:, None], outlines.h, linear.h)
    ends = np.where(of_last[:, None, None], outlines.ends, linear.ends)
    mixed = dataclasses.replace(outlines, h=h, ends=ends)
    (gamma,) = refine(session.legs, measurements, mixed, disturbed_start(session)).gammas
    assert gamma.views == ("c3",)
    assert np.log(gamma.gamma) == pytest.approx(LOG_GAMMA, abs=0.1)


def test_outlines_of_one_camera_that_were_measured_with_two_gammas_are_refused(
    session: Session,
) -> None:
    outlines = encoded(session)
    gamma = outlines.gamma.copy()
    gamma[5] = 2.2
    other = dataclasses.replace(outlines, gamma=gamma)
    measurements = untold(session.measurements)
    with pytest.raises(DatasetError, match=r"view c1 could not be used.*1 and 2\.2") as refused:
        refine(session.legs, measurements, other, disturbed_start(session))
    assert len(refused.value.problems) == 1


@pytest.mark.parametrize("share", [0.35, 0.6, 1.0])
@pytest.mark.parametrize("true", [1.0, 1.6, 2.2])
def test_search_comes_to_rest_near_the_gamma_at_which_fits_see_nothing(
    true: float, share: float
) -> None:
    read, found = 1.0, list[tuple[EstimatedGamma, ...]]()
    for _ in range(4):
        seen = share * np.log(true / read)
        found.append((EstimatedGamma(("c1", "c2"), read * float(np.exp(seen)), 0.05, read),))
        gammas = next_gammas(found)
        if not gammas:
            break
        assert set(gammas) == {"c1", "c2"}
        assert GAMMA_RANGE[0] <= gammas["c1"] <= GAMMA_RANGE[1]
        assert abs(np.log(gammas["c1"] / read)) <= MAX_GAMMA_STEP + 1e-12
        read = gammas["c1"]
    assert gammas == {}
    assert abs(np.log(true / read)) <= GAMMA_TOLERANCE / share + 1e-12


def test_note_says_where_gamma_is_hardly_told_and_names_few_views() -> None:
    clear = str(EstimatedGamma(("c1",), 2.1, 0.05, 2.0))
    assert clear.startswith("The gamma of the camera of view c1 is not told: found 2.10 +- 0.43 by")
    vague = str(EstimatedGamma(tuple(f"c{k}" for k in range(8)), 1.2, 0.4, 1.0))
    assert "of views c0, c1, c2, c3, c4 and 3 more is not told, and its outlines hardly" in vague


def test_photographs_are_not_read_with_a_gamma_that_no_camera_has() -> None:
    assert next_gammas([(EstimatedGamma(("c1",), 0.6, 0.05, 1.0),)]) == {}
    assert next_gammas([(EstimatedGamma(("c1",), 4.5, 0.05, 2.9),)]) == {}
    assert next_gammas([(EstimatedGamma(("c1",), 0.6, 0.05, 1.5),)]) == {"c1": 1.0}


def test_gamma_that_may_be_chance_is_not_followed() -> None:
    assert next_gammas([(EstimatedGamma(("c1",), 1.3, 0.2, 1.0),)]) == {}
    assert next_gammas([(EstimatedGamma(("c1",), 1.3, 0.1, 1.0),)]) != {}


def test_dataset_says_whether_gamma_is_given(folder: Folder) -> None:
    folder.entry["views"]["c1"]["gamma"] = 1
    cameras = {v.name: v.camera for v in load_dataset(folder.write()).measurements.views}
    assert cameras["c1"].gamma_is_given
    assert not any(c.gamma_is_given for name, c in cameras.items() if name != "c1")
    assert all(camera.gamma == 1.0 for camera in cameras.values())


@pytest.mark.slow
def test_photographs_without_a_gamma_are_read_with_the_one_they_show(tmp_path: Path) -> None:
    session = settings(level="photographs", poses=5, views=3, seed=1, tell_gamma=False)
    data = simulate_folder("hexapod", tmp_path / "data", session).folder
    assert "gamma" not in (data / "dataset.yaml").read_text()
    assert any("c1, c2, c3 is not told and was taken as 1" in n for n in detect(data).notes)
    found = legcal.calibrate(data)
    (gamma,) = found.solution.gammas
    assert abs(np.log(gamma.gamma / 2.2)) < 3.0 * gamma.sigma
    assert gamma.gamma > 1.4
    assert gamma.measured_with > 1.3
    with (data / "observations.csv").open(newline="") as file:
        read = {row["gamma"] for row in csv.DictReader(file)} - {""}
    assert {float(cell) for cell in read} == {gamma.measured_with}
    again = legcal.calibrate(data)  # by the table, which knows with what it was measured
    assert again.solution.gammas[0].gamma == pytest.approx(gamma.gamma, rel=1e-6)
