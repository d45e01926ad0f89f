"""What a person asks for: a table, or a family with its dimensions."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import LegcalError, ModelError, OutOfResources, UsageError
from legcal.files import motion_to_xyz_quat, plain_name, temporary_folder
from legcal.geometry import Array, frame_on_points, motion_of
from legcal.machine.description import (
    NEEDED_TYPE,
    Description,
    Home,
    LegEntry,
    LegType,
    leg_type,
    wrong_axes,
    wrong_lengths,
    wrong_sizes,
)
from legcal.machine.description_table import in_metres, read_description
from legcal.machine.leg import MOST_LEGS, LegKind
from legcal.machine.load import load_mechanism
from legcal.machine.model import Mechanism
from legcal.machine.schema import mechanism_yaml
from legcal.machine.tree import TreeText, along, limit, place, visual

TRIALS = 40
EVALUATIONS = 60  # of the closure in each trial; good starts need about ten
CLOSED = 1e-10  # of the size of the machine
SETTLED = 1e-13
FAR = 0.01  # of the size: a home written with few digits is nearer


def find_home(described: Description) -> Home:
    """Return a pose in which a machine closes, moved onto what its legs keep constant.

    Without a given one it is the pose where all motors are at the middle of their travel that
    turns the platform least; of mirror images in the plane of the base joints the one on the
    positive side of z is taken.
    """
    if described.home is not None:
        return _settle(described, described.home)
    closure = _Closure(described, mid_travel=True)
    found = _search(closure, turning=False) or _search(closure, turning=True)
    if found is None:
        raise ModelError(
            f"{described.source}: no home was found: no pose has all motors at the middle of "
            "their travel with their axes in place, needed a pose in which the machine closes; "
            "write home, or correct the joints, offsets or travel."
        )
    return found


class _Closure:
    """What must vanish at home, as a function of three coordinates [m] and a rotation vector."""

    def __init__(self, described: Description, *, mid_travel: bool) -> None:
        legs = described.legs
        self.A = np.array([leg.A_base for leg in legs])
        self.B = np.array([leg.B_platform for leg in legs])
        self.size = float(max(np.ptp(self.A, axis=0).max(), np.ptp(self.B, axis=0).max(), 1e-3))
        self._legs = legs
        self._planar = all((leg.type.base, leg.type.platform) == ("R", "R") for leg in legs)
        self.wanted = np.full(len(legs), np.nan)
        for j, leg in enumerate(legs):
            if leg.kind is LegKind.CONSTANT:
                self.wanted[j] = np.nan if leg.offset is None else leg.offset
            elif mid_travel and leg.kind is LegKind.ACTUATED and leg.travel is not None:
                self.wanted[j] = (leg.offset or 0.0) + 0.5 * sum(leg.travel)
        known = self.wanted[np.isfinite(self.wanted)]
        self.size = max(self.size, float(known.max(initial=0.0)))

    def residual(self, T: RigidTransform) -> Array:
        """Return lengths and axes that are off, as parts of the machine's size."""
        vectors = T.apply(self.B) - self.A
        lengths = np.linalg.norm(vectors, axis=1)
        held = np.isfinite(self.wanted)
        rows = [(lengths - self.wanted)[held] / self.size]
        for leg, vector in zip(self._legs, vectors, strict=True):
            axes = self._axes(leg.base_axis, leg.platform_axis, T)
            for letter, axis in zip((leg.type.base, leg.type.platform), axes, strict=True):
                if letter == "R" and axis is not None:
                    rows.append(np.array([axis @ vector]) / self.size)
            if self._planar:
                rows.append(np.cross(axes[0], axes[1]))  # type: ignore[arg-type]
        return np.concatenate(rows)

    def misfits(self, T: RigidTransform) -> list[str]:
        """Return what is off at a pose, in words."""
        found = []
        for leg, wanted, vector in zip(
            self._legs, self.wanted, T.apply(self.B) - self.A, strict=True
        ):
            length = float(np.linalg.norm(vector))
            if abs(length - wanted) > CLOSED * self.size:
                found.append(
                    f"leg '{leg.name}' {1e3 * length:.6g} mm long instead of {1e3 * wanted:.6g} mm"
                )
            axes = self._axes(leg.base_axis, leg.platform_axis, T)
            for side, axis in zip(("base", "platform"), axes, strict=True):
                if getattr(leg.type, side) != "R" or axis is None:
                    continue
                angle = np.degrees(np.arccos(min(1.0, abs(float(axis @ vector)) / length)))
                if 90.0 - angle > 1e-6:
                    found.append(
                        f"the {side} axis of leg '{leg.name}' at {angle:.4g} deg to the leg "
                        "instead of 90 deg, which an R joint needs,"
                    )
        return found or ["axes of a planar mechanism that are not parallel"]

    def _axes(
        self, base: Array | None, platform: Array | None, T: RigidTransform
    ) -> tuple[Array | None, Array | None]:
        """Return the given axes in the base; in the plane also the default ones."""
        if self._planar:
            z = np.array([0.0, 0.0, 1.0])
            base, platform = (z if axis is None else axis for axis in (base, platform))
        if platform is not None:
            platform = np.asarray(T.rotation.apply(platform))
        return base, platform


