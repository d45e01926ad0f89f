"""Diagnostics of images, views and rough poses, each named once.

Images in which few legs were found where the others of their view show theirs are examined again:
with the readings of all other images, with the cameras of the other views, and mirrored. An
explanation must be clearly better than the reading itself. Whatever is wrong is left out with a
reason.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.measurements import Measurements, View, few_views, images_in_words
from legcal.data.outlines import Outlines, is_edited
from legcal.data.reasons import USED, Reason, Rejection
from legcal.errors import Cause, by_cause
from legcal.geometry.motions import pose_distance
from legcal.geometry.types import BoolArray, IntArray
from legcal.perception.camera_search import LEFT_RIGHT, UP_DOWN, UPSIDE_DOWN, flipped, shrunk
from legcal.perception.candidate_pairs import CandidatePairs
from legcal.perception.pair_matching import (
    CameraPoses,
    Picture,
    Pictures,
    match_pairs,
)
from legcal.perception.placement import NotPlaced, Placement, Search
from legcal.perception.tuning import SEARCHING, SHARE_OF_OTHERS
from legcal.workers import Run

TOLERANCE = SEARCHING[-1]  # of an axis from its edge pair
# Share of the legs of another explanation of an image: at least, times that of its own reading,
# and more than that.
MIN_SHARE, MIN_GAIN, MIN_MORE = 0.35, 2.0, 0.15
AMBIGUOUS = 0.85  # part of the best explanation from which on another one is about as good
LONE_READING = 3.0  # how many times more than any other one it differs, if it alone is wrong
ZOOMS = 1.02 ** np.setdiff1d(np.arange(-12, 36), 0)  # of images cut out and scaled
# Remedies
_ORIGINAL = "replace it by the original"
_CHECK_ROWS = "check which image belongs to which row"
_FLIPS = (
    (LEFT_RIGHT, Reason.MIRRORED), (UP_DOWN, Reason.MIRRORED), (UPSIDE_DOWN, Reason.UPSIDE_DOWN)
)  # fmt: skip

N_REFERENCES = 3  # good images that others are compared with
GOOD_PERCENTILE = 75.0  # percentile of the shares that images show, for good images
MIN_USUAL_SHARE = 0.3  # that good images show, for others to be compared with them
NOT_IN_SIGHT = (Reason.OUTSIDE, Reason.HIDDEN)
NO_OUTLINE = Rejection(Reason.OTHER, "no outline is used")

# Axes of cameras in other software, as columns the x, y and z of ours in them.
_CAMERA_AXES = {
    "y up and z backward": np.diag([1.0, -1.0, -1.0]),
    "x forward and z up": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "x left and y up, or its images are upside down": np.diag([-1.0, -1.0, 1.0]),
}
# Three times the accuracy of a rough pose: part of the distance of the camera, angle
FAR_OFF = (0.06, np.deg2rad(6.0))
BEFORE_FIT = 2.5  # times more, while the cameras are only where legs were recognised


class ImageExplanation(NamedTuple):
    """The explanation of an image whose legs are not where its reading predicts them."""

    own: float  # share of the legs, by visible length, that are where its reading has them
    reason: Rejection = USED  # the explanation; false without a clear one
    remedy: str = ""


class OutlineCount(NamedTuple):
    """Numbers of measured and of predicted outlines of an image."""

    used: int
    visible: int

    @property
    def share(self) -> float:
        """Their ratio."""
        return self.used / self.visible


def find_wrong_images(
    search: Search,
    placement: Placement,
    outlines: Outlines,
    rows: IntArray,
    defects: Mapping[int, Rejection],
    run: Run,
) -> tuple[Placement, dict[int, Rejection]]:
    """Return the placement with notes on images, and the rejections of images by row.

    ``rows`` were searched; ``defects`` are what is wrong with single images. A view all of whose
    images have one is not placed, with one note.
    """
    view = search.measurements.view
    usable = [row for row in rows.tolist() if row not in defects]
    defective = set(view[rows].tolist()) - set(view[usable].tolist())
    placement = _without_views(search.measurements, placement, sorted(defective), defects)
    counts = _found(outlines, [r for r in usable if placement.T_base_camera[view[r]] is not None])
    suspects = _suspects(counts, view)
    usual = _usual(search, placement, counts, suspects, run)
    task = partial(explain, search, placement, usual, suspects=frozenset(suspects))
    reasons = dict(defects)
    single = {row: why for row, why in sorted(defects.items()) if view[row] not in defective}
    notes = defect_notes(search.measurements, single)
    left_out, barely = dict[int, Cause](), dict[int, Cause]()
    for row, explanation in zip(suspects, run(task, suspects), strict=True):
        reason, said = image_verdict(search.measurements, row, explanation, usual, counts)
        if reason:
            reasons[row] = reason
        if reason.reason is Reason.OTHER_SCENE:
            barely[row] = Cause("was left out: {}.", (said,))
        elif reason:
            left_out[row] = said
        else:
            barely[row] = Cause("{}.", (said,))
    notes += _left_out_notes(search.measurements, left_out)
    notes += _leg_notes(search, outlines, counts, reasons)
    return replace(placement, notes=(*placement.notes, *notes), barely=barely), reasons


def reject_images(outlines: Outlines, reasons: Mapping[int, Rejection]) -> Outlines:
    """Reject the outlines of some images; edited ones stay.

    Those that an image should not show keep the reason for that, so that they do not count as
    expected there.
    """
    out = np.isin(outlines.row, list(reasons)) & ~is_edited(outlines)
    reason = tuple(
        reasons[row].as_stored if is_out and why.reason not in NOT_IN_SIGHT else why
        for row, is_out, why in zip(
            outlines.row.tolist(), out.tolist(), outlines.reason, strict=True
        )
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)


def is_out_of_sight(outlines: Outlines) -> BoolArray:
    """Return the mask of outlines outside the image or hidden."""
    return outlines.rejected_for(*NOT_IN_SIGHT)


def is_visible(outlines: Outlines) -> BoolArray:
    """Return the mask of outlines that an image should show."""
    return ~outlines.rejected_for(*NOT_IN_SIGHT, Reason.NOT_PLACED)


def is_measurable(outlines: Outlines) -> BoolArray:
    """Return the mask of outlines that an image should show, long enough to be measured."""
    return is_visible(outlines) & ~outlines.rejected_for(Reason.SHORT)


def _without_views(
    measurements: Measurements,
    placement: Placement,
    defective: Sequence[int],
    defects: Mapping[int, Rejection],
) -> Placement:
    """Return the placement without the cameras of views with unusable images only."""
    cameras, unplaced = list(placement.T_base_camera), dict(placement.unplaced)
    for v in defective:
        name = measurements.views[v].name
        of_view = {row: why.cause for row, why in defects.items() if measurements.view[row] == v}
        images = [f"{measurements.image[row]}: " for row in of_view] if len(of_view) == 1 else []
        causes = [cause for cause, _ in by_cause(of_view)]
        cameras[v] = None
        unplaced[name] = NotPlaced(
            name,
            Cause(
                f"its camera could not be placed: {'none of ' * (len(of_view) != 1)}its {{}} image"
                f"{'s' * (len(of_view) != 1)} is {'un' * (len(of_view) == 1)}usable "
                f"({'{}' * len(images)}{'; '.join(['{}'] * len(causes))}); take them again.",
                (len(of_view), *images, *causes),
            ),
        )
    return replace(placement, T_base_camera=tuple(cameras), unplaced=unplaced)


def image_verdict(
    measurements: Measurements,
    row: int,
    explanation: ImageExplanation,
    usual: Mapping[int, float],
    counts: Mapping[int, OutlineCount],
) -> tuple[Rejection, Cause]:
    """Return the rejection of an image, false if it is used, and its cause with a remedy."""
    if explanation.reason:
        return explanation.reason, Cause("{}; {}", (explanation.reason.cause, explanation.remedy))
    much = Cause("{} of {} predicted outlines were found", tuple(counts[row]))
    view = int(measurements.view[row])
    if explanation.own >= SHARE_OF_OTHERS * usual[view]:
        little = "shows little of the legs: {}, in other images most; check its light and sharpness"
        return USED, Cause(little, (much,))
    q, given = measurements.q, measurements.q[row]
    is_read = np.isfinite(given)
    same = (measurements.view == view) & is_read.any() & np.all(q[:, is_read] == given[is_read], 1)
    if len(others := np.setdiff1d(np.flatnonzero(same), row)):
        copied = "{}, and its readings are those of image {}; correct its row if it was copied"
        cause = Cause(copied, (much, measurements.image[int(others[0])]))
        return Rejection(Reason.OTHER_SCENE), cause
    nothing = (
        "{}, and no other explanation fits; check that it is a photograph of this machine, taken "
        "by this camera at this reading"
    )
    return Rejection(Reason.OTHER_SCENE), Cause(nothing, (much,))


def defect_notes(measurements: Measurements, defects: Mapping[int, Rejection]) -> list[str]:
    """Return one sentence for each defect of single images, by row."""
    again = {row: Cause("{}; take it again", (why.cause,)) for row, why in defects.items()}
    return _left_out_notes(measurements, again)


def _left_out_notes(measurements: Measurements, why: Mapping[int, Cause]) -> list[str]:
    """Return one sentence for each cause for which images were left out, by row."""
    notes = []
    for cause, rows in by_cause(why):
        verb = ": was left out" if len(rows) == 1 else " were left out"
        notes.append(f"{images_in_words(measurements, rows)}{verb}: {cause}.")
    return notes


def images_left_out(outlines: Outlines) -> dict[int, Rejection]:
    """Return the commonest rejection of images with no used outline, by row."""
    rejections = {}
    for row in np.unique(outlines.row[~is_out_of_sight(outlines)]).tolist():
        of_image = np.flatnonzero(outlines.row == row)
        if outlines.used[of_image].any():
            continue
        shown = [why for i in of_image.tolist() if (why := outlines.reason[i])
                 and why.reason not in NOT_IN_SIGHT]  # fmt: skip
        rejections[row] = _most_common(shown or [NO_OUTLINE])
    return rejections


def _most_common(rejections: Sequence[Rejection]) -> Rejection:
    """Return the commonest reason, with its detail if all have the same."""
    reason = Counter(why.reason for why in rejections).most_common(1)[0][0]
    details = {why.detail for why in rejections if why.reason is reason}
    return Rejection(reason, details.pop() if len(details) == 1 else "")


def share_shown(search: Search, placement: Placement, row: int) -> float:
    """Return the fraction of the predicted legs, by visible length, that an image shows.

    Of the legs stated for its view, which must have been placed.
    """
    view = int(search.measurements.view[row])
    picture = search.picture(row)
    return _share(picture, placement, view)


def explain(
    search: Search,
    placement: Placement,
    usual: Mapping[int, float],
    row: int,
    *,
    suspects: Collection[int] = (),
) -> ImageExplanation:
    """Explain an image of a placed view whose legs are not where its reading predicts them.

    ``usual`` is the fraction of legs that good images of each view show (:func:`share_shown`);
    ``suspects`` are all suspect images: a reading that another image shows hardly belongs to this
    one.
    """
    measurements = search.measurements
    view = int(measurements.view[row])
    pairs = search.pairs(row, view)
    picture = search.picture(row, view, pairs)
    own = _share(picture, placement, view)

    def as_if(changed: CandidatePairs) -> float:
        return _share(replace(picture, pairs=changed), placement, view)

    def best_reading(rows: Sequence[int], v: int, seen: CandidatePairs) -> list[tuple[float, int]]:
        readings = [(_share(search.picture(r, v, seen), placement, v), r) for r in rows]
        return _best(readings, suspects)

    tried = [
        (as_if(flipped(pairs, picture.corners, flip)), Rejection(reason), _ORIGINAL)
        for flip, reason in _FLIPS
    ]
    zooms = np.array([as_if(shrunk(pairs, picture.corners, zoom)) for zoom in ZOOMS.tolist()])
    zoom = float(np.median(ZOOMS[zooms == zooms.max()]))
    zoomed = Rejection(Reason.ZOOMED, Cause("{:.2f}", (zoom,)))
    tried.append((float(zooms.max()), zoomed, _ORIGINAL))
    rows = _other_readings(search, row)
    for share, other in best_reading(rows, view, pairs):
        tried.append((share, *_at_other_reading(search, row, other, other in suspects)))
    for w, other_view in enumerate(measurements.views):
        sizes = [(c.width, c.height) for c in (measurements.views[view].camera, other_view.camera)]
        if w == view or placement.T_base_camera[w] is None or sizes[0] != sizes[1]:
            continue
        same = other_view.camera is measurements.views[view].camera
        there = [row, *(other for other in rows if measurements.view[other] == w)]
        for share, other in best_reading(there, w, pairs if same else search.pairs(row, w)):
            image = measurements.image[other]
            at = "" if other == row else f" at the reading given for image {image}"
            shown = f"it was taken by the camera of view {other_view.name}{at}"
            tried.append((share, Rejection(Reason.OTHER_VIEW, shown), _CHECK_ROWS))
    share, why, remedy = max(tried, key=lambda one: one[0])
    # Clearly more of the legs than the reading's own, and enough of them
    of_others = SHARE_OF_OTHERS * usual.get(view, 0.0)
    least = max(MIN_SHARE, of_others, MIN_GAIN * own, own + MIN_MORE)
    return ImageExplanation(own, why, remedy) if share >= least else ImageExplanation(own)


def _at_other_reading(
    search: Search, row: int, other: int, exchanged: bool
) -> tuple[Rejection, str]:
    """Return the rejection of an image that matches another image's reading, and the remedy.

    Where that image matches its own reading, the two were not exchanged: its pose may be near, and
    one wrong digit in this reading makes the difference.
    """
    measurements = search.measurements
    image, remedy = measurements.image[other], _CHECK_ROWS
    if exchanged:
        shown = f"it shows the reading given for image {image}"
        return Rejection(Reason.OTHER_READING, shown), remedy
    why = f"its legs match the reading of image {image}"
    difference = np.abs(measurements.q[row] - measurements.q[other])
    *_, second, first = np.argsort(np.nan_to_num(difference))
    if difference[first] > LONE_READING * difference[second]:
        given, there = 1e3 * measurements.q[[row, other], first]
        name = search.leg_names[first]
        remedy = f"check its reading of {name}, {given:.2f} mm against {there:.2f} mm, and {remedy}"
    return Rejection(Reason.OTHER_READING, why), remedy


def _best(
    readings: Sequence[tuple[float, int]], suspects: Collection[int]
) -> list[tuple[float, int]]:
    """Return the reading that suits best, if no other one suits about as well.

    Where its own image is a suspect, images were exchanged: then only readings of such are rivals.
    """
    ranked = sorted(readings, key=lambda one: -one[0])
    if ranked and ranked[0][1] in suspects:
        ranked = [one for one in ranked if one[1] in suspects]
    if len(ranked) > 1 and ranked[1][0] > AMBIGUOUS * ranked[0][0]:
        return []
    return ranked[:1]


def _other_readings(search: Search, row: int) -> list[int]:
    """Return a row with an image of each other pose, of the same view where there is one."""
    measurements = search.measurements
    pose_of_row, view = int(measurements.pose[row]), int(measurements.view[row])
    of_pose: dict[int, int] = {}
    for other, image in enumerate(measurements.image):
        pose = int(measurements.pose[other])
        if (
            pose != pose_of_row
            and image
            and (pose not in of_pose or measurements.view[other] == view)
        ):
            of_pose[pose] = other
    return list(of_pose.values())


def _share(picture: Picture, placement: Placement, view: int) -> float:
    """Return the share of the visible length of the legs on which a picture has their pairs."""
    T = placement.T_base_camera[view]
    if T is None or len(picture.targets) == 0:
        return 0.0
    pose = CameraPoses.one(T, placement.shift[view])
    seen = match_pairs(Pictures.of([picture]), pose, TOLERANCE)
    share = picture.targets.share
    visible = float(seen.visible[0, 0] @ share)
    return float(seen.exclusive_score[0, 0] @ share) / visible if visible > 0.0 else 0.0


def _found(outlines: Outlines, rows: Sequence[int]) -> dict[int, OutlineCount]:
    """Return the numbers of outlines of images that should show any, by row."""
    visible = is_visible(outlines)
    counts = {}
    for row in rows:
        of_image = (outlines.row == row) & visible
        if of_image.any():
            counts[row] = OutlineCount(int(outlines.used[of_image].sum()), int(of_image.sum()))
    return counts


def _suspects(counts: Mapping[int, OutlineCount], view: IntArray) -> list[int]:
    """Return the images in which far fewer outlines were found than in others of their view.

    Where a view has few images, all others are compared with.
    """
    suspects = []
    for row, count in counts.items():
        own = [other.share for r, other in counts.items() if view[r] == view[row]]
        every = [other.share for other in counts.values()]
        usual = float(np.percentile(own if len(own) >= N_REFERENCES else every, GOOD_PERCENTILE))
        if usual >= MIN_USUAL_SHARE and count.share < SHARE_OF_OTHERS * usual:
            suspects.append(row)
    return suspects


def _usual(
    search: Search,
    placement: Placement,
    counts: Mapping[int, OutlineCount],
    suspects: Sequence[int],
    run: Run,
) -> dict[int, float]:
    """Return the fraction of legs that good images show, for views with suspect images.

    There is always a good one: an image is a suspect where others show far more.
    """
    views = np.unique(search.measurements.view[list(suspects)]).tolist() if suspects else []
    usual = {}
    for v in views:
        good = {row: count for row, count in counts.items() if row not in suspects}
        rows = _references(search.measurements, good, v)
        task = partial(share_shown, search, placement)
        usual[v] = float(np.median(list(run(task, rows))))
    return usual


def _references(
    measurements: Measurements, counts: Mapping[int, OutlineCount], view: int
) -> list[int]:
    """Return the images of a view in which most was found; of all views if it has none."""
    of_view = [row for row in counts if measurements.view[row] == view]
    return sorted(of_view or counts, key=lambda row: -counts[row].share)[:N_REFERENCES]


def _leg_notes(
    search: Search,
    outlines: Outlines,
    counts: Mapping[int, OutlineCount],
    reasons: Mapping[int, Rejection],
) -> list[str]:
    """Return notes on legs that views list and do not show."""
    measurements, names = search.measurements, search.leg_names
    notes = []
    for v, view in enumerate(measurements.views):
        rows = [r for r in counts if measurements.view[r] == v and r not in reasons]
        if view.legs is None or not rows:
            continue
        of_view = np.isin(outlines.row, rows)
        used = set(outlines.leg[of_view & outlines.used].tolist())
        for leg in np.flatnonzero(search.wanted[v]).tolist():
            mine = of_view & (outlines.leg == leg)
            if leg in used or not used or not mine.any():
                continue
            why = _most_common([outlines.reason[i] for i in np.flatnonzero(mine).tolist()])
            notes.append(
                f"view {view.name} lists {names[leg]} (legs), but none of its images has a usable "
                f"outline of it ({why}); inspect them with legcal detect, or remove it from the "
                "list."
            )
    return notes


def far_off(hint: RigidTransform, T_base_camera: RigidTransform, reach: float = 1.0) -> bool:
    """Return whether a rough pose is farther from a pose than the tolerance of rough poses."""
    distance = float(np.linalg.norm(T_base_camera.translation))
    apart, angle = pose_distance(hint, T_base_camera)
    return apart > reach * FAR_OFF[0] * distance or angle > reach * FAR_OFF[1]


def _other_meanings(hint: RigidTransform) -> Iterator[tuple[str, RigidTransform]]:
    """Yield common misinterpretations of T_base_camera, with the pose each would mean."""
    yield "it is T_camera_base, the inverse", hint.inv()
    w_first = Rotation.from_quat(np.roll(hint.rotation.as_quat(), -1))
    order = "its quaternion is in the order w, x, y, z"
    yield order, RigidTransform.from_components(hint.translation, w_first)
    for axes, R_axes in _CAMERA_AXES.items():
        turned = RigidTransform.from_rotation(Rotation.from_matrix(R_axes))
        yield f"its camera axes are {axes}", hint * turned


def far_from_hints(
    hints: Sequence[RigidTransform | None], cameras: Sequence[RigidTransform | None]
) -> list[int]:
    """Return the views whose cameras are far from their rough poses, whatever these may mean.

    Views that suit the camera of another one are left out: they were exchanged.
    """
    return [
        v
        for v, (hint, T) in enumerate(zip(hints, cameras, strict=True))
        if hint is not None
        and T is not None
        and far_off(hint, T)
        and not any(other is not None and not far_off(hint, other) for other in cameras)
        and all(far_off(as_meant, T) for _, as_meant in _other_meanings(hint))
    ]


def hint_notes(
    views: Sequence[View],
    cameras: Sequence[RigidTransform | None],
    reach: float = 1.0,
    *,
    by_landmarks: Collection[str] = (),
) -> list[str]:
    """Return notes on rough T_base_camera of views that the images contradict.

    ``cameras`` are found in the images, None where a view could not be placed; ``reach`` multiplies
    the tolerance of rough poses. Views with the same misinterpretation have one note. Poses of the
    views ``by_landmarks`` follow from clicks.
    """
    notes, alike = [], dict[str, list[tuple[str, float, float]]]()  # by misinterpretation
    names = [view.name for view in views]
    hints = [view.T_base_camera for view in views]
    for name, hint, T in zip(names, hints, cameras, strict=True):
        if hint is None or T is None or not far_off(hint, T, reach):
            continue
        apart, angle = pose_distance(hint, T)
        if name in by_landmarks:
            notes.append(
                f"view {name}: its clicks contradict the images: the camera by clicks is "
                f"{1e3 * apart:.0f} mm and {np.degrees(angle):.0f} deg from the camera found in "
                f"the images; check the clicks of the view in {LANDMARKS_NAME}."
            )
            continue
        x, y, z = T.translation
        other = next(
            (
                other
                for other, camera in zip(names, cameras, strict=True)
                if other != name and camera is not None and not far_off(hint, camera, reach)
            ),
            None,
        )
        meant = next((what for what, as_meant in _other_meanings(hint)
                      if not far_off(as_meant, T, reach)), None)  # fmt: skip
        remedy = "correct it in dataset.yaml"
        if other is not None:
            remedy = f"it fits view {other}: check whether views or their images were swapped"
        elif meant is not None:
            alike.setdefault(meant, []).append((name, 1e3 * apart, float(np.degrees(angle))))
            continue
        notes.append(
            f"view {name}: its T_base_camera is wrong: it is {1e3 * apart:.0f} mm and "
            f"{np.degrees(angle):.0f} deg from the camera found in the images (xyz: [{x:.3f}, "
            f"{y:.3f}, {z:.3f}]); {remedy}."
        )
    for meant, those in alike.items():
        of_views, mm, deg = zip(*those, strict=True)
        one = len(those) == 1
        notes.append(
            f"{few_views(of_views)}: {'its' if one else 'each'} T_base_camera is wrong: it is "
            f"{_span(mm)} mm and {_span(deg)} deg from the camera found in the images; it fits if "
            f"{meant}: correct {'it' if one else 'them'} in dataset.yaml."
        )
    return notes


def _span(values: Sequence[float]) -> str:
    """Return the range of some values, in whole numbers."""
    ends = f"{min(values):.0f}", f"{max(values):.0f}"
    return " to ".join(dict.fromkeys(ends))
