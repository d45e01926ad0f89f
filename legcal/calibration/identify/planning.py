"""Planned sessions (cameras in default places, random poses), and those of datasets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.identify.session import Session
from legcal.calibration.session import nominal_poses
from legcal.data import Dataset
from legcal.estimation import Frames
from legcal.geometry import Array, BoolArray
from legcal.machine import (
    Leg,
    LegKind,
    Machine,
    Parametrization,
    geometries,
    main_cylinders,
    moved_legs,
    parametrization_of,
    random_poses,
)
from legcal.vision import shared_cameras

FOCAL_PX = 1290.0  # 1024 x 768 pixels, 43 degrees wide
_DISTANCE = 2.5  # machine sizes
_TILT = 0.5  # [rad] from the normal of a planar machine
SIGMA_Q = 2e-6  # [m] of a reading, where no dataset says
_SEED = 2002
_PERTURBATION = 1e-6  # of the mean leg length, and [rad]
REACHED = 20  # poses, at least, over which errors of the platform are judged
THIN = 0.02  # radius of a leg without a visible cylinder, of the mean leg length


def planned_session(
    machine: Machine,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    images: int = 15,  # and poses, a view
    *,
    board: bool = False,  # every image shows a calibration board on the base
) -> Session:
    """Return a session with cameras in default places and random poses inside the travel.

    It is that of a machine whose every parameter is a micrometre or less from the nominal one, so
    that no symmetry by accident decides. Raises DidNotConverge if the machine cannot move.
    """
    home = machine.T_base_Rb.inv() * machine.home * machine.T_platform_Re
    legs, length, rng = machine_near(machine, home)
    A, B = joints_at(legs, home)
    n_poses = images * len(views)
    R, t = random_poses(
        legs, machine.frame_legs, home, travel_of(machine), max(n_poses, REACHED), rng
    )
    seen = np.zeros((len(views), len(legs)), dtype=np.bool_)
    for v, view in enumerate(views):
        seen[v, list(view)] = True
    return Session(
        leg_names=machine.leg_names,
        legs=legs,
        frame_legs=machine.frame_legs,
        parametrization=parametrization_of(machine),
        radius=radii(machine.legs, length),
        R=R[:n_poses],
        t=t[:n_poses],
        R_reached=R,
        t_reached=t,
        view=np.repeat(np.arange(len(views)), images),
        pose=np.arange(n_poses),
        seen=seen,
        camera=default_cameras(A, B, views, machine.spatial, rng),
        focal=np.full(len(views), FOCAL_PX),
        sigma_q=SIGMA_Q,
        board=np.full(len(views), board, dtype=np.bool_),
    )


def recorded_session(
    # A view is taken to show the legs that have axes in it; without a table of axes those that it
    # names, or all
    dataset: Dataset,
    *,
    twists: bool = False,  # count the twists of legs among the parameters
) -> Session:
    """Return the session of a dataset.

    Where readings do not give its poses, random ones inside the travel take their place.

    Raises DatasetError if readings are out of reach of the model by more than its errors may be.
    """
    machine, m = dataset.machine, dataset.measurements
    to_Rb, from_Re = machine.T_base_Rb.inv(), machine.T_platform_Re
    home = to_Rb * machine.home * from_Re
    legs, length, rng = machine_near(machine, home)
    if machine.is_determined:
        R, t = Frames.of(nominal_poses(machine, m)[0])
    else:
        travel = travel_of(machine)
        R, t = random_poses(legs, machine.frame_legs, home, travel, m.n_poses, rng)
    parametrization = parametrization_of(machine, twists=twists)
    R_reached, t_reached = R, t
    if 3 * len(t) < len(parametrization):  # too few to tell what no pose would show
        more = random_poses(
            legs, machine.frame_legs, home, travel_of(machine), REACHED - len(t), rng
        )
        R_reached, t_reached = np.concatenate([R, more[0]]), np.concatenate([t, more[1]])
    used = np.unique(m.view)
    views = [m.views[v] for v in used]
    seen = np.array(
        [[view.legs is None or name in view.legs for name in machine.leg_names] for view in views]
    )
    if dataset.axes is not None:
        shown_legs = np.zeros((len(m.views), len(machine.leg_names)), dtype=np.bool_)
        shown_legs[m.view[dataset.axes.row], dataset.axes.leg] = True
        seen = shown_legs[used]
    A, B = joints_at(legs, home)
    shown = [np.flatnonzero(row).tolist() for row in seen]
    camera = default_cameras(A, B, shown, machine.spatial, rng)
    for v, view in enumerate(views):
        if view.T_base_camera is not None:
            camera[v] = (to_Rb * view.T_base_camera).translation
    return Session(
        leg_names=machine.leg_names,
        legs=legs,
        frame_legs=machine.frame_legs,
        parametrization=parametrization,
        radius=radii(machine.legs, length),
        R=R,
        t=t,
        R_reached=R_reached,
        t_reached=t_reached,
        view=np.searchsorted(used, m.view),
        pose=m.pose,
        seen=seen,
        camera=camera,
        focal=np.array([_focal(view.camera.K) for view in views]),
        sigma_q=m.sigma_q,
        board=_with_board(dataset)[used],
    )


def orientations_of(dataset: Dataset, session: Session) -> Array:
    """Return R of the camera of every used view in R_b, (n_views, 3, 3).

    Cameras whose place the dataset does not give look at the legs.
    """
    to_Rb, views = dataset.machine.T_base_Rb.inv(), dataset.measurements.views
    found = looking_at(session)
    for v, view in enumerate(views[i] for i in np.unique(dataset.measurements.view).tolist()):
        if view.T_base_camera is not None:
            found[v] = (to_Rb * view.T_base_camera).rotation.as_matrix()
    return found


def cameras_of(dataset: Dataset) -> tuple[str, ...]:
    """Return the name of the camera of every used view: that of the first view that has it."""
    m = dataset.measurements
    owners = shared_cameras([view.name for view in m.views], [view.camera for view in m.views])
    return tuple(owners[v] for v in np.unique(m.view).tolist())


def looking_at(session: Session) -> Array:
    """Return orientations (n_views, 3, 3) of cameras that look at the legs of their views."""
    middle = 0.5 * (session.A + (session.arm + session.t[:, None]).mean(axis=0))
    orientations = []
    for place, shown in zip(session.camera, session.seen, strict=True):
        z = (middle[shown] if shown.any() else middle).mean(axis=0) - place
        z /= np.linalg.norm(z)
        x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
        x /= np.linalg.norm(x)
        orientations.append(np.column_stack([x, np.cross(z, x), z]))
    return np.array(orientations).reshape(-1, 3, 3)


def default_cameras(
    A: Array,  # A, B: (n_legs, 3): joint centres at home, in R_b [m]
    B: Array,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    # planar machines are seen from along their normal, tilted toward the side of the legs
    spatial: bool,
    rng: np.random.Generator,
) -> Array:
    """Return where a camera for each view stands.

    No two of them stand in the same place, even if they show the same legs.

    Returns (n_views, 3): In R_b [m].
    """
    points = np.concatenate([A, B])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = 0.5 * (A + B)
    centre = middle.mean(axis=0)
    axis = _axis(A, B) if spatial else np.array([0.0, 0.0, 1.0])
    places = []
    for seen in views:
        outward = (middle[list(seen)] - centre).mean(axis=0)
        outward -= axis * (outward @ axis)
        if np.linalg.norm(outward) < 0.02 * size:  # legs all around: any side will do
            outward = np.cross(axis, rng.normal(size=3))
        outward /= np.linalg.norm(outward)
        side = np.cross(axis, outward)
        turn, lift = rng.uniform(-0.15, 0.15), rng.uniform(0.05, 0.3)
        if not spatial:
            lift = 0.5 * np.pi - _TILT + rng.uniform(-0.1, 0.1)
        toward = np.cos(turn) * outward + np.sin(turn) * side
        toward = np.cos(lift) * toward + np.sin(lift) * axis
        places.append(centre + _DISTANCE * size * rng.uniform(0.95, 1.05) * toward)
    return np.array(places).reshape(-1, 3)


def cameras_for(session: Session, views: Sequence[Sequence[int]]) -> Array:
    """Return where further cameras stand by default, (n_views, 3) in R_b [m]."""
    B = (session.arm + session.t[:, None]).mean(axis=0)
    rng = np.random.default_rng(_SEED + 1)
    return default_cameras(session.A, B, views, session.spatial, rng)


def _axis(A: Array, B: Array) -> Array:
    """Return the direction from base to platform."""
    across = B.mean(axis=0) - A.mean(axis=0)
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(across / size)


def machine_near(
    machine: Machine, home: RigidTransform
) -> tuple[tuple[Leg, ...], float, np.random.Generator]:
    """Return legs near the nominal ones, their mean length at home [m], and a source of chance."""
    rng = np.random.default_rng(_SEED)
    nominal = geometries(machine)
    A, B = joints_at(nominal, home)
    length = float(np.linalg.norm(B - A, axis=1).mean())
    return perturbed(nominal, parametrization_of(machine), length, rng), length, rng


def perturbed(
    legs: Sequence[Leg],
    parametrization: Parametrization,
    length: float,
    rng: np.random.Generator,
) -> tuple[Leg, ...]:
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


def joints_at(legs: Sequence[Leg], T: RigidTransform) -> tuple[Array, Array]:
    """Return the joint centres A and B at a pose, in R_b."""
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    return A, np.asarray(T.apply(B))


def travel_of(machine: Machine) -> Array:
    """Return shortest and longest length of each leg, (n_legs, 2) [m]."""
    lengths = []
    for leg in machine.legs:
        ends = [leg.sign * q + leg.q0 for q in leg.travel]
        lengths.append([leg.q0, leg.q0] if leg.kind is LegKind.CONSTANT else sorted(ends))
    return np.array(lengths)


def _with_board(dataset: Dataset) -> BoolArray:
    """Return which views show the board, (n_views,): all of them where nobody has looked yet."""
    m = dataset.measurements
    shown = np.full(len(m.views), dataset.board is not None, dtype=np.bool_)
    if dataset.board is not None and dataset.corners is not None:
        corners = dataset.corners
        shown[:] = False
        shown[m.view[corners.row[corners.used]]] = True
    return shown


def _focal(K: Array) -> float:
    """Return the mean focal length [px]."""
    return float(np.sqrt(K[0, 0] * K[1, 1]))
