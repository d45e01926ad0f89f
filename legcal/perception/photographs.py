"""The photographs of a dataset turned into outlines: detected, kept, given or edited.

:func:`place_and_measure` reads as the method: images are inspected, legs are recognised and the
cameras placed, outlines are measured near there, parts that were not found are tried with other
radii, views are fitted to their outlines and missing legs looked for, and what is wrong with an
image is noted. Once a joint fit has placed everything, :func:`measure_photographs` measures near
it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, is_edited, join_outlines, merge_edited, no_outlines
from legcal.data.reasons import Reason, Rejection
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder
from legcal.machine.model import Machine, vectors_at
from legcal.machine.rods import joints_at, measured_readings
from legcal.perception.candidate_pairs import CandidatePairs, Still, still_picture
from legcal.perception.diagnostics import (
    find_wrong_images,
    reject_images,
)
from legcal.perception.free_poses import ROUNDS, find_free_poses
from legcal.perception.image_quality import Exposure, image_defects, measure_exposure
from legcal.perception.limb import powers
from legcal.perception.outline import measure_outlines
from legcal.perception.placement import (
    Joined,
    Load,
    Placement,
    Search,
    group_views,
)
from legcal.perception.recognition import place_views
from legcal.perception.tuning import JOINT_ERROR, WINDOW_PX
from legcal.perception.view_fit import refine_views
from legcal.progress import Report
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.image_file import Grey, shrink
from legcal.workers import Run

DETECTOR_VERSION = 23  # raise it whenever outlines or notes that are kept come out differently
MEASURING = "Measuring outlines"  # a stage of progress
CHOICE_ROUNDS = 2  # in which outlines decide between poses that readings leave open
FreePosesOf = Mapping[int, tuple[RigidTransform, ...]]  # T_base_platform of poses, likeliest first
# Outlines that check a pose which readings do not give: with fewer of them one image in two shows
# as many at a wrong pose.
MIN_OUTLINES = 5
MIN_POSES = 3  # of a view, so that they check its camera
MIN_VIEWS = 2  # in which a part must show another radius than the model's
MIN_WRONG_SHARE = 0.6  # of the outlines of one part alone, before a fit has told more of it
MIN_CHANGE = 0.08  # of a radius from the model, as a logarithm: less does no harm
MIN_SHARE_ALIKE = 0.75  # of the parts that must be wrong alike, to be all
LEAST_JOINT_ERROR = 0.004  # of the mean leg length: edges of images are known no better
LegRadius = tuple[int, float]  # leg, and radius in the model [m]


def detection_settings() -> dict[str, object]:
    """Return the settings that detected outlines depend on besides the dataset."""
    return {"near_fit_px": WINDOW_PX, "detector": DETECTOR_VERSION}


@dataclass(frozen=True, eq=False)
class Photographs:
    """The images of a dataset, and which of them are searched."""

    machine: Machine  # its legs in the order of the measurements' columns
    measurements: Measurements  # all rows
    load: Load  # returns the image of a row; it can travel to another process
    run: Run  # how images are searched: in turn or by several processes
    detect: IntArray  # (n,) the rows to search
    keep: Outlines  # outlines to use as they are; edited ones win over detected ones
    # Edge pairs of rows that were searched, kept for who looks at the same images again
    edge_pairs: dict[int, CandidatePairs] = field(default_factory=dict)
    # T_base_platform by clicks, by pose, where readings do not give it
    clicked_poses: FreePosesOf = field(default_factory=dict)
    still: dict[int, Still] = field(default_factory=dict)  # static background by view
    joint_error: float = math.inf  # of joints of the model where stated, of the mean leg length

    @property
    def cylinders(self) -> tuple[tuple[Cylinder, ...], ...]:
        """The visible cylinders of each leg."""
        return tuple(leg.cylinders for leg in self.machine.legs)

    @property
    def wanted(self) -> BoolArray:
        """Which legs to use in each view, (n_views, n_legs)."""
        return np.array(
            [
                [view.uses(name) for name in self.machine.leg_names]
                for view in self.measurements.views
            ],
            dtype=np.bool_,
        )

    def search(
        self,
        nominal: Placement,
        pairs: Mapping[int, CandidatePairs] | None = None,
        blur: Mapping[int, float] | None = None,
    ) -> Search:
        """Return the search for the legs of a model.

        Candidate pairs of some images may be known, and roughly the blur [px], by row.
        """
        return Search(
            self.load,
            self.measurements,
            nominal.A_base,
            nominal.B_base,
            self.cylinders,
            self.wanted,
            self.machine.leg_names,
            self.machine.size,
            {} if pairs is None else pairs,
            {} if blur is None else blur,
            self.machine.occluders,
            self.still,
            float(np.clip(self.joint_error, LEAST_JOINT_ERROR, JOINT_ERROR)),
        )

    def with_found(self, outlines: Outlines) -> Outlines:
        """Return found outlines and kept ones in one table; edited ones win."""
        others = self.keep.choose(~is_edited(self.keep))
        return join_outlines([merge_edited(outlines, self.keep), others])

    def narrowed(self, rows: IntArray, outlines: Outlines) -> Photographs:
        """Return the search of some rows again; edited and other rows' outlines are kept."""
        kept = ~np.isin(outlines.row, rows) | is_edited(outlines)
        return replace(self, detect=rows, keep=outlines.choose(kept))

    def with_intrinsics(self, cameras: Sequence[Camera]) -> Photographs:
        """Return the images with the intrinsics of other cameras, one a view."""
        views = tuple(
            replace(view, camera=replace(view.camera, K=lens.K, distortion=lens.distortion))
            for view, lens in zip(self.measurements.views, cameras, strict=True)
        )
        return replace(self, measurements=replace(self.measurements, views=views))

    def with_gammas(self, gammas: Mapping[str, float]) -> Photographs:
        """Return the images with other gammas of some views, by name."""
        views = tuple(
            replace(view, camera=replace(view.camera, gamma=gammas[view.name]))
            if view.name in gammas
            else view
            for view in self.measurements.views
        )
        return replace(self, measurements=replace(self.measurements, views=views))


