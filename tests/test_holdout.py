"""Which images are kept aside: whole poses, by chance, no leg loses more than its share."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hexapod_example import HEXAPOD
from outline_tables import outlines_of

from legcal.data.dataset import Dataset, load_dataset
from legcal.data.holdout import dataset_at, split_images
from legcal.data.measurements import Measurements
from legcal.data.rows import Order, measurements_at, reorder_measurements
from legcal.errors import NotIdentifiable, UsageError
from legcal.geometry.types import IntArray


@cache
def _example() -> Dataset:
    return replace(load_dataset(HEXAPOD, check_images=False), observations=None)


def _with(measurements: Measurements) -> Dataset:
    return replace(_example(), measurements=measurements)


def _names(dataset: Dataset, rows: IntArray) -> set[str]:
    return {dataset.measurements.image[row] for row in rows.tolist()}


@pytest.mark.parametrize(("fraction", "count"), [(0.2, 9), (0.5, 22), (0.01, 1), (0.9, 40)])
def test_the_asked_part_of_the_images_is_kept_aside_view_by_view(
    fraction: float, count: int
) -> None:
    dataset = _example()
    split = split_images(dataset, fraction)
    assert len(split[1]) == count
    both = np.concatenate([split[0], split[1]])
    assert sorted(both.tolist()) == list(range(45))
    aside = np.bincount(dataset.measurements.view[split[1]], minlength=3)
    assert aside.max() <= np.ceil(15 * fraction)


def test_images_of_one_pose_stay_together() -> None:
    m = _example().measurements
    shared = replace(m, pose=np.tile(np.arange(15), 3), q=np.tile(m.q[:15], (3, 1)))
    split = split_images(_with(shared), 0.2)
    assert len(split[1]) == 9
    assert len(set(shared.pose[split[1]].tolist())) == 3


def test_the_choice_does_not_depend_on_the_order_of_the_rows() -> None:
    given = _example()
    rows = np.random.default_rng(3).permutation(45)
    order = Order(rows, np.array([2, 0, 1]), np.arange(6))
    other = _with(reorder_measurements(given.measurements, order))
    chosen = split_images(given, 0.2), split_images(other, 0.2)
    assert _names(given, chosen[0][1]) == _names(other, chosen[1][1])


def test_a_leg_that_few_images_show_stays_in_them() -> None:
    dataset = _example()
    table = outlines_of(1, range(45), legs=(0, 1), rejected=0.0)
    rare = (table.leg == 0) & ~np.isin(table.row, [4, 20, 21])
    table = replace(table, used=~rare)
    for fraction in (0.2, 0.6):
        split = split_images(replace(dataset, observations=table), fraction)
        assert 4 in split[0]  # alone in its view
        assert set(split[0].tolist()) & {20, 21}


def test_the_part_that_is_fitted_is_a_dataset_of_its_own() -> None:
    dataset = _example()
    table = outlines_of(2, range(45), legs=(0, 1))
    rows = split_images(dataset, 0.2)[0]
    part = dataset_at(replace(dataset, observations=table), rows)
    assert part.measurements.n_rows == 36
    assert part.measurements.pose.tolist() == list(range(36))
    assert part.image_path(0) == dataset.image_path(int(rows[0]))
    assert part.observations is not None
    kept = np.isin(table.row, rows)
    np.testing.assert_array_equal(rows[part.observations.row], table.row[kept])
    np.testing.assert_array_equal(part.observations.h, table.h[kept])


def test_poses_and_labels_of_a_part_follow_its_rows() -> None:
    m = _example().measurements
    labels = tuple(f"p{k}" for k in range(15))
    shared = replace(m, pose=np.tile(np.arange(15), 3), pose_labels=labels)
    part = measurements_at(shared, np.array([17, 2, 5, 35]))
    assert part.pose.tolist() == [0, 0, 1, 1]
    assert part.pose_labels == ("p2", "p5")
    assert part.image == tuple(m.image[row] for row in (17, 2, 5, 35))
    assert len(outlines_of(3, range(4)).at(np.zeros(0, dtype=np.intp))) == 0


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.2, 20.0, float("nan"), float("inf")])
def test_a_fraction_that_is_none_is_refused(fraction: float) -> None:
    with pytest.raises(UsageError, match="needed a number between 0 and 1"):
        split_images(_example(), fraction)


@pytest.mark.parametrize("rows", [[0], [0, 15], [0, 15, 30]])
def test_too_few_images_to_keep_any_aside_are_refused(rows: list[int]) -> None:
    dataset = dataset_at(_example(), np.array(rows))
    with pytest.raises(NotIdentifiable, match=rf"found {len(rows)} images? of {len(rows)} poses?,"):
        split_images(dataset, 0.2)
