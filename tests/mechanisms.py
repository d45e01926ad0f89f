"""Model files of one hexapod in many layouts, for tests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array

ROOT = Path(__file__).resolve().parents[1]
SHIPPED_YAML = ROOT / "models" / "hexapod.yaml"
SHIPPED_URDF = ROOT / "urdf" / "hexapod.urdf"
TRUTH_YAML = ROOT / "tests" / "data" / "hexapod-truth" / "models" / "hexapod.yaml"
EYE = RigidTransform.identity()


@dataclass(frozen=True)
class Layout:
    """How a leg is written down: the mechanism stays the same.

    ``hung`` is where the leg hangs, ``first`` its joint there; the other end is an S, cut with
    a ``3d`` closure or written as three revolutes and welded (``6d``).
    """

    hung: str = "platform"
    first: str = "U"
    welded: bool = False
    sign: int = 1
    mounts: bool = False  # turned fixed links between base or platform and the leg
    slid: float = 0.0  # joint origins moved along their own axes [m]
    carried: bool = False  # leg 1 carries the platform, there is no virtual joint


LAYOUTS = {
    "SPU, hung from the platform": Layout(),
    "UPS, hung from the base": Layout(hung="base"),
    "SPS, hung from the base": Layout(hung="base", first="S"),
    "SPS, hung from the platform": Layout(first="S"),
    "UPS, welded": Layout(hung="base", welded=True),
    "SPU, welded, mounts": Layout(welded=True, mounts=True),
    "SPS, welded": Layout(hung="base", first="S", welded=True),
    "SPU, flipped sliders": Layout(sign=-1),
    "UPS, flipped sliders": Layout(hung="base", sign=-1),
    "SPU, mounts": Layout(mounts=True),
    "UPS, mounts, slid origins": Layout(hung="base", mounts=True, slid=0.02),
    "UPS, platform on leg 1": Layout(hung="base", carried=True),
    "SPS, slid origins": Layout(hung="base", first="S", slid=0.013),
}


@dataclass(frozen=True, eq=False)
class Geometry:
    """A hexapod: joint centres in the links, offsets, home."""

    A: Array
    B: Array
    q0: Array
    home: RigidTransform
    travel: tuple[float, float] = (-0.005, 0.155)


def geometry(seed: int = 7) -> Geometry:
    """Return the shipped hexapod with 3 mm errors in every coordinate: nothing is coplanar."""
    rng = np.random.default_rng(seed)
    ring = np.deg2rad([210.0, -54.0, -30.0, 66.0, 90.0, 186.0])
    top = np.deg2rad([210.0, 234.0, -30.0, -6.0, 90.0, 114.0])
    A = 0.270 * np.stack([np.cos(ring), np.sin(ring), 0.0 * ring], axis=1)
    B = 0.195 * np.stack([np.cos(top), np.sin(top), 0.0 * top], axis=1)
    return Geometry(
        A=A + rng.uniform(-3e-3, 3e-3, A.shape),
        B=B + rng.uniform(-3e-3, 3e-3, B.shape),
        q0=0.345 + rng.uniform(-3e-3, 3e-3, 6),
        home=RigidTransform.from_components(
            [0.0, 0.0, 0.38274], Rotation.from_euler("z", 36.0, degrees=True)
        ),
    )


@dataclass
class _Text:
    links: list[str] = field(default_factory=list)
    joints: list[str] = field(default_factory=list)

    def link(self, name: str, cylinder: tuple[float, float] | None = None) -> None:
        if cylinder is None:
            self.links.append(f'  <link name="{name}"/>')
            return
        z, length = cylinder
        self.links.append(
            f'  <link name="{name}"><visual><origin xyz="0 0 {z!r}" rpy="0 0 0"/><geometry>'
            f'<cylinder radius="0.01" length="{length!r}"/></geometry></visual></link>'
        )

    def joint(
        self,
        name: str,
        kind: str,
        parent: str,
        child: str,
        T: RigidTransform,
        axis: str = "0 0 1",
        limits: tuple[float, float] = (-6.3, 6.3),
    ) -> None:
        xyz = " ".join(repr(float(x)) for x in T.translation)
        rpy = " ".join(repr(float(x)) for x in T.rotation.as_euler("xyz"))
        moving = ""
        if kind in ("revolute", "prismatic"):
            moving = (
                f'<axis xyz="{axis}"/><limit lower="{limits[0]!r}" upper="{limits[1]!r}" '
                'effort="10" velocity="1"/>'
            )
        self.joints.append(
            f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/>{moving}</joint>'
        )


def write_hexapod(
    folder: Path, layout: Layout | None = None, machine: Geometry | None = None
) -> Path:
    """Write a hexapod in a layout and return its YAML."""
    layout, machine = layout or Layout(), machine or geometry()
    text = _Text()
    for link in ("base", "platform"):
        text.link(link)
    if not layout.carried:
        text.joint("platform_free", "floating", "base", "platform", EYE)
    closures = [frames for j in range(6) if (frames := _leg(text, j, layout, machine)) is not None]
    names = [f"leg{j + 1}" for j in range(6)]
    document = {
        "closed_loop": closures,
        "type": ["6d" if layout.welded else "3d"] * len(closures),
        "name_mot": [f"{name}_prismatic" for name in names],
        "legcal": {
            "version": 1,
            "base": "base",
            "platform": "platform",
            "platform_joint": None if layout.carried else "platform_free",
            "base_frame": ["leg1", "leg3", "leg5"],
            "home": {
                "xyz": [float(x) for x in machine.home.translation],
                "quat_xyzw": [float(x) for x in machine.home.rotation.as_quat()],
            },
            "legs": {name: f"{name}_prismatic" for name in names},
        },
    }
    folder.mkdir(parents=True, exist_ok=True)
    lines = ['<?xml version="1.0"?>', '<robot name="hexapod">', *text.links, *text.joints]
    (folder / "hexapod.urdf").write_text("\n".join([*lines, "</robot>", ""]))
    path = folder / "hexapod.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def _leg(text: _Text, j: int, layout: Layout, machine: Geometry) -> list[str] | None:
    """Write one leg and return the frames of its closure, None if it carries the platform."""
    name, from_base = f"leg{j + 1}", layout.hung == "base"
    root, other = ("base", "platform") if from_base else ("platform", "base")
    T_base = {"base": EYE, "platform": machine.home}
    near, far = (machine.A[j], machine.B[j]) if from_base else (machine.B[j], machine.A[j])
    start, end = T_base[root].apply(near), T_base[other].apply(far)
    T_base_leg = RigidTransform.from_components(start, _toward(end - start))
    T_root = T_base[root].inv() * T_base_leg
    if layout.mounts:
        mount = RigidTransform.from_components([0.01, 0.02, -0.03], Rotation.from_rotvec([1, 2, 3]))
        text.link(f"{name}_mount")
        text.joint(f"{name}_mounted", "fixed", root, f"{name}_mount", mount)
        root, T_root = f"{name}_mount", mount.inv() * T_root
    axes = ["1 0 0", "0 1 0"] + (["0 0 1"] if layout.first == "S" else [])
    link = _revolutes(text, f"{name}_a", root, T_root, axes, layout.slid, 0.31)
    travel = machine.travel if layout.sign > 0 else (-machine.travel[1], -machine.travel[0])
    text.link(f"{name}_tube", (-0.15, 0.3))
    text.joint(
        f"{name}_prismatic", "prismatic", link, f"{name}_tube",
        RigidTransform.from_translation([0.0, 0.0, float(machine.q0[j])]),
        f"0 0 {layout.sign}", travel,
    )  # fmt: skip
    link = f"{name}_tube"
    carries = layout.carried and j == 0
    if layout.welded or carries:
        link = _revolutes(text, f"{name}_c", link, EYE, ["0 0 1", "0 1 0", "1 0 0"], 0.0, None)
    T_other = T_base[other].inv() * RigidTransform.from_components(end, T_base_leg.rotation)
    if carries:
        text.joint("platform_carried", "fixed", link, other, T_other.inv())
        return None
    text.link(f"{name}_end")
    text.joint(f"{name}_end_frame", "fixed", link, f"{name}_end", EYE)
    text.link(f"{name}_seat")
    text.joint(f"{name}_seat_frame", "fixed", other, f"{name}_seat", T_other)
    return [f"{name}_end", f"{name}_seat"]


def _revolutes(
    text: _Text,
    name: str,
    parent: str,
    T: RigidTransform,
    axes: list[str],
    slid: float,
    cylinder: float | None,
) -> str:
    """Write revolutes through one point and return the last link."""
    for i, axis in enumerate(axes, start=1):
        last = i == len(axes)
        along = slid * np.array([float(x) for x in axis.split()])
        link = f"{name}{i}_link"
        # the cylinder of the last link is shifted back to the joint centre
        shown = (0.5 * cylinder, cylinder) if last and cylinder and slid == 0.0 else None
        text.link(link, shown)
        text.joint(
            f"{name}{i}", "revolute", parent, link, T * RigidTransform.from_translation(along), axis
        )
        parent, T = link, RigidTransform.from_translation(-along)
    if slid != 0.0:
        text.link(f"{name}_centre", None if cylinder is None else (0.5 * cylinder, cylinder))
        text.joint(f"{name}_back", "fixed", parent, f"{name}_centre", T)
        parent = f"{name}_centre"
    return parent


def _toward(direction: Array) -> Rotation:
    """Return a rotation whose z axis points along a direction."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.3, 0.9, 0.1], z)
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))


