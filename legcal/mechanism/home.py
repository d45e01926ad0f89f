"""The home pose: found where a file gives none, and settled on the lengths of rods."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge, ModelError
from legcal.geometry.types import Array
from legcal.mechanism.closing import leg_vectors
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism

TRIALS = 200


def find_home(mechanism: Mechanism) -> RigidTransform:
    """Return a pose where every leg is at the middle of its travel.

    Of all that seeded starts find, the one that turns the platform least is taken, and of the
    mirror images in the plane of the base joints the one on the positive side of the base's z.

    Raises
    ------
    DidNotConverge
        If none is found.
    """
    middle = np.array([0.5 * sum(leg.travel) for leg in mechanism.legs])
    wanted = mechanism.sign * middle + mechanism.q0
    held = np.array([leg.kind is not LegKind.PASSIVE for leg in mechanism.legs])
    rng = np.random.default_rng(1965)
    centre = mechanism.A_base.mean(axis=0)
    reach = float(np.abs(wanted).mean())

    def misfit(x: Array) -> Array:
        return np.asarray((_lengths(mechanism, x) - wanted)[held])

    best: tuple[float, RigidTransform] | None = None
    for trial in range(TRIALS):
        start = np.concatenate(
            [centre + rng.normal(0.0, reach, 3), rng.normal(0.0, 0.1 + trial / TRIALS, 3)]
        )
        fit = least_squares(misfit, start, xtol=1e-15)
        if np.abs(fit.fun).max() > 1e-9:
            continue
        T = _pose(fit.x)
        below = float(T.apply(mechanism.B_platform).mean(axis=0)[2] < centre[2])
        rank = 10.0 * below + float(T.rotation.magnitude())
        if best is None or rank < best[0] - 1e-6:
            best = rank, T
        if trial >= 20 and best[0] < 10.0:
            break
    if best is None:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: no home pose was found: with all legs at mid-travel the "
            f"loops did not close from {TRIALS} starts, needed a closed pose; write legcal.home."
        )
    return best[1]


def settle_home(mechanism: Mechanism, home: RigidTransform) -> RigidTransform:
    """Return the pose nearest to home that keeps the length of every leg of constant length.

    Files give home with few digits; legs with sliders absorb that, rods cannot.

    Raises
    ------
    ModelError
        If home is more than 1 % of a leg length away from any such pose.
    """
    rods = [j for j, leg in enumerate(mechanism.legs) if leg.kind is LegKind.CONSTANT]
    if not rods:
        return home
    T = home
    for _ in range(20):
        vectors = leg_vectors(mechanism, T)[rods]
        lengths = np.linalg.norm(vectors, axis=1)
        miss = lengths - mechanism.q0[rods]
        if np.abs(miss).max() < 1e-15:
            break
        if np.abs(miss).max() > 0.01 * lengths.mean():
            leg = mechanism.legs[rods[int(np.argmax(np.abs(miss)))]]
            raise ModelError(
                f"{mechanism.yaml_path}: legcal.home could not be used: found leg '{leg.name}' "
                f"{1e3 * np.abs(miss).max():.3g} mm off its constant length there, needed a closed "
                "pose; correct legcal.home."
            )
        u = vectors / lengths[:, None]
        arms = T.rotation.apply(mechanism.B_platform[rods])
        scale = float(lengths.mean())
        jacobian = np.hstack([u, np.cross(arms, u) / scale])
        step = -np.linalg.lstsq(jacobian, miss, rcond=None)[0]
        turn = Rotation.from_rotvec(step[3:] / scale)
        T = RigidTransform.from_components(T.translation + step[:3], turn * T.rotation)
    return T


def _pose(x: Array) -> RigidTransform:
    """Return the pose of three coordinates [m] and a rotation vector [rad]."""
    return RigidTransform.from_components(x[:3], Rotation.from_rotvec(x[3:]))


def _lengths(mechanism: Mechanism, x: Array) -> Array:
    """Return the leg lengths at a pose [m]."""
    return np.asarray(np.linalg.norm(leg_vectors(mechanism, _pose(x)), axis=1))
