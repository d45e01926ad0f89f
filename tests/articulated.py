"""Machines whose platform has several bodies, an H4 and I4s, written as URDF and YAML.

Eight rods hang in pairs on four motors, and end in pairs on two bars. On an H4 the bars are hinged
to a bar in the middle, on an I4 they slide along each other. Dimensions are of the size of the
prototypes (arms of 260 mm, rods of about half a metre), and without symmetry.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from legcal.geometry.types import Array, IntArray

HOME = np.array([0.012, -0.017, -0.45])  # of the platform, which is not turned, below the base
UP, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class Inside:
    """A joint inside the platform, in the frame of the platform."""

    name: str
    kind: str
    point: Array
    axis: Array


@dataclass(frozen=True, eq=False)
class Articulated:
    """A machine at home, where all motors and joints read 0, in the base but for ``inside``."""

    turning: bool  # motors turn arms; else they move carriages
    motor_point: Array  # (n_motors, 3), 4 of those made here
    motor_axis: Array  # (n_motors, 3)
    motor: IntArray  # (n_rods,) of each rod, 8 of those made here
    A: Array  # (n_rods, 3)
    B: Array  # (n_rods, 3)
    body: IntArray  # (n_rods,) 0 the platform, 1 and 2 what ``inside`` carries
    inside: tuple[Inside, ...]

    def write(self, folder: Path, *, block: bool = True, platform: str = "platform") -> Path:
        """Write the files; rods have three revolutes at A and a point closure at B."""
        links, joints = [_link("base"), _link("platform")], list[str]()
        joints.append(
            f'<joint name="free" type="floating"><parent link="base"/><child link="{platform}"/>'
            "</joint>"
        )
        loops, legs = list[list[str]](), dict[str, str]()
        kind, name = ("revolute", "arm") if self.turning else ("prismatic", "carriage")
        for k in range(len(self.motor_point)):
            links.append(_link(f"{name}{k + 1}"))
            joints.append(
                _joint(f"motor{k + 1}", kind, "base", f"{name}{k + 1}", self.motor_point[k],
                       self.motor_axis[k])
            )  # fmt: skip
        seat = {0: ("platform", HOME)}
        for i, joint in enumerate(self.inside, start=1):
            links.append(_link(f"bar{i}"))
            ends, at = ("platform", f"bar{i}"), joint.point
            if platform == ends[1]:
                ends, at = ends[::-1], -at
            joints.append(_joint(joint.name, joint.kind, *ends, at, joint.axis))
            seat[i] = f"bar{i}", HOME + joint.point
        for j in range(len(self.A)):
            leg, k = f"leg{j + 1}", int(self.motor[j])
            u = self.B[j] - self.A[j]
            length = float(np.linalg.norm(u))
            first = np.cross(u, UP)
            first /= np.linalg.norm(first)
            axes = (first, np.cross(first, u) / length, u / length)
            above, at = f"{name}{k + 1}", self.motor_point[k]
            for i, axis in enumerate(axes, start=1):
                below = f"{leg}_rod" if i == 3 else f"{leg}_{i}"
                shape = _cylinder(0.5 * (self.A[j] + self.B[j]) - self.A[j], u, length)
                links.append(_link(below, shape if i == 3 else ""))
                joints.append(
                    _joint(f"{leg}_a{i}", "revolute", above, below, self.A[j] - at, axis, 3.0)
                )
                above, at = below, self.A[j]
            body, origin = seat[int(self.body[j])]
            for end, parent, start in ((f"{leg}_end", above, at), (f"{leg}_seat", body, origin)):
                links.append(_link(end))
                joints.append(_joint(f"{end}_fix", "fixed", parent, end, self.B[j] - start))
            loops.append([f"{leg}_end", f"{leg}_seat"])
            legs[leg] = f"{leg}_a1"
        motors = [f"motor{k + 1}" for k in range(len(self.motor_point))]
        document: dict[str, object] = {
            "closed_loop": loops, "type": ["3d"] * len(loops), "name_mot": motors,
        }  # fmt: skip
        if block:
            place = seat[{"platform": 0, "bar1": 1, "bar2": 2}[platform]][1]
            document["legcal"] = {
                "version": 1, "base": "base", "platform": platform, "platform_joint": "free",
                "legs": legs, "home_readings": dict.fromkeys(motors, 0.0),
                "home": {"xyz": place.tolist(), "quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
            }  # fmt: skip
        folder.mkdir(exist_ok=True, parents=True)
        (folder / "r.urdf").write_text(f'<robot name="r">{"".join(links)}{"".join(joints)}</robot>')
        (folder / "r.yaml").write_text(yaml.safe_dump(document))
        return folder / "r.yaml"


def machine(kind: str, *, turning: bool, seed: int = 4) -> Articulated:
    """Return an ``h4``, or an ``i4``, which moves only while its parallelograms are exact."""
    rng = np.random.default_rng(seed)

    def about(points: Array, by: float = 0.004) -> Array:
        return np.asarray(points + by * rng.normal(size=points.shape))

    # With four motors alike around z the platform of an H4 is singular
    angle = np.radians([0.0, 90.0, 270.0, 0.0] if kind == "h4" else [50.0, 310.0, 130.0, 235.0])
    out = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    side = np.cross(UP, out)
    if kind == "h4":
        end = 0.06 * np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
        pivot = about(0.2 * out + np.sum(end * side, axis=1)[:, None] * side)
    else:
        end = np.where(out[:, :1] > 0.0, 1.0, -1.0) * [0.07, 0.0, 0.0] + (
            np.sign(out[:, 1])[:, None] * [0.0, 0.06, 0.0]
        )
        pivot = about(0.2 * out)
    end = HOME + end
    joint = pivot + 0.26 * out if turning else pivot + 0.2 * out
    axis = about(side if turning else UP + 0.5 * out, 0.02)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    pair = np.array([-1.0, 1.0])[:, None] * 0.04
    if kind == "i4":
        joint, end = about(joint, 0.01), about(end, 0.01)
        side = axis if turning else side
    A = np.concatenate([a + pair * s for a, s in zip(joint, side, strict=True)])
    B = np.concatenate([b + pair * s for b, s in zip(end, side, strict=True)])
    if kind == "h4":
        A, B = about(A), about(B)
    motor = np.repeat(np.arange(4), 2)
    body = np.where(motor < 2, 1, 2)
    if kind == "h4":
        points = about(np.array([[0.0, 0.06, 0.01], [0.0, -0.06, 0.01]]))
        axes = about(np.stack([UP, UP]), 0.02)
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        inside = tuple(Inside(f"hinge{i + 1}", "revolute", points[i], axes[i]) for i in range(2))
    else:
        guide = about(ACROSS, 0.02)
        guide /= np.linalg.norm(guide)
        inside = (Inside("slide", "prismatic", np.array([-0.07, 0.0, 0.0]), guide),)
        body = np.where(body == 2, 1, 0)
    return Articulated(turning, pivot, axis, motor, A, B, body, inside)


def _link(name: str, shape: str = "") -> str:
    return f'<link name="{name}">{shape}</link>'


def _numbers(values: Array) -> str:
    return " ".join(repr(float(x)) for x in values)


def _cylinder(middle: Array, u: Array, length: float) -> str:
    x, y, z = u / length
    rpy = np.array([0.0, np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)])
    return (
        f'<visual><origin xyz="{_numbers(middle)}" rpy="{_numbers(rpy)}"/><geometry>'
        f'<cylinder radius="0.006" length="{0.9 * length!r}"/></geometry></visual>'
    )


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Array,
    axis: Array | None = None,
    limit: float = 0.35,
) -> str:
    moving = ""
    if axis is not None:
        limit = 0.12 if kind == "prismatic" else limit
        moving = (
            f'<axis xyz="{_numbers(axis)}"/>'
            f'<limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/>'
        )
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_numbers(xyz)}"/>{moving}</joint>'
    )
