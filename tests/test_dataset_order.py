"""The canonical order: the same whatever the order of rows, views and legs in the files."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from outline_tables import LEG_NAMES, assert_same, outlines_of, recorded

from legcal.data.measurements import Measurements
from legcal.data.rows import (
    Order,
    canonical_order,
    inverse,
    reorder_measurements,
    sort_rows,
)

FAST = settings(deadline=None, max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)
IMAGES = ("b", "a", "", "", "d", "c", "", "")


def session() -> Measurements:
    """Eight rows of five poses in two views; some without an image, some without a label."""
    recording = recorded(IMAGES)
    pose = np.array([0, 1, 2, 0, 3, 1, 4, 2], dtype=np.intp)
    q = recording.q[pose]
    q[:, 1] = np.nan  # a passive leg
    return replace(recording, pose=pose, q=q, pose_labels=("z", "y", "", "x", "w"))


def shuffled(seed: int) -> Order:
    rng = np.random.default_rng(seed)
    return Order(rng.permutation(8), rng.permutation(2), rng.permutation(3))


def names(measurements: Measurements) -> list[tuple[str, str, str]]:
    return [
        (measurements.views[v].name, image, measurements.pose_labels[p])
        for v, image, p in zip(
            measurements.view, measurements.image, measurements.pose, strict=True
        )
    ]


@FAST
@given(SEEDS)
def test_canonical_order_forgets_the_order_of_the_files(seed: int) -> None:
    expected = reorder_measurements(session(), canonical_order(session(), LEG_NAMES))
    order = shuffled(seed)
    mixed = reorder_measurements(session(), order)
    mixed_names = [LEG_NAMES[leg] for leg in order.legs]
    found = reorder_measurements(mixed, canonical_order(mixed, mixed_names))
    assert names(found) == names(expected)
    np.testing.assert_array_equal(found.q, expected.q)
    np.testing.assert_array_equal(found.pose, expected.pose)
    assert [view.name for view in found.views] == ["left", "right"]


@FAST
@given(SEEDS)
def test_reordered_rows_keep_their_views_labels_poses_and_readings(seed: int) -> None:
    order = shuffled(seed)
    mixed = reorder_measurements(session(), order)
    for new, old in enumerate(order.rows):
        assert names(mixed)[new] == names(session())[old]
        np.testing.assert_array_equal(mixed.q[new], session().q[old, order.legs])
    together = mixed.pose[:, None] == mixed.pose
    was_together = session().pose[:, None] == session().pose
    np.testing.assert_array_equal(together, was_together[np.ix_(order.rows, order.rows)])
    _, first = np.unique(mixed.pose, return_index=True)
    assert np.all(np.diff(first) > 0)


@FAST
@given(SEEDS)
def test_restored_outlines_are_those_before_reordering(seed: int) -> None:
    outlines, order = outlines_of(seed), shuffled(seed)
    order = replace(order, rows=np.random.default_rng(seed).permutation(4))
    assert_same(order.restore(order.reorder(outlines)), outlines.sort())


def test_reordered_outlines_stay_with_their_image_and_leg() -> None:
    outlines = outlines_of(1, rows=(0, 1))
    order = Order(np.array([1, 0]), np.array([1, 0]), np.array([2, 0, 1]))
    found = order.reorder(outlines)
    assert found.part[0] == "leg, C_rod"
    assert (found.row[0], found.leg[0]) == (0, 0)
    np.testing.assert_array_equal(found.h[0], outlines.h[10])


def test_rows_are_sorted_by_view_then_image() -> None:
    plain = replace(session(), pose_labels=())
    rows = sort_rows(plain)
    view_names = [plain.views[v].name for v in plain.view[rows]]
    assert view_names == ["left"] * 4 + ["right"] * 4
    assert [plain.image[i] for i in rows][2:4] == ["a", "c"]


def test_inverse_undoes_a_permutation() -> None:
    p = np.array([2, 0, 3, 1])
    np.testing.assert_array_equal(inverse(p)[p], np.arange(4))
