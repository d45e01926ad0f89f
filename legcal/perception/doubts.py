"""What an image shows in place of the legs of its reading: another reading, or a mirror image.

The bars of the image are judged once more: with the readings of all other images, with the cameras
of the other views, and mirrored. An explanation must be clearly better than the reading itself.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry import IntArray
from legcal.perception.agreement import Picture, Poses, agreement, targets_of
from legcal.perception.bars import Bars
from legcal.perception.camera_search import LEFT_RIGHT, UP_DOWN, UPSIDE_DOWN, flipped
from legcal.perception.recognise import Recognised
from legcal.perception.search import Search, corners_of

TOLERANCE = 0.006  # of an axis from its bar [m]
UNPLACED = 0.015  # the same of a leg that nothing has moved from where the model has it
CLEAR, BETTER = (
    0.35,
    (2.0, 0.15),
)  # share of the legs that explain; against the reading's: factor, more
AS_USUAL = 0.5  # of the share that the other images of the view reach
ALIKE = 0.85  # of the best explanation: then another one is about as good
MIRRORED = "the image is mirrored"  # reasons
TURNED = "the image is upside down"
_FLIPS = ((LEFT_RIGHT, MIRRORED), (UP_DOWN, MIRRORED), (UPSIDE_DOWN, TURNED))


@dataclass(frozen=True)
class Explanation:
    """What an image shows.

    Attributes
    ----------
    own : float
        Share of the legs, by visible length, that are where its reading has them.
    reason : str
        What it shows instead; "" where nothing explains it clearly.
    remedy : str
        What to do then.
    """

    own: float
    reason: str = ""
    remedy: str = ""


def share_shown(
    search: Search, found: Recognised, row: int, *, legs: IntArray | None = None
) -> float:
    """Return the share of the legs, by visible length, that an image shows where they should be.

    Parameters
    ----------
    search : Search
        The images and the model.
    found : Recognised
        The placed cameras.
    row : int
        An image of a view that was placed.
    legs : (n,) array of int, optional
        The legs to look for; by default those that the view is said to show.
    """
    view = int(search.measurements.view[row])
    picture = _picture(search, search.bars(row, view), row, view, legs)
    return _share(picture, found, view, TOLERANCE if legs is None else UNPLACED)


def explain(
    search: Search,
    found: Recognised,
    usual: Mapping[int, float],
    row: int,
    *,
    doubted: Collection[int] = (),
) -> Explanation:
    """Return what an image shows whose legs are not where its reading has them.

    Parameters
    ----------
    search : Search
        The images and the model.
    found : Recognised
        The placed cameras.
    usual : mapping
        The share of the legs that good images of each view show, by :func:`share_shown`.
    row : int
        An image of a view that was placed.
    doubted : collection of int
        All images in doubt: readings that other images show are hardly those of this one.
    """
    measurements = search.measurements
    view = int(measurements.view[row])
    bars = search.bars(row, view)
    picture = _picture(search, bars, row, view)
    own = _share(picture, found, view)
    others = [
        (_share(replace(picture, bars=flipped(bars, picture.corners, flip)), found, view), why)
        for flip, why in _FLIPS
    ]
    tried = [(share, why, "replace it by the original") for share, why in others]
    rows = _other_readings(search, row)
    readings = [(_share(_picture(search, bars, other, view), found, view), other) for other in rows]
    for share, other in _best(readings, doubted):
        why = f"it shows the reading given for image {measurements.image[other]}"
        tried.append((share, why, "check which image belongs to which row"))
    for w, other_view in enumerate(measurements.views):
        if w == view or found.T_base_camera[w] is None or not _same_size(search, view, w):
            continue
        same = other_view.camera is measurements.views[view].camera
        seen = bars if same else search.bars(row, w)
        there = [row, *(other for other in rows if measurements.view[other] == w)]
        readings = [(_share(_picture(search, seen, other, w), found, w), other) for other in there]
        for share, other in _best(readings, doubted):
            at = (
                ""
                if other == row
                else f" at the reading given for image {measurements.image[other]}"
            )
            why = f"it was taken by the camera of view {other_view.name}{at}"
            tried.append((share, why, "check which image belongs to which row"))
    share, why, remedy = max(tried, key=lambda one: one[0])
    factor, more = BETTER
    least = max(CLEAR, AS_USUAL * usual.get(view, 0.0), factor * own, own + more)
    return Explanation(own, why, remedy) if share >= least else Explanation(own)


def _best(
    readings: Sequence[tuple[float, int]], doubted: Collection[int]
) -> list[tuple[float, int]]:
    """Return the reading that suits best, if no other one suits about as well.

    Where its own image is in doubt, images were exchanged: then only readings of such are rivals.
    """
    ranked = sorted(readings, key=lambda one: -one[0])
    if ranked and ranked[0][1] in doubted:
        ranked = [one for one in ranked if one[1] in doubted]
    if len(ranked) > 1 and ranked[1][0] > ALIKE * ranked[0][0]:
        return []
    return ranked[:1]


def _other_readings(search: Search, row: int) -> list[int]:
    """Return a row with an image of each other pose, of the same view where there is one."""
    measurements = search.measurements
    own, view = int(measurements.pose[row]), int(measurements.view[row])
    of_pose: dict[int, int] = {}
    for other, image in enumerate(measurements.image):
        pose = int(measurements.pose[other])
        if pose != own and image and (pose not in of_pose or measurements.view[other] == view):
            of_pose[pose] = other
    return list(of_pose.values())


def _same_size(search: Search, view: int, other: int) -> bool:
    """Say whether the cameras of two views take images of one size."""
    one, two = (search.measurements.views[v].camera for v in (view, other))
    return (one.width, one.height) == (two.width, two.height)


def _picture(
    search: Search, bars: Bars, row: int, view: int, legs: IntArray | None = None
) -> Picture:
    """Return bars with what a view should show at the reading of a row."""
    wanted = np.flatnonzero(search.wanted[view]) if legs is None else legs
    targets = targets_of(search.A_base[row], search.B_base[row], search.cylinders, wanted)
    return Picture(bars, targets, corners_of(search.measurements.views[view].camera))


def _share(picture: Picture, found: Recognised, view: int, tolerance: float = TOLERANCE) -> float:
    """Return the share of the visible length of the legs on which a picture has their bars."""
    T = found.T_base_camera[view]
    if T is None or len(picture.targets) == 0:
        return 0.0
    T = T.inv()
    pose = Poses(T.rotation.as_matrix()[None], T.translation[None], found.shift[view][None])
    seen = agreement(picture, pose, tolerance)
    share = picture.targets.share
    visible = float((seen.visible @ share)[0])
    return float(seen.one_bar_each[0] @ share) / visible if visible > 0.0 else 0.0
