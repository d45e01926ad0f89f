"""The folder of a planned session: a dataset without its photographs.

``dataset.yaml``, ``measurements.csv``, the model and the camera file are those of the dataset;
``poses.csv`` has the settings in millimetres and degrees, ``plan.json`` the expected errors.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.joint_fit.outline_errors import KINDS, PLACES
from legcal.calibration.joint_fit.parameter_choices import Group
from legcal.calibration.joint_fit.part_errors import PartSigma
from legcal.calibration.joint_fit.platform import PlatformError
from legcal.calibration.joint_fit.predicted import PredictedNoise
from legcal.calibration.summary import mm_deg
from legcal.data.dataset import PLAN_NAME, POSES_NAME
from legcal.data.dataset_file import dataset_texts
from legcal.data.reading_units import stated_sigma
from legcal.files.folder import (
    OutputKind,
    check_destination,
    output_path,
    result_folder,
)
from legcal.files.motions import Pose, motion_to_xyz_quat
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import Document, Number, SparseDocument, Version
from legcal.files.table import format_table
from legcal.geometry.motions import roll_pitch_yaw
from legcal.geometry.types import Array, BoolArray
from legcal.machine.configurations import Configurations
from legcal.machine.model import Machine
from legcal.machine.model_writer import write_model
from legcal.planning.places import MAX_ANGLE, MAX_DRAWS, LaidBoard, Setting
from legcal.planning.poses import HOME
from legcal.version import __version__
from legcal.vision.board import board_document
from legcal.vision.camera import Camera
from legcal.vision.camera_file import camera_info
from legcal.vision.visibility import Seen

CAMERA = "camera_info.yaml"
HAND = "hand"  # the view of a hand-held camera
PLANNED = OutputKind("session", PLAN_NAME, "legcal_plan")


def check_session(output: str | Path) -> Path:
    """Return the folder of a session; refuse to replace other files."""
    destination = output_path(output, PLANNED)
    check_destination(destination, PLANNED, replaces=False)
    return destination


def write_session(
    plan: Plan,
    output: str | Path,
    *,
    pictures: Mapping[str, str | bytes] | None = None,
) -> list[Path]:
    """Write the folder of a session atomically, and return its files.

    *pictures* are further files by their names: drawings and pages.
    """
    destination = check_session(output)
    with result_folder(destination, PLANNED) as folder:
        yaml_path, _ = write_model(plan.machine, folder)
        texts = {
            CAMERA: camera_info(plan.camera, "camera"),
            **_dataset(plan, yaml_path.relative_to(folder).as_posix()),
            POSES_NAME: format_table(*poses_to_take(plan)),
            PLAN_NAME: json.dumps(plan.document(), indent=1, allow_nan=False) + "\n",
            **(pictures or {}),
        }
        for name, content in texts.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            data = content if isinstance(content, bytes) else content.encode()
            (folder / name).write_bytes(data)
    return [destination / name for name in texts]


def images_of(plan: Plan) -> list[tuple[str, str, str, int, int]]:
    """Return view, image file, label of the pose, and indices of view and pose of every image.

    All images of a hand-held camera are of one view.
    """
    labels = plan.labels
    images: list[tuple[str, str, str, int, int]] = []
    for v, view in enumerate(plan.views):
        name = HAND if plan.hand_held else view.name
        for k in range(len(view.poses.poses)):
            label = labels[len(images)]
            images.append((name, f"images/{name}_{label}.jpg", label, v, k))
    return images


def _dataset(plan: Plan, model: str) -> dict[str, str]:
    """Return ``dataset.yaml``, and ``measurements.csv`` with the planned readings."""
    views: dict[str, Any] = {}
    for view in plan.views:
        shown = np.flatnonzero(view.shows.any(axis=0)).tolist()
        legs = [plan.machine.leg_names[j] for j in shown]
        entry = {"camera": CAMERA} | rough_view(view.T_base_camera, legs, plan.machine)
        views[view.name] = entry
    if plan.hand_held:
        views = {HAND: {"camera": CAMERA, "hand_held": True}}
    motors, sigma = list(plan.machine.motors), stated_sigma(plan.machine.legs, plan.sigma_q)
    rows = [
        [name, image, label, *plan.views[v].poses.readings[k, motors].tolist()]
        for name, image, label, v, k in images_of(plan)
    ]
    board = {} if plan.board is None else {"board": board_document(plan.board.board)}
    return dataset_texts(plan.machine, model, views, rows, sigma, board)


def rough_view(
    T_base_camera: RigidTransform | None, legs: Sequence[str] | None, machine: Machine
) -> dict[str, Any]:
    """Return the rough pose of a view, to five digits, and the legs that it shows, if not all."""
    entry: dict[str, Any] = {}
    if T_base_camera is not None:
        motion = motion_to_xyz_quat(T_base_camera)
        entry["T_base_camera"] = {key: [round(x, 5) for x in motion[key]] for key in motion}
    if legs is not None and len(legs) < machine.n_legs:
        entry["legs"] = list(legs)
    return entry


def settings_in_words(machine: Machine, q: Array, digits: int = 3) -> tuple[str, ...]:
    """Return the readings of the motors at q (n_legs,): ``leg1_prismatic 28.663 mm``."""
    legs = [(j, machine.legs[j]) for j in machine.motors]
    shown = [(j, leg.prismatic, *SHOWN_IN[leg.reading_unit]) for j, leg in legs]
    words = [f"{joint} {size * q[j]:z.{digits}f} {unit}" for j, joint, size, unit in shown]
    return tuple(dict.fromkeys(words))


def poses_to_take(plan: Plan) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of ``poses.csv``."""
    motors, labels = list(plan.machine.motors), plan.labels
    rows = list[list[str]]()
    shown = [SHOWN_IN[plan.machine.legs[j].reading_unit] for j in motors]
    scale = np.array([size for size, _ in shown])
    for name, image, label, v, k in images_of(plan):
        view = plan.views[v]
        T, via = view.poses.poses[k], view.via[k]
        if via and via != HOME:
            via = labels[int(via) - 1]
        angles = np.degrees(roll_pitch_yaw(T.rotation.as_matrix()))
        numbers = [*(scale * view.poses.readings[k, motors]), *(1e3 * T.translation), *angles]
        where = 1e3 * view.T_base_camera.translation
        rows.append([name, label, image, via, *(f"{x:z.4f}" for x in numbers),
                     *(f"{x:z.0f}" for x in where)])  # fmt: skip
    joints = [
        f"{name} [{unit}]" for name, (_, unit) in zip(plan.machine.motor_names, shown, strict=True)
    ]
    pose = [*(f"{x} [mm]" for x in "xyz"), *(f"{x} [deg]" for x in ("roll", "pitch", "yaw"))]
    camera = [f"camera {x} [mm]" for x in "xyz"]
    header = ["view", "pose", "image", "on the way", *joints, *pose, *camera]
    return header, rows


