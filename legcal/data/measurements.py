"""The table ``measurements.csv``: for every image its view, its pose and the readings.

The header is ``view,image,<actuated joint>,...`` with an optional ``pose``, in any order.
Readings are in metres. Rows with the same pose label, in any view, share one platform pose
and one reading (their mean); a row without a label is a pose of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError
from legcal.files import Row, closest, describe, path_problem, read_table
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import Leg, LegKind
from legcal.vision import Camera


@dataclass(frozen=True, eq=False)
class View:
    """One position of a calibrated camera.

    Attributes
    ----------
    name : str
        The name in ``dataset.yaml``.
    camera : Camera
        Its intrinsics.
    T_base_camera : RigidTransform or None
        A rough pose of the camera in the base link, good to 2 cm and 2 degrees.
    legs : tuple of str or None
        Use only these legs in this view; None for all.
    hand_held : bool
        Whether this is one image of a camera in the hand, which only the board can place.
    """

    name: str
    camera: Camera
    T_base_camera: RigidTransform | None = None
    legs: tuple[str, ...] | None = None
    hand_held: bool = False


@dataclass(frozen=True, eq=False)
class Measurements:
    """The rows of ``measurements.csv``: one for each image.

    Attributes
    ----------
    views : tuple of View
        The camera positions.
    image : tuple of str, length n_rows
        The image of each row, relative to the dataset; "" where only outlines are given.
    view : (n_rows,) array of int
        Index into ``views``.
    pose : (n_rows,) array of int
        Index of the platform pose, 0 to n_poses - 1; rows that share it share one pose.
    q : (n_rows, n_legs) array
        Encoder readings in the order of the mechanism's legs [m]; zero for constant-length
        legs, NaN for passive ones.
    sigma_q : float
        Standard deviation of a reading [m].
    pose_labels : tuple of str, length n_poses
        What the optional column ``pose`` calls each pose; "" for a pose without a label.
        Empty where there is no such column.
    """

    views: tuple[View, ...]
    image: tuple[str, ...]
    view: IntArray
    pose: IntArray
    q: Array
    sigma_q: float
    pose_labels: tuple[str, ...] = ()

    @property
    def n_rows(self) -> int:
        """Number of images."""
        return len(self.image)

    @property
    def first_rows(self) -> IntArray:
        """The first row of every pose, (n_poses,): its reading is that of the pose."""
        return np.asarray(np.unique(self.pose, return_index=True)[1])

    @property
    def n_poses(self) -> int:
        """Number of different platform poses."""
        return int(self.pose.max()) + 1 if len(self.pose) else 0


MOST = 5  # that are named


def few(names: Sequence[str]) -> str:
    """Return names one after the other, not more than a few: ``c1, c2 and 3 more``."""
    more = len(names) - MOST
    return ", ".join(names[:MOST]) + f" and {more} more" * (more > 0)


def few_views(names: Sequence[str]) -> str:
    """Return views as a sentence names them: ``views c1, c2``, not more than a few."""
    return f"view{'s' * (len(names) > 1)} {few(names)}"


TRAVEL_MARGIN = 0.05  # of the travel: a reading further outside is an error

_SHOWN = 3  # readings quoted in a sentence about many


def check_travel(
    path: Path, wheres: Sequence[str], legs: Sequence[Leg], readings: Array
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what is wrong with readings outside their travel, and what is only odd.

    Parameters
    ----------
    path : Path
        The table, for the message.
    wheres : sequence of str, length n_rows
        The place of each row, for the message.
    legs : sequence of Leg
        The actuated legs.
    readings : (n_rows, n_actuated) array
        Their readings [m]; NaN is passed over.

    Returns
    -------
    problems : tuple of str
        One sentence for each column with readings outside by more than 5 % of the travel.
    notes : tuple of str
        One sentence for each other column with readings outside by less.
    """
    problems, notes = [], []
    for leg, column in zip(legs, readings.T, strict=True):
        lower, upper = leg.travel
        margin = TRAVEL_MARGIN * (upper - lower)
        if not (np.isfinite(margin) and margin > 0.0):
            continue
        outside = (column < lower) | (column > upper)
        far = (column < lower - margin) | (column > upper + margin)
        start = f"{path}, column {leg.prismatic}"
        travel = f"{lower:g} to {upper:g} m (the joint limits of the model)"
        if np.any(far):
            remedy = (
                "these look like millimetres: divide the column by 1000"
                if 2 * np.sum(far) >= len(column)
                and _look_like_millimetres(column[far], lower, upper)
                else "correct the readings or the limits"
            )
            problems.append(
                f"{start}: readings are outside the travel: found {_some(wheres, column, far)}, "
                f"needed {travel} with a margin of {TRAVEL_MARGIN:.0%}; {remedy}."
            )
        elif np.any(outside):
            found = _some(wheres, column, outside)
            notes.append(f"{start}: readings are a little outside the travel {travel}: {found}.")
    return tuple(problems), tuple(notes)


