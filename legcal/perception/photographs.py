"""The images of a dataset as one table of outlines: detected, cached, given or edited.

First the legs are recognised and the camera of every view is placed by its images, then outlines
are measured near where that has them; once a fit has told where everything is, images that left
doubts are searched again close to it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import (
    Measurements,
    Outlines,
    is_edited,
    join_outlines,
    merge_edited,
    no_outlines,
)
from legcal.errors import NotVisible
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import Cylinder, Mechanism
from legcal.perception.bars import Bars
from legcal.perception.detection import JOINT_ERROR, PIXEL_ERROR, Load, Method, detect_outlines
from legcal.perception.outline import outline_parts
from legcal.perception.radii import Part, radius_notes
from legcal.perception.recognise import Recognised, recognise, shifted
from legcal.perception.search import LookedAt, Search
from legcal.progress import Report
from legcal.workers import Run

Joined = Sequence[RigidTransform | None] | None
NEAR_FIT_PX = 3.0  # how far outlines may be from a fit of everything
DETECTOR_VERSION = 1  # raise it whenever outlines or notes that are kept come out differently


def detection_settings() -> dict[str, object]:
    """Return what detected outlines depend on besides the dataset."""
    return {"near_fit_px": NEAR_FIT_PX, "detector": DETECTOR_VERSION}


@dataclass(frozen=True, eq=False)
class Scene:
    """Where everything is believed to be, in the base link.

    Attributes
    ----------
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres at every row [m].
    T_base_camera : tuple of RigidTransform or None
        The camera of every view; None where nothing is known.
    joint_error : float or (n_views, n_legs) array
        How far joint centres may be off in the images of a view [m].
    """

    A_base: Array
    B_base: Array
    T_base_camera: tuple[RigidTransform | None, ...]
    joint_error: float | Array = JOINT_ERROR


def scene_at_poses(
    mechanism: Mechanism, measurements: Measurements, T_base_platform: Sequence[RigidTransform]
) -> Scene:
    """Return where a model has the legs of every row, with the rough cameras of the views.

    Parameters
    ----------
    mechanism : Mechanism
        The model.
    measurements : Measurements
        All rows.
    T_base_platform : sequence of RigidTransform, length n_poses
        The platform at every pose.
    """
    B_base = np.array([T.apply(mechanism.B_platform) for T in T_base_platform])
    A_base = np.broadcast_to(mechanism.A_base, B_base.shape)
    hints = tuple(view.T_base_camera for view in measurements.views)
    return Scene(A_base[measurements.pose], B_base[measurements.pose], hints)


@dataclass(frozen=True, eq=False)
class Photographs:
    """What is needed to search images.

    Attributes
    ----------
    mechanism : Mechanism
        Its legs, in the order of the measurements' columns.
    measurements : Measurements
        All rows.
    load : callable
        Returns the image of a row; it can travel to another process.
    run : callable
        How images are searched: in turn or by several processes.
    detect : (n,) array of int
        The rows to search.
    keep : Outlines
        Outlines to use as they are; edited ones win over detected ones.
    """

    mechanism: Mechanism
    measurements: Measurements
    load: Load
    run: Run
    detect: IntArray
    keep: Outlines

    @property
    def searched(self) -> Measurements:
        """The measurements, with an image only in the rows to search."""
        wanted = set(self.detect.tolist())
        images = tuple(
            image if row in wanted else "" for row, image in enumerate(self.measurements.image)
        )
        return replace(self.measurements, image=images)

    @property
    def cylinders(self) -> tuple[tuple[Cylinder, ...], ...]:
        """What can be seen of each leg."""
        return tuple(leg.cylinders for leg in self.mechanism.legs)

    @property
    def wanted(self) -> BoolArray:
        """Which legs to use in each view, (n_views, n_legs)."""
        return np.array(
            [
                [view.legs is None or name in view.legs for name in self.mechanism.leg_names]
                for view in self.measurements.views
            ],
            dtype=np.bool_,
        )

    def narrowed(self, rows: IntArray, outlines: Outlines) -> Photographs:
        """Return the search of some rows again; edited and other rows' outlines are kept."""
        kept = ~np.isin(outlines.row, rows) | is_edited(outlines)
        return replace(self, detect=rows, keep=outlines.choose(kept))

    def with_gammas(self, gammas: Mapping[str, float]) -> Photographs:
        """Return the same images, read with other gammas of some views, by their names."""
        views = tuple(
            replace(view, camera=replace(view.camera, gamma=gammas[view.name]))
            if view.name in gammas
            else view
            for view in self.measurements.views
        )
        return replace(self, measurements=replace(self.measurements, views=views))


@dataclass(frozen=True, eq=False)
class Placement:
    """What the images say of where everything is.

    Attributes
    ----------
    scene : Scene
        With the camera of every searched view where its images put it, and joint centres where
        the view sees them.
    unplaced : dict of str
        Why views could not be placed, by name.
    notes : tuple of str
        What else a reader should know.
    search : Search
        The images and the model, with the radii that the images show.
    recognised : Recognised
        What was made of them.
    """

    scene: Scene
    unplaced: dict[str, str]
    notes: tuple[str, ...]
    search: Search
    recognised: Recognised

    def require_one(self) -> None:
        """Refuse images of which no view could be placed.

        Raises
        ------
        NotVisible
            One sentence for each view.
        """
        if self.unplaced and all(T is None for T in self.scene.T_base_camera):
            raise NotVisible(list(dict.fromkeys(self.unplaced.values())))

    @property
    def all_notes(self) -> tuple[str, ...]:
        """What a reader should know, with the views that could not be placed."""
        return (*dict.fromkeys(self.unplaced.values()), *self.notes)


