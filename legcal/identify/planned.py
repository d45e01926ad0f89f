"""Sessions to judge: one of default cameras and random poses, or that of a dataset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array
from legcal.identify.cameras import FOCAL_PX, default_cameras
from legcal.identify.poses import random_poses
from legcal.identify.session import Session
from legcal.mechanism.leg import Leg, LegKind, main_cylinders
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.leg_steps import moved_legs
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import Parametrization, geometries, parametrization_of

SIGMA_Q = 2e-6  # [m] of a reading, where no dataset says
_SEED = 2002
_PERTURBATION = 1e-6  # of the mean leg length, and [rad]
REACHED = 20  # poses, at least, over which errors of the platform are judged
THIN = 0.02  # radius of a leg without a visible cylinder, of the mean leg length


def planned_session(
    mechanism: Mechanism,
    views: Sequence[Sequence[int]],
    images: int = 15,
    *,
    board: bool = False,
) -> Session:
    """Return a session with cameras in default places and random poses inside the travel.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal machine. The session is that of a machine whose every parameter is a
        micrometre or less elsewhere, so that no symmetry by accident decides.
    views : sequence of sequences of int
        The legs that each view shows.
    images : int
        Number of images, and poses, a view.
    board : bool
        Whether every image shows a calibration board on the base.

    Raises
    ------
    DidNotConverge
        If the machine cannot move inside its travel.
    """
    home = mechanism.T_base_Rb.inv() * mechanism.home * mechanism.T_platform_Re
    legs, length, rng = machine_near(mechanism, home)
    A, B = joints_at(legs, home)
    n_poses = images * len(views)
    R, t = random_poses(
        legs, mechanism.frame_legs, home, travel_of(mechanism), max(n_poses, REACHED), rng
    )
    seen = np.zeros((len(views), len(legs)), dtype=np.bool_)
    for v, view in enumerate(views):
        seen[v, list(view)] = True
    return Session(
        leg_names=mechanism.leg_names,
        legs=legs,
        frame_legs=mechanism.frame_legs,
        parametrization=parametrization_of(mechanism),
        radius=radii(mechanism.legs, length),
        R=R[:n_poses],
        t=t[:n_poses],
        R_reached=R,
        t_reached=t,
        view=np.repeat(np.arange(len(views)), images),
        pose=np.arange(n_poses),
        seen=seen,
        camera=default_cameras(A, B, views, mechanism.spatial, rng),
        focal=np.full(len(views), FOCAL_PX),
        sigma_q=SIGMA_Q,
        board=np.full(len(views), board, dtype=np.bool_),
    )


def cameras_for(session: Session, views: Sequence[Sequence[int]]) -> Array:
    """Return where further cameras stand by default, (n_views, 3) in R_b [m]."""
    B = (session.arm + session.t[:, None]).mean(axis=0)
    rng = np.random.default_rng(_SEED + 1)
    return default_cameras(session.A, B, views, session.spatial, rng)


def machine_near(
    mechanism: Mechanism, home: RigidTransform
) -> tuple[tuple[LegGeometry, ...], float, np.random.Generator]:
    """Return legs near the nominal ones, their mean length at home [m], and a source of chance."""
    rng = np.random.default_rng(_SEED)
    nominal = geometries(mechanism)
    A, B = joints_at(nominal, home)
    length = float(np.linalg.norm(B - A, axis=1).mean())
    return perturbed(nominal, parametrization_of(mechanism), length, rng), length, rng


def perturbed(
    legs: Sequence[LegGeometry],
    parametrization: Parametrization,
    length: float,
    rng: np.random.Generator,
) -> tuple[LegGeometry, ...]:
    """Return legs whose every parameter is slightly elsewhere."""
    units = np.array([length if unit == "m" else 1.0 for unit in parametrization.units])
    step = _PERTURBATION * units * rng.uniform(-1.0, 1.0, len(units))
    return moved_legs(legs, parametrization.place, step)


def radii(legs: Sequence[Leg], length: float) -> Array:
    """Return the radius of the thickest visible cylinder of each leg, (n_legs,) [m]."""
    return np.array(
        [
            max((c.radius for c in main_cylinders(leg.cylinders).values()), default=THIN * length)
            for leg in legs
        ]
    )


def joints_at(legs: Sequence[LegGeometry], T: RigidTransform) -> tuple[Array, Array]:
    """Return the joint centres A and B at a pose, in R_b."""
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    return A, np.asarray(T.apply(B))


def travel_of(mechanism: Mechanism) -> Array:
    """Return shortest and longest length of each leg, (n_legs, 2) [m]."""
    lengths = []
    for leg in mechanism.legs:
        ends = [leg.sign * q + leg.q0 for q in leg.travel]
        lengths.append([leg.q0, leg.q0] if leg.kind is LegKind.CONSTANT else sorted(ends))
    return np.array(lengths)