# The plan


@dataclass(frozen=True, eq=False)
class PlannedView:
    """A camera place and the images to take from it."""

    name: str
    T_base_camera: RigidTransform
    poses: Configurations  # in the order to take them
    via: tuple[str, ...]  # intermediate pose before each: "" for none, home, or the 1-based number
    # of an earlier pose of the session
    seen: Seen  # of the nominal machine, from the nominal place

    @property
    def shows(self) -> BoolArray:
        """Which legs each image shows, (n_images, n_legs)."""
        return self.seen.visible_legs(len(self.poses.poses), self.poses.readings.shape[1])


def pose_labels(n_images: int, n_given: int = 0) -> list[str]:
    """Return labels of the poses of a session, in the order to take them.

    Numbers continue those of the given session, since the same label means the same pose.
    """
    width = max(2, len(str(n_given + n_images)))
    return [f"p{k + 1:0{width}d}" for k in range(n_given, n_given + n_images)]


@brief
@dataclass(frozen=True, eq=False)
class Plan:
    """A planned session."""

    machine: Machine  # the nominal model
    camera: Camera
    setting: Setting
    noise: PredictedNoise
    sigma_q: Array  # (n_legs,) standard deviations of readings [m or rad]
    views: tuple[PlannedView, ...]  # of a camera in the hand, every image is one
    # The criterion as planned: the mean error of the platform over the workspace [m], or where
    # readings do not give its pose, the determinant's root
    value: float
    # Expected over the workspace, one standard deviation: the root mean square over the draws;
    # None if readings do not determine the pose
    error: PlatformError | None
    sigma: Array  # (p,) expected standard deviation of each kinematic parameter [m, rad]
    names: tuple[str, ...]
    units: tuple[str, ...]
    # (n, 2) numbers of images, and the criterion with that many, most useful images first; beyond
    # the planned number, with copies of the planned images
    growth: Array
    seed: int = 0
    board: LaidBoard | None = None  # on the base, in every image
    hand_held: bool = False
    given: str = ""  # the dataset that the plan extends
    n_given: int = 0  # number of its photographs
    notes: tuple[str, ...] = ()
    parts: tuple[PartSigma, ...] = ()  # what is expected of parts, with tolerances as priors
    only: Group | None = None  # the group of parts asked for

    @property
    def n_images(self) -> int:
        """Number of photographs."""
        return sum(len(view.poses.poses) for view in self.views)

    @property
    def labels(self) -> list[str]:
        """Labels of the poses, in the order to take them."""
        return pose_labels(self.n_images, self.n_given)

    @property
    def has_ways(self) -> bool:
        """Whether some pose is reached by another one."""
        return any(via for view in self.views for via in view.via)

    @property
    def sentence(self) -> str:
        """The expected error, in words."""
        if self.error is None:
            return "The error of the platform is not predicted: readings do not determine its pose."
        beside = f" beside those of {self.given}" if self.given else ""
        return (
            f"Expected of {self.n_images} photographs{beside}: predicted error "
            f"{mm_deg(self.error.mean_displacement, self.error.mean_rotation)} (1 sigma) over the "
            "workspace, "
            f"the mean of {self.setting.draws} sessions with tripods up to "
            f"{1e2 * self.setting.shift:.2g} cm and {np.degrees(self.setting.turn):g} deg off and "
            f"the machine {1e3 * self.setting.length:.2g} mm."
        )

    def document(self) -> dict[str, Any]:
        """Return the document of ``legcal plan --json``, a :class:`PlanDocument`."""
        error, names, setting, noise = self.error, self.machine.leg_names, self.setting, self.noise
        rows = zip(self.names, self.sigma.tolist(), self.units, strict=True)
        return PlanDocument.describing(
            self,
            legcal_plan=1,
            legcal=__version__,
            mechanism=self.machine.name,
            images=self.n_images,
            criterion="d" if error is None else "mean",
            expected=None if error is None else ExpectedError(**error.fields()),
            tolerance=Tolerance(
                camera_m=setting.shift,
                camera_rad=setting.turn,
                machine_m=setting.length,
                machine_rad=setting.angle,
                draws=setting.draws,
            ),
            noise=NoiseOfPlan.describing(
                noise,
                common_px=dict(zip(KINDS, noise.common_px, strict=True)),
                places_px=dict(zip(PLACES, noise.places_px, strict=True)),
            ),
            board=self.board is not None,
            T_base_board=None if self.board is None else Pose.of(self.board.T_base_board),
            given=self.given or None,
            views={
                view.name: ViewOfPlan(
                    T_base_camera=Pose.of(view.T_base_camera),
                    images=len(view.poses.poses),
                    legs=dict(zip(names, view.shows.sum(axis=0).tolist(), strict=True)),
                )
                for view in self.views
            },
            parameters=[ExpectedSigma(name=n, sigma=sigma, unit=u) for n, sigma, u in rows],
            growth=[Growth(images=int(n), value=float(x)) for n, x in self.growth],
            notes=list(self.notes),
            parts=list(self.parts) or None,
        ).document()


