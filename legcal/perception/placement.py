"""The search for legs in images, and the estimated cameras and joint centres.

A :class:`Search` is the nominal model at every reading. A :class:`Placement` is what flows through
the room: first rough cameras and the nominal model, then what was recognised, then what views
fitted to outlines say, then a joint fit. Each says how far from it outlines may be, so that looking
again is measuring with a better placement.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements, few_views, image_notes
from legcal.errors import Cause, NotVisible, by_cause
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Cylinder, Leg, cylinder_of_arm
from legcal.machine.rods import arms_at
from legcal.machine.shapes import Occluder, bodies_of
from legcal.perception.candidate_pairs import (
    CandidatePairs,
    Still,
    find_candidate_pairs,
    moving_pixels,
    reduction,
    segments_of_reduced,
)
from legcal.perception.pair_matching import EdgeMaps, Picture, leg_segments
from legcal.perception.tuning import JOINT_ERROR, WINDOW_PX
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey, shrink
from legcal.vision.visibility import PredictedLeg, predict_legs

Load = Callable[[int], Grey]  # the image of a row
Joined = Sequence[RigidTransform | None] | None  # T_board_camera of views that show a board

# Of joint centres that the nominal model and its platform pose predict, of the mean leg length
PREDICTED_JOINT_ERROR = 0.01
NEAR_IMAGES = 6  # images of a group that are searched first where a rough pose is given


@dataclass(frozen=True, eq=False)
class Search:
    """The search for legs; it travels to worker processes."""

    load: Load  # the image of a row
    measurements: Measurements
    A_base: Array  # (n_rows, n_legs, 3) joint centres by the nominal model, in the base link [m]
    B_base: Array
    cylinders: Sequence[Sequence[Cylinder]]  # visible cylinders of each leg
    wanted: BoolArray  # (n_views, n_legs) legs that each view is stated to show
    leg_names: Sequence[str]
    size: float  # mean leg length of the machine [m]
    edge_pairs: Mapping[int, CandidatePairs] = field(default_factory=dict)  # of rows seen before
    blur: Mapping[int, float] = field(default_factory=dict)  # of their images, roughly [px]
    occluders: Sequence[Occluder] = ()  # occluders besides legs and arms
    still: Mapping[int, Still] = field(default_factory=dict)  # static background by view
    joint_error: float = JOINT_ERROR  # of the joints of the model, of the size
    # (n_legs, 6, 6) of errors of A and B, where other views have shown them [m^-1]
    shift_whitening: Array | None = None

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.cylinders)

    def picture(
        self, row: int, view: int | None = None, pairs: CandidatePairs | None = None
    ) -> Picture:
        """Return the edge pairs and predicted legs of the image of a row.

        As if the camera of another view had taken it, or with other pairs, if given.
        """
        view = int(self.measurements.view[row]) if view is None else view
        legs = np.flatnonzero(self.wanted[view])
        targets = leg_segments(self.A_base[row], self.B_base[row], self.shapes, legs)
        extent = sensor_extent(self.measurements.views[view].camera)
        pairs = self.pairs(row, view) if pairs is None else pairs
        return Picture(pairs, targets, extent, self.size, self.joint_error)

    def pairs(self, row: int, view: int | None = None) -> CandidatePairs:
        """Return the edge pairs of an image, as if the camera of another view had taken it."""
        own = int(self.measurements.view[row])
        view = own if view is None else view
        if view == own and row in self.edge_pairs:
            return self.edge_pairs[row]
        return self.pairs_of_reduced(shrink(self.load(row), self.reduction(view)), view)

    def reduction(self, view: int) -> int:
        """Return the factor by which the pictures of a view are reduced: that of its background."""
        if view in self.still:
            return self.still[view].factor
        thinnest = min((c.radius for one in self.cylinders for c in one), default=self.size)
        return reduction(self.measurements.views[view].camera, 2.0 * thinnest / self.size)

    def edge_maps(self, rows: Sequence[int]) -> EdgeMaps:
        """Return the edge maps of the images of rows, without the static background."""
        views = [int(self.measurements.view[row]) for row in rows]
        factors = [self.reduction(view) for view in views]
        cameras = [self.measurements.views[view].camera for view in views]
        small = [shrink(self.load(row), f) for row, f in zip(rows, factors, strict=True)]
        moving = [
            moving_pixels(picture, self.still[view]) if view in self.still else None
            for picture, view in zip(small, views, strict=True)
        ]
        return EdgeMaps.of(small, moving, cameras, factors)

    def pairs_of_reduced(self, small: Grey, view: int) -> CandidatePairs:
        """Return the edge pairs of a reduced image as if the camera of a view had taken it."""
        camera, still = self.measurements.views[view].camera, self.still.get(view)
        segments = segments_of_reduced(small, camera, self.reduction(view), still)
        return find_candidate_pairs(segments)

    @cached_property
    def shapes(self) -> list[tuple[Cylinder, ...]]:
        """The cylinders by which each leg is recognised, with bodies as such."""
        bodies = bodies_of(self.occluders, self.n_legs)
        return [(*own, *around) for own, around in zip(self.cylinders, bodies, strict=True)]


@lru_cache(maxsize=64)  # the same in all images of a view, and at all candidate places of a camera
def sensor_extent(camera: Camera) -> Array:
    """Return the least and the greatest x and y (2, 2) of the sensor plane that an image shows."""
    x, y = camera.width - 1.0, camera.height - 1.0
    border = np.array(
        [[0, 0], [x, 0], [0, y], [x, y], [x / 2, 0], [0, y / 2], [x / 2, y], [x, y / 2]]
    )
    xy = camera.undistort(border)
    return np.array([xy.min(axis=0), xy.max(axis=0)])


@dataclass(frozen=True, eq=False)
class PlacedArm:
    """An arm that is a cylinder, where a joint fit or the model has it."""

    name: str  # its motor, for reasons
    cylinder: Cylinder  # along its line, from its near end
    ends: Array  # (n_rows, 2, 3) in the base link [m]
    error: (
        float  # how far it may be from there, of the mean leg length: where only the model has it
    )


def predict_legs_and_arms(
    camera: Camera,
    T_base_camera: RigidTransform,
    ends: tuple[Array, Array],  # A and B in the base link, (n_rows, n_legs, 3) each [m]
    cylinders: Sequence[Sequence[Cylinder]],  # of each leg
    arms: Mapping[int, PlacedArm],
    row: int,
) -> list[PredictedLeg]:
    """Predict every leg that an image should show, and after them its arms, which count on."""
    A, B = (
        np.concatenate([of_legs[row], *(arm.ends[row, k : k + 1] for arm in arms.values())])
        for k, of_legs in enumerate(ends)
    )
    every = [*cylinders, *([arm.cylinder] for arm in arms.values())]
    return predict_legs(camera, T_base_camera, A, B, every)


def placed_arms(
    legs: Sequence[Leg],
    q: Array,  # (n_poses, n_actuators) readings of actuators
    pose: IntArray,  # (n_rows,) the pose of each row
    *,
    T_base: RigidTransform | None = None,  # from the frame of the legs, if that is not the base
    radii: Mapping[tuple[int, str], float] = MappingProxyType({}),  # of those that a fit has seen
) -> dict[int, PlacedArm]:
    """Return the arms that are cylinders, by the legs that have them as parts."""
    arms = {}
    for j, ends in arms_at(legs, q).items():
        actuator = legs[j].actuator
        if actuator is not None and actuator.arm is not None:
            if T_base is not None:
                ends = T_base.apply(ends.reshape(-1, 3)).reshape(ends.shape)
            seen = radii.get((j, actuator.arm.link))
            arm = actuator.arm if seen is None else replace(actuator.arm, radius=seen)
            error = PREDICTED_JOINT_ERROR if seen is None else 0.0
            arms[j] = PlacedArm(actuator.joint, cylinder_of_arm(arm), ends[pose], error)
    return arms


class NotPlaced(NamedTuple):
    """Why a view, or all that are placed together, has no camera."""

    view: str  # or the name of the group
    why: Cause

    def __str__(self) -> str:
        return f"view {self.view}: {self.why}"


@dataclass(frozen=True, eq=False)
class Placement:
    """Where cameras and joint centres are estimated to be, and how far outlines may be from there.

    Outlines are looked for within ``pixel_error`` and what ``joint_error`` makes in an image, or
    within ``window`` about a fit to other legs.
    """

    A_base: Array  # (n_rows, n_legs, 3) where the view of each row sees them, in the base link [m]
    B_base: Array
    T_base_camera: tuple[RigidTransform | None, ...]  # of each view; None: not known
    # (n_views, n_legs), of the mean leg length
    joint_error: float | Array = PREDICTED_JOINT_ERROR
    pixel_error: float = WINDOW_PX  # [px]
    window: Array | None = None  # (n_rows, n_legs) [px]; NaN: not looked for
    blur: tuple[float, ...] = ()  # of each view near a fit [px]; NaN or (): not known
    polished: frozenset[tuple[int, str]] = frozenset()  # legs and parts with polished surfaces
    # (n_views, n_legs, 2, 3) of A and B in each view from the nominal model [m]; None: not moved
    moved: Array | None = None
    unplaced: dict[str, NotPlaced] = field(default_factory=dict)  # by the names of views
    notes: tuple[str, ...] = ()  # further notes
    # What is said of images that show little or nothing of the legs, by row: near a fit they may
    # show more
    barely: Mapping[int, Cause] = field(default_factory=dict)
    # by the legs that have them as parts; looked for once cameras are placed
    arms: Mapping[int, PlacedArm] = field(default_factory=dict)

    @cached_property
    def shift(self) -> Array:
        """Shift of A and B from the nominal model in each view, (n_views, n_legs, 2, 3) [m]."""
        if self.moved is None:
            return np.zeros((len(self.T_base_camera), self.A_base.shape[1], 2, 3))
        return self.moved

    @classmethod
    def of_fit(
        cls,
        A_base: Array,
        B_base: Array,
        T_base_camera: Sequence[RigidTransform | None],
        blur: Sequence[float] = (),
        arms: Mapping[int, PlacedArm] = MappingProxyType({}),
        polished: frozenset[tuple[int, str]] = frozenset(),
    ) -> "Placement":
        """Return the placement of a joint fit, with the usual blur of each view [px]."""
        cameras = tuple(T_base_camera)
        of_views = tuple(blur)
        return cls(A_base, B_base, cameras, 0.0, blur=of_views, arms=arms, polished=polished)

    def shifted(self, search: Search, shift: Array) -> "Placement":
        """Return joint centres where views see them, (n_views, n_legs, 2, 3) from the model [m]."""
        of_row = shift[search.measurements.view]
        A, B = search.A_base + of_row[:, :, 0], search.B_base + of_row[:, :, 1]
        return replace(self, A_base=A, B_base=B, moved=shift)

    def require_one(self) -> None:
        """Raise NotVisible, one sentence for each view, if no view could be placed."""
        if self.unplaced and all(T is None for T in self.T_base_camera):
            raise NotVisible(unplaced_notes(self.unplaced))

    def all_notes(self, measurements: Measurements) -> tuple[str, ...]:
        """Return all notes, also on views without a camera, and on images."""
        on_images = image_notes(measurements, self.barely)
        return (*unplaced_notes(self.unplaced), *self.notes, *on_images)


def unplaced_notes(unplaced: Mapping[str, NotPlaced]) -> list[str]:
    """Return one sentence for each cause for which views have no camera."""
    return [
        f"{few_views(views)}{', each' * (len(views) > 1)}: {why}"
        for why, views in by_cause({one.view: one.why for one in unplaced.values()})
    ]


@dataclass(frozen=True, eq=False)
class Group:
    """Views whose cameras are placed together, since they know how they stand to each other."""

    views: list[int]
    T_group_camera: dict[int, RigidTransform]  # by view
    rows: list[int]  # all images to use
    some: list[int]  # a few of them, at even distances
    view_of_row: dict[int, int]
    hint: RigidTransform | None  # T_base_group, roughly
    is_placed: bool = False  # by clicks: the hint is its camera where its images show too little

    def cameras(self, T_base_group: RigidTransform) -> dict[int, RigidTransform | None]:
        """Return T_base_camera of its views."""
        return {v: T_base_group * self.T_group_camera[v] for v in self.views}

    def not_placed(self, measurements: Measurements, why: Cause) -> dict[str, NotPlaced]:
        """Return why its views have no camera, by their names."""
        names = [measurements.views[v].name for v in self.views]
        name = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
        return dict.fromkeys(names, NotPlaced(name, why))

    def pictures(self, of_row: Mapping[int, Picture], rows: Sequence[int]) -> list[Picture]:
        """Return the pictures of some rows, in the frame of the group."""
        pictures_of_rows = []
        for row in rows:
            T = self.T_group_camera[self.view_of_row[row]].inv()
            pictures_of_rows.append(replace(of_row[row], R=T.rotation.as_matrix(), t=T.translation))
        return pictures_of_rows


def group_views(
    measurements: Measurements,
    rows: IntArray,
    hints: Sequence[RigidTransform | None],
    joined: Joined,
) -> list[Group]:
    """Return the single views of rows, and groups of views related by T_board_camera.

    Hints are rough T_base_camera of each view.
    """
    view_of = {int(row): int(measurements.view[row]) for row in rows}
    views = sorted(set(view_of.values()))
    together = [v for v in views if joined is not None and joined[v] is not None]
    groups = [[v] for v in views if v not in together] + ([together] if together else [])
    found = []
    for group in groups:
        rows_of_group = [row for row, v in view_of.items() if v in group]
        T = {v: RigidTransform.identity() for v in group}
        if joined is not None and group == together:
            T = {v: joined_v for v in group if (joined_v := joined[v]) is not None}
        given = [(hint, v) for v in group if (hint := hints[v]) is not None]
        placed = [(hint, v) for hint, v in given if measurements.views[v].is_placed]
        known = [hint * T[v].inv() for hint, v in placed or given]
        spread = np.unique(
            np.rint(np.linspace(0, len(rows_of_group) - 1, min(NEAR_IMAGES, len(rows_of_group))))
        )
        some = [rows_of_group[k] for k in spread.astype(int).tolist()]
        hint = known[0] if known else None
        found.append(Group(group, T, rows_of_group, some, view_of, hint, bool(placed)))
    return found
