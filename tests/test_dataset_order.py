"""Canonical order and held-out images: neither depends on the order of rows, views and legs."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hexapod_example import HEXAPOD
from hypothesis import given, settings
from hypothesis import strategies as st
from outline_tables import LEG_NAMES, assert_same, outlines_of, recorded

from legcal.data.dataset import Dataset, load_dataset
from legcal.data.image_choice import dataset_at, split_images
from legcal.data.image_tables import Order, canonical_order, reorder_measurements
from legcal.data.measurements import Measurements, images_in_words
from legcal.errors import NotIdentifiable, UsageError

FAST = settings(deadline=None, max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)
IMAGES = ("b", "a", "", "", "d", "c", "", "")


def _session() -> Measurements:
    """Eight rows of five poses in two views; some without an image, some without a label."""
    recording = recorded(IMAGES)
    pose = np.array([0, 1, 2, 0, 3, 1, 4, 2], dtype=np.intp)
    q = recording.q[pose]
    q[:, 1] = np.nan  # a passive leg
    return replace(recording, pose=pose, q=q, pose_labels=("z", "y", "", "x", "w"))


def _shuffled(seed: int) -> Order:
    rng = np.random.default_rng(seed)
    return Order(rng.permutation(8), rng.permutation(2), rng.permutation(3))


def _names(m: Measurements) -> list[tuple[str, str, str]]:
    return [
        (m.views[v].name, image, m.pose_labels[p])
        for v, image, p in zip(m.view, m.image, m.pose, strict=True)
    ]


@FAST
@given(SEEDS)
def test_canonical_order_forgets_the_order_of_the_files(seed: int) -> None:
    expected = reorder_measurements(_session(), canonical_order(_session(), LEG_NAMES))
    order = _shuffled(seed)
    mixed = reorder_measurements(_session(), order)
    legs = [LEG_NAMES[leg] for leg in order.legs]
    found = reorder_measurements(mixed, canonical_order(mixed, legs))
    assert _names(found) == _names(expected)
    np.testing.assert_array_equal(found.q, expected.q)
    np.testing.assert_array_equal(found.pose, expected.pose)
    assert [view.name for view in found.views] == ["left", "right"]
    assert [found.views[v].name for v in found.view] == ["left"] * 4 + ["right"] * 4
    assert found.image == ("", "", "a", "c", "", "", "b", "d")


@FAST
@given(SEEDS)
def test_tables_follow_their_images_and_legs_and_are_restored(seed: int) -> None:
    outlines, order = outlines_of(seed), _shuffled(seed)
    order = replace(order, rows=np.random.default_rng(seed).permutation(4))
    moved = order.reorder(outlines)
    keys = zip(order.rows[moved.row], order.legs[moved.leg], moved.edge, moved.h, strict=True)
    before = zip(outlines.row, outlines.leg, outlines.edge, outlines.h, strict=True)
    of_key = {(row, leg, edge): h for row, leg, edge, h in before}
    for row, leg, edge, h in keys:
        np.testing.assert_array_equal(h, of_key[row, leg, edge])
    assert_same(order.restore(moved), outlines.sort())


def test_numbers_in_names_are_in_order() -> None:
    """Notes list views and images so."""
    names = [f"phone-{k}" for k in (1, 10, 2, 11)]
    m = recorded(tuple(names))
    m = replace(m, view=np.zeros(4, dtype=np.intp))
    order = canonical_order(m, LEG_NAMES)
    assert [m.image[row] for row in order.rows] == ["phone-1", "phone-2", "phone-10", "phone-11"]
    views = tuple(replace(m.views[0], name=name) for name in names)
    in_hand = replace(m, views=views, view=np.arange(4), image=("",) * 4)
    found = reorder_measurements(in_hand, canonical_order(in_hand, LEG_NAMES))
    assert images_in_words(found, range(4)).startswith(
        "4 images of views phone-1, phone-2, phone-10, phone-11 "
    )


# Held-out images.


@cache
def _example() -> Dataset:
    return replace(load_dataset(HEXAPOD, check_images=False), observations=None)


@pytest.mark.parametrize(("fraction", "count"), [(0.2, 9), (0.5, 22), (0.01, 1), (0.9, 40)])
def test_the_fraction_is_held_out_of_every_view(fraction: float, count: int) -> None:
    dataset = _example()
    fitted, held_out = split_images(dataset, fraction)
    assert len(held_out) == count
    assert sorted([*fitted, *held_out]) == list(range(45))
    of_view = np.bincount(dataset.measurements.view[held_out], minlength=3)
    assert of_view.max() <= np.ceil(15 * fraction)


def test_the_choice_does_not_depend_on_the_order_of_the_rows() -> None:
    rows = np.random.default_rng(3).permutation(45)
    order = Order(rows, np.array([2, 0, 1]), np.arange(6))
    mixed = reorder_measurements(_example().measurements, order)
    names = [
        {dataset.measurements.image[row] for row in split_images(dataset, 0.2)[1].tolist()}
        for dataset in (_example(), replace(_example(), measurements=mixed))
    ]
    assert names[0] == names[1]


def test_a_leg_that_few_images_show_stays_in_them() -> None:
    table = outlines_of(1, range(45), legs=(0, 1), rejected=0.0)
    rare = (table.leg == 0) & ~np.isin(table.row, [4, 20, 21])
    dataset = replace(_example(), observations=replace(table, used=~rare))
    for fraction in (0.2, 0.6):
        fitted, _ = split_images(dataset, fraction)
        assert 4 in fitted  # alone in its view
        assert set(fitted.tolist()) & {20, 21}


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.2, 20.0, float("nan"), float("inf")])
def test_a_fraction_outside_zero_and_one_is_refused(fraction: float) -> None:
    with pytest.raises(UsageError, match="needed a number between 0 and 1"):
        split_images(_example(), fraction)


@pytest.mark.parametrize("rows", [[0], [0, 15], [0, 15, 30]])
def test_too_few_images_to_hold_any_out_are_refused(rows: list[int]) -> None:
    dataset = dataset_at(_example(), np.array(rows))
    with pytest.raises(NotIdentifiable, match=rf"found {len(rows)} images? of {len(rows)} poses?,"):
        split_images(dataset, 0.2)