def search_in(
    photographs: Photographs, scene: Scene, known: Mapping[int, Bars] = MappingProxyType({})
) -> Search:
    """Return what is searched for in the images, some of whose bars are known."""
    return LookedAt(
        photographs.load,
        photographs.measurements,
        scene.A_base,
        scene.B_base,
        photographs.cylinders,
        photographs.wanted,
        dict(known),
    )


def place(
    photographs: Photographs,
    scene: Scene,
    report: Report,
    joined: Joined = None,
    doubtful: Collection[Part] = (),
    known: Mapping[int, Bars] = MappingProxyType({}),
) -> Placement:
    """Recognise the legs in the images, and place the cameras by them.

    Parameters
    ----------
    photographs : Photographs
        The images.
    scene : Scene
        The model, and rough camera poses where there are any.
    report : callable
        Called as ``report(stage, done, total)``.
    joined : sequence of RigidTransform or None, for each view
        T_board_camera of the views that show a calibration board: they are placed together.
    doubtful : collection of (int, float)
        Parts that may have other radii, as :func:`legcal.perception.recognise.recognise` has it.
    known : mapping of Bars
        The bars of images that were looked at before, by row.
    """
    search = search_in(photographs, scene, known)
    found = recognise(
        search,
        photographs.detect,
        scene.T_base_camera,
        joined,
        doubtful=doubtful,
        run=photographs.run,
        progress=counted(report, "Recognising legs", len(photographs.detect)),
    )
    A, B = shifted(found, photographs.measurements.view, scene.A_base, scene.B_base)
    cameras, unplaced = placed_cameras(photographs, scene, found)
    notes = tuple(radius_notes(found.radii, photographs.mechanism.leg_names))
    search = replace(search, cylinders=found.radii.corrected(search.cylinders))
    return Placement(Scene(A, B, cameras, found.joint_error), unplaced, notes, search, found)


def placed_cameras(
    photographs: Photographs, scene: Scene, found: Recognised
) -> tuple[tuple[RigidTransform | None, ...], dict[str, str]]:
    """Return the cameras of all views, those of searched ones as found, and why some have none.

    The reasons are by the names of the views.
    """
    measurements = photographs.measurements
    searched = set(measurements.view[photographs.detect].tolist())
    cameras = tuple(
        T if v in searched else rough
        for v, (T, rough) in enumerate(zip(found.T_base_camera, scene.T_base_camera, strict=True))
    )
    return cameras, {measurements.views[v].name: why for v, why in found.unplaced.items()}


def detect(
    photographs: Photographs,
    scene: Scene,
    report: Report,
    *,
    near_fit: bool = False,
    method: Method | Sequence[Method] = outline_parts,
    stage: str = "Measuring outlines",
    blur_of_row: dict[int, float] | None = None,
) -> Outlines:
    """Return all outlines: those searched for near the scene, and those kept.

    ``method`` and ``blur_of_row`` are those of :func:`legcal.perception.detection.detect_outlines`.
    """
    stage = f"{stage} again" if near_fit else stage
    found = detect_outlines(
        photographs.load,
        photographs.searched,
        scene.A_base,
        scene.B_base,
        photographs.cylinders,
        scene.T_base_camera,
        photographs.wanted,
        photographs.mechanism.leg_names,
        run=photographs.run,
        method=method,
        progress=counted(report, stage, len(photographs.detect)),
        joint_error=0.0 if near_fit else scene.joint_error,
        pixel_error=NEAR_FIT_PX if near_fit else PIXEL_ERROR,
        blur_of_row=blur_of_row,
    )
    return given_outlines(photographs, found)


def usual_blur(photographs: Photographs, blur_of_row: Mapping[int, float]) -> tuple[float, ...]:
    """Return the blur of most images of each view [px]; NaN where none was measured."""
    view = photographs.measurements.view
    of_view: list[list[float]] = [[] for _ in photographs.measurements.views]
    for row, blur in blur_of_row.items():
        of_view[int(view[row])].append(blur)
    return tuple(float(np.median(blurs)) if blurs else np.nan for blurs in of_view)


def given_outlines(photographs: Photographs, found: Outlines | None = None) -> Outlines:
    """Return found outlines and kept ones in one table; edited ones win."""
    kept = photographs.keep
    detected = no_outlines() if found is None else found
    return join_outlines([merge_edited(detected, kept), kept.choose(~is_edited(kept))])


def counted(report: Report, stage: str, total: int) -> Callable[[int], None]:
    """Return a callback that counts images, up to a total that may not be reached."""
    done = itertools.count(1)
    report(stage, 0, total)
    return lambda row: report(stage, min(next(done), total), total)
