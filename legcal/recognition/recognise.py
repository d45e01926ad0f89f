"""Which leg is which in all images, and where their cameras stand: with rough poses or without.

Bars of every image vote, all images of a view together. A rough camera pose is where the search of
its view begins; if the images do not agree near it, the view is searched as if there were none, and
a pose that they agree on elsewhere is used and said.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import IntArray
from legcal.recognition.agreement import Picture, Poses
from legcal.recognition.groups import Group, group_views
from legcal.recognition.mirror import is_mirrored, may_be_mirrored, mirrored
from legcal.recognition.place import START_PICTURES, place_camera, place_near
from legcal.recognition.placed import Placed
from legcal.recognition.radii import (
    LEFT,
    MOST_TURNS,
    NO_OTHER_RADII,
    OtherRadii,
    Part,
    other_radii,
)
from legcal.recognition.recognised import Recognised
from legcal.recognition.searching import Search
from legcal.recognition.second_look import look_again
from legcal.recognition.sentences import named, placing_problem
from legcal.workers import Run, in_turn

RADII_GAIN = 1.18  # of the support, by which radii that all differ must explain more
SCALED = (0.8, 1.25)  # radii, in a view that could not be placed
MIRRORED_STARTS = 1, 1  # as START_PICTURES, for mirrored pictures
UNSEEN_ERROR = 6e-3  # of the joint centres of a leg that a view did not show [m]
LEAST_ERROR, ERROR_REACH = 1.5e-3, 2.5  # of those of a leg that it did: [m], standard deviations


def recognise(
    search: Search,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Sequence[RigidTransform | None] | None = None,
    *,
    doubtful: Collection[Part] = (),
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
    doubtful : collection of (int, float)
        Parts, by leg and radius [m], whose outlines were not found with the radii of the model:
        they may have others.
    progress : callable, optional
        Called with the row of each image when it has been searched.
    run : callable
        How images are searched: in turn, or by several processes.

    Returns
    -------
    Recognised
        Also where views could not be placed.
    """
    groups = group_views(search.measurements, rows, hints, joined)
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
    for g, anywhere in zip(doubted, _anywhere(groups, doubted, pictures, search, run), strict=True):
        hint = groups[g].hint
        if hint is None:
            found[g] = anywhere
            continue
        of_group = groups[g].pictures(pictures, groups[g].rows)
        found[g] = _better(place_near(of_group, hint, search.n_legs), anywhere)
    placed = [one for one in found if one is not None]
    radii = NO_OTHER_RADII
    if doubtful:
        radii = _radii(search, groups, placed, pictures, run).only(doubtful)
    given, step, as_given = search.cylinders, radii, (search, placed, pictures)
    for _ in range(MOST_TURNS):
        if not step.factor:
            break
        search = replace(search, cylinders=radii.corrected(given))
        pictures = {row: search.retargeted(row, one) for row, one in pictures.items()}
        placed = _placed_again(search, groups, placed, pictures, run)
        few = _for_radii(groups, placed, pictures)
        step = radii.of_the_same(other_radii(few, LEFT, alone=not radii.common))
        radii = radii.then(step)
    if radii.common and _mean_support(placed) < RADII_GAIN * _mean_support(as_given[1]):
        (search, placed, pictures), radii = as_given, NO_OTHER_RADII  # the scale is not known well
    looking = partial(_look, search, groups, placed, pictures)
    placed = list(run(looking, range(len(groups))))
    return _gathered(search, groups, placed, pictures, radii, run)


def _pictures(
    search: Search, rows: Sequence[int], progress: Callable[[int], None] | None, run: Run
) -> dict[int, Picture]:
    found = {}
    for row, picture in zip(rows, run(search.picture, rows), strict=True):
        found[row] = picture
        if progress is not None:
            progress(row)
    return found


def _anywhere(
    groups: Sequence[Group],
    chosen: Sequence[int],
    pictures: dict[int, Picture],
    search: Search,
    run: Run,
) -> list[Placed]:
    """Return the cameras of some groups by all of their images, searched for anywhere."""
    of_group = [groups[g].pictures(pictures, groups[g].rows) for g in chosen]
    return list(run(partial(_place, of_group, search.n_legs, START_PICTURES), range(len(chosen))))


def _place(
    groups: Sequence[Sequence[Picture]], n_legs: int, starts: Sequence[int], group: int
) -> Placed:
    return place_camera(groups[group], n_legs, starts)