def _settle(described: Description, home: Home) -> Home:
    """Return the pose nearest to home that closes where legs leave no choice."""
    closure = _Closure(described, mid_travel=False)
    T = home.motion()
    miss = closure.residual(T)
    if np.abs(miss).max(initial=0.0) < SETTLED:
        return home
    if np.abs(miss).max() < FAR:
        T = _polished(closure, T)
        miss = closure.residual(T)
    if np.abs(miss).max() < CLOSED:
        return _written(T)
    raise ModelError(
        [
            f"{described.source}: home could not be used: found {found} there, needed a pose in "
            "which the machine closes; correct home, lengths or axes."
            for found in closure.misfits(home.motion())
        ]
    )


def _polished(closure: _Closure, T: RigidTransform) -> RigidTransform:
    """Return the nearest pose that closes, as far as steps get nearer to one."""
    miss = closure.residual(T)
    for _ in range(30):
        step = np.linalg.lstsq(_jacobian(closure, T), miss, rcond=1e-9)[0]
        moved = _moved(T, np.asarray(-step), closure.size)
        if np.abs(closure.residual(moved)).max() >= np.abs(miss).max():
            break
        T, miss = moved, closure.residual(moved)
    return T


def _search(closure: _Closure, *, turning: bool) -> Home | None:
    """Return the best of the poses that seeded starts find; without turning first."""
    rng = np.random.default_rng(1965)
    centre = closure.A.mean(axis=0) - closure.B.mean(axis=0)
    n_free = 6 if turning else 3

    def pose(x: Array) -> RigidTransform:
        turn = np.zeros(3) if n_free == 3 else x[3:]
        return motion_of(Rotation.from_rotvec(turn).as_matrix(), closure.size * x[:3])

    def misfit(x: Array) -> Array:
        return closure.residual(pose(x))

    best: tuple[float, RigidTransform] | None = None
    for trial in range(TRIALS if turning else 8):
        shift = rng.normal(0.0, 1.0, 3) if trial else np.array([0.0, 0.0, 1.0])
        start = np.concatenate([centre / closure.size + shift, rng.normal(0.0, 0.3, n_free - 3)])
        fit = least_squares(misfit, start, xtol=1e-15, gtol=1e-15, max_nfev=EVALUATIONS)
        if np.abs(fit.fun).max(initial=0.0) > CLOSED:
            continue
        T = pose(fit.x)
        below = float((T.apply(closure.B) - closure.A).mean(axis=0)[2]) < -1e-9
        rank = 10.0 * below + float(T.rotation.magnitude())
        if best is None or rank < best[0] - 1e-6:
            best = rank, T
        if best[0] < 10.0 and trial > (15 if turning else 0):
            break
    return None if best is None else _written(_polished(closure, best[1]))


def _jacobian(closure: _Closure, T: RigidTransform) -> Array:
    """Return the change of what must vanish with a small motion, by central differences."""
    h = 1e-6
    columns = [
        closure.residual(_moved(T, step, closure.size))
        - closure.residual(_moved(T, -step, closure.size))
        for step in h * np.eye(6)
    ]
    return np.column_stack(columns) / (2.0 * h)


def _moved(T: RigidTransform, step: Array, size: float) -> RigidTransform:
    """Return a pose moved by parts of a size and turned by a rotation vector [rad]."""
    turn = Rotation.from_rotvec(step[3:])
    return motion_of((turn * T.rotation).as_matrix(), T.translation + size * step[:3])


def _written(T: RigidTransform) -> Home:
    """Return a computed pose, the rounding noise of its zeros left out."""
    entry = motion_to_xyz_quat(T)
    clean = {key: [x if abs(x) > 1e-13 else 0.0 for x in value] for key, value in entry.items()}
    return Home(tuple(clean["xyz"]), tuple(clean["quat_xyzw"]))


PARALLEL = 1e-9
FREE_TRAVEL = (0.5, 1.5)  # of the length at home, for passive sliders without limits


