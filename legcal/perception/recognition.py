"""Which leg is which in all images, and where their cameras stand: with rough poses or without.

Edge pairs of every image vote, all images of a view together. A rough camera pose is where the
search of its view begins; if the images do not agree near it, the view is searched as if there were
none, and a pose that they agree on elsewhere is used, with a note. Where edge pairs are ambiguous,
outlines measured at the best poses decide.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.outlines import Outlines
from legcal.errors import Cause
from legcal.geometry.types import Array, IntArray
from legcal.perception.alignment import is_moved
from legcal.perception.camera_search import (
    NOT_MIRRORED_SUPPORT,
    SOME_PICTURES,
    PoseCandidates,
    is_mirrored,
    mirrored,
    place_at,
    place_by_edges,
    place_camera,
    place_near,
    with_first,
)
from legcal.perception.outline import measure_outlines
from legcal.perception.pair_matching import CameraPoses, Picture
from legcal.perception.placement import (
    Group,
    Joined,
    NotPlaced,
    Placement,
    Search,
    group_views,
)
from legcal.perception.tuning import EVIDENCE_RATIO, JOINT_ERROR
from legcal.perception.view_fit import (
    ViewFit,
    fit_view,
    min_evidence,
    refine_views,
    with_common_shift,
)
from legcal.workers import Run, in_turn

MIRRORED_EDGES = 1.06  # legs along edges of mirrored images, over the original images
MIRRORED_STARTS = 1, 1  # as START_PICTURES, for mirrored pictures
# Lengths are parts of the mean leg length.
# Of the joint centres of a leg that a view shows: at least, besides standard deviations
MIN_ERROR, ERROR_SIGMAS = 0.004, 2.5
POSE_JOINT_ERROR = 0.0075  # of the legs as a pose has them

N_POSES, N_REFINED = 4, 3  # at which outlines are measured, and at the best missing legs sought
MARGIN, MARGIN_ALONE = 3.0, 6.0  # of the evidence for a pose over the least, of a single image
# Of the evidence for a pose to that for any other one: where edge pairs are convincing by
# themselves, of a single image, and from which on no margin is needed.
RATIO_AGREED, RATIO_ALONE, RATIO_WITHOUT_RIVAL = 1.5, 2.5, 4.0
KNOWN_JOINTS = 0.5 * JOINT_ERROR  # from which on a single image needs no more than others
SAME_PX, SAME_PART = 3.0, 0.7  # of outlines that two poses share: how near, how many of them
TWO_POSES = (
    "its camera could not be placed: two poses explain its images about equally well ({:.1f} and "
    "{:.1f} legs per image; {:.0f} mm and {:.0f} deg apart); add images at readings that differ "
    f"more between the legs, or clicks on its joints ({LANDMARKS_NAME})."
)

MOVED = Cause(
    "its camera could not be placed: its photographs share no background, so that the camera was "
    "in the hand or stood in several places; give each place a view of its own, or put a board on "
    "the base and write hand_held: true for that view and board in dataset.yaml (legcal init "
    "--hand-held --board SPEC does)."
)


def place_views(
    search: Search,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Joined = None,
    *,
    progress: Callable[[int], None] | None = None,
    run: Run = in_turn,
) -> Placement:
    """Return the cameras of views where the images of rows show most legs, and these legs.

    Where pairs are ambiguous, outlines decide.

    ``hints`` are rough T_base_camera of views; those of views without images are kept. ``joined``
    are T_board_camera of views that know how they stand to each other by a board: they are placed
    together. ``progress`` is called with each row.
    """
    groups = group_views(search.measurements, rows, hints, joined)
    n_legs = search.n_legs
    near = [r for group in groups if group.hint is not None for r in group.some]
    far = [r for group in groups if group.hint is None for r in group.rows]
    pictures = _pictures(search, sorted([*near, *far]), progress, run)
    found = [
        None if g.hint is None else place_near(g.pictures(pictures, g.some), g.hint, n_legs)
        for g in groups
    ]
    # Views without a rough pose, and those whose images do not agree near it: all images, anywhere.
    unclear = [k for k, near in enumerate(found) if near is None or not near.is_clear]
    missing = [r for k in unclear for r in groups[k].rows if r not in pictures]
    pictures |= _pictures(search, missing, progress, run)
    tasks = [
        _Task(group, {row: pictures[row] for row in group.rows if row in pictures}, one)
        for group, one in zip(groups, found, strict=True)
    ]
    T, unplaced = dict(enumerate(hints)), dict[str, NotPlaced]()
    shift = np.zeros((len(T), n_legs, 2, 3))
    error: Array = np.full((len(T), n_legs), search.joint_error)
    place = run if unclear else in_turn
    placed = _all_placed(search, tasks, place)
    for group, (one, swapped) in zip(groups, placed, strict=True):
        if swapped or not one.is_convincing:
            alone = len(group.views) == 1 and not swapped
            moved = alone and is_moved(search.load, group.rows)
            hinted = group.hint is not None
            cause = MOVED if moved else _why_not_placed(one, hinted, is_mirrored=swapped)
            unplaced |= group.not_placed(search.measurements, cause)
            T |= dict.fromkeys(group.views)
            continue
        T |= group.cameras(one.pose())
        seen, leg_error = np.isfinite(one.leg_error), MIN_ERROR + ERROR_SIGMAS * one.leg_error
        shift[group.views] = one.poses.shift[0]
        error[group.views] = np.where(seen, leg_error, search.joint_error)
    placement = Placement(search.A_base, search.B_base, tuple(T.values()), error)
    return replace(placement.shifted(search, shift), unplaced=unplaced)


class _Task(NamedTuple):
    """A group to place."""

    group: Group
    pictures: Mapping[int, Picture]  # of its rows; of all of them where the search near is unclear
    near: PoseCandidates | None  # the camera near its rough pose, by a few of its images


def _placed(search: Search, task: _Task) -> tuple[PoseCandidates, bool]:
    """Return the camera of a group, and whether its images are mirrored.

    By pairs near its rough pose; else by pairs of all images, anywhere, and by outlines where these
    are ambiguous; else by all edges along legs, and by outlines.
    """
    group, pictures, best = task
    n_legs = search.n_legs
    if best is None or not best.is_clear:
        every = group.pictures(pictures, group.rows)
        best = place_camera(every, n_legs)
        if group.hint is not None:
            best = _better(place_near(every, group.hint, n_legs), best)
        best = _decided_by_outlines(search, group, pictures, best)
        if not best.is_convincing:
            by_edges = _by_edges(search, group, pictures, best.poses)
            best = _decided_by_outlines(search, group, pictures, by_edges)
    if group.is_placed and group.hint is not None and not best.is_convincing:
        best = place_at(group.pictures(pictures, list(pictures)), group.hint, n_legs)
    return best, _is_mirrored(search, group, pictures, best)


def _all_placed(
    search: Search, tasks: Sequence[_Task], run: Run
) -> list[tuple[PoseCandidates, bool]]:
    """Return the cameras of all groups, and whether their images are mirrored.

    What is left is placed by the joints as the groups that are placed show them: poses that look
    alike from one image of a symmetric machine need other errors of its joints. So is a group whose
    fit contradicts those of the others.
    """
    placed = list(run(partial(_placed, search), tasks))
    fits, seen = dict[int, ViewFit | None](), set[int]()
    while True:
        left = [k for k, (one, swapped) in enumerate(placed) if swapped or not one.is_convincing]
        new = [k for k in range(len(tasks)) if k not in left and k not in fits]
        if not left or seen.issuperset(new):
            return placed
        seen.update(new)
        at = [(tasks[k].group, placed[k][0]) for k in new]
        fits |= dict(zip(new, run(partial(_fitted, search), at), strict=True))
        known = {k: fit for k, fit in fits.items() if fit is not None}
        if not known:
            return placed
        shown, shift, agree = with_common_shift(search, list(known.values()))
        for k in compress(known, ~agree):
            placed[k] = replace(placed[k][0], by_outlines=False), False
            left.append(k)
            del fits[k]
        again = run(partial(_placed, shown), [_seen_by(shown, tasks[k]) for k in left])
        for k, (one, swapped) in zip(left, again, strict=True):
            if one.is_convincing and not swapped:
                poses = replace(one.poses, shift=one.poses.shift + shift)
                placed[k] = replace(one, poses=poses), False


def _fitted(search: Search, placed: tuple[Group, PoseCandidates]) -> ViewFit | None:
    """Return the fit of a group that is placed to outlines in a few of its images."""
    group, one = placed
    return _measure_at(search, replace(group, rows=group.some), one, 0).fit


def _seen_by(search: Search, task: _Task) -> _Task:
    """Return a task with the legs of another model predicted, and nothing found yet."""
    known = {row: picture.pairs for row, picture in task.pictures.items()}
    pictures = {row: search.picture(row, pairs=known.get(row)) for row in task.group.rows}
    return _Task(task.group, pictures, None)


def _is_mirrored(
    search: Search, group: Group, pictures: Mapping[int, Picture], placed: PoseCandidates
) -> bool:
    """Return whether images of a group show the legs only with left and right exchanged."""
    if placed.is_given or (placed.is_convincing and placed.share >= NOT_MIRRORED_SUPPORT):
        return False
    few = placed.hinted and placed.support.shape[1] == len(group.some)
    flipped = mirrored(group.pictures(pictures, group.some if few else group.rows))
    if not is_mirrored(placed, place_camera(flipped, search.n_legs, MIRRORED_STARTS)):
        return False
    if not (placed.along_edges and placed.is_convincing):
        return True
    # Pairs say little of a view that is placed by other edges.
    none = CameraPoses.none(search.n_legs)
    other = _by_edges(search, group, pictures, none, is_flipped=True)
    return other.along_edges >= MIRRORED_EDGES * placed.along_edges


def _decided_by_outlines(
    search: Search, group: Group, pictures: Mapping[int, Picture], candidates: PoseCandidates
) -> PoseCandidates:
    """Return the poses of a group, first the one of outlines if pairs are ambiguous."""
    near = candidates.hinted and candidates.is_convincing
    n = len(candidates.poses)
    if n == 0 or near or candidates.is_clear:
        return candidates
    few = replace(group, rows=group.some)
    trials = [_measure_at(search, few, candidates, 0)]
    if not (candidates.leads_clearly and _is_decided(search, trials, candidates, few)):
        trials += [_measure_at(search, few, candidates, i) for i in range(1, min(N_POSES, n))]
        if not (candidates.is_convincing and _is_decided(search, trials, candidates, few)):
            by_both = candidates.score[: len(trials)] + [trial.evidence for trial in trials]
            for i in np.argsort(-by_both, kind="stable")[:N_REFINED].tolist():
                one = trials[i]
                if one.fit is not None:
                    again = refine_views(search, [few], one.placement, one.outlines)
                    trials[i] = _Trial(again[0], again[1], again[2][0])
    best = _best(trials)
    fit = trials[best].fit
    if fit is None or not _is_decided(search, trials, candidates, few):
        return replace(candidates, by_outlines=False)
    pose = CameraPoses.one(fit.T_base_group, fit.shift)
    of_group = group.pictures(pictures, list(pictures))
    return replace(with_first(candidates, best, pose, of_group), by_outlines=True)


def _pictures(
    search: Search, rows: Sequence[int], progress: Callable[[int], None] | None, run: Run
) -> dict[int, Picture]:
    """Return edge pairs and predicted legs of the images of rows."""
    pictures = {}
    run = run if any(row not in search.edge_pairs for row in rows) else in_turn
    for row, picture in zip(rows, run(search.picture, rows), strict=True):
        pictures[row] = picture
        if progress is not None:
            progress(row)
    return pictures


def _by_edges(
    search: Search,
    group: Group,
    pictures: Mapping[int, Picture],
    known: CameraPoses,
    *,
    is_flipped: bool = False,  # whether left and right are exchanged
) -> PoseCandidates:
    """Return the camera of a group by all edges along legs in a few of its pictures."""
    known = CameraPoses.rigid(known.R, known.t, search.n_legs)
    rows = sorted(group.rows, key=lambda row: -pictures[row].pairs.best_merit)[:SOME_PICTURES]
    maps, some = search.edge_maps(rows), group.pictures(pictures, rows)
    if is_flipped:
        maps = maps.mirrored(np.array([one.corners[:, 0].mean() for one in some]))
        some = mirrored(some)
    return place_by_edges(some, maps, search.n_legs, known)


def _better(near: PoseCandidates, anywhere: PoseCandidates) -> PoseCandidates:
    """Return the pose with the greater support, that near a rough pose if they are alike."""
    if len(anywhere.poses) == 0 or not anywhere.is_convincing:
        return near
    if len(near.poses) == 0:
        return anywhere
    mean = [float(candidates.support[0].mean()) for candidates in (near, anywhere)]
    return anywhere if mean[1] > 1.1 * mean[0] else near


@dataclass(frozen=True, eq=False)
class _Trial:
    """A pose with the outlines that were measured at it, and their fit."""

    placement: Placement
    outlines: Outlines
    fit: ViewFit | None

    @property
    def evidence(self) -> float:
        """Their support."""
        return 0.0 if self.fit is None else self.fit.evidence


def _measure_at(search: Search, group: Group, candidates: PoseCandidates, i: int) -> _Trial:
    """Measure outlines at a pose, and fit it to them."""
    shift, n_views = candidates.poses.shift[i], len(search.measurements.views)
    T = dict.fromkeys(range(n_views)) | group.cameras(candidates.pose(i))
    error = min(POSE_JOINT_ERROR, search.joint_error)
    placement = Placement(search.A_base, search.B_base, tuple(T.values()), error)
    shifts = np.broadcast_to(shift, (n_views, *shift.shape)).copy()
    placement = placement.shifted(search, shifts)
    outlines, _ = measure_outlines(search, placement, group.rows)
    fit = fit_view(search, group, candidates.pose(i), shift, outlines)
    return _Trial(placement, outlines, fit)


def _best(trials: Sequence[_Trial]) -> int:
    """Return the pose that outlines support most."""
    return int(np.argmax([trial.evidence for trial in trials]))


def _is_decided(
    search: Search, trials: Sequence[_Trial], candidates: PoseCandidates, group: Group
) -> bool:
    """Return whether outlines support one pose clearly more than any other."""
    best = _best(trials)
    others = [
        trial.evidence
        for i, trial in enumerate(trials)
        if i != best and not _same(trial.outlines, trials[best].outlines)
    ]
    alone = len(group.rows) == 1 and search.joint_error > KNOWN_JOINTS
    margin, ratio = (MARGIN_ALONE, RATIO_ALONE) if alone else (MARGIN, EVIDENCE_RATIO)
    fit, other = trials[best].fit, max(others, default=0.0)
    if fit is None or not fit.is_determined:
        return False
    if best == 0 and candidates.is_convincing:  # by edge pairs already
        margin, ratio = 0.0, RATIO_AGREED
    elif not alone and fit.evidence >= RATIO_WITHOUT_RIVAL * other:
        margin = 0.0
    return fit.evidence >= max(min_evidence(group) + margin, ratio * other)


def _same(one: Outlines, other: Outlines) -> bool:
    """Return whether two poses have most legs in the same positions."""
    where = [
        {
            (row, leg, part, edge): middle
            for row, leg, part, edge, middle, used in zip(
                o.row.tolist(), o.leg.tolist(), o.part, o.edge.tolist(), o.ends, o.used, strict=True
            )
            if used
        }
        for o in (one, other)
    ]
    common = [key for key in where[0] if key in where[1]]
    alike = sum(_gap(where[0][key], where[1][key]) <= SAME_PX for key in common)
    return alike >= SAME_PART * max(1, min(len(w) for w in where))


def _gap(one: Array, other: Array) -> float:
    """Return the distance of the middle of a line (2, 2) from another line [px]."""
    along = other[1] - other[0]
    step = one.mean(axis=0) - other[0]
    return float(abs(along[0] * step[1] - along[1] * step[0]) / np.linalg.norm(along))


def _why_not_placed(placed: PoseCandidates, hinted: bool, *, is_mirrored: bool) -> Cause:
    """Return the cause for which a view could not be placed."""
    if is_mirrored:
        return Cause(
            "its camera could not be placed: its images show the legs only if left and right are "
            "swapped; replace mirrored images with the originals, or check what looks the same: "
            "the order of the columns of readings, and the signs of y in the model."
        )
    where = "near its rough pose or anywhere else" if hinted else "anywhere"
    if len(placed.poses) == 0:
        return Cause(
            "its camera could not be placed: no pair of edges in its images could be a leg; check "
            "that the photographs show the machine, sharp and neither black nor overexposed."
        )
    legs, n = float(placed.support[0].mean()), float(placed.expected[0].mean())
    clicked = "" if hinted else f"; or click its joints ({LANDMARKS_NAME})"
    if not placed.is_enough:
        return Cause(
            f"its camera could not be placed: no pose {where} explains its images: the best one "
            "matches {:.1f} of {:.0f} legs per image, and {:.1f} are needed; check that the images "
            "belong to this machine and to their readings, that they are not mirrored, the camera "
            "file, the radii of the model, and the legs of the view if dataset.yaml lists them"
            f"{clicked}.",
            (legs, n, float(placed.needed)),
        )
    if len(placed.poses) == 1 or (placed.by_outlines is False and placed.leads):
        return Cause(
            f"its camera could not be placed: too few outlines were measured at the best pose "
            f"{where}, which matches {{:.1f}} of {{:.0f}} legs per image, to distinguish it from "
            "other edges in the images; add images at other readings, in better light, or clicks "
            f"on its joints ({LANDMARKS_NAME}).",
            (legs, n),
        )
    other = placed.pose(1)
    apart = placed.pose().inv() * other
    return Cause(
        TWO_POSES,
        (
            legs,
            float(placed.support[1].mean()),
            1e3 * float(np.linalg.norm(apart.translation)),
            float(np.degrees(apart.rotation.magnitude())),
        ),
    )
