"""The documents of the jobs: ``result.json``, and what ``check`` and ``evaluate`` print.

:class:`Result` is ``result.json``: its fields are the keys, in their order, and the schema by which
an earlier result is read (docs/formats.md).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializerFunctionWrapHandler,
    StrictFloat,
    StrictInt,
    StrictStr,
    model_serializer,
)
from pydantic.json_schema import SkipJsonSchema

from legcal.data.reasons import Rejection
from legcal.errors import DatasetError
from legcal.files.motions import Pose
from legcal.files.schema import (
    Document,
    Number,
    SparseDocument,
    Triple,
    Version,
    content_of,
    describe,
    validate,
)
from legcal.machine.actuator import Actuator
from legcal.machine.inspection import ActuatorBlock
from legcal.machine.leg import Link, ParameterId

AxesByLeg = dict[str, Triple]  # unit vectors
Matrix = list[list[Number]]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]


class Legs(Document):
    """The legs in R_b and R_e [m, rad]."""

    base_joints: list[Triple]
    platform_joints: list[Triple]
    offsets: list[Number | None]  # the length of a constant leg, null for a passive one
    base_axes: AxesByLeg  # of axes that are parameters
    platform_axes: AxesByLeg
    twists: dict[str, Number]
    actuators: dict[str, ActuatorBlock] | None = None  # by joint; left out where none moves A


class ParameterRow(SparseDocument):
    """One parameter."""

    name: str
    value: Number  # [unit]; axes are turns of the nominal ones
    nominal: Number  # in the model or camera file
    sigma: Positive | None  # None where it was not estimated
    unit: str  # m, rad, px, or nothing for coefficients of distortion
    status: Literal["estimated", "fixed", "weak"]  # weak: part of a direction that is held
    prior_sigma: Positive | None = None  # of an intrinsic by its camera file; else left out

    @property
    def is_shown(self) -> bool:
        """Whether tables have it: they leave out gains of motors that are fixed at 1."""
        is_gain = ParameterId.parse(self.name).kind == "gain"
        return not (is_gain and self.status == "fixed" and self.value == 1.0)


class Kinematic(Document):
    """What is known of all kinematic parameters."""

    names: list[str]
    covariance: Matrix  # zero where they are fixed and along what is held
    held: Matrix  # how they change along each held direction, by a metre


FrameMark = Literal["origin", "x axis", "xy plane"]  # what of R_b or R_e a joint defines
# frame: zero by the definition of R_b or R_e; weak: part of a direction that is held
CoordinateStatus = Literal["estimated", "fixed", "weak", "frame"]


class JointInLink(Document):
    """The centre of a joint in a link of the model [m]."""

    leg: str
    xyz: Triple  # calibrated
    nominal: Triple
    sigma: Annotated[list[NotNegative | None], Field(min_length=3, max_length=3)]  # as status says
    covariance: Matrix  # (3, 3), zero along what is fixed or defines the frame
    status: Annotated[list[CoordinateStatus], Field(min_length=3, max_length=3)]  # of x, y, z
    defines: FrameMark | None  # a joint on which the frame is built


class AxisInLink(Document):
    """An axis of the joint of a leg, in the link of base or platform."""

    leg: str
    direction: Triple  # calibrated, a unit vector
    nominal: Triple
    turn: Triple  # rotation vector from the nominal one [rad]
    sigma: list[NotNegative] | None  # of the turn about x, y and z [rad]; None if not estimated


class LinkBlock(Document):
    """The joints on base or platform, in the link."""

    link: str
    T_link_frame: Pose  # where R_b or R_e is in it
    joints: list[JointInLink]
    axes: list[AxisInLink]


class Distance(Document):
    """How far two frames are from each other; over poses, means."""

    dX_m: NotNegative
    dE_rad: NotNegative


class WeakCombination(Document):
    """A combination of parameters that is known badly."""

    direction: str
    parameters: list[str]
    components: list[Number]
    sigma_m: Number
    links: WeakInLinks

    @property
    def in_words(self) -> str:
        """What changes, along the axes of the links where they are known."""
        return self.links.direction


class WeakInLinks(Document):
    """The same combination with coordinates of joints and axes along the axes of the links."""

    direction: str
    parameters: list[str]
    components: list[Number]


class ViewPose(Document):
    """The camera pose of a view."""

    T_base_camera: Pose


class Gamma(Document):
    """The gamma that outlines show of a camera."""

    views: list[str]
    gamma: Number
    sigma: Number


class Staged(Legs):
    """What the four steps gave."""

    diagnostics: list[str]
    from_fit: Distance | None = None  # None where the motors do not determine the pose

    @model_serializer(mode="wrap")
    def _without_actuators(self, whole: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found: dict[str, Any] = whole(self)
        if self.actuators is None:
            del found["actuators"]
        return found


class NoSteps(Document):
    """Why the four steps gave nothing."""

    failure: str


class Stages(Document):
    """What single parts of the method gave."""

    staged: Staged | NoSteps


class NoiseBlock(Document):
    """The noise of the outlines."""

    scale: Positive
    bias_px: NotNegative
    tilt_px: NotNegative


class FitQuality(Document):
    """How large the residuals of a fit are."""

    chi2: Number
    dof: int
    rms_px: Number | None


class WrongReadingBlock(Document):
    """A reading that all other measurements contradict, left out of the fit."""

    motor: str
    view: str
    image: str
    off: Number  # how far it is above what all else shows
    unit: Literal["m", "rad"]
    alike: tuple[str, ...]  # other motors one of which may be meant as well


class ReadingResiduals(Document):
    """How readings of more motors than freedoms agree with a model."""

    rms: NotNegative  # of residuals over their standard deviations
    rms_expected: NotNegative  # of right readings: below 1, because poses follow each in part
    rms_m: NotNegative  # of residuals, as far as they move joints


class RedundantReadings(ReadingResiduals):
    """The same of a fit, which also leaves out wrong ones."""

    wrong: tuple[WrongReadingBlock, ...]


class ResidualsBlock(FitQuality, SparseDocument):
    """The same of a calibration, with the noise that they show."""

    noise: NoiseBlock
    shared_px: dict[str, NotNegative]
    edges_px: NotNegative | None = None  # of edges of bodies; left out where none is used
    redundant_readings: RedundantReadings | None = None  # left out where readings cannot disagree


class NamedImage(Document):
    """An image, as tables name it."""

    view: str
    image: str


class LeftOut(Document):
    """Images that were left out, and why."""

    reason: str = ""  # its code
    why: str
    images: list[NamedImage]


def left_out_blocks(
    places: Sequence[tuple[str, str]], why: Mapping[int, Rejection]
) -> list[LeftOut]:
    """Return images that were left out, a block a reason with its detail.

    *places* are the view and the image of each row.
    """
    images: dict[tuple[str, str], list[NamedImage]] = {}
    for row, rejection in sorted(why.items()):
        view, image = places[row]
        alike = images.setdefault((str(rejection.reason), str(rejection)), [])
        alike.append(NamedImage(view=view, image=image))
    return [LeftOut(reason=code, why=text, images=named) for (code, text), named in images.items()]


class Observations(Document):
    """What the fit was made from."""

    used: int
    total: int
    images: int
    rejected: dict[str, int]  # outlines, by the code of the reason
    left_out: list[LeftOut] = Field(
        default_factory=list
    )  # images that should show legs, none of whose outlines is used


class BoardBlock(Document):
    """A calibration board in the fit."""

    given: Pose | None  # its pose in the link that it is fixed to, as the dataset has it
    scale: Number
    rms_px: Number | None
    corners: int = 0  # of all images
    used: int = 0  # of these
    images: int = 0  # with a corner that is used
    off: Distance | None = None  # from where the dataset has it, joints of the link being nominal


class BoardPose(BoardBlock):
    """The pose of the calibration board on the base, R_b laid on the nominal one."""

    T_base_board: Pose


class PlatformBoardPose(BoardBlock):
    """The pose of the calibration board on the platform, R_e laid on the nominal one."""

    T_platform_board: Pose


class PoseAccuracy(Document):
    """Change and predicted error at one pose."""

    pose: str | None
    images: list[str]
    change_dX_m: Number
    change_dE_rad: Number
    sigma_dX_m: Number
    sigma_dE_rad: Number


class WorkspaceAccuracy(Document):
    """The predicted error all over the travel."""

    poses: int
    sigma_dX_m: Number
    sigma_dE_rad: Number
    sigma_dX_max_m: Number
    sigma_dE_max_rad: Number


class SensitivityRow(Document):
    """What an error in what counts as known would do to the platform."""

    what: str
    dX_m: Number
    dE_rad: Number
    dX_max_m: Number
    dE_max_rad: Number


class PlatformBlock(Document):
    """Change and predicted error of the platform, means and maxima over poses."""

    poses: int
    change_dX_m: Number
    change_dE_rad: Number
    sigma_dX_m: Number
    sigma_dE_rad: Number
    sigma_dX_max_m: Number
    sigma_dE_max_rad: Number
    per_pose: list[PoseAccuracy]
    workspace: WorkspaceAccuracy | None
    sensitivities: list[SensitivityRow]


class Holdout(Document):
    """Held-out images compared with the predictions of a fit.

    Offsets are corrected for the common-mode biases of the fit. Expected errors are one standard
    deviation, from the noise of outlines and readings and the covariance of the fit.
    """

    images: int  # held-out images
    poses: int
    outlines: int  # in these images
    wrong: int  # outliers, excluded below
    rms_px: Number | None  # of the offsets; None without outlines
    expected_px: Number | None
    views: dict[str, Number]  # rms by name of the view [px]


class DiagnosisBlock(Document):
    """What looks wrong with a session."""

    kind: str  # in a few words: ``columns exchanged``, ``handedness``, ...
    what: str  # the same as a clause that names columns, views and legs
    same_as: tuple[str, ...]  # mistakes that images cannot tell from it, the commoner first
    images_before: int  # that agree as things are
    images_after: int  # that agree with the correction
    score: Number  # fraction of the predicted legs that images show with the correction
    remedy: str  # as an imperative


@dataclass(frozen=True)
class Doubt:
    """Something that speaks against a result; effects are null where they cannot be computed."""

    code: str  # what was tested; codes do not change
    what: str  # what was found, as a clause
    remedy: str  # what to do, as a clause
    # how far the platform would be displaced and turned if it were true [m, rad]
    sigma_dX_m: float | None = None
    sigma_dE_rad: float | None = None
    # the result is not to be loaded; no part of the document
    is_grave: Annotated[bool, Field(exclude=True), SkipJsonSchema()] = False

    @property
    def sentence(self) -> str:
        """What was found, and what to do."""
        return f"{self.what[0].upper()}{self.what[1:]}; {self.remedy}."


class Heading(Document):
    """What a result is worth, and the order of its legs."""

    legcal_result: Version
    status: Literal["converged"]
    verdict: str
    trustworthy: bool
    doubts: list[Doubt]
    legs: list[str]  # the order of what follows


class Overlay(Document):
    """The overlay of an image, relative to the folder."""

    view: str
    image: str
    file: str


def overlay_blocks(places: Sequence[tuple[str, str]], files: Mapping[int, str]) -> list[Overlay]:
    """Return the overlays of rows; *places* are the view and the image of each row."""
    return [
        Overlay(view=places[row][0], image=places[row][1], file=file) for row, file in files.items()
    ]


class MotorZero(Document):
    """How much further a motor stands than it reads [m or rad]."""

    motor: str
    value: Number
    written: Number  # in calibrated.urdf, where it serves the platform best beside nominal parts
    sigma: Number
    tolerance: Number
    unit: Literal["m", "rad"]
    teeth: StrictInt  # of its spline by which its horn is off; 0 where it is no whole number


class NextStep(Document):
    """A thing to do, with a command to copy, "" where there is none."""

    what: str
    command: str


class Result(Legs, Heading, SparseDocument):
    """``result.json``: the heading, the calibrated legs, and how well they are known."""

    nominal_axes: dict[str, AxesByLeg]  # that turns count from, by side
    nominal_actuators: dict[str, ActuatorBlock] | None = None  # likewise; left out where none is
    parameters: Annotated[list[ParameterRow], Field(min_length=1)]
    covariance: Matrix  # of the estimated parameters, in their order
    kinematic: Kinematic
    links: dict[Link, LinkBlock]
    weakest: list[WeakCombination]
    held: list[str]
    views: dict[str, ViewPose]
    cameras: dict[str, dict[str, StrictInt | StrictFloat | StrictStr]]  # as they came
    gammas: list[Gamma]
    stages: Stages
    residuals: ResidualsBlock
    observations: Observations
    board: BoardPose | None = None  # left out without a board
    platform_board: PlatformBoardPose | None = None  # left out without a board on the platform
    start: str
    platform: PlatformBlock | None
    holdout: Holdout | None = None  # left out without held-out images
    notes: list[str]
    details: list[str] = Field(default_factory=list)  # how the fit went, for those who ask
    diagnosis: list[DiagnosisBlock] | None = None  # left out where nothing looks wrong
    only: Literal["zeros", "lengths", "all"] | None = None  # the group, where one was asked for
    zeros: list[MotorZero] | None = None  # of the motors, likewise
    overlays: list[Overlay] | None = None  # left out where none were asked for
    next: list[NextStep] | None = None  # what to do next, in ``calibrate --json`` alone

    def nominal_actuator(self, calibrated: Actuator | None) -> Actuator | None:
        """Return the actuator that the parameters count from."""
        if calibrated is None or self.nominal_actuators is None:
            return calibrated
        return calibrated.placed(self.nominal_actuators[calibrated.joint].document())

    @classmethod
    def read(cls, path: Path) -> Result:
        """Return the result in a file.

        Raises
        ------
        DatasetError
            If it is missing, or no such document.
        """
        content = content_of(path, "result of an earlier calibration")
        try:
            found = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise unreadable(path, "no JSON", "the document of a calibration") from error
        if not isinstance(found, dict) or "legcal_result" not in found:
            what = "another document" if isinstance(found, dict) else describe(found)
            raise unreadable(path, what, "one with 'legcal_result: 1'")
        return validate(cls, found, path)


def unreadable(path: Path, found: str, needed: str) -> DatasetError:
    """Return why an earlier result could not be read."""
    return DatasetError(
        f"{path}: the result of the earlier calibration could not be read: found {found}, needed "
        f"{needed}; give the folder that legcal calibrate wrote."
    )


class ExplanationBlock(Document):
    """What may have changed, by how much, and what it leaves unexplained."""

    what: str
    components: list[str]
    units: list[str]
    links: list[str]  # in which x, y, z are; empty for what is no coordinate
    values: list[float]
    sigma: list[float]
    remaining: float
    p_value: float


class MovedPlatform(Document):
    """How far the platform is from where the earlier result has it."""

    dX_m: float
    dE_rad: float
    sigma_dX_m: float
    sigma_dE_rad: float


class CheckDocument(Document):
    """What ``legcal calibrate --check --json`` prints."""

    legcal_check: int
    result: str
    moved: bool
    significance: float
    p_value: float
    statistic: float
    dof: int
    of: int
    noise_dof: int
    verdict: str
    explanations: list[ExplanationBlock]
    platform: MovedPlatform
    images: int
    residuals: FitQuality  # of the new images
    notes: list[str]


class ComparedParameter(Document):
    """A parameter of the model and of the reference [m, rad]."""

    name: str
    value: float
    reference: float
    difference: float


class EvaluationDocument(SparseDocument):
    """What ``legcal evaluate --json`` prints; null where no pose is compared."""

    dX_m: float | None
    dE_rad: float | None
    dX_max_m: float | None
    poses: int  # that are compared
    left_out: int  # poses that are not, since one of the models does not reach them
    unreached: list[int]  # the rows of these, counted from 1
    parameters: list[ComparedParameter]