@dataclass(frozen=True, eq=False)
class AssembledLeg:
    """A leg of which everything is known."""

    name: str  # as described, see :class:`legcal.machine.description.LegEntry`
    type: LegType  # as described, see :class:`legcal.machine.description.LegEntry`
    kind: LegKind  # as described, see :class:`legcal.machine.description.LegEntry`
    A_base: Array  # (3,) joint centres in the base and the platform link [m]
    B_platform: Array  # (3,) joint centres in the base and the platform link [m]
    u: Array  # (3,) direction from A to B at home, in the base link
    q0: float  # length at reading zero, or of a constant leg [m]
    travel: tuple[float, float]  # lowest and highest reading [m]; (0, 0) for a constant leg
    tube: float | None  # as described, see :class:`legcal.machine.description.LegEntry`
    rod: float | None  # as described, see :class:`legcal.machine.description.LegEntry`
    base_axis: Array  # (3,) axes of R and outer axes of U, both in the base link at home
    platform_axis: Array  # (3,) axes of R and outer axes of U, both in the base link at home

    @property
    def shortest_shown(self) -> float:
        """The length at reading zero, or at the reading nearest to it within the travel [m]."""
        return self.q0 + min(max(0.0, self.travel[0]), self.travel[1])


@dataclass(frozen=True, eq=False)
class Assembled:
    """A machine of which everything is known."""

    name: str  # its name
    legs: tuple[AssembledLeg, ...]  # in order
    home: Home  # a pose in which it closes, as the file gets it
    base_frame: tuple[str, ...]  # the legs whose joints define R_b and R_e
    planar: bool  # whether it moves in the xy plane of base and platform

    @property
    def T_base_platform(self) -> RigidTransform:
        """The home pose."""
        return self.home.motion()


def assemble(described: Description) -> Assembled:
    """Return a described machine with its home, lengths and axes."""
    _refuse(wrong_sizes(described))
    home = find_home(described)
    T = home.motion()
    A = np.array([leg.A_base for leg in described.legs])
    B = T.apply(np.array([leg.B_platform for leg in described.legs]))
    lengths = np.linalg.norm(B - A, axis=1)
    _refuse(wrong_lengths(described, lengths))
    u = (B - A) / lengths[:, None]
    tangents = np.array([across_leg(u[j], A[j] - A.mean(axis=0)) for j in range(len(A))])
    if all_revolute(described):
        tangents[:] = [0.0, 0.0, 1.0]
    legs, problems = [], []
    for j, entry in enumerate(described.legs):
        axes = _axes(entry, tangents[j], T)
        problems += wrong_axes(described, entry, u[j], axes)
        q0, travel = _law(entry, float(lengths[j]))
        legs.append(
            AssembledLeg(
                entry.name, entry.type, entry.kind, entry.A_base, entry.B_platform, u[j], q0,
                travel, entry.tube, entry.rod, *axes,
            )
        )  # fmt: skip
    _refuse(problems)
    planar = all_revolute(described) and is_planar(legs, T)
    frame = _base_frame(described, 2 if _in_a_plane(legs) else 3)
    return Assembled(described.name, tuple(legs), home, frame, planar)


def all_revolute(described: Description) -> bool:
    """Say whether all joints are R, as in planar mechanisms."""
    return all((leg.type.base, leg.type.platform) == ("R", "R") for leg in described.legs)


def _in_a_plane(legs: Sequence[AssembledLeg]) -> bool:
    """Say whether all axes are parallel revolutes across all legs."""
    n = legs[0].base_axis
    return all(
        (leg.type.base, leg.type.platform) == ("R", "R")
        and np.linalg.norm(np.cross(axis, n)) < PARALLEL
        and abs(leg.u @ n) < PARALLEL
        for leg in legs
        for axis in (leg.base_axis, leg.platform_axis)
    )


def is_planar(legs: Sequence[AssembledLeg], T: RigidTransform) -> bool:
    """Say whether the plane of motion is the xy plane of base and platform link."""
    z = np.array([0.0, 0.0, 1.0])
    upright = np.linalg.norm(np.cross(legs[0].base_axis, z)) < PARALLEL
    return _in_a_plane(legs) and bool(upright) and bool(T.rotation.apply(z)[2] > 1.0 - 1e-15)


def across_leg(u: Array, outward: Array) -> Array:
    """Return the horizontal direction across a leg; across the way outward for upright legs."""
    z = np.array([0.0, 0.0, 1.0])
    for other in (u, outward, np.array([1.0, 0.0, 0.0])):
        across = np.cross(z, other)
        if np.linalg.norm(across) > 1e-6 * max(1.0, float(np.linalg.norm(other))):
            across = across - (across @ u) * u
            return np.asarray(across / np.linalg.norm(across))
    return np.array([0.0, 1.0, 0.0])


