"""Which leg is which in all images, and where their cameras stand: with rough poses or without.

Bars of every image vote, all images of a view together. A rough camera pose is where the search of
its view begins; if the images do not agree near it, the view is searched as if there were none, and
a pose that they agree on elsewhere is used and said.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.detection.picture import to_grey
from legcal.geometry.types import Array, BoolArray, Image, IntArray
from legcal.mechanism.leg import Cylinder
from legcal.observations.measurements import Measurements
from legcal.recognition.agreement import Picture
from legcal.recognition.bars import find_bars
from legcal.recognition.place import Placed, place_camera, place_near
from legcal.recognition.segments import find_segments
from legcal.recognition.targets import targets_of
from legcal.vision.camera import Camera
from legcal.workers import Run, in_turn

Load = Callable[[int], Image]
NEAR_IMAGES = 6  # of a view that are searched where a rough pose is given, at first
FAR_OFF = (0.10, np.deg2rad(8.0))  # of a rough pose: part of the distance, angle
UNSEEN_ERROR = 6e-3  # of the joint centres of a leg that a view did not show [m]
LEAST_ERROR, ERROR_REACH = 1.5e-3, 2.5  # of those of a leg that it did: [m], standard deviations


@dataclass(frozen=True, eq=False)
class Recognised:
    """Where the legs and the cameras are.

    Attributes
    ----------
    T_base_camera : list of RigidTransform or None, for each view
        None where a view could not be placed, or has no images.
    shift : (n_views, n_legs, 2, 3) array
        Where each view sees A and B of the legs, against the model, in the base link [m].
    joint_error : (n_views, n_legs) array
        How far the legs may still be from there [m].
    unplaced : dict of str
        Why views could not be placed, by view: one sentence for each.
    notes : tuple of str
        What else a reader should know: rough poses that are wrong.
    """

    T_base_camera: list[RigidTransform | None]
    shift: Array
    joint_error: Array
    unplaced: dict[int, str]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Search:
    """What is searched for; it travels to worker processes.

    Attributes
    ----------
    load : callable
        Returns the image of a row.
    measurements : Measurements
        All rows.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres of every row by the model, in the base link [m].
    cylinders : sequence, for each leg a sequence of Cylinder
        What can be seen of the legs.
    wanted : (n_views, n_legs) array of bool
        Legs that each view is said to show.
    """

    load: Load
    measurements: Measurements
    A_base: Array
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]
    wanted: BoolArray

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.cylinders)

    def picture(self, row: int) -> Picture:
        """Return what the image of a row shows, and what it should."""
        view = int(self.measurements.view[row])
        camera = self.measurements.views[view].camera
        bars = find_bars(find_segments(to_grey(self.load(row)), camera))
        legs = np.flatnonzero(self.wanted[view])
        targets = targets_of(self.A_base[row], self.B_base[row], self.cylinders, legs)
        return Picture(bars, targets, _corners(camera))


def recognise(
    search: Search,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Sequence[RigidTransform | None] | None = None,
    *,
    progress: Callable[[int], None] | None = None,
    run: Run = in_turn,
) -> Recognised:
    """Find the cameras of all views and the legs in their images.

    Parameters
    ----------
    search : Search
        The images and the model.
    rows : (n,) array of int
        The images to use.
    hints : sequence of RigidTransform or None, for each view
        Rough camera poses T_base_camera.
    joined : sequence of RigidTransform or None, for each view
        T_x_camera of views that know how they stand to each other, by a calibration board x: they
        are placed together.
    progress : callable, optional
        Called with the row of each image when it has been searched.
    run : callable
        How images are searched: in turn, or by several processes.

    Returns
    -------
    Recognised
        Also where views could not be placed.
    """
    groups = _groups(search, rows, hints, joined)
    near = [r for group in groups if group.hint is not None for r in group.some]
    far = [r for group in groups if group.hint is None for r in group.rows]
    pictures = _pictures(search, sorted([*near, *far]), progress, run)
    found: list[Placed | None] = [
        None
        if group.hint is None
        else place_near(group.pictures(pictures, group.some), group.hint, search.n_legs)
        for group in groups
    ]
    # Views without a rough pose, and those whose images do not agree near it: all images, anywhere.
    doubted = [g for g, near in enumerate(found) if near is None or not near.is_clear]
    missing = [r for g in doubted for r in groups[g].rows if r not in pictures]
    pictures |= _pictures(search, missing, progress, run)
    everywhere = [groups[g].pictures(pictures, groups[g].rows) for g in doubted]
    task = partial(_place, everywhere, search.n_legs)
    for g, anywhere in zip(doubted, run(task, range(len(doubted))), strict=True):
        found[g] = _better(found[g], anywhere)
    return _gathered(search, groups, [placed for placed in found if placed is not None])


@dataclass(frozen=True, eq=False)
class _Group:
    """Views whose cameras are placed together, since they know how they stand to each other.

    Attributes
    ----------
    views : list of int
    T_group_camera : dict of RigidTransform, by view
    rows, some : list of int
        All images to use, and a few of them.
    view_of_row : dict of int
    hint : RigidTransform or None
        T_base_group, roughly.
    """

    views: list[int]
    T_group_camera: dict[int, RigidTransform]
    rows: list[int]
    some: list[int]
    view_of_row: dict[int, int]
    hint: RigidTransform | None

    def pictures(self, of_row: dict[int, Picture], rows: Sequence[int]) -> list[Picture]:
        """Return the pictures of some rows, in the frame of the group."""
        found = []
        for row in rows:
            T = self.T_group_camera[self.view_of_row[row]].inv()
            found.append(replace(of_row[row], R=T.rotation.as_matrix(), t=T.translation))
        return found


def _groups(
    search: Search,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Sequence[RigidTransform | None] | None,
) -> list[_Group]:
    """Return the views that stand alone, and those that are joined."""
    view_of = {int(row): int(search.measurements.view[row]) for row in rows}
    views = sorted(set(view_of.values()))
    together = [v for v in views if joined is not None and joined[v] is not None]
    groups = [[v] for v in views if v not in together] + ([together] if together else [])
    found = []
    for group in groups:
        own = [row for row, v in view_of.items() if v in group]
        T = {v: RigidTransform.identity() for v in group}
        if joined is not None and group == together:
            T = {v: joined_v for v in group if (joined_v := joined[v]) is not None}
        given = [(hint, T[v]) for v in group if (hint := hints[v]) is not None]
        hint = None if not given else given[0][0] * given[0][1].inv()
        found.append(_Group(group, T, own, _some(own), view_of, hint))
    return found


def _some(rows: Sequence[int]) -> list[int]:
    """Return a few rows spread over all of them."""
    chosen = np.linspace(0, len(rows) - 1, min(NEAR_IMAGES, len(rows)))
    return [rows[int(k)] for k in np.unique(np.rint(chosen).astype(int))]


def _pictures(
    search: Search, rows: Sequence[int], progress: Callable[[int], None] | None, run: Run
) -> dict[int, Picture]:
    found = {}
    for row, picture in zip(rows, run(search.picture, rows), strict=True):
        found[row] = picture
        if progress is not None:
            progress(row)
    return found


def _place(groups: Sequence[Sequence[Picture]], n_legs: int, group: int) -> Placed:
    return place_camera(groups[group], n_legs)


def _better(near: Placed | None, anywhere: Placed) -> Placed:
    """Return the pose with the greater support, that near a rough pose if they are alike."""
    if near is None:
        return anywhere
    if len(anywhere.poses) == 0 or not anywhere.is_convincing:
        return near
    if len(near.poses) == 0:
        return anywhere
    mean = [float(found.support[0].mean()) for found in (near, anywhere)]
    return anywhere if mean[1] > 1.1 * mean[0] else near


def _gathered(search: Search, groups: Sequence[_Group], poses: Sequence[Placed]) -> Recognised:
    """Put the views together, with what is to be said of them."""
    views = search.measurements.views
    n_views, n_legs = len(views), search.n_legs
    found: list[RigidTransform | None] = [None] * n_views
    shift = np.zeros((n_views, n_legs, 2, 3))
    error = np.full((n_views, n_legs), UNSEEN_ERROR)
    unplaced: dict[int, str] = {}
    notes: list[str] = []
    for group, placed in zip(groups, poses, strict=True):
        name = _named([views[v].name for v in group.views])
        if not placed.is_convincing:
            sentence = _problem(name, placed, group.hint is not None)
            unplaced |= dict.fromkeys(group.views, sentence)
            continue
        of_leg = np.where(
            np.isfinite(placed.leg_error),
            LEAST_ERROR + ERROR_REACH * placed.leg_error,
            UNSEEN_ERROR,
        )
        for v in group.views:
            found[v] = placed.pose() * group.T_group_camera[v]
            shift[v], error[v] = placed.poses.shift[0], of_leg
        if group.hint is not None:
            notes.extend(_wrong_hint(name, group.hint, placed.pose()))
    return Recognised(found, shift, error, unplaced, tuple(notes))


def _named(names: Sequence[str]) -> str:
    """Return the name of a view, or of a group."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _problem(name: str, placed: Placed, hinted: bool) -> str:
    """Say why a view could not be placed."""
    where = "near its T_base_camera or anywhere else" if hinted else "anywhere"
    if len(placed.poses) == 0:
        return (
            f"view {name}: its camera could not be placed: found no pair of edges in its images "
            "that could be a leg, needed legs; check that the photographs show the machine, "
            "sharp and neither black nor overexposed."
        )
    legs, n = float(placed.support[0].mean()), placed.expected[0].mean()
    if not placed.is_enough:
        return (
            f"view {name}: its camera could not be placed: found no pose {where} at which its "
            f"images show the legs (at the best one {legs:.1f} of {n:.0f} legs an image), needed "
            f"{placed.needed:.1f}; check that the images belong to this machine and to their "
            "readings, that they are no mirror images, and the camera file."
        )
    other = placed.pose(1)
    apart = placed.pose().inv() * other
    return (
        f"view {name}: its camera could not be placed: found two poses at which its images show "
        f"the legs about as well ({legs:.1f} and {placed.support[1].mean():.1f} legs an image; "
        f"{1e3 * np.linalg.norm(apart.translation):.0f} mm and "
        f"{np.degrees(apart.rotation.magnitude()):.0f} deg apart), needed one; add images at "
        "readings that differ more between the legs, or a rough T_base_camera."
    )


