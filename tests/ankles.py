"""An ankle of a humanoid: a foot on a universal joint, moved by two cranks and rods (2-RSS + U)."""

from pathlib import Path

import numpy as np
from layouts import numbers

ROD = 0.18
CRANK = 0.04  # from the axis of its motor to the ball [m]
PIN = np.array([-0.045, 0.03, 0.0])  # ball of the left rod on the foot, behind the joint [m]
# Each crank turns about the y axis of the shin, above the ball on the foot, and points backwards.
MOTOR = np.array([PIN[0] + CRANK, 0.03, ROD])


def write_ankle(folder: Path) -> Path:
    """Write ``ankle.urdf`` with the loops of an export, and return its path."""
    limit = '<limit effort="1" velocity="1" lower="{}" upper="{}"/>'
    lines = ['<robot name="ankle">', '<link name="pelvis"/><link name="shin"/>']

    def joint(name: str, kind: str, ends: str, at: np.ndarray, axis: str, reach: float) -> None:
        parent, child = ends.split()
        lines.append(
            f'<link name="{child}"/>'
            * (child != "shin")
            + f'<joint name="{name}" type="{kind}"><origin xyz="{numbers(at)}" rpy="0 0 0"/>'
            f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{axis}"/>'
            f"{limit.format(-reach, reach)}</joint>"
        )

    zero = np.zeros(3)
    joint("knee", "revolute", "pelvis shin", np.array([0.0, 0.0, 0.6]), "0 1 0", 1.0)
    joint("pitch", "revolute", "shin cross", zero, "0 1 0", 0.6)
    joint("roll", "revolute", "cross foot", zero, "1 0 0", 0.4)
    for name, side in (("left", 1.0), ("right", -1.0)):
        mirror = np.array([1.0, side, 1.0])
        joint(f"{name}_motor", "revolute", f"shin {name}_crank", MOTOR * mirror, "0 1 0", 0.8)
        at = np.array([-CRANK, 0.0, 0.0])
        for axis, links in zip(
            ("1 0 0", "0 1 0", "0 0 1"),
            (f"{name}_crank {name}_1", f"{name}_1 {name}_2", f"{name}_2 {name}_rod"),
            strict=True,
        ):
            joint(f"{name}_ball_{axis.index('1') // 2}", "revolute", links, at, axis, 3.0)
            at = zero
        lines[-1] = lines[-1].replace(
            f'<link name="{name}_rod"/>',
            f'<link name="{name}_rod"><visual><origin xyz="0 0 {-ROD / 2}"/><geometry><cylinder '
            f'radius="0.004" length="{0.8 * ROD}"/></geometry></visual></link>',
        )
        end = np.array([0.0, 0.0, -ROD])
        joint(f"{name}_end", "fixed", f"{name}_rod closing_{name}_1", end, "0 0 1", 0.0)
        joint(f"{name}_seat", "fixed", f"foot closing_{name}_2", PIN * mirror, "0 0 1", 0.0)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "ankle.urdf"
    path.write_text("\n".join([*lines, "</robot>"]))
    return path