def _look_like_millimetres(readings: Array, lower: float, upper: float) -> bool:
    """Say whether readings lie far outside a travel [m], and in it when divided by 1000."""
    metres, margin = 1e-3 * readings, TRAVEL_MARGIN * (upper - lower)
    fit = (metres >= lower - margin) & (metres <= upper + margin)
    far = (readings > 2.0 * upper - lower) | (readings < 2.0 * lower - upper)
    return bool(np.all(fit & far))


def _some(wheres: Sequence[str], column: Array, chosen: BoolArray) -> str:
    """Return the first of some readings with their rows, and how many more there are."""
    index = np.flatnonzero(chosen).tolist()
    shown = ", ".join(f"{column[i]:g} m in {_row(wheres[i])}" for i in index[:_SHOWN])
    return shown + (f" and {len(index) - _SHOWN} more" if len(index) > _SHOWN else "")


def _row(where: str) -> str:
    """Return a place without its file."""
    return where.rsplit(", ", 1)[-1]


SAME_READING = 10.0  # sigma by which rows of one pose may differ

_FIXED_COLUMNS = ("view", "image", "pose")


def read_measurements(
    path: Path, folder: Path, views: Sequence[View], legs: Sequence[Leg], sigma_q: float
) -> tuple[Measurements, tuple[str, ...]]:
    """Read ``measurements.csv``.

    Parameters
    ----------
    path, folder : Path
        The table, and the dataset folder that images are relative to.
    views : sequence of View
        The views of the dataset.
    legs : sequence of Leg
        The legs of the mechanism; their actuated joints name the columns.
    sigma_q : float
        Standard deviation of a reading [m].

    Returns
    -------
    measurements : Measurements
        With the rows in the order of the file.
    notes : tuple of str
        What is odd but allowed: readings a little outside their travel.

    Raises
    ------
    DatasetError
        With one sentence for each thing that is wrong, naming row and column. Whether the
        images exist is not looked at.
    """
    joints = [leg.prismatic or "" for leg in legs if leg.kind is LegKind.ACTUATED]
    table = read_table(path, "table of measurements", "one row for each image; record measurements")
    problems = _header_problems(path, table.header, joints)
    if problems:
        raise DatasetError(problems)
    rows = table.rows(problems)
    view_index = {view.name: i for i, view in enumerate(views)}
    problems += _view_problems(rows, view_index) + _image_problems(rows, folder)
    readings = np.array(
        [[row.number(joint, "reading", "metres", problems) for joint in joints] for row in rows],
        dtype=np.float64,
    ).reshape(len(rows), len(joints))
    pose, labels = _poses(rows)
    actuated = [leg for leg in legs if leg.kind is LegKind.ACTUATED]
    outside, notes = check_travel(path, [row.where for row in rows], actuated, readings)
    problems += outside
    readings = _shared_readings(rows, pose, joints, readings, sigma_q, problems)
    if problems:
        raise DatasetError(problems)
    measurements = Measurements(
        views=tuple(views),
        image=tuple(row.cells["image"] for row in rows),
        view=np.array([view_index[row.cells["view"]] for row in rows], dtype=np.intp),
        pose=pose,
        q=_by_leg(legs, joints, readings),
        sigma_q=sigma_q,
        pose_labels=labels if "pose" in table.header else (),
    )
    return measurements, notes