@dataclass(frozen=True, eq=False)
class MeasuredImages:
    """Images with the legs that were recognised and the outlines that were measured."""

    photographs: Photographs  # the images, and the mechanism with the radii that they show
    placement: Placement  # with views that could not be placed, and notes on views and images
    outlines: Outlines  # of all images; rejected in images that are left out
    left_out: dict[int, Rejection]  # why images were left out, by row
    blur: tuple[float, ...]  # usual one of each view [px]; NaN where none was measured
    # T_base_platform of every pose that images show, where the readings do not give it
    free_poses: Mapping[int, RigidTransform] = field(default_factory=dict)

    @property
    def unlike(self) -> list[int]:
        """Images of placed views that were left out since nothing like the legs was found."""
        view, cameras = self.photographs.measurements.view, self.placement.T_base_camera
        return [
            row
            for row, why in self.left_out.items()
            if why.reason is Reason.OTHER_SCENE and cameras[view[row]] is not None
        ]

    def kept(self, rows: IntArray) -> IntArray:
        """Return the rows of images that were not left out, in placed views."""
        view, cameras = self.photographs.measurements.view, self.placement.T_base_camera
        is_kept = [r not in self.left_out and cameras[view[r]] is not None for r in rows.tolist()]
        return rows[np.array(is_kept, dtype=np.bool_)]


def given_outlines(photographs: Photographs) -> Outlines:
    """Return the outlines that are used as they are; edited ones win."""
    return photographs.with_found(no_outlines())