def _wrong_hint(name: str, hint: RigidTransform, T: RigidTransform) -> list[str]:
    """Return a note if a rough pose is far from where the images put the camera."""
    off = hint.inv() * T
    distance = float(np.linalg.norm(T.translation))
    apart, angle = float(np.linalg.norm(off.translation)), float(off.rotation.magnitude())
    if apart <= FAR_OFF[0] * distance and angle <= FAR_OFF[1]:
        return []
    x, y, z = T.translation
    return [
        f"view {name}: its T_base_camera is {1e3 * apart:.0f} mm and {np.degrees(angle):.0f} deg "
        f"from where its images put the camera (xyz: [{x:.3f}, {y:.3f}, {z:.3f}]); it was not "
        "used; correct it in dataset.yaml."
    ]


def _corners(camera: Camera) -> Array:
    """Return the least and the greatest x and y (2, 2) of the sensor plane that an image shows."""
    x, y = camera.width - 1.0, camera.height - 1.0
    border = np.array(
        [[0, 0], [x, 0], [0, y], [x, y], [x / 2, 0], [0, y / 2], [x / 2, y], [x, y / 2]]
    )
    xy = camera.undistort(border)
    return np.array([xy.min(axis=0), xy.max(axis=0)])


def shifted(found: Recognised, view: IntArray, A: Array, B: Array) -> tuple[Array, Array]:
    """Return joint centres (n_rows, n_legs, 3) where the view of each row sees them [m]."""
    return A + found.shift[view][:, :, 0], B + found.shift[view][:, :, 1]
