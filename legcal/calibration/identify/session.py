"""Sessions to judge: one of default cameras and random poses, or that of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import (
    N_LOCAL,
    Leg,
    LegGeometry,
    LegKind,
    Mechanism,
    Parametrization,
    geometries,
    joined,
    leg_labels,
    main_cylinders,
    moved_legs,
    parametrization_of,
    random_poses,
)

_TIMES = {2: "two", 3: "three", 4: "four"}


def views_in_words(views: Sequence[str]) -> str:
    """Return views one after the other, equal ones once: ``1,2,3 from two places``."""
    said = []
    for view in dict.fromkeys(views):
        times = list(views).count(view)
        said.append(view if times == 1 else f"{view} from {_TIMES.get(times, times)} places")
    return "; ".join(said)


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {joined([labels[leg_names[j]] for j in legs])}"


SIGMA_PX = 0.1  # of an outline across a leg, in the image


@dataclass(frozen=True, eq=False)
class Session:
    """Observations as they will be made, of a machine that is nearly the nominal one.

    Attributes
    ----------
    leg_names : tuple of str
        Names of the legs.
    legs : tuple of LegGeometry
        The legs in R_b and R_e.
    frame_legs : tuple of int
        The legs that define R_b and R_e.
    parametrization : Parametrization
        The parameters.
    radius : (n_legs,) array
        Radius of the cylinder that is seen of each leg [m].
    R, t : (k, 3, 3) and (k, 3) array
        Platform poses: rotation and position [m] of R_e in R_b.
    R_reached, t_reached : (w, 3, 3) and (w, 3) array
        Poses over which errors of the platform are judged: those above, and more if they are few.
    view, pose : (n_images,) array of int
        The view and the pose of each image.
    seen : (n_views, n_legs) array of bool
        The legs that each view shows.
    camera : (n_views, 3) array
        Where the cameras stand in R_b [m].
    focal : (n_views,) array
        Their focal lengths [px].
    sigma_q : float
        Standard deviation of a reading [m].
    board : (n_views,) array of bool
        The views whose images show a calibration board on the base: how these cameras stand to
        each other is known.
    """

    leg_names: tuple[str, ...]
    legs: tuple[LegGeometry, ...]
    frame_legs: tuple[int, ...]
    parametrization: Parametrization
    radius: Array
    R: Array
    t: Array
    R_reached: Array
    t_reached: Array
    view: IntArray
    pose: IntArray
    seen: BoolArray
    camera: Array
    focal: Array
    sigma_q: float
    board: BoolArray

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @property
    def n_views(self) -> int:
        """Number of camera positions."""
        return len(self.seen)

    @cached_property
    def frame(self) -> IntArray:
        """The frame in which each view shows the legs, (n_views,): with a board one for all."""
        first = int(np.argmax(self.board))
        frame = np.where(self.board, first, np.arange(self.n_views))
        return np.asarray(np.unique(frame, return_inverse=True)[1])

    @property
    def n_frames(self) -> int:
        """Number of frames: of cameras that nothing ties to others, and of the board."""
        return int(self.frame.max(initial=-1)) + 1

    @cached_property
    def frames(self) -> tuple[tuple[int, ...], ...]:
        """The legs that are seen in each frame."""
        seen = [self.seen[self.frame == f].any(axis=0) for f in range(self.n_frames)]
        return tuple(tuple(np.flatnonzero(row).tolist()) for row in seen)

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return len(self.frame_legs) == 3

    @cached_property
    def views(self) -> tuple[tuple[int, ...], ...]:
        """The legs of each view."""
        return tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in self.seen)

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def arm(self) -> Array:
        """From the origin of R_e to B in the directions of R_b, (k, n_legs, 3) [m]."""
        B = np.array([leg.B for leg in self.legs])
        return np.asarray(np.einsum("kij,nj->kni", self.R, B))

    @cached_property
    def length(self) -> Array:
        """Leg lengths at every pose, (k, n_legs) [m]."""
        return np.asarray(np.linalg.norm(self.arm + self.t[:, None] - self.A, axis=2))

    @cached_property
    def u(self) -> Array:
        """Leg directions in R_b at every pose, (k, n_legs, 3)."""
        return (self.arm + self.t[:, None] - self.A) / self.length[..., None]

    @cached_property
    def mean_length(self) -> float:
        """Mean leg length, by which angles become lengths [m]."""
        return float(self.length.mean())

    @cached_property
    def unit(self) -> Array:
        """A metre of every parameter in its own unit, (p,): angles at the leg's length."""
        lengths = np.array([unit == "m" for unit in self.parametrization.units], dtype=np.bool_)
        return np.where(lengths, 1.0, 1.0 / self.mean_length)

    @cached_property
    def local_to_parameters(self) -> Array:
        """Derivative of each leg's twelve numbers by the parameters in metres, (n_legs, 12, p)."""
        eye = np.eye(N_LOCAL)
        scattered = [self.parametrization.scatter(eye, j) for j in range(self.n_legs)]
        return np.array(scattered).reshape(self.n_legs, N_LOCAL, len(self.unit)) * self.unit

    @cached_property
    def with_length(self) -> BoolArray:
        """Which legs have a length that is measured or constant, (n_legs,)."""
        return np.array([leg.kind is not LegKind.PASSIVE for leg in self.legs], dtype=np.bool_)

    def with_board(self, *, board: bool = True) -> Session:
        """Return the same with a calibration board in all images, or in none."""
        return replace(self, board=np.full(self.n_views, board, dtype=np.bool_))

    def columns(self, kinds: Sequence[int]) -> IntArray:
        """Return the parameters that stand for given ones of the legs' twelve numbers."""
        place = self.parametrization.place[:, list(kinds)]
        return np.unique(place[place >= 0])