def nominal_placement(
    machine: Machine, measurements: Measurements, T_base_platform: Sequence[RigidTransform]
) -> Placement:
    """Return the placement by a model at poses (n_poses,), with the rough cameras of views."""
    B_base = np.array([T.apply(machine.B_platform) for T in T_base_platform])
    poses = np.array([T.as_matrix() for T in T_base_platform])
    A_base = B_base - vectors_at(machine, poses)
    if machine.actuators:
        q = measurements.q_of_poses
        read = measured_readings(machine.legs, poses[:, :3, :3], poses[:, :3, 3], q)
        A_base = joints_at(machine.legs, read)
    hints = tuple(view.T_base_camera for view in measurements.views)
    return Placement(A_base[measurements.pose], B_base[measurements.pose], hints)


def place_and_measure(
    photographs: Photographs,
    nominal: Placement,
    report: Report,
    joined: Joined = None,
    *,
    in_brief: bool = False,
) -> MeasuredImages:
    """Place the cameras, measure the outlines, and leave out the images that are wrong.

    ``joined`` are T_board_camera of views that show a calibration board, which are placed together.
    """
    defects, pairs, rough = _inspect_images(photographs, nominal, report, joined)
    photographs.edge_pairs.update(pairs)
    usable = np.array([row for row in photographs.detect if row not in defects], dtype=np.intp)
    nominal, free_poses = _with_free_poses(photographs, nominal, pairs, usable, report)
    hints = nominal.T_base_camera
    if free_poses:
        nominal, free_poses, shown = _decided_by_outlines(
            photographs, nominal, free_poses, usable, report, joined
        )
        doubtful = _in_doubt(photographs.measurements, usable, shown)
        defects |= doubtful
        usable = np.setdiff1d(usable, list(doubtful))
    search = photographs.search(nominal, pairs, rough)
    counted = _counted(report, "Recognising legs", len(usable))
    placement = place_views(search, usable, hints, joined, run=photographs.run, progress=counted)
    outlines, blur = _measured(photographs, search, placement, report, in_brief=in_brief)
    if not free_poses:  # which would follow wrong radii, and these wrong poses
        photographs, search, outlines, notes = _with_other_radii(
            photographs, search, placement, outlines, report, in_brief=in_brief
        )
        placement = replace(placement, notes=(*placement.notes, *notes))
    groups = group_views(photographs.measurements, usable, hints, joined)
    is_own = np.isin(outlines.row, usable)
    own, others = outlines.choose(is_own), outlines.choose(~is_own)
    placement, found, _ = refine_views(
        search,
        groups,
        placement,
        own,
        in_brief=in_brief,
        run=photographs.run,
        progress=_counted(report, "Looking for missing legs", len(usable)),
    )
    outlines = join_outlines([merge_edited(found, own), others])
    placement, reasons = find_wrong_images(
        search, placement, outlines, photographs.detect, defects, photographs.run
    )
    outlines = reject_images(outlines, reasons)
    seen_poses = {pose: choices[0] for pose, choices in free_poses.items()}
    known = ~np.isnan(blur)
    of_views = [
        blur[known & (photographs.measurements.view == v)]
        for v in range(len(photographs.measurements.views))
    ]
    blur_of_views = tuple(
        float(np.median(of_view)) if len(of_view) else np.nan for of_view in of_views
    )
    return MeasuredImages(photographs, placement, outlines, reasons, blur_of_views, seen_poses)