def _header_problems(path: Path, header: Sequence[str], joints: Sequence[str]) -> list[str]:
    """Return what is wrong with the columns."""
    start = f"{path}, header: the columns could not be used: found"
    known = [*_FIXED_COLUMNS, *joints]
    problems = [
        f"{start} the column '{name}' {header.count(name)} times, needed it once; remove one."
        for name in dict.fromkeys(header)
        if header.count(name) > 1
    ]
    problems += [
        f"{start} the unknown column '{name}', needed view, image, pose or an actuated joint of "
        f"the mechanism; {closest(name, known)}"
        for name in dict.fromkeys(header)
        if name not in known
    ]
    problems += [
        f"{start} no column '{name}', needed {'the readings of that joint [m]' * (name in joints)}"
        f"{'one' * (name not in joints)}; add the column."
        for name in ("view", "image", *joints)
        if name not in header
    ]
    return problems


def _view_problems(rows: Sequence[Row], view_index: Mapping[str, int]) -> list[str]:
    """Return the rows whose view the dataset does not have."""
    return [
        f"{row.where}, column view: the row could not be used: found the unknown view "
        f"{describe(row.cells['view'])}, needed a view of the dataset file; "
        f"{closest(row.cells['view'], view_index)}"
        for row in rows
        if row.cells["view"] not in view_index
    ]


def _image_problems(rows: Sequence[Row], folder: Path) -> list[str]:
    """Return images that are named twice or lie outside the dataset folder."""
    problems = []
    first: dict[Path, str] = {}
    for row in rows:
        image = row.cells["image"]
        if not image:
            continue
        found = path_problem(folder, image)
        if found:
            problems.append(
                f"{row.where}, column image: {image} could not be used: found {found}, needed a "
                "relative path inside it; move the image there."
            )
            continue
        earlier = first.setdefault((folder / image).resolve(), row.where)
        if earlier != row.where:
            problems.append(
                f"{row.where}, column image: {image} could not be used: found it also in "
                f"{earlier.rsplit(', ', 1)[-1]}, needed one row an image; remove one of them."
            )
    return problems


def _poses(rows: Sequence[Row]) -> tuple[IntArray, tuple[str, ...]]:
    """Return the pose of each row, numbered as they first appear, and the label of each pose."""
    labels: list[str] = []
    index: dict[str, int] = {}
    pose = []
    for row in rows:
        label = row.cells.get("pose", "")
        if not label or label not in index:
            index[label] = len(labels)
            labels.append(label)
        pose.append(index[label])
    return np.array(pose, dtype=np.intp), tuple(labels)


def _shared_readings(
    rows: Sequence[Row],
    pose: IntArray,
    joints: Sequence[str],
    readings: Array,
    sigma_q: float,
    problems: list[str],
) -> Array:
    """Return the readings with those of one pose replaced by their mean."""
    shared = readings.copy()
    for p in np.unique(pose):
        members = np.flatnonzero(pose == p)
        if len(members) == 1:
            continue
        spread = np.ptp(readings[members], axis=0)
        for j in np.flatnonzero(spread > SAME_READING * sigma_q).tolist():
            problems.append(
                f"{rows[members[0]].where}, column {joints[j]}: pose "
                f"{rows[members[0]].cells['pose']} could not be used: found readings of its "
                f"{len(members)} rows that differ by {spread[j]:.3g} m, needed one reading within "
                f"{SAME_READING:g} sigma ({SAME_READING * sigma_q:.3g} m); give rows of different "
                "poses different labels."
            )
        # fsum rounds once, so that the mean does not depend on the order of the rows.
        shared[members] = [math.fsum(c) / len(members) for c in readings[members].T.tolist()]
    return shared


def _by_leg(legs: Sequence[Leg], joints: Sequence[str], readings: Array) -> Array:
    """Return the readings in the order of the legs: zero for constant legs, NaN for passive."""
    columns = [
        readings[:, joints.index(leg.prismatic or "")]
        if leg.kind is LegKind.ACTUATED
        else np.full(len(readings), 0.0 if leg.kind is LegKind.CONSTANT else math.nan)
        for leg in legs
    ]
    return np.column_stack(columns)
