"""Agreement of images with hypotheses on their machine: readings, model, cameras.

The legs of all images of a view vote for one camera pose, as in recognition, and what counts is how
many legs they show there. Nothing is measured, so that many assumptions can be compared.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.tables import Table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.perception.camera_search import flipped, place_camera
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import Picture
from legcal.perception.placement import Group, Search
from legcal.workers import Run

AGREES = 0.5  # of the legs that an image should show, from which on it agrees
_MIN_EXPECTED = 1e-9


@dataclass(frozen=True, eq=False)
class Agreement(Table):
    """Agreement of images with one hypothesis."""

    common = ("cameras",)

    row: IntArray  # (n,) of the images
    support: Array  # (n,) legs that agree with each, less its share of the cost of shifted joints
    expected: Array  # (n,) legs that each should show
    cameras: tuple[RigidTransform | None, ...]  # T_base_group of each group of views, where found

    @classmethod
    def joined(cls, parts: Sequence["Agreement"]) -> "Agreement":
        """Return the agreement of several groups together."""
        cameras = tuple(T for part in parts for T in part.cameras)
        return replace(super().joined(parts), cameras=cameras)

    @classmethod
    def of_places(cls, parts: Sequence["Agreement"], rows: Sequence[int]) -> "Agreement":
        """Return the agreement of the images of one group, whose cameras stood in several places.

        The images are in the order of *rows*; the camera is that of the first place.
        """
        if len(parts) == 1:
            return parts[0]
        joined = super().joined(parts)
        place = {row: i for i, row in enumerate(joined.row.tolist())}
        return joined.choose(np.array([place[row] for row in rows], dtype=np.intp))

    def at(self, rows: Sequence[int]) -> "Agreement":
        """Return the agreement of some images."""
        return self.choose(np.isin(self.row, rows))

    @property
    def share(self) -> Array:
        """Share of the legs that each image should show, (n,)."""
        return self.support / np.maximum(self.expected, _MIN_EXPECTED)

    @property
    def agrees(self) -> BoolArray:
        """Which images agree, (n,)."""
        return np.asarray(self.share >= AGREES)

    @property
    def images(self) -> int:
        """Number of images that agree."""
        return int(self.agrees.sum())

    @property
    def mean(self) -> float:
        """Share of the legs that all images together should show."""
        return float(self.support.sum() / max(self.expected.sum(), _MIN_EXPECTED))


@dataclass(frozen=True, eq=False)
class Assumption:
    """The predicted legs in the images of a group of views."""

    search: Search  # with the edge pairs of all images
    flip: Array  # (n_rows, 2) of images, as in :func:`as_if`
    focal: float  # focal lengths as a part of the stated ones
    group: Group
    rows: Sequence[int]  # of the images that are asked
    starts: Sequence[int]  # as START_PICTURES
    known: Sequence[RigidTransform] = ()  # T_base_group that are tried first


def pairs_of_outlines(outlines: Outlines, measurements: Measurements) -> dict[int, CandidatePairs]:
    """Return the edge pairs by row that both used outlines of a part make, whatever leg they name.

    Nothing of rows without any.
    """
    index = {key: i for i, key in enumerate(outlines.row_keys()) if outlines.used[i]}
    both: dict[int, list[tuple[int, int]]] = {}
    for (row, leg, part, edge), i in index.items():
        if edge == 1 and (other := index.get((row, leg, part, 2))) is not None:
            both.setdefault(row, []).append((i, other))
    found = {}
    for row, pairs in both.items():
        camera = measurements.views[measurements.view[row]].camera
        one, two = np.array(pairs).T
        # Points of the axis at both ends, and how far the two lines are from them.
        ends = 0.5 * (camera.undistort(outlines.ends[one]) + camera.undistort(outlines.ends[two]))
        homogeneous = np.concatenate([ends, np.ones((len(one), 2, 1))], axis=2)
        normals = [h / np.linalg.norm(h[:, :2], axis=1)[:, None]
                   for h in (outlines.h[one], outlines.h[two])]  # fmt: skip
        offsets = [np.einsum("nex,nx->ne", homogeneous, h) for h in normals]
        ends = ends - 0.5 * (offsets[0] + offsets[1])[..., None] * normals[0][:, None, :2]
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        pairs_of_row = CandidatePairs(
            middle=ends.mean(axis=1),
            along=along / length[:, None],
            half_length=0.5 * length,
            width=np.abs(offsets[0] - offsets[1]),
            merit=length,
            pixel=1.0 / float(camera.K[0, 0]),
        )
        found[row] = pairs_of_row.choose(np.argsort(-length, kind="stable"))
    return found


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


def compare_assumptions(assumptions: Iterable[Assumption], run: Run) -> list[Agreement]:
    """Return the agreement of images with each of some hypotheses.

    Rows at which the legs are not known (NaN) agree with nothing.
    """
    return list(run(_agreement, assumptions))


def _agreement(one: Assumption) -> Agreement:
    """Return the agreement of the images of a group with a hypothesis."""
    search, rows, n_legs = one.search, one.rows, one.search.n_legs
    known_rows = [row for row in rows if np.isfinite(search.B_base[row]).all()]
    pictures = one.group.pictures({row: _picture(one, row) for row in known_rows}, known_rows)
    row = np.array(rows, dtype=np.intp)
    support, expected = np.zeros(len(row)), np.full(len(row), float(n_legs))
    nothing = Agreement(row, support, expected, (None,))
    if not known_rows:
        return nothing
    placed = place_camera(pictures, n_legs, one.starts, one.known)
    if len(placed.poses) == 0:
        return nothing
    is_known = np.isin(row, known_rows)
    cost = float(placed.support[0].sum() - placed.score[0]) / len(known_rows)
    support[is_known] = np.maximum(placed.support[0] - cost, 0.0)
    expected[is_known] = placed.expected[0]
    return Agreement(row, support, expected, (placed.pose(),))


def _picture(one: Assumption, row: int) -> Picture:
    """Return the edge pairs and predicted legs of an image under a hypothesis."""
    picture = one.search.picture(row)
    pairs = as_if(picture.pairs, picture.corners, one.flip[row], one.focal)
    return replace(picture, pairs=pairs, corners=picture.corners / one.focal)
