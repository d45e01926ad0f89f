"""Machines that the method does not cover, and mistakes in those that it does, as files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from layouts import EYE, Layout, LegLayout, MachineSpec, Text, numbers, write_machine
from machines import exechon, of_types, planar
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array

Z = np.array([0.0, 0.0, 1.0])
Joint = tuple[str, Array, Array]  # type, point and axis in the base link
HEIGHT = 0.5


class Drawing:
    """A URDF with chains that hang from the base and are closed on the platform."""

    def __init__(self) -> None:
        self.text = Text()
        self.text.link("base")
        self.text.link("platform")
        self.text.joint("free", "floating", "base", "platform", EYE)
        self.loops: list[list[str]] = []
        self.kinds: list[str] = []
        self.legs: dict[str, str] = {}  # name and first joint
        self.motors: list[str] = []  # where they are not those first joints

    def chain(
        self,
        name: str,
        root: str,
        at: Array,
        joints: Sequence[Joint],
        *,
        end: Array,
        kind: str,
        on: tuple[str, Array] = ("platform", HEIGHT * Z),
    ) -> None:
        """Hang joints from a link whose origin is at a point; close at ``end``, on the platform."""
        link, origin = root, at
        for i, (joint, point, axis) in enumerate(joints):
            child = f"{name}_{i}"
            self.add(child, joint, link, point - origin, axis)
            link, origin = child, point
        self.add(f"{name}_end", "fixed", link, end - origin)
        self.add(f"{name}_seat", "fixed", on[0], end - on[1])
        self.loops.append([f"{name}_end", f"{name}_seat"])
        self.kinds.append(kind)

    def add(self, name: str, kind: str, parent: str, xyz: Array, axis: Array | None = None) -> None:
        """Add a link and the joint that carries it."""
        self.text.link(name)
        moving = ""
        if axis is not None:
            limit = '<limit lower="-0.3" upper="0.5" effort="1" velocity="1"/>'
            moving = f'<axis xyz="{numbers(axis)}"/>{limit}'
        T = RigidTransform.from_translation(xyz)
        self.text.joint(f"j_{name}", kind, parent, name, T, moving)

    def write(self, folder: Path, *, driven: bool = True) -> Path:
        """Write the files, with motors if they are driven."""
        document: dict[str, object] = {
            "closed_loop": self.loops, "type": self.kinds,
            "name_mot": (self.motors or list(self.legs.values())) if driven else [],
            "legcal": {
                "version": 1, "base": "base", "platform": "platform", "platform_joint": "free",
                "home": {"xyz": [0, 0, HEIGHT], "quat_xyzw": [0, 0, 0, 1]}, "legs": self.legs,
            },
        }  # fmt: skip
        (folder / "machine.urdf").write_text(self.text.robot("r"))
        (folder / "machine.yaml").write_text(yaml.safe_dump(document))
        return folder / "machine.yaml"


def _around(j: int, radius: float, height: float) -> tuple[Array, Array]:
    """Return a point of three around z, and the tangent there."""
    turn = Rotation.from_euler("z", 120.0 * j, degrees=True)
    return turn.apply([radius, 0.0, height]), turn.apply([0.0, 1.0, 0.0])


def _arm(
    drawing: Drawing, j: int, points: Array, axis: Array, on: tuple[str, Array] | None = None
) -> None:
    """Add an arm that turns about an axis at the first of points, and two rods to the last."""
    pivot, elbow, end = points
    drawing.add(f"arm{j}", "revolute", "base", pivot, axis)
    drawing.motors.append(f"j_arm{j}")
    for k, out in enumerate((-0.03 * axis, 0.03 * axis)):
        inner, name = np.cross(axis, end - elbow), f"rod{j}{k}"
        inner /= np.linalg.norm(inner)
        rod: list[Joint] = [("revolute", elbow + out, line) for line in (axis, inner)]
        at = on or ("platform", HEIGHT * Z)
        drawing.chain(name, f"arm{j}", pivot, rod, end=end + out, kind="3d", on=at)
        drawing.legs[name] = f"j_{name}_0"


def _couplers() -> Drawing:
    """Return a Delta whose parallelograms end on bars that turn on the platform."""
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (elbow, _) = _around(j, 0.2, 0.0), _around(j, 0.35, 0.1)
        end = _around(j, 0.05, HEIGHT)[0]
        drawing.add(f"bar{j}", "revolute", "platform", end - HEIGHT * Z, axis)
        _arm(drawing, j, np.array([pivot, elbow, end]), axis, (f"bar{j}", end))
    return drawing


def _bars(joint: str, n_bars: int) -> Drawing:
    """Return four arms whose rods end on the platform, or on bars that a joint connects to it.

    With two hinges they are those of an H4, with one guide those of an I4.
    """
    drawing = Drawing()
    at = [np.array([0.0, 0.1 * i - 0.05, HEIGHT]) for i in range(n_bars)]
    for i in range(n_bars):
        drawing.add(f"bar{i}", joint, "platform", at[i] - HEIGHT * Z, Z)
    for j in range(4):
        turn, i = Rotation.from_euler("z", 90.0 * j + 45.0, degrees=True), j // 2
        points = turn.apply([[0.2, 0, 0], [0.35, 0, 0.1], [0.05, 0, HEIGHT]])
        on = (f"bar{i}", at[i]) if i < n_bars else None
        _arm(drawing, j, points, turn.apply([0.0, 1.0, 0.0]), on)
    return drawing


def _planar_arms() -> Drawing:
    drawing = Drawing()
    for j in range(3):
        points = [_around(j, radius, 0.0)[0] for radius in (0.3, 0.35, 0.1)]
        joints: list[Joint] = [("revolute", point, Z) for point in points]
        drawing.chain(f"arm{j}", "base", np.zeros(3), joints, end=points[-1], kind="6d")
        drawing.legs[f"arm{j}"] = f"j_arm{j}_0"
    return drawing


def _stiff_arms() -> Drawing:
    """Return arms on motors that reach the joint on the platform without a rod between."""
    drawing = Drawing()
    for j in range(3):
        (pivot, axis), (end, _) = _around(j, 0.2, 0.0), _around(j, 0.05, HEIGHT)
        drawing.add(f"arm{j}", "revolute", "base", pivot, axis)
        drawing.motors.append(f"j_arm{j}")
        joints: list[Joint] = [("revolute", end, axis), ("revolute", end, Z)]
        drawing.chain(f"end{j}", f"arm{j}", pivot, joints, end=end, kind="3d")
        drawing.legs[f"leg{j}"] = f"j_end{j}_0"
    return drawing


def _hinges() -> Drawing:
    drawing = Drawing()
    for j in range(3):
        point, axis = _around(j, 0.3, HEIGHT)
        hinge: list[Joint] = [("revolute", point, axis)]
        drawing.chain(f"leg{j}", "base", np.zeros(3), hinge, end=point, kind="6d")
        drawing.legs[f"leg{j}"] = f"j_leg{j}_0"
    return drawing


def _with_leg(machine: MachineSpec, j: int, **changes: object) -> MachineSpec:
    leg = replace(machine.legs[j], **changes)  # type: ignore[arg-type]
    return replace(machine, legs=(*machine.legs[:j], leg, *machine.legs[j + 1 :]))


def missing(types: str, by: float) -> MachineSpec:
    """Return a machine whose second slider does not point at its joint, by so much [m]."""
    machine = of_types([types] * 3)
    leg = machine.legs[1]
    assert leg.base_axis is not None
    across = np.cross(leg.u, leg.base_axis)
    moved = leg.B_home + by * across / np.linalg.norm(across)
    return _with_leg(machine, 1, B_home=moved, slides=leg.u)


def _axis_off(types: str, angle: float) -> MachineSpec:
    """Return a machine whose first leg has a base axis (of R) or inner axis (of U) off square."""
    machine = of_types([types] * 3)
    leg = machine.legs[0]
    assert leg.base_axis is not None
    if types == "RS":
        return _with_leg(
            machine, 0, base_axis=np.cos(angle) * leg.base_axis + np.sin(angle) * leg.u
        )
    inner = np.cross(leg.base_axis, leg.u)
    inner /= np.linalg.norm(inner)
    towards = leg.base_axis if types == "US" else np.cross(leg.base_axis, inner)
    return _with_leg(machine, 0, base_inner=np.cos(angle) * inner + np.sin(angle) * towards)


def _turned_exechon(angle: float) -> MachineSpec:
    """Return an Exechon whose first axis at the base is off its place [rad]."""
    machine = exechon()
    axis = np.array(machine.legs[0].base_axis) + angle * Z
    return _with_leg(machine, 0, base_axis=axis / np.linalg.norm(axis))


def _of_nine_decimals(folder: Path) -> Path:
    path = write_machine(folder, exechon(), Layout())
    urdf = path.with_suffix(".urdf")
    urdf.write_text(re.sub(r"-?\d\.\d{9,}", lambda x: f"{float(x[0]):.9f}", urdf.read_text()))
    return path


def scaled(machine: MachineSpec, scale: float) -> MachineSpec:
    legs = tuple(replace(leg, A=scale * leg.A, B_home=scale * leg.B_home) for leg in machine.legs)
    home = RigidTransform.from_components(
        scale * np.asarray(machine.home.translation), machine.home.rotation
    )
    return MachineSpec(legs, home)


Machine = Callable[[Path], Path]  # writes machine.yaml and machine.urdf, and returns the former


def _drawn(drawing: Callable[[], Drawing], *, driven: bool = True) -> Machine:
    return lambda folder: drawing().write(folder, driven=driven)


def _specified(machine: Callable[[], MachineSpec], layout: Layout | None = None) -> Machine:
    return lambda folder: write_machine(folder, machine(), layout or Layout())


def _replaced(written: Machine, *changes: tuple[str, str], yaml: bool = False) -> Machine:
    """Return a machine in one of whose files something is replaced."""

    def write(folder: Path) -> Path:
        path = written(folder)
        target = path if yaml else path.with_suffix(".urdf")
        text = target.read_text()
        for old, new in changes:
            assert old in text, old
            text = text.replace(old, new, 1)
        target.write_text(text)
        return path

    return write


def _open_across_its_plane(folder: Path) -> Path:
    path = write_machine(folder, planar(), Layout(virtual="planar"))
    urdf = path.with_suffix(".urdf")
    head, tail = urdf.read_text().split('<child link="leg2_seat"/><origin xyz="')
    xyz, rest = tail.split('"', 1)
    x, y, z = xyz.split()
    moved = f"{x} {y} {float(z) + 1e-3}"
    urdf.write_text(f'{head}<child link="leg2_seat"/><origin xyz="{moved}"{rest}')
    return path


def _in_another_plane(folder: Path) -> Path:
    path = write_machine(folder, planar((0.0, 0.6, 0.8)), Layout(virtual="planar"))
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    start = text.index("<origin", text.index('name="platform_free"'))
    urdf.write_text(text[:start] + '<origin xyz="0 0 0"' + text[text.index("/>", start) :])
    return path


TRIPOD = partial(of_types, ["US"] * 3)


def _carried_by_a_leg() -> Machine:
    extra = (
        '<joint name="p" type="floating"><parent link="leg1_a1_link"/><child link="platform"/>'
        "</joint></robot>"
    )
    below = '<parent link="base"/><child link="{}"/>'
    written = _replaced(
        _specified(TRIPOD),
        ('name="platform_free" type="floating"', 'name="free" type="fixed"'),
        (below.format("platform"), below.format("spare")),
        ("</robot>", f'<link name="spare"/>{extra}'),
    )
    return _replaced(written, ("platform_joint: platform_free", "platform_joint: p"), yaml=True)


def _on_one_line() -> MachineSpec:
    machine = of_types(["US"] * 6)
    legs = [replace(leg, A=np.array([0.1 * j, 0.0, 0.0])) for j, leg in enumerate(machine.legs[:3])]
    return replace(machine, legs=(*legs, *machine.legs[3:]))


PLANE = ("a planar machine of arms", "axes are parallel", "cannot be calibrated")
LOOP = ("a loop inside the leg", "'j_arm0'", "as a leg of its own")
SEVERAL = ("a platform of several bodies", "H4 or I4", "legs end on link 'bar", "joint 'j_bar0'")
OFF_AXIS = "from perpendicular to the leg"

OUTSIDE: dict[str, tuple[Machine, tuple[str, ...]]] = {
    "hinges": (_drawn(_hinges, driven=False), ("directly between base and platform",)),
    "i4": (_drawn(partial(_bars, "prismatic", 1)), SEVERAL),
    "delta-of-four": (
        _drawn(partial(_bars, "revolute", 0)),
        ("overconstrained machine (1 of the 4", "moving joints at A"),
    ),
    "stiff-arms": (
        _drawn(_stiff_arms),
        ("the leg of motor 'j_arm0'", "beyond it", "at each end; this machine cannot"),
    ),
    "couplers": (_drawn(_couplers), LOOP),
    "3-rrr": (_drawn(_planar_arms), PLANE),
    **{
        f"slider-off-{types}": (
            _specified(partial(missing, types, 0.002)),
            ("'leg2_slider'", "by 2 mm", "needed at most 0.01"),
        )
        for types in ("RS", "UU")
    },
    "r-off": (_specified(lambda: _axis_off("RS", 0.1)), ("'leg1_a1'", f"5.73 deg {OFF_AXIS}")),
    "inner-axis-off": (
        _specified(lambda: _axis_off("UU", 0.1)),
        ("'leg1_a2'", OFF_AXIS, "inner axis of a U"),
    ),
    "u-off": (_specified(lambda: _axis_off("US", 0.02)), ("'leg1_a1' and 'leg1_a2'", "1.146 deg")),
    "one-leg": (_specified(lambda: of_types(["US"])), ("1 leg in space", "at least 3")),
    "too-many": (
        _specified(lambda: replace(TRIPOD(), legs=TRIPOD().legs * 11)),
        ("33 legs", "at most 32"),
    ),
    "fixed-in-a-plane": (
        _specified(lambda: _with_leg(planar(), 2, type="R", platform_axis=None)),
        ("'leg3_slider'", "fixed to the platform"),
    ),
    "spin": (
        _specified(partial(of_types, ["RR"] * 3), Layout((LegLayout(spin="base"),))),
        ("'leg1_spin' along the leg, and no S joint",),
    ),
    "turning-motor": (
        _replaced(_specified(planar), ("- leg2_slider\n", "- leg2_a1\n"), yaml=True),
        (
            "found the slider 'leg2_slider' beyond the motor 'leg2_a1' on the base",
            "name only one of 'leg2_a1' and 'leg2_slider'",
        ),
    ),
    "open-plane": (
        _open_across_its_plane,
        ("'leg2_end' and 'leg2_seat' 1 mm and 0.000 deg apart",),
    ),
    "another-plane": (_in_another_plane, ("from the plane in which the legs move",)),
    "carried-by-a-leg": (
        _carried_by_a_leg(),
        ("found it between the parent 'leg1_a1_link'",),
    ),
    "scaled-1000-no-home": (
        _specified(partial(scaled, of_types(["US"] * 6), 1e3), Layout(home=False)),
        ("write all lengths",),
    ),
    "exechon-nearly": (
        _specified(partial(_turned_exechon, 1e-6)),
        ("'machine'", "2 of the 5 constraints of its joints follow from the others to 1 mrad"),
    ),
    "exechon-off": (
        _specified(partial(_turned_exechon, 0.02)),
        ("'machine'", "overconstrained machine (1 of the 5 constraints", "mobility 2"),
    ),
    "exechon-digits": (_of_nine_decimals, ("2 of the 5 constraints", "with all digits")),
    "on-one-line": (_specified(_on_one_line), ("base joints of leg1, leg2, leg3",)),
}
"""What each of them must be told: the reason, the joint or leg, and the amount."""