def _look(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    g: int,
) -> Placed:
    """Return the poses of a group, judged by outlines where bars leave a doubt."""
    of_group = groups[g].pictures(pictures, [r for r in groups[g].rows if r in pictures])
    return look_again(search, groups[g], placed[g], of_group)


def _radii(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    run: Run,
) -> OtherRadii:
    """Return the radii that the images contradict, as far as the views can be placed."""
    if not any(one.is_convincing for one in placed):
        for factor in SCALED:
            cylinders = [
                [replace(c, radius=factor * c.radius) for c in leg] for leg in search.cylinders
            ]
            scaled = replace(search, cylinders=cylinders)
            others = {row: scaled.retargeted(row, one) for row, one in pictures.items()}
            placed = _anywhere(groups, range(len(groups)), others, scaled, run)
            if any(one.is_clear for one in placed):
                break
    return other_radii(_for_radii(groups, placed, pictures))


def _for_radii(
    groups: Sequence[Group], placed: Sequence[Placed], pictures: dict[int, Picture]
) -> Iterator[tuple[int, list[Picture], Poses]]:
    """Return a few pictures of each group that was placed."""
    for g, (group, one) in enumerate(zip(groups, placed, strict=True)):
        if one.is_convincing:
            yield g, group.pictures(pictures, group.some), one.poses


def _mean_support(placed: Sequence[Placed]) -> float:
    """Return how many legs agree in a picture, over all groups that were placed."""
    return sum(float(one.support[0].mean()) for one in placed if one.is_convincing)


def _placed_again(
    search: Search,
    groups: Sequence[Group],
    placed: Sequence[Placed],
    pictures: dict[int, Picture],
    run: Run,
) -> list[Placed]:
    """Return the cameras by other radii: near where they were, or anywhere if they were not."""
    found = list(placed)
    lost = [g for g, one in enumerate(placed) if not one.is_convincing]
    for g, one in zip(lost, _anywhere(groups, lost, pictures, search, run), strict=True):
        found[g] = one
    for g, one in enumerate(placed):
        if one.is_convincing:
            some = groups[g].pictures(pictures, groups[g].some)
            near = place_near(some, one.pose(), search.n_legs)
            found[g] = near if near.is_convincing else one
    return found


def _better(near: Placed, anywhere: Placed) -> Placed:
    """Return the pose with the greater support, that near a rough pose if they are alike."""
    if len(anywhere.poses) == 0 or not anywhere.is_convincing:
        return near
    if len(near.poses) == 0:
        return anywhere
    mean = [float(found.support[0].mean()) for found in (near, anywhere)]
    return anywhere if mean[1] > 1.1 * mean[0] else near


def _gathered(
    search: Search,
    groups: Sequence[Group],
    poses: Sequence[Placed],
    pictures: dict[int, Picture],
    radii: OtherRadii,
    run: Run,
) -> Recognised:
    """Put the views together, with what is to be said of them."""
    views = search.measurements.views
    n_views, n_legs = len(views), search.n_legs
    found: list[RigidTransform | None] = [None] * n_views
    shift = np.zeros((n_views, n_legs, 2, 3))
    error = np.full((n_views, n_legs), UNSEEN_ERROR)
    unplaced: dict[int, str] = {}
    doubted = [g for g, placed in enumerate(poses) if may_be_mirrored(placed)]
    flipped = [_flipped(groups[g], poses[g], pictures) for g in doubted]
    place = partial(_place, flipped, n_legs, MIRRORED_STARTS)
    mirrors = dict(zip(doubted, run(place, range(len(doubted))), strict=True))
    for g, (group, placed) in enumerate(zip(groups, poses, strict=True)):
        name = named([views[v].name for v in group.views])
        exchanged = g in mirrors and is_mirrored(placed, mirrors[g])
        if exchanged or not placed.is_convincing:
            sentence = placing_problem(name, placed, group.hint is not None, is_mirrored=exchanged)
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
    return Recognised(found, shift, error, unplaced, radii)


def _flipped(group: Group, placed: Placed, pictures: dict[int, Picture]) -> list[Picture]:
    """Return the pictures by which a group was placed, with left and right exchanged."""
    few = placed.hinted and placed.support.shape[1] == len(group.some)
    return mirrored(group.pictures(pictures, group.some if few else group.rows))
