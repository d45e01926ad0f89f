"""Whether something moved: false alarms as often as stated, changes found and named."""

import numpy as np
import pytest

from legcal.calibration.change_detection import (
    Change,
    Movement,
    difference,
    judge_movement,
    possible_changes,
)
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import geometries, load_mechanism, parametrization_of

N = 6
PRIOR = np.array([5e-3, 5e-3, 5e-3, 5e-3, 0.05, 0.05])
LAST = 1e-9  # of what is known of the last parameter by the new images: nothing


def _matrix(rng: np.random.Generator, scale: Array) -> Array:
    root = rng.normal(size=(N, 2 * N))
    return np.asarray(root @ root.T / (2 * N) * np.outer(scale, scale))


def _changes() -> tuple[tuple[Change, ...], ...]:
    eye = np.eye(N)
    return (
        tuple(Change(f"c{i}", (f"c{i}",), ("m",), eye[:, i : i + 1]) for i in range(N)),
        (Change("both", ("c0", "c1"), ("m", "m"), eye[:, :2]),),
    )


def _compare(
    rng: np.random.Generator, moved: Array, noise_dof: int = 200, significance: float = 0.05
) -> Movement:
    """Draw an earlier result and new images of a machine that has moved since; compare them."""
    matrices = np.random.default_rng(5)
    known = _matrix(matrices, 2e-2 * PRIOR)
    information = np.linalg.inv(_matrix(matrices, 1e-2 * PRIOR))
    information[-1] *= LAST
    information[:, -1] *= LAST
    noise = np.sqrt(rng.chisquare(noise_dof) / noise_dof)  # as estimated, the truth is one
    truth = np.array([0.1, 0.2, -0.3, 0.4, 0.01, 0.02])
    old = truth + rng.multivariate_normal(np.zeros(N), known, method="eigh")
    score = rng.multivariate_normal(np.zeros(N), information, method="eigh")
    score += information @ (truth + moved - old)
    covariance = np.linalg.inv(information / noise**2 + np.diag(PRIOR**-2))
    values = old + covariance @ (score / noise**2)
    found = difference(values, covariance, PRIOR, old, known)
    return judge_movement(found, noise_dof, _changes(), significance)


def test_alarms_are_as_rare_as_stated_where_nothing_moved() -> None:
    rng = np.random.default_rng(1)
    results = [_compare(rng, np.zeros(N)) for _ in range(2000)]
    assert results[0].dof == N - 1  # of the last one the new images say nothing
    alarms = np.mean([result.moved for result in results])
    assert 0.03 < alarms < 0.07  # 4 standard deviations around 0.05
    p_values = np.sort([result.p_value for result in results])
    assert np.abs(p_values - np.linspace(0.0, 1.0, len(p_values))).max() < 0.04


def test_a_change_is_noticed_and_named_with_its_size() -> None:
    moved = np.zeros(N)
    moved[2] = 0.3 * PRIOR[2]
    result = _compare(np.random.default_rng(2), moved)
    assert result.moved
    best = result.explanations[0]
    assert best.change.what == "c2"
    assert best.p_value > result.significance
    assert abs(best.values[0] - moved[2]) < 4.0 * best.sigma[0]
    assert best.sigma[0] < 0.1 * moved[2]


def test_what_takes_two_numbers_is_not_laid_on_one() -> None:
    moved = np.zeros(N)
    moved[:2] = 0.3 * PRIOR[0], -0.3 * PRIOR[1]
    result = _compare(np.random.default_rng(3), moved)
    assert [explanation.change.what for explanation in result.explanations] == ["both"]
    assert np.all(
        np.abs(result.explanations[0].values - moved[:2]) < 4.0 * result.explanations[0].sigma
    )


def test_a_change_of_which_the_new_images_say_nothing_is_not_noticed() -> None:
    moved = np.zeros(N)
    moved[-1] = 3.0 * PRIOR[-1]
    alarms = [_compare(np.random.default_rng(i), moved, significance=1e-3) for i in range(20)]
    assert not any(result.moved for result in alarms)


def test_images_that_determine_nothing_are_refused() -> None:
    wide = np.diag(0.9 * PRIOR**2)
    with pytest.raises(NotIdentifiable, match="determine no direction"):
        difference(np.zeros(N), wide, PRIOR, np.zeros(N), np.zeros((N, N)))


@pytest.mark.parametrize(("model", "size"), [("hexapod", 7), ("3-rpr", 5), ("3-upu-tilted", 11)])
def test_a_joint_of_a_frame_leg_moves_the_coordinates_of_all_others(model: str, size: int) -> None:
    machine = load_mechanism(model)
    legs, parametrization = geometries(machine), parametrization_of(machine)
    single, joints, whole = possible_changes(
        machine.leg_names, legs, machine.frame_legs, parametrization
    )
    assert {change.what for change in single} == {f"offset of {name}" for name in machine.leg_names}
    first = machine.leg_names[machine.frame_legs[0]]
    origin = next(change for change in joints if change.what == f"base joint of {first}")
    # The origin of R_b moves: x of another joint, off the x axis or not, goes the other way.
    second = machine.leg_names[machine.frame_legs[1]]
    x = parametrization.names.index(f"{second}.base.x")
    np.testing.assert_allclose(origin.columns[x, 0], -1.0, atol=1e-6)
    assert len(origin.components) == (3 if machine.spatial else 2)
    assert [len(change.components) for change in whole] == [size] * machine.n_legs
    everything = np.concatenate([change.columns for change in whole], axis=1)
    assert np.linalg.matrix_rank(everything, tol=1e-6) == len(parametrization)
