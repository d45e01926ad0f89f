"""A pose in which a described machine closes: checked, settled, or found."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.authoring.machine import Description, Home
from legcal.errors import ModelError
from legcal.geometry.frames import motion_of, motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.mechanism.leg import LegKind

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

    Raises
    ------
    ModelError
        If the given pose does not close, or none is found.
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