def _axes(entry: LegEntry, tangent: Array, T: RigidTransform) -> tuple[Array, Array]:
    """Return the axes of a leg at base and platform, both in the base link."""
    base = tangent if entry.base_axis is None else entry.base_axis
    platform = tangent
    if entry.platform_axis is not None:
        platform = np.asarray(T.rotation.apply(entry.platform_axis))
    return base, platform


def _law(entry: LegEntry, length: float) -> tuple[float, tuple[float, float]]:
    """Return length at reading zero and travel of a leg [m]."""
    if entry.kind is LegKind.CONSTANT:
        return length if entry.offset is None else entry.offset, (0.0, 0.0)
    q0 = 0.0 if entry.offset is None else entry.offset
    free = (FREE_TRAVEL[0] * length - q0, FREE_TRAVEL[1] * length - q0)
    return q0, free if entry.travel is None else entry.travel


def _base_frame(described: Description, count: int) -> tuple[str, ...]:
    """Return the legs that define the frames: as told, or 1, 3, 5 of six, or the first that can."""
    legs = described.legs
    if described.base_frame is not None:
        names = [leg.name for leg in legs]
        told = [names.index(name) for name in described.base_frame]
        if len(told) != count or _degenerate(described, told):
            raise ModelError(
                f"{described.source}: base_frame could not be used: found "
                f"{', '.join(described.base_frame)}, needed {count} legs whose joints on base and "
                "platform are not in one point or on one line; choose others, or leave it out."
            )
        return described.base_frame
    combos = list(combinations(range(len(legs)), count))
    if len(legs) == 6 and count == 3:
        combos.insert(0, (0, 2, 4))
    for chosen in combos:
        if not _degenerate(described, chosen):
            return tuple(legs[j].name for j in chosen)
    raise ModelError(
        f"{described.source}: the frames of base and platform could not be built: found the joints "
        f"of the base or of the platform all in one point or on one line, needed {count} legs "
        "whose joints span them; correct base_joints or platform_joints."
    )


def _degenerate(described: Description, chosen: Sequence[int]) -> bool:
    """Say whether the joints of some legs define no frame."""
    try:
        for side in ("A_base", "B_platform"):
            frame_on_points(np.array([getattr(described.legs[j], side) for j in chosen]))
    except ValueError:
        return True
    return False


def _refuse(problems: list[str]) -> None:
    """Raise all problems at once, if there are any."""
    if problems:
        raise ModelError(problems)


TURN = (-3.15, 3.15)  # [rad]
VISIBLE = 0.9  # part of the shortest leg that its tube and its rod cover
_AXES = {letter: along(axis) for letter, axis in zip("xyz", np.eye(3), strict=True)}


def urdf_text(machine: Assembled) -> str:
    """Return the URDF of a machine: all its geometry."""
    tree = TreeText()
    tree.link("base")
    tree.link("platform")
    if machine.planar:
        height = np.array([0.0, 0.0, machine.T_base_platform.translation[2]])
        _joint(tree, "platform_free", "planar", ("base", "platform"), height, moving=_AXES["z"])
    else:
        _joint(tree, "platform_free", "floating", ("base", "platform"))
    for leg in machine.legs:
        _Branch(tree, machine, leg).write()
    return tree.robot(machine.name).decode()


def yaml_text(machine: Assembled) -> str:
    """Return the mechanism YAML of a machine: closures, motors, legs and home."""
    return mechanism_yaml(
        [
            (f"{leg.name}_end", f"{leg.name}_seat", "3d" if leg.type.has_sphere else "6d")
            for leg in machine.legs
        ],
        [f"{leg.name}_prismatic" for leg in machine.legs if leg.kind is LegKind.ACTUATED],
        {
            "urdf": f"../urdf/{machine.name}.urdf",
            "base": "base",
            "platform": "platform",
            "platform_joint": "platform_free",
            "base_frame": list(machine.base_frame),
            "home": {"xyz": list(machine.home.xyz), "quat_xyzw": list(machine.home.quat_xyzw)},
            "legs": {leg.name: _joint_of(leg) for leg in machine.legs},
        },
    )


def _hangs_from_base(leg: AssembledLeg) -> bool:
    """Say whether a leg hangs from the base, and not from the platform with its S at the base."""
    return leg.type.base != "S" or leg.type.platform == "S"


def _joint_of(leg: AssembledLeg) -> str:
    """Return the joint that names a leg in the YAML."""
    if leg.kind is LegKind.CONSTANT:
        return f"{leg.name}_a1" if _hangs_from_base(leg) else f"{leg.name}_b1"
    return f"{leg.name}_prismatic"