def _with_other_radii(
    photographs: Photographs,
    search: Search,
    placement: Placement,
    outlines: Outlines,
    report: Report,
    *,
    in_brief: bool,
) -> tuple[Photographs, Search, Outlines, list[str]]:
    """Return what is measured with the radii that outlines show, if more of these are used then.

    With notes on these radii. One camera alone may see where light and shade meet on a leg. Where
    most parts differ alike, so do the others.
    """
    machine, view = photographs.machine, photographs.measurements.view
    shown = _radii_of_outlines(photographs, placement, outlines)
    factors = {
        part: radius / part[1]
        for part, (radius, rows, _) in shown.items()
        if len(set(view[rows])) >= MIN_VIEWS and abs(np.log(radius / part[1])) > MIN_CHANGE
    }
    every = {(j, c.radius) for j, leg in enumerate(machine.legs) for c in leg.cylinders}
    values, common = list(factors.values()), 0.0
    if len(every) > 1 and len(factors) >= MIN_SHARE_ALIKE * len(every):
        common = float(np.median(values)) if np.ptp(np.log(values)) < MIN_CHANGE else 0.0
    if common:
        factors = dict.fromkeys(every, common) | factors
    else:
        factors = {part: f for part, f in factors.items() if shown[part][2] > MIN_WRONG_SHARE}
    if not factors:
        return photographs, search, outlines, []
    changed = replace(
        photographs,
        machine=machine.with_radii(lambda j, c: factors.get((j, c.radius), 1.0) * c.radius),
    )
    search_again = replace(search, cylinders=changed.cylinders)
    stage = f"{MEASURING} with other radii"
    again, _ = _measured(changed, search_again, placement, report, in_brief=in_brief, stage=stage)
    if again.used.sum() <= outlines.used.sum():
        return photographs, search, outlines, []
    return changed, search_again, again, _radius_notes(machine.leg_names, factors, common)


def _radius_notes(
    legs: Sequence[str], factors: Mapping[LegRadius, float], common: float
) -> list[str]:
    """Return notes on radii by their factors, which are alike if there is a common one."""

    def away(factor: float) -> str:
        return f"{1e2 * abs(factor - 1.0):.0f} % {'thicker' if factor > 1.0 else 'thinner'}"

    if common:
        return [
            f"All legs appear {away(common)} than in the model; the radii found in the images were "
            "used. Correct the radii of the model, or, if these are right, the unit and scale of "
            "the model and the readings."
        ]
    return [
        f"{legs[leg]} may be {away(factor)} than in the model: its radius is about "
        f"{1e3 * factor * radius:.1f} mm, not {1e3 * radius:.2f} mm; the measured radius was used; "
        "measure the leg, and correct the model if confirmed."
        for (leg, radius), factor in sorted(factors.items())
    ]


def _with_free_poses(
    photographs: Photographs,
    nominal: Placement,
    pairs: Mapping[int, CandidatePairs],
    rows: IntArray,
    report: Report,
) -> tuple[Placement, FreePosesOf]:
    """Return the placement by a model, with poses found in images where readings give none."""
    machine = photographs.machine
    if machine.is_determined or len(rows) == 0:
        return nominal, {}
    found, cameras = find_free_poses(
        photographs.search(nominal, pairs),
        machine,
        rows.tolist(),
        nominal.T_base_camera,
        photographs.run,
        _counted(report, "Looking for platform poses", ROUNDS * len(rows)),
        photographs.clicked_poses,
    )
    first = {pose: choices[0] for pose, choices in found.items()}
    return _at_poses(photographs, replace(nominal, T_base_camera=cameras), first), found


def _at_poses(
    photographs: Photographs, nominal: Placement, T_base_platform: Mapping[int, RigidTransform]
) -> Placement:
    """Return the placement by a model with the platform at other poses, by their number."""
    B_base = nominal.B_base.copy()
    for pose, T in T_base_platform.items():
        B_base[photographs.measurements.pose == pose] = T.apply(photographs.machine.B_platform)
    return replace(nominal, B_base=B_base)


def _in_doubt(
    measurements: Measurements, rows: IntArray, n_outlines: Mapping[int, int]
) -> dict[int, Rejection]:
    """Return the rejections of images that leave the platform pose ambiguous, by row."""
    checked = np.array([n_outlines[k] >= MIN_OUTLINES for k in measurements.pose[rows].tolist()])
    reasons = dict.fromkeys(rows[~checked].tolist(), Rejection(Reason.FEW_LEGS))
    left, view = rows[checked], measurements.view
    for v in np.unique(view[left]).tolist():
        of_view = left[view[left] == v]
        if len(np.unique(measurements.pose[of_view])) < MIN_POSES:
            why = Rejection(Reason.FEW_LEGS, "as most of its view do")
            reasons |= dict.fromkeys(of_view.tolist(), why)
    return reasons


