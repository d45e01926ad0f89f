"""What ``legcal inspect`` says of a machine: its document, and notes of one sentence each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from pydantic import model_validator
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.motions import Pose
from legcal.files.schema import Document, Number, SparseDocument, Triple
from legcal.geometry.types import Array
from legcal.machine.closing import LOOSE, dimensionless, project_pose, singularity
from legcal.machine.files import LegcalBlock, motor_entries
from legcal.machine.home import home_reading_in_words, in_yaml, legs_outside
from legcal.machine.leg import Cylinder, JointType, Leg, LegKind
from legcal.machine.model import Machine, readings_at
from legcal.machine.ties import ties_in_words
from legcal.machine.topology import level_rotation


class ArmBlock(Document):
    """The line of a cylindrical arm, with its motor at reading 0 [m]."""

    link: str  # link of its visual
    point: Triple  # middle
    axis: Triple  # direction, from the motor outwards


class ActuatorBlock(SparseDocument):
    """A motor that moves joints at A, in R_b or the base link at reading 0 [m]."""

    kind: Literal["prismatic", "revolute"]
    direction: Triple | None = None  # of a prismatic
    point: Triple | None = None  # of the axis of a revolute
    axis: Triple | None = None
    arm: ArmBlock | None = None  # visible cylindrical arm of a revolute

    @model_validator(mode="after")
    def _has_its_motion(self) -> ActuatorBlock:
        needed = ("direction",) if self.kind == "prismatic" else ("point", "axis")
        missing = [key for key in needed if getattr(self, key) is None]
        if missing:
            raise ValueError(f"a {self.kind} actuator has no '{missing[0]}'")
        return self


class InspectedArm(ArmBlock):
    """A cylindrical arm, as drawn by the model."""

    radius: Number  # [m]


class InspectedActuator(ActuatorBlock):
    """A motor of the model."""

    arm: InspectedArm | None = None
    gain: Number | None = None  # true motion over reading; omitted if 1
    centre_us: Number | None = None  # of a hobby servo: the pulse at joint value 0 [us]
    us_per_deg: Number | None = None


class CylinderBlock(Document):
    """A visible cylinder of a leg [m]."""

    link: str
    radius: Number


class BodyBlock(Document):
    """A body of a leg whose edges are measured: its link, and its length [m]."""

    link: str
    length: Number


class InspectedLeg(SparseDocument):
    """A leg as classified."""

    name: str
    type: str
    actuated: bool
    kind: Literal["actuated", "passive", "constant"]
    A: Triple  # in the base link [m]
    B: Triple  # in the platform link [m]
    q0: Number  # [m]
    sign: int
    travel: list[Number] | None  # of the slider or actuator [m or rad]
    q_home: Number  # the reading at ``home``
    base_axis: Triple | None
    platform_axis: Triple | None
    twist: Number | None  # [rad]
    cylinders: list[CylinderBlock]
    bodies: list[BodyBlock] | None = None  # omitted if there are none
    actuator: str | None = None  # joint of the motor that moves A; omitted if A is fixed


class Inspection(SparseDocument):
    """What ``legcal inspect --json`` prints: legs with types, frames, mobility."""

    name: str
    spatial: bool
    mobility: int
    motors: int
    motor_rank: int  # freedoms of the platform held by motors
    n: int
    n_d: int  # number of legs that define the frames
    r: int  # number of legs with an R joint on the base
    n_ac: int  # number of legs that are actuated or of constant length
    idle_spins: int  # number of freedoms that only spin a leg about itself
    base_frame: list[str]
    home: Pose  # T_base_platform
    reach: Number | None = None  # of the platform from the z axis of the base [m]; omitted if none
    floor: Number | None = None  # its lowest z there [m]; omitted if none
    legs: list[InspectedLeg]
    actuators: dict[str, InspectedActuator] | None = None  # in the base link, with A at reading 0
    diagnostics: list[str]


def machine_document(machine: Machine) -> dict[str, Any]:
    """Return the document of ``legcal inspect --json``, an :class:`Inspection`."""
    kinds = [leg.kind for leg in machine.legs]
    readings = readings_at(machine, machine.home).tolist()
    stated = motor_entries(machine.actuators)
    actuators = dict[str, InspectedActuator]()
    for a in machine.actuators:
        document = a.document() | stated.get(a.joint, {})
        if a.arm is not None:
            document["arm"] = document["arm"] | {"radius": a.arm.radius}
        actuators[a.joint] = InspectedActuator.model_validate(document)
    return Inspection(
        name=machine.name,
        spatial=machine.spatial,
        mobility=machine.mobility,
        motors=len(machine.motors),
        motor_rank=machine.motor_rank,
        n=machine.n_legs,
        n_d=len(machine.frame_legs),
        r=sum(leg.base_joint is JointType.REVOLUTE for leg in machine.legs),
        n_ac=len(kinds) - kinds.count(LegKind.PASSIVE),
        idle_spins=sum(leg.idle_spins for leg in machine.legs),
        base_frame=[machine.leg_names[j] for j in machine.frame_legs],
        home=Pose.of(machine.home),
        reach=machine.reach if np.isfinite(machine.reach) else None,
        floor=machine.floor if np.isfinite(machine.floor) else None,
        legs=[_leg(*one) for one in zip(machine.legs, readings, machine.bodies, strict=True)],
        actuators=actuators or None,
        diagnostics=list(machine.diagnostics),
    ).document()


def _leg(leg: Leg, q_home: float, bodies: Sequence[Cylinder]) -> InspectedLeg:
    has_travel = leg.has_value and bool(np.isfinite(leg.travel).all())
    return InspectedLeg(
        name=leg.name,
        type=leg.type,
        actuated=leg.is_motor,
        kind=leg.kind.value,
        A=leg.A.tolist(),
        B=leg.B.tolist(),
        q0=float(leg.q0),
        sign=leg.sign,
        travel=[float(x) for x in leg.travel] if has_travel else None,
        q_home=q_home,
        base_axis=None if leg.base_axis is None else leg.base_axis.tolist(),
        platform_axis=None if leg.platform_axis is None else leg.platform_axis.tolist(),
        twist=leg.twist,
        cylinders=[CylinderBlock(link=c.link, radius=c.radius) for c in leg.cylinders],
        bodies=[BodyBlock(link=b.link, length=b.end - b.start) for b in bodies] or None,
        actuator=None if leg.actuator is None else leg.actuator.joint,
    )


_AT_MIDDLE = 1e-6  # largest distance from mid-travel, relative to the travel
_TURNED, _LEVEL = 0.02, 1e-3  # tilt of a link that seems tilted, and of a level platform [rad]
_MIN_SINGULARITY = 1e-4  # singularity measure below which it is the rounding of a file
_GOOD_SINGULARITY = 0.05  # of a home that can be proposed
_ALONG = np.radians(np.arange(2.0, 62.0, 2.0))  # of a free motion [rad, leg lengths]
_PURE = 0.02  # part of a free motion that is not mentioned


def mechanism_notes(machine: Machine, *, home_is_given: bool) -> tuple[str, ...]:
    """Return the notes on a mechanism, one sentence each."""
    notes = []
    q = readings_at(machine, machine.home)
    if not home_is_given:
        travels = {j: machine.legs[j].travel for j in machine.motors}
        away = [(q[j] - 0.5 * sum(ends)) / np.ptp(ends) for j, ends in travels.items()]
        middle = "with all legs at mid-travel"
        if np.abs(away).max(initial=0.0) > _AT_MIDDLE:
            middle = "with all motors as near to mid-travel as possible"
        notes.append(
            f"{machine.urdf.wording.no_home}: a pose {middle} was taken, {in_yaml(machine.home)}; "
            "add it to the file if it is the right assembly."
        )
    outside = legs_outside(machine)
    for name, reading, travel in dict.fromkeys(
        home_reading_in_words(machine.legs[j], float(q[j])) for j in outside
    ):
        notes.append(
            f"{name} is at {reading} at home, outside its travel of {travel}; check the "
            f"limits, or {machine.urdf.wording.correct_home}."
        )
    notes += _level_note(machine, q)
    tied = ties_in_words(machine)
    notes += [] if tied is None else [tied]
    return (*notes, *_unseen_notes(machine), *_motor_notes(machine), *_spin_notes(machine))


def proposal_notes(written: LegcalBlock | None, machine: Machine) -> tuple[str, ...]:
    """Return the entries of the block ``legcal`` that were proposed, as notes."""
    frame = ", ".join(machine.leg_names[j] for j in machine.frame_legs)
    if written is None:
        return (
            f"the file has no block legcal: base '{machine.base}', platform "
            f"'{machine.platform}', legs {', '.join(machine.leg_names)} and base_frame "
            f"[{frame}] were taken from its bodies; add the block to choose others.",
        )
    if written.base_frame is None:
        return (
            f"legcal.base_frame is not given: [{frame}] was taken, the legs with the largest span "
            "of joints; add it to choose others.",
        )
    return ()


def singularity_note(machine: Machine) -> str | None:
    """Return a note if the motors do not hold the platform at home, or hardly; else None."""
    if not 0 < machine.mobility <= len(machine.motors):
        return None
    measure = singularity(machine, machine.home)
    if measure > LOOSE:
        return None
    jacobian = dimensionless(machine, machine.home.as_matrix()[None])[0]
    motion = np.linalg.svd(jacobian)[2][-1]
    motion /= max(np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:]))
    motion = np.concatenate([motion[:3], machine.size * motion[3:]])
    nearly = "nearly " if measure > _MIN_SINGULARITY else ""
    return (
        f"the mechanism is {nearly}singular at home: the platform can {nearly}"
        f"{_in_words(motion, machine.size)} there with all motors locked (singularity measure "
        f"{measure:.1g}, needed above {LOOSE:g}); "
        f"{machine.urdf.wording.correct_home}{_good_home(machine, motion)}, or the joints if they "
        "make similar figures on base and platform."
    )


def _in_words(motion: Array, size: float) -> str:
    """Return a free motion in words."""

    def direction(vector: Array) -> str:
        unit = vector / np.linalg.norm(vector)
        unit *= np.sign(unit[np.argmax(np.abs(unit))])
        return f"({', '.join(f'{x:.2g}' for x in np.where(np.abs(unit) < 5e-3, 0.0, unit))})"

    turn, shift = motion[:3], motion[3:]
    words = []
    if np.linalg.norm(turn) > _PURE:
        words.append(f"turn about {direction(turn)}")
    if np.linalg.norm(shift) > _PURE * size:
        words.append(f"move along {direction(shift)}")
    return f"{' and '.join(words)} of the base"


def _good_home(machine: Machine, motion: Array) -> str:
    """Return the nearest pose along a motion at which motors hold the platform, as an entry."""
    centre = machine.B_platform.mean(axis=0)
    for part in _ALONG:
        for sign in (1.0, -1.0):
            rotation = Rotation.from_rotvec(sign * part * motion[:3]) * machine.home.rotation
            middle = machine.home.apply(centre) + sign * part * motion[3:]
            moved = RigidTransform.from_components(middle - rotation.apply(centre), rotation)
            pose, problem = project_pose(machine, moved)
            if problem is None and singularity(machine, pose) > _GOOD_SINGULARITY:
                return f" (the nearest good one is {in_yaml(pose)})"
    return ""


def _level_note(machine: Machine, q: Array) -> list[str]:
    """Return a note if the platform is level at home and the frame of its link is not."""
    z = machine.home.rotation.apply([0.0, 0.0, 1.0])[2]
    if not machine.spatial or z > np.cos(_TURNED):
        return []
    level = level_rotation(machine.A_at(q), machine.B_platform)
    if (level.inv() * machine.home.rotation).magnitude() > _LEVEL:
        return []
    return ["at home the joints of the platform are level over those of the base, and not turned."]


def _unseen_notes(machine: Machine) -> list[str]:
    """Return notes on legs without visible cylinder or body."""
    unseen = [machine.leg_names[j] for j in machine.unseen_legs]
    if not unseen:
        return []
    if len(unseen) == 1:
        who, add = f"leg '{unseen[0]}' has no <visual> cylinder along its axis: it", "add one"
    else:
        who = f"legs {', '.join(unseen)} have no <visual> cylinder along their axes: they"
        add = "add one to each"
    return [
        f"{who} cannot be seen in images; {add} with its radius, or write a model that has them "
        "with: legcal inspect FILE --leg-radius MM --write DIR."
    ]


def _motor_notes(machine: Machine) -> list[str]:
    """Return notes on too few or too many motors, and on a singular home."""
    notes = []
    if machine.mobility == 0:
        return ["the platform cannot move: mobility 0; check the joints and axes of the legs."]
    n_motors, rank = len(machine.motors), machine.motor_rank
    if not machine.is_determined:
        holding = "" if rank == n_motors else f", which hold only {rank} of its freedoms"
        notes.append(
            f"the motors do not determine the pose: mobility {machine.mobility}, motors "
            f"{n_motors}{holding}; forward kinematics is refused."
        )
    elif machine.is_redundant:
        notes.append(
            f"there are more motors than the pose needs: mobility {machine.mobility}, motors "
            f"{n_motors}; the pose at readings is a least-squares pose."
        )
    singular = singularity_note(machine)
    return notes if singular is None else [*notes, singular]


def _spin_notes(machine: Machine) -> list[str]:
    """Return notes on idle spins: legs with an S joint at both ends, redundant revolutes."""
    notes, legs = [], machine.legs
    n_spinning = sum(
        leg.base_joint.twists_freely and leg.platform_joint.twists_freely for leg in legs
    )
    if n_spinning:
        who = "1 leg has an S joint at both ends and spins about itself"
        if n_spinning > 1:
            who = f"{n_spinning} legs have an S joint at both ends and spin about themselves"
        notes.append(f"{who}; this is not counted as mobility.")
    others = sum(leg.idle_spins for leg in legs) - n_spinning
    if others:
        joints = "1 revolute repeats" if others == 1 else f"{others} revolutes repeat"
        notes.append(
            f"{joints} the motion of an S joint of the leg, or of another revolute; this is not "
            "counted as mobility."
        )
    return notes
