"""Any machine of the class, written as URDF and YAML in any spanning tree, for tests."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.lines import normal_basis
from legcal.geometry.motions import roll_pitch_yaw
from legcal.geometry.types import Array

EYE = RigidTransform.identity()
PASSED = 0.05  # [m] by which every slider is out at home


@dataclass(frozen=True, eq=False)
class LegSpec:
    """A leg as drawn at home: joints, centres in the base link, and the axes there."""

    type: str  # base joint and platform joint, "U" alone if fixed to the platform
    A: Array
    B_home: Array
    kind: str = "actuated"
    base_axis: Array | None = None  # of R, or the outer one of U; a U beside an S need not have one
    platform_axis: Array | None = None
    base_inner: Array | None = None  # of U, where it is not the one across the leg
    slides: Array | None = None  # direction of the slider, where it is not that of the leg

    @property
    def ends(self) -> tuple[str, str]:
        return self.type[0], self.type[1:]

    @property
    def u(self) -> Array:
        between = self.B_home - self.A if self.slides is None else self.slides
        return np.asarray(between / np.linalg.norm(between))


@dataclass(frozen=True, eq=False)
class MachineSpec:
    """A machine at home."""

    legs: tuple[LegSpec, ...]
    home: RigidTransform
    frame_legs: tuple[int, ...] = (0, 1, 2)
    normal: Array | None = None


@dataclass(frozen=True)
class LegLayout:
    """How one leg is written.

    ``cut``: ``far`` (3d where the far joint is an S and ``sphere``), ``mid`` or ``slider``
    (welded behind or before the slider), ``carry`` (the leg carries the platform, uncut), ``bear``
    (the platform is the child of its last joint, see :func:`borne`).
    ``spin``: a revolute along the leg beside its ``S``, or on the side of ``base`` or ``platform``.
    """

    hung: str = "base"
    cut: str = "far"
    sphere: bool = True
    flip_slider: bool = False
    flip_axes: bool = False
    slid: float = 0.0
    mount: bool = False
    spin: str = ""
    seed: int = 0


@dataclass(frozen=True)
class Layout:
    """How a machine is written: one entry for all legs, or one for each."""

    legs: tuple[LegLayout, ...] = (LegLayout(),)
    virtual: str | None = "floating"
    home: bool = True

    def of(self, j: int) -> LegLayout:
        return self.legs[j % len(self.legs)]


@dataclass(frozen=True, eq=False)
class _Joint:
    """A joint of a leg at zero: type, a point of its axis, and the axis, in the base link."""

    name: str
    type: str
    point: Array
    axis: Array


@dataclass
class Text:
    """Links and joints of a URDF."""

    links: list[str] = field(default_factory=list)
    joints: list[str] = field(default_factory=list)

    def link(self, name: str, visual: str = "") -> None:
        self.links.append(f'  <link name="{name}">{visual}</link>')

    def joint(
        self, name: str, kind: str, parent: str, child: str, T: RigidTransform, moving: str = ""
    ) -> None:
        self.joints.append(
            f'  <joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f"{origin(T)}{moving}</joint>"
        )

    def robot(self, name: str) -> str:
        """Return the file."""
        lines = ['<?xml version="1.0"?>', f'<robot name="{name}">', *self.links, *self.joints]
        return "\n".join([*lines, "</robot>", ""])

    def any_joint(self, leg: str) -> str:
        """Return the slider of a leg, or a revolute of a rod that was not cut away."""
        written = "".join(self.joints)
        names = [f"{leg}_{joint}" for joint in ("slider", "a1", "b1")]
        return next(name for name in names if f'<joint name="{name}"' in written)


def numbers(values: object) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(values).ravel())


def origin(T: RigidTransform) -> str:
    rpy = roll_pitch_yaw(T.rotation.as_matrix())
    return f'<origin xyz="{numbers(T.translation)}" rpy="{numbers(rpy)}"/>'


def write_machine(folder: Path, description: MachineSpec, layout: Layout) -> Path:
    """Write a machine in a layout and return its YAML."""
    text = Text()
    text.link("base")
    text.link("platform")
    carried = any(layout.of(j).cut in ("carry", "bear") for j in range(len(description.legs)))
    virtual = None if carried else layout.virtual
    if virtual is not None:
        T = EYE
        if virtual == "planar" and description.normal is not None:
            T = RigidTransform.from_rotation(_toward(description.normal))
        text.joint("platform_free", virtual, "base", "platform", T, '<axis xyz="0 0 1"/>')
    loops: list[list[str]] = []
    kinds: list[str] = []
    for j, leg in enumerate(description.legs):
        written = _Leg(text, f"leg{j + 1}", leg, layout.of(j), description.home).write()
        if written is not None:
            loops.append(written[1:])
            kinds.append(written[0])
    names = [f"leg{j + 1}" for j in range(len(description.legs))]
    block = {
        "version": 1,
        "base": "base",
        "platform": "platform",
        "platform_joint": None if virtual is None else "platform_free",
        "legs": {n: text.any_joint(n) for n in names},
    }
    if len(names) >= len(description.frame_legs):
        block["base_frame"] = [names[j] for j in description.frame_legs]
    if layout.home:
        block["home"] = motion_to_xyz_quat(description.home)
    document = {
        "closed_loop": loops,
        "type": kinds,
        "name_mot": [f"{n}_slider" for n, leg in zip(names, description.legs, strict=True)
                     if leg.kind == "actuated"],
        "legcal": block,
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "machine.urdf").write_text(text.robot("machine"))
    path = folder / "machine.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def borne(description: MachineSpec, j: int, **others: Any) -> tuple[MachineSpec, Layout]:
    """Return a machine whose platform link is the child of the last joint of leg j, and its layout.

    The frame of the platform is that of the joint then. *others* say how other legs are written.
    """
    home = RigidTransform.from_components(description.legs[j].B_home, description.home.rotation)
    legs = [LegLayout(seed=k, **others) for k in range(len(description.legs))]
    legs[j] = LegLayout(cut="bear")
    return replace(description, home=home), Layout(tuple(legs))


class _Leg:
    """One leg on its way into the text."""

    def __init__(
        self, text: Text, name: str, leg: LegSpec, layout: LegLayout, home: RigidTransform
    ) -> None:
        self.text, self.name, self.leg, self.layout = text, name, leg, layout
        self.rng = np.random.default_rng(1000 + layout.seed)
        u = leg.u
        out = 0.0 if leg.kind == "constant" else PASSED
        self.B = leg.B_home - out * u
        back = RigidTransform.from_translation(-out * u)
        self.roots = {"base": EYE, "platform": back * home}
        base, platform = leg.ends
        lower = self._group("a", base, leg.A, leg.base_axis, leg.base_inner)
        upper = self._group("b", platform, self.B, leg.platform_axis)[::-1]
        side = layout.spin
        if side == "S":
            side = "" if "S" not in leg.type else "platform" if platform == "S" else "base"
        if side:
            place = self.B - 0.1 * u if side == "platform" else leg.A + 0.1 * u
            spin = _Joint(f"{name}_spin", "revolute", place, u)
            lower, upper = (
                (lower, [spin, *upper]) if side == "platform" else ([*lower, spin], upper)
            )
        slider = [] if leg.kind == "constant" else [_Joint(f"{name}_slider", "prismatic", leg.A, u)]
        self.joints = [*lower, *slider, *upper]
        self.n_lower, self.n_upper = len(lower), len(upper)
        self.far_axes = 3 if leg.ends[layout.hung == "base"] == "S" else 0

    def _group(
        self, end: str, letter: str, centre: Array, outer: Array | None, inner: Array | None = None
    ) -> list[_Joint]:
        """Return the revolutes of a joint, from the one fixed in base or platform inwards."""
        if outer is None:
            outer = self.rng.normal(size=3)
        outer = outer / np.linalg.norm(outer)
        across = self.leg.u if "S" not in self.leg.type else self.rng.normal(size=3)
        inner = np.cross(outer, across) if inner is None else inner
        inner = inner / np.linalg.norm(inner)
        axes = {"": [], "R": [outer], "U": [outer, inner], "S": [outer, inner, self.leg.u]}[letter]
        if letter == "S" and self.layout.flip_axes:
            axes = [outer, inner, np.cross(outer, inner)]
        return [
            _Joint(f"{self.name}_{end}{i}", "revolute", centre, axis)
            for i, axis in enumerate(axes, start=1)
        ]

    def write(self) -> list[str] | None:
        """Write the leg and return type and frames of its closure, None if it carries."""
        layout, n = self.layout, len(self.joints)
        near, far = ("base", "platform") if layout.hung == "base" else ("platform", "base")
        if layout.cut in ("mid", "slider"):
            at = self.n_lower + (layout.cut == "mid" and self.leg.kind != "constant")
            tips = [
                self._piece("base", range(at)),
                self._piece("platform", range(n - 1, at - 1, -1)),
            ]
            T_weld = RigidTransform.from_components(self.leg.A, Rotation.random(rng=self.rng))
            frames = [
                self._frame(tip, pose, side, T_weld)
                for (tip, pose), side in zip(tips, ("low", "high"), strict=True)
            ]
            return ["6d", *frames]
        walk = list(range(n)) if near == "base" else list(range(n - 1, -1, -1))
        cut_sphere = self.far_axes and layout.sphere and layout.cut == "far"
        if cut_sphere:
            walk = walk[: -self.far_axes]
        tip, pose = self._piece(near, walk)
        if layout.cut == "bear":
            return None
        if layout.cut == "carry":
            T = pose.inv() * self.roots["platform"]
            self.text.joint("platform_carried", "fixed", tip, "platform", T)
            return None
        centre = self.B if far == "platform" else self.leg.A
        T_end = RigidTransform.from_components(centre, Rotation.random(rng=self.rng))
        root, T_root = self._root(far)
        frames = [self._frame(tip, pose, "end", T_end), self._frame(root, T_root, "seat", T_end)]
        return ["3d" if cut_sphere else "6d", *frames]

    def _root(self, link: str) -> tuple[str, RigidTransform]:
        """Return base or platform, or a link mounted on it."""
        pose = self.roots[link]
        if not self.layout.mount:
            return link, pose
        T = RigidTransform.from_components([0.01, 0.02, -0.03], Rotation.from_rotvec([1, 2, 3]))
        mount = f"{self.name}_{link}_mount"
        self.text.link(mount)
        self.text.joint(f"{mount}ed", "fixed", link, mount, T)
        return mount, pose * T

    def _piece(self, root: str, walk: Sequence[int]) -> tuple[str, RigidTransform]:
        """Hang joints from base or platform; return the last link and its pose."""
        link, pose = self._root(root)
        outward = root == "base"
        for i in walk:
            joint = self.joints[i]
            point = joint.point + self.layout.slid * self.rng.uniform(-1.0, 1.0) * joint.axis
            T = RigidTransform.from_components(point, Rotation.random(rng=self.rng))
            child = f"{joint.name}_link"
            if self.layout.cut == "bear" and i == len(self.joints) - 1:
                child, T = "platform", self.roots["platform"]
            flip = self.layout.flip_slider if joint.type == "prismatic" else self.layout.flip_axes
            axis = joint.axis * (-1.0 if flip else 1.0)
            if joint.type == "prismatic":
                axis = axis if outward else -axis
            if child != "platform":
                self.text.link(child, self._visual(i + 1 if outward else i, T))
            lower, upper = (-6.3, 6.3) if joint.type == "revolute" else (-0.2, 0.5)
            if joint.type == "prismatic" and self.layout.flip_slider:
                lower, upper = -upper, -lower
            self.text.joint(
                joint.name, joint.type, link, child, pose.inv() * T,
                f'<axis xyz="{numbers(T.rotation.inv().apply(axis))}"/>'
                f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>',
            )  # fmt: skip
            link, pose = child, T
        return link, pose

    def _visual(self, region: int, T: RigidTransform) -> str:
        """Return the cylinder of the tube or the rod, where a link is one of them."""
        ends = {self.n_lower: (self.leg.A, self.leg.A + 0.2 * self.leg.u)}
        if self.leg.kind != "constant" and self.n_upper:
            ends[self.n_lower + 1] = self.B - 0.15 * self.leg.u, self.B
        if region not in ends:
            return ""
        start, end = ends[region]
        shown = RigidTransform.from_components(0.5 * (start + end), _toward(self.leg.u))
        length = float(np.linalg.norm(end - start))
        return (
            f"<visual>{origin(T.inv() * shown)}<geometry>"
            f'<cylinder radius="0.01" length="{length!r}"/></geometry></visual>'
        )

    def _frame(self, link: str, pose: RigidTransform, end: str, T: RigidTransform) -> str:
        """Write a frame on a link and return its name."""
        name = f"{self.name}_{end}"
        self.text.link(name)
        self.text.joint(f"{name}_frame", "fixed", link, name, pose.inv() * T)
        return name


def _toward(direction: Array) -> Rotation:
    """Return a rotation whose z axis points along a direction."""
    e1, e2 = normal_basis(direction)
    return Rotation.from_matrix(np.column_stack([e1, e2, direction]))