def _decided_by_outlines(
    photographs: Photographs,
    nominal: Placement,
    choices: FreePosesOf,
    rows: IntArray,
    report: Report,
    joined: Joined,
) -> tuple[Placement, FreePosesOf, dict[int, int]]:
    """Return the legs at the pose, of several, at which most outlines can be measured.

    With the number of outlines there, by pose. They are measured at the likeliest poses of all
    images first, then at others before cameras that these have placed; twice, since cameras stand
    better with better poses.
    """
    hints = nominal.T_base_camera
    for _ in range(CHOICE_ROUNDS):
        search = photographs.search(nominal)
        placement = place_views(search, rows, hints, joined, run=photographs.run)
        most = dict.fromkeys(choices, -1)
        chosen = dict[int, int]()
        for n in range(max(map(len, choices.values()))):
            there = {pose: every[n] for pose, every in choices.items() if len(every) > n}
            search = photographs.search(_at_poses(photographs, nominal, there))
            shown = placement.shifted(search, placement.shift)
            outlines, _ = _measured(photographs, search, shown, report, in_brief=True)
            pose = photographs.measurements.pose[outlines.row[outlines.used]]
            for own in there:
                n_used = int(np.sum(pose == own))
                if n_used > most[own]:
                    most[own], chosen[own] = n_used, n
        if not any(chosen.values()):
            break
        choices = {
            pose: (every[chosen[pose]], *every[: chosen[pose]], *every[chosen[pose] + 1 :])
            for pose, every in choices.items()
        }
        first = {pose: every[0] for pose, every in choices.items()}
        nominal = _at_poses(photographs, nominal, first)
    return nominal, choices, most


def measure_photographs(
    photographs: Photographs,
    placement: Placement,
    report: Report,
    *,
    in_brief: bool = False,
    stage: str = MEASURING,
) -> Outlines:
    """Return all outlines: those measured near a placement, and those kept."""
    search = photographs.search(placement)
    return _measured(photographs, search, placement, report, in_brief=in_brief, stage=stage)[0]


def with_measured_radii(
    photographs: Photographs, placement: Placement, outlines: Outlines
) -> Photographs | None:
    """Return a search near a fit with the radii that its outlines have; None where it had them.

    The radius of a fit has the bias of the edges that it was fitted to. Edges that were measured
    otherwise have another one: with more care, or with another gamma. Where that is why most
    outlines of a cylinder are at a wrong distance, it speaks against none of them.
    """
    machine = photographs.machine
    radii = {
        part: radius
        for part, (radius, _, _) in _radii_of_outlines(photographs, placement, outlines).items()
    }
    if not radii:
        return None
    other = machine.with_radii(lambda j, c: radii.get((j, c.radius), c.radius))
    return replace(photographs, machine=other)


def _radii_of_outlines(
    photographs: Photographs, placement: Placement, outlines: Outlines
) -> dict[LegRadius, tuple[float, IntArray, float]]:
    """Return the radii [m] of cylinders most of whose outlines are at a wrong distance.

    By leg and radius in the model, as the outlines have them; with the rows of these, and the share
    that is at a wrong distance.
    """
    m, wrong = photographs.measurements, outlines.rejected_for(Reason.WIDTH)
    judged = (outlines.used | wrong) & np.isfinite(outlines.h).all(axis=1)
    places = {
        v: T.inv() for v, T in enumerate(placement.T_base_camera) if T is not None
    }  # of the base before the cameras
    part, radii = np.array(outlines.part), dict[LegRadius, tuple[float, IntArray, float]]()
    for j, leg in enumerate(photographs.machine.legs):
        for cylinder in leg.cylinders:
            of_cylinder = np.flatnonzero(judged & (outlines.leg == j) & (part == cylinder.link))
            if 2 * np.count_nonzero(wrong[of_cylinder]) <= len(of_cylinder):
                continue
            share = float(np.mean(wrong[of_cylinder]))
            row, edge = outlines.row[of_cylinder], outlines.edge[of_cylinder]
            A = np.array([places[int(m.view[r])].apply(placement.A_base[r, j]) for r in row])
            distance = np.sum(outlines.h[of_cylinder] * A, axis=1) * np.array(EPSILON)[edge - 1]
            of_edges = [np.median(distance[edge == e]) for e in np.unique(edge)]
            if len(of_edges) == len(EPSILON):
                *_, before = radii.get((j, cylinder.radius), (0.0,))  # of a part as thick
                radii[j, cylinder.radius] = float(np.mean(of_edges)), row, max(share, before)
    return radii