def _joint(
    tree: TreeText,
    name: str,
    kind: str,
    links: tuple[str, str],
    xyz: Array | None = None,
    rotation: Array | None = None,
    moving: str = "",
) -> None:
    """Connect two links; without numbers their frames coincide."""
    at = place(np.zeros(3) if xyz is None else xyz, np.eye(3) if rotation is None else rotation)
    tree.connect(name, kind, links, at + moving)


class _Branch:
    """One leg, from the link that it hangs from to the frames that close its loop."""

    def __init__(self, tree: TreeText, machine: Assembled, leg: AssembledLeg) -> None:
        self._tree, self._leg = tree, leg
        self._from_base = _hangs_from_base(leg)
        self._R_base_platform = machine.T_base_platform.rotation.as_matrix()
        self._T = machine.T_base_platform
        self._link = "base" if self._from_base else "platform"
        self._along = np.zeros(3)  # where the next joint stands in the link before it

    def write(self) -> None:
        """Add the leg to the tree."""
        leg = self._leg
        if self._from_base:
            R = self._near("a", leg.type.base, leg.u, leg.base_axis, leg.A_base)
        else:
            inverse = self._R_base_platform.T
            axis = inverse @ leg.platform_axis
            R = self._near("b", leg.type.platform, -inverse @ leg.u, axis, leg.B_platform)
        self._half(near=True)
        if leg.kind is LegKind.CONSTANT:
            self._along = np.array([0.0, 0.0, leg.q0])
        else:
            far = f"{leg.name}_{'rod' if self._from_base else 'tube'}"
            offset = np.array([0.0, 0.0, leg.q0])
            self._to(f"{leg.name}_prismatic", "prismatic", far, offset, None, "z", leg.travel)
            self._half(near=False)
        if self._from_base and not leg.type.has_sphere:
            R = self._far(R)
        self._close(R)

    def _near(self, side: str, letter: str, u: Array, axis: Array, at: Array) -> Array:
        """Add the joint that a leg hangs from, and return the frame of the leg there."""
        y = _unit(np.cross(u, axis))
        along = np.column_stack([np.cross(y, u), y, u])
        first = np.column_stack([axis, y, np.cross(axis, y)]) if letter == "U" else along
        self._turn(f"{side}1", at, first, "x")
        if letter == "U":
            self._turn(f"{side}2", None, first.T @ along, "y")
        if letter == "S":
            self._turn(f"{side}2", None, None, "y")
            self._turn(f"{side}3", None, None, "z")
        return along

    def _far(self, R: Array) -> Array:
        """Add the joint at the platform of a leg without S, and return the frame after it."""
        leg = self._leg
        if leg.type.platform == "":
            return R
        y = _unit(np.cross(leg.u, leg.platform_axis))
        along = np.column_stack([np.cross(y, leg.u), y, leg.u])
        if leg.type.platform == "R":
            self._turn("b1", self._along, R.T @ along, "x")
            return along
        last = np.column_stack([leg.platform_axis, y, np.cross(leg.platform_axis, y)])
        self._turn("b2", self._along, R.T @ along, "y")
        self._turn("b1", None, along.T @ last, "x")
        return last

    def _close(self, R: Array) -> None:
        """Add the frames that coincide where the loop closes."""
        leg, tree = self._leg, self._tree
        end, seat = f"{leg.name}_end", f"{leg.name}_seat"
        tree.link(end)
        tree.link(seat)
        _joint(tree, f"{end}_frame", "fixed", (self._link, end), self._along)
        carrier, at = ("platform", leg.B_platform) if self._from_base else ("base", leg.A_base)
        turned = None if leg.type.has_sphere else self._R_base_platform.T @ R
        _joint(tree, f"{seat}_frame", "fixed", (carrier, seat), at, turned)

    def _turn(self, joint: str, at: Array | None, rotation: Array | None, axis: str) -> None:
        """Add a revolute."""
        name = f"{self._leg.name}_{joint}"
        self._to(name, "revolute", f"{name}_link", at, rotation, axis, TURN)

    def _to(
        self,
        joint: str,
        kind: str,
        child: str,
        at: Array | None,
        rotation: Array | None,
        axis: str,
        limits: tuple[float, float],
    ) -> None:
        """Add a joint and go on from its child."""
        self._tree.link(child)
        moving = _AXES[axis] + limit(limits)
        _joint(self._tree, joint, kind, (self._link, child), at, rotation, moving)
        self._link, self._along = child, np.zeros(3)

    def _half(self, *, near: bool) -> None:
        """Show the half of the leg that the present link carries."""
        leg = self._leg
        radius = leg.tube if near == self._from_base else leg.rod
        if radius is None:
            return
        if leg.kind is LegKind.CONSTANT:
            length = end = leg.q0
        else:
            length = VISIBLE * leg.shortest_shown
            end = length if near else -length
        at = f'<origin xyz="0 0 {0.5 * end!r}" rpy="0 0 0"/>'
        self._tree.show(self._link, visual(at, radius, length))


