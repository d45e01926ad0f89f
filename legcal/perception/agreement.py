"""How well images agree with what is assumed of their machine: readings, model, cameras.

The legs of all images of a view vote for one camera pose, as in recognition, and what counts is how
many legs they show there. Nothing is measured, so that many assumptions can be compared.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from legcal.geometry import Array, IntArray
from legcal.perception.camera_search import START_PICTURES, flipped, place_camera
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import Picture
from legcal.perception.placement import Group, Search, sensor_extent
from legcal.workers import Run

AGREES = 0.5  # of the legs that an image should show, from which on it agrees
QUICK_STARTS = 1, 1  # as START_PICTURES, where many assumptions are compared


@dataclass(frozen=True, eq=False)
class Agreement:
    """How well images agree with one assumption."""

    row: IntArray  # (n,) of the images
    share: Array  # (n,) of the legs that each should show
    support: float  # legs that agree, in all images together
    expected: float  # legs that the images should show

    @property
    def images(self) -> int:
        """How many images agree."""
        return int(np.sum(self.share >= AGREES))


def pairs_of_images(search: Search, rows: Sequence[int], run: Run) -> dict[int, CandidatePairs]:
    """Return the edge pairs of images by row, which hold whatever is assumed."""
    return dict(zip(rows, run(partial(_pairs_of_image, search), rows), strict=True))


def _pairs_of_image(search: Search, row: int) -> CandidatePairs:
    """Return the edge pairs of the image of a row."""
    return search.pairs(row, int(search.measurements.view[row]))


def as_if(pairs: CandidatePairs, corners: Array, flip: Array, focal: float) -> CandidatePairs:
    """Return edge pairs as if the image were turned over, or the focal length another.

    ``corners`` (2, 2) are of the sensor plane as it is; ``flip`` (2,) is -1 along axes that are
    turned over, ``focal`` the other focal length as a part of the one that is given.
    """
    pairs = flipped(pairs, corners, flip)
    return replace(
        pairs,
        middle=pairs.middle / focal,
        half_length=pairs.half_length / focal,
        width=pairs.width / focal,
        merit=pairs.merit / focal,
        pixel=pairs.pixel / focal,
    )


def compare_assumptions(
    assumptions: Iterable[tuple[Search, Array, float]],
    groups: Sequence[Group],
    run: Run,
    *,
    quick: bool,
) -> list[Agreement]:
    """Return how well the images of some groups of views agree with each of some assumptions.

    An assumption is what should be seen (with the edge pairs of all images), whether images are
    turned over (2,) as in :func:`as_if`, and a factor on focal lengths. Rows at which the legs are
    not known (NaN) agree with nothing. *quick* looks at a few images of each view.
    """
    tasks = []
    for search, flip, focal in assumptions:
        for group in groups:
            rows = group.some if quick else group.rows
            known = [r for r in rows if np.isfinite(search.B_base[r]).all()]
            pictures = {row: _picture(search, row, flip, focal) for row in known}
            tasks.append(_Task(group.pictures(pictures, known), known, search.n_legs, quick))
    found = list(run(_agreement, tasks))
    n = len(groups)
    return [_together(found[k : k + n], groups, quick) for k in range(0, len(found), n)]


@dataclass(frozen=True, eq=False)
class _Task:
    """The images of a group of views under one assumption, for any process."""

    pictures: list[Picture]
    rows: list[int]
    n_legs: int
    quick: bool


def _picture(search: Search, row: int, flip: Array, focal: float) -> Picture:
    """Return what an image shows under an assumption, and what it should."""
    view = int(search.measurements.view[row])
    corners = sensor_extent(search.measurements.views[view].camera)
    pairs = as_if(search.edge_pairs[row], corners, flip, focal)
    return Picture(pairs, search.targets(row, view), corners / focal)


def _agreement(task: _Task) -> Agreement:
    """Return how well the images of a group agree."""
    n = len(task.rows)
    row, nothing = np.array(task.rows, dtype=np.intp), np.zeros(n)
    if n == 0:
        return Agreement(row, nothing, 0.0, 0.0)
    placed = place_camera(
        task.pictures, task.n_legs, QUICK_STARTS if task.quick else START_PICTURES
    )
    if len(placed.poses) == 0:
        return Agreement(row, nothing, 0.0, 0.0)
    expected = placed.expected[0]
    share = placed.support[0] / np.maximum(expected, 1e-9)
    return Agreement(row, share, float(placed.score[0]), float(expected.sum()))


def _together(parts: Sequence[Agreement], groups: Sequence[Group], quick: bool) -> Agreement:
    """Return the agreement of all groups; images that were not compared agree with nothing."""
    row = np.concatenate([g.some if quick else g.rows for g in groups]).astype(np.intp)
    of_row = {r: s for part in parts for r, s in zip(part.row.tolist(), part.share, strict=True)}
    return Agreement(
        row,
        np.array([of_row.get(r, 0.0) for r in row.tolist()]),
        sum(part.support for part in parts),
        sum(part.expected for part in parts),
    )