class ExpectedError(Document):
    """The expected error of the platform over the workspace, one standard deviation."""

    dX_m: Number  # mean
    dE_rad: Number
    dX_max_m: Number
    dE_max_rad: Number


class Tolerance(Document):
    """Tolerances of the session and of the machine."""

    camera_m: Annotated[Number, Field(ge=0.0)]
    camera_rad: Annotated[Number, Field(ge=0.0, le=MAX_ANGLE)]
    machine_m: Annotated[Number, Field(ge=0.0)]
    machine_rad: Annotated[Number, Field(ge=0.0, le=MAX_ANGLE)]
    draws: Annotated[int, Field(ge=1, le=MAX_DRAWS)]  # sessions that were drawn to judge the plan


class NoiseOfPlan(Document):
    """The errors of outlines that were counted on."""

    sigma_px: Number
    correlation: Number
    common_px: dict[str, Number]  # standard deviations of common-mode edge biases, by kind
    places_px: dict[str, Number] = Field(
        default_factory=dict
    )  # of errors of an edge that come back with a place
    gamma_px: Number
    source: str


class ViewOfPlan(Document):
    """A camera place; of a camera in the hand, an image."""

    T_base_camera: Pose
    images: int
    legs: dict[str, int]  # in how many of its images each is seen


class ExpectedSigma(Document):
    """The expected standard deviation of a parameter."""

    name: str
    sigma: Number
    unit: str


class Growth(Document):
    """The criterion with so many images."""

    images: int
    value: Number


class PlanDocument(SparseDocument):
    """What ``plan.json`` holds and ``legcal plan --json`` prints."""

    legcal_plan: Version
    legcal: str  # the version that planned
    mechanism: str
    images: int
    seed: int
    criterion: Literal["mean", "worst", "d", "parameters"]  # two of them from earlier versions
    value: Number  # of the criterion [m; the determinant's root without a unit]
    expected: ExpectedError | None  # None where readings do not give the pose of the platform
    tolerance: Tolerance
    noise: NoiseOfPlan
    board: bool  # on the base, in every image
    T_base_board: Pose | None
    hand_held: bool
    given: str | None  # the dataset that it adds to
    views: dict[str, ViewOfPlan]
    parameters: list[ExpectedSigma]
    growth: list[Growth]
    notes: list[str]
    parts: list[PartSigma] | None = None  # left out where not asked for (--only)
