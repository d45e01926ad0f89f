"""Machines of the class, one function each, for many layouts; machines from tables."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from edits import GONE, keyed
from layouts import LegSpec, MachineSpec
from scipy.spatial.transform import RigidTransform, Rotation

import legcal
from legcal.descriptions.new_model import Created, Dimensions, create_model, description_of
from legcal.descriptions.table import described_machine
from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.machine.leg import Leg, LegKind, main_cylinders
from legcal.machine.model import Machine
from legcal.machine.model_writer import reload_and_check, write_calibrated_yaml, write_urdf

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
SHIPPED_YAML, SHIPPED_URDF = ROOT / "models" / "hexapod.yaml", ROOT / "urdf" / "hexapod.urdf"
HOME = RigidTransform.from_components([0.03, -0.02, 0.6], Rotation.from_rotvec([0.1, -0.15, 0.3]))


def ring(angles: list[float], radius: float, height: float = 0.0) -> Array:
    """Return points on a circle about z, angles in degrees."""
    a = np.deg2rad(angles)
    return np.stack([radius * np.cos(a), radius * np.sin(a), 0.0 * a + height], axis=1)


def of_types(types: list[str], kinds: list[str] | None = None, seed: int = 1) -> MachineSpec:
    """Return a machine with up to seven legs of these types between general points, on any axes."""
    of_joints, of_axes = (np.random.default_rng(seed) for _ in range(2))
    A = ring([10, 50, 130, 170, 250, 290, 0], 0.3) + of_joints.uniform(-0.02, 0.02, (7, 3))
    B = ring([-10, 70, 110, 190, 230, 310, 45], 0.2) + of_joints.uniform(-0.02, 0.02, (7, 3))
    B[6] *= 0.3
    B = HOME.apply(B)
    kinds = kinds or ["actuated"] * len(types)
    order = [0, 2, 4, 1, 3, 5, 6]
    legs = []
    for j, kind, leg_type in zip(order, kinds, types, strict=False):
        u = B[j] - A[j]
        axes = []
        for letter in (leg_type + " ")[:2]:
            axis = of_axes.normal(size=3)
            if letter == "R":
                axis = np.cross(u, axis)
            axes.append(axis / np.linalg.norm(axis))
        legs.append(LegSpec(leg_type, A[j], B[j], kind, axes[0], axes[1]))
    return MachineSpec(tuple(legs), HOME)


def planar(
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
    kinds: tuple[str, ...] = ("actuated",) * 3,
) -> MachineSpec:
    """Return a planar machine of RPR and RR legs that stand at different heights."""
    n_legs = len(kinds)
    n = np.array(normal) / np.linalg.norm(normal)
    turn = Rotation.align_vectors([n], [[0.0, 0.0, 1.0]])[0]
    angles = [200.0, 330.0, 95.0, 20.0][:n_legs]
    A = ring(angles, 0.4)
    B = ring([a + 12.0 for a in angles], 0.12)
    heights = np.array([0.0, 0.02, -0.015, 0.03])[:n_legs]
    A[:, 2] = B[:, 2] = heights
    B += [0.03, 0.02, 0.0]
    home = RigidTransform.from_components(
        turn.apply([0.03, 0.02, 0.0]), Rotation.from_rotvec(0.2 * n) * turn
    )
    legs = tuple(
        LegSpec("RR", turn.apply(a), turn.apply(b), kind, n, n)
        for a, b, kind in zip(A, B, kinds, strict=True)
    )
    return MachineSpec(legs, home, frame_legs=(0, 1), normal=n)


MACHINES: dict[str, Callable[[], MachineSpec]] = {
    "6-UPS": lambda: of_types(["US"] * 6),
    "6-SPS": lambda: of_types(["SS"] * 6),
    "3-RPR": planar,
    "3-RPR, tilted plane": lambda: planar((0.3, -0.5, 0.8)),
    "2-RPR with a rod": lambda: planar(kinds=("actuated", "constant", "actuated")),
    "3-UPU": lambda: of_types(["UU"] * 3),
    "3-RPS": lambda: of_types(["RS"] * 3),
    "3-SPR": lambda: of_types(["SR"] * 3),
    "Tricept": lambda: of_types(["SS", "SS", "SS", "U"], ["actuated"] * 3 + ["passive"]),
    "hexapod with a rod": lambda: of_types(["US"] * 6, ["actuated"] * 5 + ["constant"]),
    "hexapod with a strut": lambda: of_types(["US"] * 6 + ["SS"], ["actuated"] * 6 + ["passive"]),
}


def displaced(T: RigidTransform, step: Sequence[float] | Array) -> RigidTransform:
    """Return a pose after a rotation about its origin [rad] and a displacement [m], in the base."""
    turn = Rotation.from_rotvec(np.asarray(step)[:3])
    return RigidTransform.from_components(T.translation + np.asarray(step)[3:], turn * T.rotation)


def write_home(folder: Path, name: str, home: RigidTransform | None) -> Path:
    """Write the YAML of a shipped model with another home, or none, and return it."""
    path = copied_model(folder, name)
    keyed(path.name, legcal__home=GONE if home is None else motion_to_xyz_quat(home))(path.parent)
    return path


def copied_model(folder: Path, name: str, change: Callable[[str], str] = str) -> Path:
    """Copy the files of a shipped model, its URDF changed, and return the YAML."""
    model, urdf = folder / f"models/{name}.yaml", folder / f"urdf/{name}.urdf"
    for path in (model, urdf):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes((ROOT / path.relative_to(folder)).read_bytes())
    urdf.write_text(change(urdf.read_text()))
    return model


def by_hand(folder: Path, motors: Sequence[str] = ()) -> Path:
    """Copy the files of the shipped hexapod with some of its motors, and return the YAML."""
    path = copied_model(folder, "hexapod")
    keyed(path.name, name_mot=list(motors))(path.parent)
    return path


def written_with(
    nominal: Machine, legs: Sequence[Leg], folder: Path, home: RigidTransform | None = None
) -> Machine:
    """Write a model with other legs as a calibration writes it, and load it again."""
    folder.mkdir(exist_ok=True)
    write_urdf(nominal, legs, folder / "calibrated.urdf")
    write_calibrated_yaml(nominal, folder / "calibrated.yaml", "calibrated.urdf", home, legs)
    return reload_and_check(folder / "calibrated.yaml")


# Machines from tables


TRIPOD: dict[str, Any] = {
    "legcal_table": 1,
    "name": "tripod",
    "unit": "mm",
    "type": "3-RPS",
    "base_joints": [[300, 0, 0], [-150, 260, 0], [-150, -260, 0]],
    "platform_joints": [[180, 0, 0], [-90, 156, 0], [-90, -156, 0]],
    "offsets": 380,
    "travel": [0, 150],
    "radius": {"tube": 14, "rod": 9},
    "home": {"xyz": [0, 0, 440], "rpy_deg": [0, 0, 0]},
}


def write_table(folder: Path, **changes: Any) -> Path:
    """Write the tripod with some keys changed, or left out where they are None."""
    table = {key: value for key, value in (TRIPOD | changes).items() if value is not None}
    path = folder / "table.yaml"
    path.write_text(yaml.safe_dump(table, sort_keys=False))
    return path


def read_table(path: Path) -> Any:
    """Return what a table describes."""
    return description_of(path, Dimensions())


def regular(legs: str, platform_radius: float = 150.0) -> Any:
    """Return legs between two regular polygons, ``8-SPS``, 400 mm apart in space."""
    n, kind = int(legs.split("-")[0]), legs.split("-")[1]
    angles = np.linspace(0.0, 360.0, n, endpoint=False).tolist()
    flat = kind == "RPR"
    table = {
        "legcal_table": 1, "name": "regular", "unit": "mm", "type": legs, "radius": 8,
        "base_joints": ring(angles, 300.0).tolist(),
        "platform_joints": ring(angles, platform_radius).tolist(),
        "home": {"xyz": [0, 0, 0 if flat else 400], "rpy_deg": [0, 0, 30 * flat]},
    }  # fmt: skip
    if "P" in kind:
        low, high = (100, 300) if flat else (350, 530)
        table |= {"min_length": low, "max_length": high}
    return described_machine(table, Path("regular"))


def created_hexapod(folder: Path) -> Created:
    """Return a hexapod as ``legcal new --family hexapod`` writes it."""
    return legcal.new(
        output=folder,
        family="hexapod",
        unit="mm",
        base_radius=200,
        platform_radius=100,
        height=300,
        min_length=250,
        max_length=420,
    )


def delta_with_round_arms(radius: float = 8.0) -> Any:
    """Return the shipped Delta with arms that are cylinders [mm]."""
    table = yaml.safe_load((ROOT / "models/tables/delta.yaml").read_text())
    for motor in table["actuators"].values():
        motor["arm_radius"] = radius
    return described_machine(table, Path("delta"))


def made(folder: Path, **changes: Any) -> Machine:
    """Return the machine of a table with some keys changed, written as a model and loaded."""
    return create_model(read_table(write_table(folder, **changes)), folder).machine


def check_same(machine: Machine, description: Any) -> None:
    """Compare a loaded model with its description."""
    assert machine.name == description.name
    assert machine.leg_names == tuple(leg.name for leg in description.legs)
    for leg, entry in zip(machine.legs, description.legs, strict=True):
        assert leg.type == str(entry.type)
        assert leg.kind is entry.kind
        assert leg.sign == 1
        np.testing.assert_allclose(leg.A, entry.A_base, rtol=0, atol=1e-12)
        if entry.type.platform:
            np.testing.assert_allclose(leg.B, entry.B_platform, rtol=0, atol=1e-12)
            if entry.offset is not None:
                assert abs(leg.q0 - entry.offset) < 1e-12
        if (motor := entry.actuator) is not None:
            found = leg.actuator
            assert found is not None
            assert (found.joint, found.kind, found.link) == (motor.joint, motor.kind, motor.link)
            np.testing.assert_allclose(found.axis, motor.axis, rtol=0, atol=1e-15)
            np.testing.assert_allclose(found.travel, motor.travel, rtol=0, atol=1e-15)
            off = np.cross(found.point - motor.point, motor.axis) if motor.turns else 0.0
            assert np.linalg.norm(off) < 1e-12
        if entry.travel is not None:
            np.testing.assert_allclose(leg.travel, entry.travel, rtol=0, atol=1e-15)
        for axis, wanted in (
            (leg.base_axis, entry.base_axis),
            (leg.platform_axis, entry.platform_axis),
        ):
            if axis is not None and wanted is not None:
                assert np.linalg.norm(np.cross(axis, wanted)) < 1e-12
        parts = {c.side: c.radius for c in main_cylinders(leg.cylinders).values()}
        radii = {"base": entry.tube, "platform": entry.rod}
        if entry.kind is LegKind.CONSTANT:
            assert set(parts.values()) <= set(radii.values())
        elif entry.type.platform:
            assert parts == {side: radius for side, radius in radii.items() if radius is not None}


def exechon() -> MachineSpec:
    """Return a 2-UPR + SPR: legs 1 and 2 lie in a plane that turns about the line of their bases.

    Six freedoms less five constraints of joints would be one; two constraints follow from others.
    """
    A = np.array([[-0.21, 0.0, 0.0], [0.21, 0.0, 0.0], [0.0, 0.27, 0.0]])
    B = np.array([[-0.072, 0.0, 0.42], [0.084, 0.0, 0.42], [0.006, 0.09, 0.42]])
    tilt = Rotation.from_euler("x", -0.1)
    B[:2] = tilt.apply(B[:2])
    normal, u = tilt.apply([0.0, 1.0, 0.0]), B[2] - A[2]
    across = np.cross(normal, u) / np.linalg.norm(np.cross(normal, u))
    line = np.array([1.0, 0.0, 0.0])
    legs = (
        LegSpec("UR", A[0], B[0], "actuated", line, normal),
        LegSpec("UR", A[1], B[1], "actuated", line, normal),
        LegSpec("SR", A[2], B[2], "actuated", None, across),
    )
    return MachineSpec(legs, RigidTransform.from_components([0.0, 0.03, 0.4], tilt))


def exechon_and_ups() -> MachineSpec:
    """Return an :func:`exechon` with a fourth motor, one more than its freedoms."""
    machine = exechon()
    A, B, axis = np.array([[-0.05, -0.25, 0.0], [-0.02, -0.1, 0.41], [1.0, 0.0, 0.0]])
    more = LegSpec("US", A, B, base_axis=axis)
    return MachineSpec((*machine.legs, more), machine.home)


def two_upr_two_sps() -> MachineSpec:
    """Return the legs 1 and 2 of an :func:`exechon` with two SPS legs: four freedoms."""
    machine = exechon()
    one = LegSpec("SS", np.array([0.06, 0.27, 0.0]), np.array([0.03, 0.09, 0.41]))
    two = LegSpec("SS", np.array([-0.06, -0.24, 0.0]), np.array([-0.03, -0.09, 0.43]))
    return MachineSpec((*machine.legs[:2], one, two), machine.home)


def four_upu() -> MachineSpec:
    """Return four UPU legs, one of them passive, whose platform only translates."""
    A, B = ring([10, 100, 190, 290], 0.3), ring([20, 95, 185, 300], 0.15, 0.4)
    axes = np.array([[2.0, 0.3, 0.5], [-0.4, 2.0, 0.2], [2.0, -0.6, -0.3], [0.5, 1.8, -0.4]])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    legs = tuple(
        LegSpec("UU", a, b, kind, axis, axis)
        for a, b, axis, kind in zip(A, B, axes, ["actuated"] * 3 + ["passive"], strict=True)
    )
    return MachineSpec(legs, RigidTransform.from_translation([0.0, 0.0, 0.4]))