def _measured(
    photographs: Photographs,
    search: Search,
    placement: Placement,
    report: Report,
    *,
    in_brief: bool,
    stage: str = MEASURING,
) -> tuple[Outlines, Array]:
    """Return all outlines, measured and kept, and the blur of each row [px]."""
    rows = [r for r in photographs.detect.tolist() if photographs.measurements.image[r]]
    found, blur = measure_outlines(
        search,
        placement,
        rows,
        in_brief=in_brief,
        run=photographs.run,
        progress=_counted(report, stage, len(photographs.detect)),
    )
    return photographs.with_found(found), blur


def _inspect_images(
    photographs: Photographs, nominal: Placement, report: Report, joined: Joined
) -> tuple[dict[int, Rejection], dict[int, CandidatePairs], dict[int, float]]:
    """Return rejections of unusable images, edge pairs of the first ones, blurs [px], by row."""
    rows, measurements = photographs.detect.tolist(), photographs.measurements
    hints = nominal.T_base_camera
    groups = group_views(measurements, photographs.detect, hints, joined)
    free = not photographs.machine.is_determined
    first = {r for g in groups for r in (g.rows if g.hint is None or free else g.some)}
    exposures, small = dict[int, Exposure](), dict[int, Grey]()
    count = _counted(report, "Looking at images", len(rows))
    look = partial(_inspect, photographs.search(nominal), first)
    powers(np.zeros(1))  # tabulated once, not by each process that is forked
    for row, (exposure, own) in zip(rows, photographs.run(look, rows), strict=True):
        exposures[row] = exposure
        if own is not None:
            small[row] = own
        count(row)
    defects = defects_of(measurements, exposures)
    search = photographs.search(nominal)
    photographs.still.update(_still_pictures(search, small, defects))
    pairs = {  # in this process: pictures take about as long to send
        row: search.pairs_of_reduced(picture, int(measurements.view[row]))
        for row, picture in small.items()
    }
    return defects, pairs, {row: exposure.blur for row, exposure in exposures.items()}


def _still_pictures(
    search: Search, small: Mapping[int, Grey], defects: Collection[int]
) -> dict[int, Still]:
    """Return the static background of each view with enough reduced images."""
    of_view: dict[int, list[Grey]] = {}
    for row, picture in small.items():
        if row not in defects:
            of_view.setdefault(int(search.measurements.view[row]), []).append(picture)
    still = {
        view: still_picture(pictures, search.reduction(view)) for view, pictures in of_view.items()
    }
    return {view: picture for view, picture in still.items() if picture is not None}


def defects_of(
    measurements: Measurements, exposures: Mapping[int, Exposure]
) -> dict[int, Rejection]:
    """Return rejections of unusable images, alone or compared with their view, by row."""
    camera = measurements.owners
    view = {row: int(measurements.view[row]) for row in exposures}
    return image_defects(exposures, view, {row: camera[v] for row, v in view.items()})


def _inspect(search: Search, rows: Collection[int], row: int) -> tuple[Exposure, Grey | None]:
    """Return the exposure of an image, and the reduced image if it is one of rows."""
    image = search.load(row)
    factor = search.reduction(int(search.measurements.view[row]))
    return measure_exposure(image), shrink(image, factor) if row in rows else None


def _counted(report: Report, stage: str, total: int) -> Callable[[int], None]:
    """Return a callback that counts images, up to a total that may not be reached."""
    done = itertools.count(1)
    report(stage, 0, total)
    return lambda row: report(stage, min(next(done), total), total)