FOCAL_PX = 1290.0  # 1024 x 768 pixels, 43 degrees wide
_DISTANCE = 2.5  # machine sizes
_TILT = 0.5  # [rad] from the normal of a planar machine


def default_cameras(
    A: Array, B: Array, views: Sequence[Sequence[int]], spatial: bool, rng: np.random.Generator
) -> Array:
    """Return where a camera for each view stands.

    No two of them stand in the same place, even if they show the same legs.

    Parameters
    ----------
    A, B : (n_legs, 3) array
        Joint centres at home, in R_b [m].
    views : sequence of sequences of int
        The legs that each view shows.
    spatial : bool
        Planar machines are seen from along their normal, tilted toward the side of the legs.
    rng : numpy.random.Generator
        Source of the variation.

    Returns
    -------
    (n_views, 3) array
        In R_b [m].
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


def _axis(A: Array, B: Array) -> Array:
    """Return the direction from base to platform."""
    across = B.mean(axis=0) - A.mean(axis=0)
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(across / size)


def legs_around(session: Session) -> list[int]:
    """Return the legs in their order around the base."""
    points = session.A + (session.arm + session.t[:, None]).mean(axis=0)
    centred = points - points.mean(axis=0)
    _, _, basis = np.linalg.svd(session.A - session.A.mean(axis=0))
    angle = np.arctan2(centred @ basis[1], centred @ basis[0])
    return [int(j) for j in np.argsort(angle, kind="stable")]


def neighbours(ring: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return all groups of so many neighbours, (size,) each, in the order of the legs."""
    n = len(ring)
    groups = (
        tuple(sorted(ring[(start + k) % n] for k in range(min(size, n)))) for start in range(n)
    )
    return list(dict.fromkeys(groups))


def steps_apart(ring: Sequence[int], leg: int, others: Sequence[int]) -> int:
    """Return how many places around the base a leg is from the nearest of others."""
    place = {j: k for k, j in enumerate(ring)}
    steps = (abs(place[leg] - place[other]) for other in others)
    return min((min(s, len(ring) - s) for s in steps), default=0)


_ALONG = 1e-6  # a leg that points at the camera shows no lateral direction: least |u x ray|


@dataclass(frozen=True, eq=False)
class Across:
    """Two directions across each leg at a point of its axis, over their standard deviations.

    Attributes
    ----------
    gradient : (n_images, n_legs, 2, 3) array
        n_lat and n_dep in R_b by their sigma [1/m]; zero where the leg is not seen.
    point : (n_images, n_legs, 3) array
        The points in R_b [m].
    """

    gradient: Array
    point: Array

    def by_camera(self) -> Array:
        """Return the derivative (n_images, n_legs, 2, 6) by the camera's turn and displacement."""
        turn = -np.cross(self.point[:, :, None], self.gradient)
        return np.concatenate([turn, -self.gradient], axis=3)


def at_base_joints(session: Session) -> Across:
    """Return what is seen at the base joint centres."""
    images = len(session.view)
    return _across(session, np.broadcast_to(session.A, (images, *session.A.shape)))


def at_platform_joints(session: Session) -> Across:
    """Return what is seen at the platform joint centres."""
    return _across(session, (session.arm + session.t[:, None])[session.pose])


def _across(session: Session, point: Array) -> Across:
    """Return the directions across legs at points (n_images, n_legs, 3)."""
    u = session.u[session.pose]
    ray = point - session.camera[session.view][:, None]
    distance = np.linalg.norm(ray, axis=2)
    lateral = np.cross(u, ray / distance[..., None])
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), _ALONG)[..., None]
    depth = np.cross(u, lateral)
    sigma_lateral = SIGMA_PX * distance / session.focal[session.view][:, None]
    sigma_depth = sigma_lateral * distance / session.radius
    gradient = np.stack(
        [lateral / sigma_lateral[..., None], depth / sigma_depth[..., None]], axis=2
    )
    gradient[~session.seen[session.view]] = 0.0
    return Across(gradient, point)


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
