"""The document of `legcal inspect`."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from legcal.files.motions import Pose
from legcal.files.schema import Document, Number, SparseDocument, Triple
from legcal.machine.files import motor_entries
from legcal.machine.leg import JointType, Leg, LegKind
from legcal.machine.model import Machine, readings_at


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
        legs=[_leg(leg, q) for leg, q in zip(machine.legs, readings, strict=True)],
        actuators=actuators or None,
        diagnostics=list(machine.diagnostics),
    ).document()


def _leg(leg: Leg, q_home: float) -> InspectedLeg:
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
        actuator=None if leg.actuator is None else leg.actuator.joint,
    )
