"""Change detection: rare false alarms, changes found and named, results read back as written."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edits import added
from simulated import files_of, simulated

from legcal import Dataset, calibrate, check, load_dataset, load_mechanism
from legcal.calibration.verification import (
    Change,
    Movement,
    determined_parts,
    difference,
    judge_movement,
    noise_dof,
    possible_changes,
)
from legcal.data.image_choice import dataset_at
from legcal.errors import DatasetError, NotIdentifiable, UsageError
from legcal.geometry.motions import frame_on_points
from legcal.geometry.types import Array
from legcal.machine.parameters import geometries, parametrization_of, vector_of

pytestmark = pytest.mark.usefixtures("without_steps")

MODEL = "3-rpr"


def _simulated(
    folder: Path, model: str = MODEL, *, poses: int = 4, views: int = 1, **changes: Any
) -> Path:
    """Simulate outlines; the true machine depends on the seed alone."""
    return simulated(folder, model, poses=poses, views=views, **changes).folder


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a calibration, a focal length among its parameters."""
    folder = tmp_path_factory.mktemp("earlier")
    dataset = load_dataset(_simulated(folder / "set", poses=8, views=2))
    fx = float(dataset.measurements.views[0].camera.K[0, 0])
    calibrate(dataset, output=folder / "result", priors={"c1.fx": (fx, 1.0)})
    return folder / "result"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few new images of the same machine."""
    return _simulated(tmp_path_factory.mktemp("new") / "set")


def _of_leg(dataset: Dataset, leg: int) -> Dataset:
    assert dataset.observations is not None
    shown = dataset.observations.choose(dataset.observations.leg == leg)
    return replace(dataset, observations=shown)


def test_images_of_the_calibration_itself_are_no_proof(result: Path, images: Path) -> None:
    again = check(result.parent / "set", result)
    assert not again.movement.moved
    assert "those of the earlier calibration" in again.notes[0]
    assert not any(
        "those of the earlier calibration" in note for note in check(images, result).notes
    )


def test_a_machine_that_was_left_alone_has_not_moved(result: Path, images: Path) -> None:
    before = files_of(images)
    found = check(images, result)
    assert not found.movement.moved
    assert found.movement.explanations == ()
    assert found.at_platform.dX_m < 4.0 * found.at_platform.sigma_dX_m
    assert files_of(images) == before


def test_many_images_contradict_a_result_of_few_by_no_more_than_its_errors(
    result: Path, images: Path, tmp_path: Path
) -> None:
    calibrate(images, output=tmp_path / "few")
    found = check(result.parent / "set", tmp_path / "few")
    assert not found.movement.moved
    assert found.movement.p_value > found.movement.significance


def test_an_encoder_that_slipped_is_found_with_its_size(
    result: Path, images: Path, tmp_path: Path
) -> None:
    slipped = Path(shutil.copytree(images, tmp_path / "slipped"))
    added("measurements.csv", "leg2_prismatic", -3e-4)(slipped)
    found = check(slipped, result)
    assert found.movement.moved
    best = found.movement.explanations[0]
    assert best.what == "offset of leg2"
    assert best.values[0] == pytest.approx(3e-4, abs=4.0 * best.sigma[0])
    assert 0.0 < best.sigma[0] < 1e-4
    assert found.at_platform.dX_m > found.at_platform.sigma_dX_m


@pytest.mark.system
def test_few_images_of_a_hexapod_show_an_encoder_that_slipped_and_else_raise_no_alarm(
    tmp_path: Path,
) -> None:
    """Of one pose before three cameras other minima fit as well, millimetres away."""
    session = load_dataset(_simulated(tmp_path / "set", "hexapod", poses=16, views=3, seed=1))
    pose = session.measurements.pose
    calibrate(dataset_at(session, np.flatnonzero(pose < 14)), output=tmp_path / "out")
    for new in (14, 15):
        images = dataset_at(session, np.flatnonzero(pose == new))
        assert not check(images, tmp_path / "out").movement.moved
        q = images.measurements.q.copy()
        q[:, 1] -= 3e-3
        slipped = replace(images, measurements=replace(images.measurements, q=q))
        found = check(slipped, tmp_path / "out")
        assert found.movement.moved
        assert "offset of leg2" in [e.what for e in found.movement.explanations]


def test_images_of_one_leg_are_refused_or_raise_no_alarm(
    result: Path, images: Path, tmp_path: Path
) -> None:
    found = check(_of_leg(load_dataset(images), 0), result)
    assert not found.movement.moved
    assert found.movement.dof <= 4
    one = load_dataset(_simulated(tmp_path / "one", poses=1))
    with pytest.raises(NotIdentifiable, match="The fit is not determined") as refused:
        check(_of_leg(one, 0), result)
    assert len(refused.value.problems) == 1


@pytest.mark.parametrize("significance", [0.0, -0.1, 0.6, float("nan")])
def test_a_significance_that_is_no_small_probability_is_refused(significance: float) -> None:
    with pytest.raises(UsageError, match=r"found the significance .* needed a probability above 0"):
        check("images", "result", significance=significance)


# Refusals; more of them are in refusal_table.py.


def test_the_result_of_another_machine_is_refused(result: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="the result of another machine, with the leg leg1"):
        check(_simulated(tmp_path / "set", "3-spr", poses=2), result)


# The test statistic by itself, on linear models.

N = 6
PRIOR = np.array([5e-3, 5e-3, 5e-3, 5e-3, 0.05, 0.05])
LAST = 1e-9  # of the information on the last parameter in the new images: none


def _matrix(rng: np.random.Generator, scale: Array) -> Array:
    root = rng.normal(size=(N, 2 * N))
    return np.asarray(root @ root.T / (2 * N) * np.outer(scale, scale))


def _compare(seed: int, moved: Array, significance: float = 0.05) -> Movement:
    """Draw an earlier result and new images of a machine that has moved since; compare them."""
    matrices, rng = np.random.default_rng(5), np.random.default_rng(seed)
    old_covariance = _matrix(matrices, 2e-2 * PRIOR)
    information = np.linalg.inv(_matrix(matrices, 1e-2 * PRIOR))
    information[-1] *= LAST
    information[:, -1] *= LAST
    dof = 200
    noise = np.sqrt(rng.chisquare(dof) / dof)  # as estimated, the truth is one
    truth = np.array([0.1, 0.2, -0.3, 0.4, 0.01, 0.02])
    old = truth + rng.multivariate_normal(np.zeros(N), old_covariance, method="eigh")
    score = rng.multivariate_normal(np.zeros(N), information, method="eigh")
    score += information @ (truth + moved - old)
    covariance = np.linalg.inv(information / noise**2 + np.diag(PRIOR**-2))
    values = old + covariance @ (score / noise**2)
    found = difference(values, covariance, PRIOR, old, old_covariance)
    away = values - old
    saved = float(away @ np.linalg.solve(covariance + old_covariance, away))
    parts = determined_parts(covariance, PRIOR)
    single = tuple(
        Change("", f"c{i}", (f"c{i}",), ("m",), ("",), np.eye(N)[:, i : i + 1]) for i in range(N)
    )
    pair = (Change("", "both", ("c0", "c1"), ("m", "m"), ("", ""), np.eye(N)[:, :2]),)
    return judge_movement(found, saved, parts, dof, (single, pair), significance)


def test_alarms_are_as_rare_as_stated_where_nothing_moved() -> None:
    results = [_compare(seed, np.zeros(N)) for seed in range(1500)]
    assert results[0].dof == N - 1  # the new images do not determine the last one
    assert 0.028 < np.mean([result.moved for result in results]) < 0.072  # 4 sigma around 0.05
    p_values = np.sort([result.p_value for result in results])
    assert np.abs(p_values - np.linspace(0.0, 1.0, len(p_values))).max() < 0.045


@pytest.mark.parametrize(("columns", "named"), [([2], "c2"), ([0, 1], "both")])
def test_the_simplest_change_that_suffices_is_named_with_its_size(
    columns: list[int], named: str
) -> None:
    moved = np.zeros(N)
    moved[columns] = 0.3 * PRIOR[columns] * [1.0, -1.0][: len(columns)]
    result = _compare(2, moved)
    assert result.moved
    best = result.explanations[0]
    assert best.what == named
    assert best.p_value > result.significance
    assert np.all(np.abs(best.values - moved[columns]) < 4.0 * np.array(best.sigma))
    assert best.sigma[0] < 0.1 * abs(moved[columns[0]])


def test_a_change_that_the_new_images_do_not_determine_raises_no_alarm() -> None:
    moved = np.zeros(N)
    moved[-1] = 3.0 * PRIOR[-1]
    assert not any(_compare(seed, moved, significance=1e-3).moved for seed in range(20))
    with pytest.raises(NotIdentifiable, match="determine no direction"):
        difference(np.zeros(N), np.diag(0.9 * PRIOR**2), PRIOR, np.zeros(N), np.zeros((N, N)))


def test_priors_that_data_dominate_are_no_degrees_of_freedom() -> None:
    """A linear fit of n data with unit noise and wide priors of p parameters: n - p are left."""
    rng, n, p = np.random.default_rng(7), 40, 5
    J, sigma = rng.normal(size=(n, p)), np.full(p, 1e3)
    covariance = np.asarray(np.linalg.inv(J.T @ J + np.diag(sigma**-2)))
    assert noise_dof(n + p - p, covariance, sigma) == n - p
    narrow = np.full(p, 1e-3)  # the data add nothing: all priors stay residuals
    assert noise_dof(n, np.asarray(np.diag(narrow**2), dtype=np.float64), narrow) == n


def test_what_changes_at_a_motor_that_moves_joints_at_A_is_named() -> None:
    machine, joint = load_mechanism("hexaglide"), "rail4"
    legs, found = geometries(machine), parametrization_of(machine)
    changes = single, joints, whole = possible_changes(machine, found.names)
    everything = np.concatenate([change.columns for change in whole], axis=1)
    n_gains = sum(name.endswith(".gain") for name in found.names)
    assert np.linalg.matrix_rank(everything, tol=1e-6) == len(found) - n_gains
    (axis,) = (c for c in joints if c.what.split()[0] == "direction" and joint in c.what)
    assert len(axis.components) == 2
    # A reading is too small by 1e-4: joints at A stand where they were at that reading.
    moved = [
        replace(leg, A=leg.actuator.at(leg.A, np.array([1e-4]))[0])
        if leg.actuator is not None and leg.actuator.joint == joint
        else leg
        for leg in legs
    ]
    platform = [leg.B for leg in legs]
    frame = list(machine.frame_legs)
    T = frame_on_points(np.array([leg.A for leg in moved])[frame]).inv()
    there = [
        replace(
            leg,
            A=T.apply(leg.A),
            B=B,
            actuator=leg.actuator and leg.actuator.in_frame(T.as_matrix()),
        )
        for leg, B in zip(moved, platform, strict=True)
    ]
    step = vector_of(found, there, legs) - vector_of(found, legs, legs)
    n = len(found)
    found_step, saved = (np.eye(n), step, 1e-14 * np.eye(n)), 1e14 * float(step @ step)
    movement = judge_movement(found_step, saved, np.ones(n), 500, changes, 1e-3)
    best = movement.explanations[0]
    assert best.what == f"zero of {joint}"
    assert best.values[0] == pytest.approx(1e-4, rel=1e-3)
    assert len(movement.explanations) == 1
    assert {c.what for c in single} >= {f"length of {name}" for name in machine.leg_names}