def _unit(vector: Array) -> Array:
    """Return a vector of length one."""
    return np.asarray(vector / np.linalg.norm(vector))


@dataclass(frozen=True, eq=False)
class Created:
    """A model that was written."""

    mechanism: Mechanism  # the model as legcal understands it
    yaml_path: Path  # its files
    urdf_path: Path  # its files


def create_model(described: Description, output: Path, *, force: bool = False) -> Created:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine, and load them."""
    machine = assemble(described)
    paths = model_paths(machine.name, output)
    folders = [str(path) for path in paths if path.is_dir()]
    if folders:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found the "
            f"folder {folders[0]}, needed a place for a file; give another --name or --output."
        )
    there = [str(path) for path in paths if os.path.lexists(path)]
    if there and not force:
        raise UsageError(
            f"{described.source}: the model '{machine.name}' could not be written: found "
            f"{' and '.join(there)} already there, needed new files; give another --name or "
            "--output, or --force to replace them."
        )
    try:
        return _write(machine, described.source, output)
    except OSError as error:
        raise OutOfResources(
            f"{output}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or choose another --output."
        ) from error


def model_paths(name: str, output: Path) -> tuple[Path, Path]:
    """Return where the YAML and the URDF of a model go."""
    return output / "models" / f"{name}.yaml", output / "urdf" / f"{name}.urdf"


def _write(machine: Assembled, source: str, output: Path) -> Created:
    """Write and load the files aside, then move them to their places."""
    made = [path for path in (output, *output.parents) if not path.exists()]
    output.mkdir(parents=True, exist_ok=True)
    try:
        with temporary_folder(output, machine.name) as aside:
            written = model_paths(machine.name, aside)
            for path, text in zip(written, (yaml_text(machine), urdf_text(machine)), strict=True):
                path.parent.mkdir()
                path.write_bytes(text.encode())
            _load(written[0], aside, source)
            places = model_paths(machine.name, output)
            for path in places:
                if not path.parent.is_dir():
                    path.parent.mkdir()
                    made.insert(0, path.parent)
            for path, place in zip(reversed(written), reversed(places), strict=True):
                os.replace(path, place)  # the YAML last: a URDF alone is no model
    except BaseException:
        for folder in made:
            if folder.is_dir() and not os.listdir(folder):
                folder.rmdir()
        raise
    return Created(load_mechanism(places[0]), *places)


def _load(path: Path, aside: Path, source: str) -> None:
    """Load the files where they were written aside; problems name the source instead."""
    try:
        load_mechanism(path)
    except LegcalError as error:
        told = [p.replace(f"{aside}{os.sep}", f"{source}: ") for p in error.problems]
        raise type(error)(told) from error


_FAMILY = re.compile(r"([0-9]{1,2})-([A-Z]+)")
SPREAD = 30.0  # [deg] between the two joints of a pair
TURN_IN_PLANE = 30.0  # [deg]; without, the legs of a planar platform meet in one point
SHORTEST, STROKE, RADIUS = 0.8, 0.4, 0.02  # parts of the length at home


@dataclass(frozen=True)
class Family:
    """The dimensions of a machine, lengths in ``unit`` and angles in degrees."""

    family: str  # number and type of the legs, ``6-UPS``
    unit: str | None = None  # unit of the lengths; it must be stated
    base_radius: float | None = None  # radii of the circles on which the joint centres lie
    platform_radius: float | None = None  # radii of the circles on which the joint centres lie
    height: float | None = None  # height of the platform over the base at home
    base_spread: float | None = None  # angle between the two joints of a pair, for 6 legs
    platform_spread: float | None = None  # angle between the two joints of a pair, for 6 legs
    turn: float | None = None  # turn of the platform about z at home
    offset: float | None = None  # leg length at reading zero; by default 0.8 of the length at home
    travel: tuple[float, float] | None = None  # lowest and highest reading
    leg_radius: float | None = None  # radius of tube and rod; by default 0.02 of the length at home
    tilt: float = 0.0
    name: str | None = None  # name of the model; the family in small letters by default


def describe_family(asked: Family) -> Description:
    """Return the machine of a family."""
    match = _FAMILY.fullmatch(asked.family)
    letters = None if match is None else leg_type(match[2])
    if match is None or letters is None or not 2 <= int(match[1]) <= MOST_LEGS:
        raise UsageError(
            f"The family could not be understood: found '{asked.family}', needed a number of legs "
            f"from 2 to {MOST_LEGS} and their type, such as 6-UPS: {NEEDED_TYPE}; correct --family."
        )
    in_plane = (letters.base, letters.platform) == ("R", "R")
    problems = _problems(asked, in_plane) + _pointless(asked, int(match[1]), letters, in_plane)
    if problems:
        raise UsageError(problems)
    unit = str(asked.unit)

    def metres(value: float | None) -> float:
        return 0.0 if value is None else in_metres(value, unit)

    count = int(match[1])
    base_angles, platform_angles = _angles(count, asked)
    A = metres(asked.base_radius) * _ring(base_angles)
    B = metres(asked.platform_radius) * _ring(platform_angles)
    turn = asked.turn if asked.turn is not None else TURN_IN_PLANE * in_plane
    z_turn = Rotation.from_euler("z", turn, degrees=True)
    T = RigidTransform.from_components([0.0, 0.0, metres(asked.height)], z_turn)
    tilt = float(np.radians(asked.tilt))
    legs = []
    for j in range(count):
        vector = T.apply(B[j]) - A[j]
        axes = _axes_families(letters, vector, A[j], tilt)
        length = float(np.linalg.norm(vector))
        legs.append(
            _leg(asked, f"leg{j + 1}", letters, (A[j], B[j]), length, axes, T)
        )  # fmt: skip
    home = Home((0.0, 0.0, metres(asked.height)), _quaternion(z_turn))
    name = asked.name or asked.family.lower()
    return Description(name, f"--family {asked.family}", unit, tuple(legs), home, None)


def _problems(asked: Family, in_plane: bool) -> list[str]:
    """Return what is missing or impossible among the dimensions."""
    where = f"The family {asked.family} could not be built"
    needed = {
        "--base-radius": asked.base_radius,
        "--platform-radius": asked.platform_radius,
        **({} if in_plane else {"--height": asked.height}),
        "--unit": asked.unit,
    }
    missing = [option for option, value in needed.items() if value is None]
    problems = []
    if missing:
        problems.append(
            f"{where}: found no {' and no '.join(missing)}, needed "
            f"{', '.join(needed)}; for example --base-radius 300 --platform-radius 150"
            f"{'' if in_plane else ' --height 400'} --unit mm."
        )
    if asked.unit not in (None, "m", "mm"):
        problems.append(f"{where}: found the unit '{asked.unit}', needed m or mm; correct --unit.")
    for option, value in (*needed.items(), ("--leg-radius", asked.leg_radius)):
        if isinstance(value, float | int) and not 0.0 < value < 1e9:
            problems.append(f"{where}: found {option} {value:g}, needed a positive length; fix it.")
    for option, angle in (
        ("--base-spread", asked.base_spread),
        ("--platform-spread", asked.platform_spread),
    ):
        if angle is not None and not 0.0 < angle < 120.0:
            problems.append(
                f"{where}: found {option} {angle:g} deg, needed an angle between 0 and 120 deg; "
                "mend it."
            )
    if not abs(asked.tilt) <= 80.0:
        problems.append(
            f"{where}: found --tilt {asked.tilt:g} deg, needed at most 80 deg either way; mend it."
        )
    if asked.turn is not None and not abs(asked.turn) <= 180.0:
        problems.append(
            f"{where}: found --turn {asked.turn:g} deg, needed at most 180 deg either way; mend it."
        )
    if asked.travel is not None and not -1e9 < asked.travel[0] < asked.travel[1] < 1e9:
        problems.append(
            f"{where}: found --travel {asked.travel[0]:g} {asked.travel[1]:g}, needed the lower "
            "reading first; swap them."
        )
    if asked.offset is not None and not abs(asked.offset) < 1e9:
        problems.append(f"{where}: found --offset {asked.offset:g}, needed a length; mend it.")
    if asked.name is not None:
        try:
            plain_name(asked.name)
        except ValueError as error:
            problems.append(f"{where}: the name could not be used: {error}")
    return problems


def _pointless(asked: Family, count: int, letters: LegType, in_plane: bool) -> list[str]:
    """Return which dimensions were told that a machine of this family does not have."""
    no_axes = not {letters.base, letters.platform} & {"R", "U"}
    found = {
        "--height": in_plane and bool(asked.height) and "a planar machine",
        "--tilt": (in_plane or no_axes) and bool(asked.tilt) and "axes that cannot tilt",
        "--base-spread": count != 6 and asked.base_spread is not None and f"{count} legs",
        "--platform-spread": count != 6 and asked.platform_spread is not None and f"{count} legs",
        "--offset": not letters.has_slider and asked.offset is not None and "legs without P",
        "--travel": not letters.has_slider and asked.travel is not None and "legs without P",
    }
    return [
        f"The family {asked.family} could not be built: found {option} for {what}, needed none; "
        "leave it out."
        for option, what in found.items()
        if what
    ]


def _angles(count: int, asked: Family) -> tuple[Array, Array]:
    """Return the angles of the joints on base and platform [rad]."""
    if count != 6:
        even = 2.0 * np.pi * np.arange(count) / count
        return even, even
    half = np.array([0.5, -0.5])
    spreads = (SPREAD if s is None else s for s in (asked.base_spread, asked.platform_spread))
    on_base, on_platform = (spread * np.tile(half, 3) for spread in spreads)
    base = np.array([0.0, 120.0, 120.0, 240.0, 240.0, 360.0]) + on_base
    platform = np.repeat([60.0, 180.0, 300.0], 2) - on_platform
    return np.radians(base), np.radians(platform)


def _ring(angles: Array) -> Array:
    """Return points of the unit circle in the plane z = 0."""
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    return np.where(np.abs(ring) < 1e-15, 0.0, ring)


def _axes_families(
    letters: LegType, vector: Array, A: Array, tilt: float
) -> tuple[Array | None, ...]:
    """Return the tilted axes at base and platform, in the base; None for the default ones."""
    if tilt == 0.0:
        return None, None
    u = vector / np.linalg.norm(vector)
    across = across_leg(u, A)
    axes = list[Array | None]()
    for letter, sense in ((letters.base, 1.0), (letters.platform, -1.0)):
        up = np.cross(u, across) if letter == "R" else np.array([0.0, 0.0, 1.0])
        tilted = np.cos(tilt) * across + sense * np.sin(tilt) * up
        axes.append(tilted if letter in ("R", "U") else None)
    return tuple(axes)


def _leg(
    asked: Family,
    name: str,
    letters: LegType,
    joints: tuple[Array, Array],
    length: float,
    axes: tuple[Array | None, ...],
    T: RigidTransform,
) -> LegEntry:
    """Return a leg of a length at home [m]."""
    unit = str(asked.unit)
    kind = LegKind.ACTUATED if letters.has_slider else LegKind.CONSTANT
    radius = _default(RADIUS * length)
    if asked.leg_radius is not None:
        radius = in_metres(asked.leg_radius, unit)
    offset: float | None = None
    travel: tuple[float, float] | None = None
    if letters.has_slider:
        offset, travel = _default(SHORTEST * length), (0.0, _default(STROKE * length))
        if asked.offset is not None:
            offset = in_metres(asked.offset, unit)
        if asked.travel is not None:
            travel = in_metres(asked.travel[0], unit), in_metres(asked.travel[1], unit)
    at_platform = None if axes[1] is None else np.asarray(T.rotation.inv().apply(axes[1]))
    return LegEntry(
        name, letters, kind, *joints, offset, travel, radius, radius, axes[0], at_platform
    )


def _default(length: float) -> float:
    """Return a length that nobody chose, in tenths of a millimetre [m]."""
    return max(round(length, 4), 1e-4)


def _quaternion(turn: Rotation) -> tuple[float, ...]:
    """Return a rotation as files write it."""
    return tuple(float(x) for x in turn.as_quat(canonical=True))


def described(
    table: Path | None,
    *,
    family: str | None,
    unit: str | None,
    name: str | None,
    dimensions: Mapping[str, Any],
) -> Description:
    """Return the machine that a table or a family describes."""
    told = {key: value for key, value in dimensions.items() if value is not None}
    if (table is None) == (family is None):
        found = "neither" if table is None else "both"
        raise UsageError(
            f"The model could not be written: found {found} of a table and --family, needed one; "
            "give a YAML or CSV table, or --family 6-UPS with its dimensions."
        )
    if unit not in (None, "m", "mm"):
        raise UsageError(
            f"The unit could not be used: found '{unit}', needed mm or m; correct --unit."
        )
    if table is None:
        return describe_family(Family(family=str(family), unit=unit, name=name, **told))
    if told:
        options = ", ".join(f"--{key.replace('_', '-')}" for key in told)
        raise UsageError(
            f"The model could not be written: found {options} beside a table, needed them with "
            "--family only; write them in the table."
        )
    return read_description(table, unit, name)
