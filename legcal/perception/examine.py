"""Photographs observed with doubt: what each shows, against its reading and the others of its view.

Images that are black, overexposed, empty or blurred are found before anything else; images in which
few legs were found where the others of their view show theirs are judged once more by all that they
may show instead. Whatever is wrong is left out with a reason, and said once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from legcal.data import Outlines, is_edited, join_outlines, merge_edited
from legcal.geometry import BoolArray, IntArray
from legcal.perception.bars import Bars
from legcal.perception.detection import NOT_PLACED
from legcal.perception.doubts import Explanation, explain, share_shown
from legcal.perception.exposure import Exposure, expose, image_defects
from legcal.perception.outline import HIDDEN, OUTSIDE, WRONG_WIDTH, outline_parts
from legcal.perception.photographs import (
    Joined,
    Photographs,
    Placement,
    Scene,
    counted,
    detect,
    place,
    placed_cameras,
    search_in,
    usual_blur,
)
from legcal.perception.picture import to_grey
from legcal.perception.radii import Part
from legcal.perception.recognise import look_closer
from legcal.perception.search import Search, group_views
from legcal.progress import Report
from legcal.vision import camera_numbers


def closer_look(
    photographs: Photographs,
    placement: Placement,
    outlines: Outlines,
    report: Report,
    joined: Joined = None,
    *,
    together: bool = True,
) -> tuple[Placement, Outlines]:
    """Return cameras by the outlines, and these with the legs that are found near that.

    Parameters
    ----------
    photographs : Photographs
        The images.
    placement : Placement
        What was recognised in them.
    outlines : Outlines
        Measured near there.
    report : callable
        Called as ``report(stage, done, total)``.
    joined : sequence of RigidTransform or None, for each view
        As :func:`legcal.perception.photographs.place` has it.
    together : bool
        As for :func:`legcal.perception.outline.outline_parts`.
    """
    search, found, scene = placement.search, placement.recognised, placement.scene
    hints = [view.T_base_camera for view in search.measurements.views]
    groups = group_views(search.measurements, photographs.detect, hints, joined)
    is_own = np.isin(outlines.row, photographs.detect)
    own, others = outlines.choose(is_own), outlines.choose(~is_own)
    closer = look_closer(
        search,
        groups,
        found,
        own,
        photographs.mechanism.leg_names,
        together=together,
        run=photographs.run,
        progress=counted(report, "Looking for missing legs", len(photographs.detect)),
    )
    searched = np.zeros(search.measurements.n_rows, dtype=np.bool_)
    searched[photographs.detect] = True
    rows = searched[:, None, None]
    cameras, unplaced = placed_cameras(photographs, scene, closer.recognised)
    scene = replace(
        scene,
        A_base=np.where(rows, closer.A_base, scene.A_base),
        B_base=np.where(rows, closer.B_base, scene.B_base),
        T_base_camera=cameras,
    )
    placement = replace(
        placement,
        scene=scene,
        recognised=closer.recognised,
        unplaced={**placement.unplaced, **unplaced},
    )
    return placement, join_outlines([merge_edited(closer.outlines, own), others])


FEW = 0.5  # found, against other images
WITNESSES = 3  # good images that tell how much of the legs they show
SHOWN = 0.5  # share of a leg's length in each of them, from which on it is clearly visible
NOTHING_LIKE = "it does not show the legs where its reading has them"  # a reason


@dataclass(frozen=True)
class OutlineCount:
    """How many outlines of an image were found, of those that it should show."""

    used: int
    visible: int

    @property
    def share(self) -> float:
        """Their ratio."""
        return self.used / self.visible


def witnesses(photographs: Photographs, found: Mapping[int, OutlineCount], view: int) -> list[int]:
    """Return the images of a view in which most was found; of all views if it has none."""
    own = [row for row in found if photographs.measurements.view[row] == view]
    return sorted(own or found, key=lambda row: -found[row].share)[:WITNESSES]


def image_name(photographs: Photographs, row: int) -> str:
    """Return what an image is called in notes."""
    measurements = photographs.measurements
    view = measurements.views[int(measurements.view[row])]
    return f"view {view.name}, image {measurements.image[row]}"


def judged(
    photographs: Photographs,
    row: int,
    explanation: Explanation,
    usual: Mapping[int, float],
    found: Mapping[int, OutlineCount],
) -> tuple[str, str]:
    """Return why an image is left out, "" if it is not, and the sentence that says so."""
    name, count = image_name(photographs, row), found[row]
    much = f"{count.used} of {count.visible} outlines where its reading has the legs"
    if explanation.reason:
        return (
            explanation.reason,
            f"{name}: was left out: {explanation.reason}; {explanation.remedy}.",
        )
    view = int(photographs.measurements.view[row])
    if explanation.own >= FEW * usual[view]:
        return "", (
            f"{name}: shows little of the legs: found {much}, in other images most; look "
            " at its light and sharpness."
        )
    return NOTHING_LIKE, (
        f"{name}: was left out: found {much}, and nothing else that it shows; check that it is a "
        "photograph of this machine, taken by this camera at this reading."
    )


def defect_notes(photographs: Photographs, defects: Mapping[int, str]) -> list[str]:
    """Return what is to be said of images that show nothing."""
    return [
        f"{image_name(photographs, row)}: was left out: {why}; take it again."
        for row, why in sorted(defects.items())
    ]


def leg_notes(
    photographs: Photographs,
    placement: Placement,
    outlines: Outlines,
    found: Mapping[int, OutlineCount],
    reasons: Mapping[int, str],
) -> list[str]:
    """Return what is to be said of the legs that views are said to show."""
    measurements, names = photographs.measurements, photographs.mechanism.leg_names
    notes = []
    for v, view in enumerate(measurements.views):
        rows = [r for r in found if measurements.view[r] == v and r not in reasons]
        if view.legs is None or not rows:
            continue
        own = np.isin(outlines.row, rows)
        used = set(outlines.leg[own & outlines.used].tolist())
        for leg in np.flatnonzero(photographs.wanted[v]).tolist():
            mine = own & (outlines.leg == leg)
            if leg in used or not used or not mine.any():
                continue
            why = Counter(outlines.reason[i] for i in np.flatnonzero(mine).tolist())
            notes.append(
                f"view {view.name}: legs names {names[leg]}, of which none of its images shows an "
                f"outline that can be used ({why.most_common(1)[0][0]}); look at legcal detect, "
                "or leave it out there."
            )
        good = {row: found[row] for row in rows}
        notes += _left_out_legs(photographs, placement, v, witnesses(photographs, good, v))
    return notes


def _left_out_legs(
    photographs: Photographs, placement: Placement, v: int, rows: Sequence[int]
) -> list[str]:
    """Return a note on legs that a view leaves out although its images show them clearly."""
    search = placement.search
    clear = [
        name
        for leg, name in enumerate(photographs.mechanism.leg_names)
        if not photographs.wanted[v, leg]
        and search.cylinders[leg]
        and all(
            share_shown(search, placement.recognised, row, legs=np.array([leg])) >= SHOWN
            for row in rows
        )
    ]
    if not clear:
        return []
    return [
        f"view {photographs.measurements.views[v].name}: legs leaves out {', '.join(clear)}, which "
        "its images show clearly; name them there to use them."
    ]


USUALLY = 0.3  # the least that images of a view must find to be compared with
GOOD = 75.0  # percentile of what images find, for what good ones do
HARDLY = 0.3  # of the outlines of a part that should be seen
NOT_IN_SIGHT = (OUTSIDE, HIDDEN)  # beginnings of reasons


@dataclass(frozen=True, eq=False)
class Observed:
    """What the images show.

    Attributes
    ----------
    photographs : Photographs
        The images, and the mechanism with the radii that they show.
    placement : Placement
        The scene, views that could not be placed, and notes on views and images.
    outlines : Outlines
        Of all images; those of images that are left out are rejected.
    left_out : dict of str
        Why images were left out, by row.
    blur : tuple of float
        Standard deviation of the usual blur of each view [px]; NaN where none was measured.
    """

    photographs: Photographs
    placement: Placement
    outlines: Outlines
    left_out: dict[int, str]
    blur: tuple[float, ...]


def observe(
    photographs: Photographs,
    scene: Scene,
    report: Report,
    joined: Joined = None,
    *,
    together: bool = True,
) -> Observed:
    """Place the cameras, measure the outlines, and leave out the images that are wrong.

    Parameters
    ----------
    photographs : Photographs
        The images.
    scene : Scene
        The model, and rough camera poses where there are any.
    report : callable
        Called as ``report(stage, done, total)``.
    joined : sequence of RigidTransform or None, for each view
        As :func:`legcal.perception.photographs.place` has it.
    together : bool
        As for :func:`legcal.perception.outline.outline_parts`.
    """
    defects, bars = _looked_at(photographs, scene, report, joined)
    rows = photographs.detect
    usable = np.array([row for row in rows.tolist() if row not in defects], dtype=np.intp)
    searched = replace(photographs, detect=usable)
    placement = place(searched, scene, report, joined, known=bars)
    blurs: dict[int, float] = {}
    method = partial(outline_parts, together=together)
    measure = partial(detect, report=report, method=method, blur_of_row=blurs)
    outlines = measure(photographs, placement.scene)
    doubtful = _parts_not_found(photographs, outlines)
    if doubtful:
        other = place(searched, scene, report, joined, doubtful, bars)
        if other.recognised.radii.factor:
            mechanism = photographs.mechanism.with_cylinders(other.search.cylinders)
            corrected = replace(photographs, mechanism=mechanism)
            again = measure(corrected, other.scene)
            if again.used.sum() > outlines.used.sum():
                photographs, placement, outlines = corrected, other, again
    placement, outlines = closer_look(
        replace(photographs, detect=usable), placement, outlines, report, joined, together=together
    )
    placement = _without_images(photographs, placement, usable, defects)
    view = photographs.measurements.view
    placed = [row for row in rows.tolist() if placement.scene.T_base_camera[view[row]] is not None]
    found = _found(outlines, [row for row in placed if row not in defects])
    doubted = _doubted(found, view)
    usual = _usual(photographs, placement, found, doubted)
    explained = _explained(photographs, placement, usual, doubted)
    lost = _lost_views(photographs, usable)  # each has a sentence of its own
    reasons = dict(defects)
    notes = defect_notes(photographs, {r: w for r, w in defects.items() if view[r] not in lost})
    for row, explanation in explained.items():
        reason, note = judged(photographs, row, explanation, usual, found)
        notes.append(note)
        if reason:
            reasons[row] = reason
    notes += leg_notes(photographs, placement, outlines, found, reasons)
    placement = replace(placement, notes=(*placement.notes, *notes))
    blur = usual_blur(photographs, blurs)
    return Observed(photographs, placement, rejected(outlines, reasons), reasons, blur)


def _parts_not_found(photographs: Photographs, outlines: Outlines) -> list[Part]:
    """Return the parts of legs, by leg and radius, of which hardly an outline can be used.

    One that is used although the width of its part is wrong speaks for no radius.
    """
    visible = visible_outlines(outlines)
    which = list(zip(outlines.row.tolist(), outlines.leg.tolist(), outlines.part, strict=True))
    of_wrong_width = {
        one for one, why in zip(which, outlines.reason, strict=True) if why.startswith(WRONG_WIDTH)
    }
    used = outlines.used & np.array([one not in of_wrong_width for one in which], dtype=np.bool_)
    part = np.array(outlines.part)
    parts = []
    for j, leg in enumerate(photographs.mechanism.legs):
        for link, radius in leg.radius_of_part.items():
            own = visible & (outlines.leg == j) & (part == link)
            is_seen = own.any() or not visible.any()
            if is_seen and used[own].sum() <= HARDLY * own.sum():
                parts.append((j, radius))
    return parts


def rejected(outlines: Outlines, reasons: Mapping[int, str]) -> Outlines:
    """Return outlines with those of some images rejected; edited ones stay.

    Those that an image should not show keep the reason for that, so that they do not count as
    expected there.
    """
    out = np.isin(outlines.row, list(reasons)) & ~is_edited(outlines)
    reason = tuple(
        reasons[row] if is_out and not why.startswith(NOT_IN_SIGHT) else why
        for row, is_out, why in zip(
            outlines.row.tolist(), out.tolist(), outlines.reason, strict=True
        )
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)


def _look(search: Search, rows: Collection[int], row: int) -> tuple[Exposure, Bars | None]:
    """Return how an image was exposed, and the bars of those that are to be recognised."""
    image = search.load(row)
    view = int(search.measurements.view[row])
    bars = replace(search, load=lambda _: image).bars(row, view) if row in rows else None
    return expose(to_grey(image)), bars


def _looked_at(
    photographs: Photographs, scene: Scene, report: Report, joined: Joined
) -> tuple[dict[int, str], dict[int, Bars]]:
    """Return why images show nothing, and the bars of those that are recognised first, by row."""
    rows, view = photographs.detect.tolist(), photographs.measurements.view
    count = counted(report, "Looking at images", len(rows))
    hints = scene.T_base_camera
    groups = group_views(photographs.measurements, photographs.detect, hints, joined)
    first = {r for g in groups for r in (g.rows if g.hint is None else g.some)}
    exposures, bars = {}, {}
    look = partial(_look, search_in(photographs, scene), first)
    for row, (exposure, own) in zip(rows, photographs.run(look, rows), strict=True):
        exposures[row] = exposure
        if own is not None:
            bars[row] = own
        count(row)
    views = photographs.measurements.views
    numbers = [camera_numbers(one.camera) for one in views]
    camera = [numbers.index(own) for own in numbers]  # the first view of the same camera
    defects = image_defects(
        exposures,
        {row: int(view[row]) for row in rows},
        {row: camera[view[row]] for row in rows},
    )
    return defects, bars


def _lost_views(photographs: Photographs, usable: IntArray) -> set[int]:
    """Return the searched views all of whose images show nothing."""
    view = photographs.measurements.view
    return set(view[photographs.detect].tolist()) - set(view[usable].tolist())


def _without_images(
    photographs: Photographs, placement: Placement, usable: IntArray, defects: Mapping[int, str]
) -> Placement:
    """Return the placement with views unplaced all of whose images show nothing."""
    measurements = photographs.measurements
    cameras = list(placement.scene.T_base_camera)
    unplaced = dict(placement.unplaced)
    for v in sorted(_lost_views(photographs, usable)):
        name = measurements.views[v].name
        own = [row for row in defects if measurements.view[row] == v]
        cameras[v] = None
        unplaced[name] = (
            f"view {name}: its camera could not be placed: found nothing to see in its {len(own)} "
            f"image{'s' * (len(own) != 1)} ({measurements.image[own[0]]}: {defects[own[0]]}), "
            "needed photographs of the legs; take them again."
        )
    scene = replace(placement.scene, T_base_camera=tuple(cameras))
    return replace(placement, scene=scene, unplaced=unplaced)


def _found(outlines: Outlines, rows: Sequence[int]) -> dict[int, OutlineCount]:
    """Return how many outlines were found in images that should show any, by row."""
    visible = visible_outlines(outlines)
    counts = {}
    for row in rows:
        own = (outlines.row == row) & visible
        if own.any():
            counts[row] = OutlineCount(int(outlines.used[own].sum()), int(own.sum()))
    return counts


def visible_outlines(outlines: Outlines) -> BoolArray:
    """Return which outlines an image should show."""
    return np.array(
        [not why.startswith((*NOT_IN_SIGHT, NOT_PLACED)) for why in outlines.reason],
        dtype=np.bool_,
    )


def _doubted(found: Mapping[int, OutlineCount], view: IntArray) -> list[int]:
    """Return the images in which far fewer outlines were found than in others of their view.

    Where a view has few images, all others are compared with.
    """
    doubted = []
    for row, count in found.items():
        own = [other.share for r, other in found.items() if view[r] == view[row]]
        every = [other.share for other in found.values()]
        usual = float(np.percentile(own if len(own) >= WITNESSES else every, GOOD))
        if usual >= USUALLY and count.share < FEW * usual:
            doubted.append(row)
    return doubted


def _usual(
    photographs: Photographs,
    placement: Placement,
    found: Mapping[int, OutlineCount],
    doubted: Sequence[int],
) -> dict[int, float]:
    """Return how much of the legs good images show, for views with images in doubt.

    There is always a good one: an image is in doubt where others show far more.
    """
    views = np.unique(photographs.measurements.view[list(doubted)]).tolist() if doubted else []
    usual = {}
    for v in views:
        good = {row: count for row, count in found.items() if row not in doubted}
        rows = witnesses(photographs, good, v)
        task = partial(share_shown, placement.search, placement.recognised)
        usual[v] = float(np.median(list(photographs.run(task, rows))))
    return usual


def _explained(
    photographs: Photographs,
    placement: Placement,
    usual: Mapping[int, float],
    rows: Sequence[int],
) -> dict[int, Explanation]:
    """Return what images show, by row."""
    task = partial(
        explain, placement.search, placement.recognised, dict(usual), doubted=frozenset(rows)
    )
    return dict(zip(rows, photographs.run(task, rows), strict=True))