def moved(machine: Geometry, seed: int = 3) -> Geometry:
    """Return a machine whose every parameter is up to 2 mm elsewhere."""
    rng = np.random.default_rng(seed)
    return replace(
        machine,
        A=machine.A + rng.uniform(-2e-3, 2e-3, (6, 3)),
        B=machine.B + rng.uniform(-2e-3, 2e-3, (6, 3)),
        q0=machine.q0 + rng.uniform(-2e-3, 2e-3, 6),
    )


def poses_near_home(machine: Geometry, count: int, seed: int = 5) -> list[RigidTransform]:
    """Return poses up to 4 cm and 12 degrees from home."""
    rng = np.random.default_rng(seed)
    return [
        RigidTransform.from_components(
            np.asarray(machine.home.translation)
            + rng.uniform(-0.04, 0.04, 3) * [1.0, 1.0, 0.6]
            + [0.0, 0.0, 0.02],
            Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)) * machine.home.rotation,
        )
        for _ in range(count)
    ]


def displaced(T: RigidTransform, step: Sequence[float] | Array) -> RigidTransform:
    """Return a pose after a rotation about its origin [rad] and a displacement [m], in the base."""
    turn = Rotation.from_rotvec(np.asarray(step)[:3])
    return RigidTransform.from_components(T.translation + np.asarray(step)[3:], turn * T.rotation)
