"""Sessions to judge: one of default cameras and random poses, or that of a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import qr
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import (
    N_LOCAL,
    Leg,
    LegGeometry,
    LegKind,
    Mechanism,
    Parametrization,
    freedoms,
    geometries,
    joined,
    leg_labels,
    main_cylinders,
    moved_legs,
    parametrization_of,
    pose_equations,
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


_STEPS = 5  # from home to a pose, so that no pose jumps to another assembly mode
_ITERATIONS = 3  # of Newton's method a step
_LAST_ITERATIONS = 12
_CLOSED = 1e-9  # of the mean leg length
_NEARLY_CLOSED = 1e-5  # where more is demanded than freedoms are left, and joints give way
_DEPENDENT = 1e-4  # singular values of equations below this are those of the others
_SINGULAR = 0.05  # smallest singular value, of its value at home
_RANK = 1e-9  # of the largest singular value
_FREE = 0.05  # mean leg lengths: how far poses move where no motor holds them
_ATTEMPTS = 12
_SHRINKING = 0.6  # each attempt with that part of the travel of the one before, but
_LOOSE = 0.01  # of a hold by motors and joints, without unit
_LEAST_SHARE = 0.078  # of the travel at least


def random_poses(
    legs: Sequence[LegGeometry],
    frame_legs: Sequence[int],
    home: RigidTransform,
    travel: Array,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Return random poses with all sliders inside their travel.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    home : RigidTransform
        T_Rb_Re near a closed pose of the wanted assembly mode.
    travel : (n_legs, 2) array
        Shortest and longest length of each leg [m]; equal for legs of constant length.
    count : int
        Number of poses.
    rng : numpy.random.Generator
        Source of the poses.

    Returns
    -------
    (count, 3, 3) and (count, 3) array
        Rotations and positions [m] of R_e in R_b.

    Raises
    ------
    DidNotConverge
        If the machine cannot move inside its travel.
    """
    closing = _Closing(legs, frame_legs)
    R0, t0 = _one(home)
    R0, t0 = closing.close(R0, t0, None, _LAST_ITERATIONS)
    closing.drive(R0, t0)
    home_lengths = closing.lengths(R0, t0)[0]
    found_R, found_t = np.zeros((0, 3, 3)), np.zeros((0, 3))
    share, tried, near_singular = 1.0, 0, 0
    for _ in range(_ATTEMPTS):
        n = 2 * (count - len(found_t)) + 10
        wanted = rng.uniform(travel[:, 0], travel[:, 1], (n, len(legs)))
        wanted = home_lengths + share * (wanted - home_lengths)
        R, t = closing.wander(R0, t0, n, share, rng)
        first, good = closing.lengths(R, t), np.ones(n, dtype=np.bool_)
        for part in np.linspace(0.0, 1.0, _STEPS + 1)[1:]:
            R, t = closing.close(R, t, first + part * (wanted - first), _ITERATIONS)
            good &= closing.is_regular(R, t, R0, t0)
        tried, near_singular = tried + n, near_singular + int(np.sum(~good))
        R, t = closing.close(R, t, wanted, _LAST_ITERATIONS - _ITERATIONS)
        good &= closing.is_closed(R, t, wanted)
        good &= _inside(closing.lengths(R, t), travel, home_lengths)
        found_R, found_t = np.concatenate([found_R, R[good]]), np.concatenate([found_t, t[good]])
        if len(found_t) >= count:
            return found_R[:count], found_t[:count]
        share = max(_SHRINKING * share, _LEAST_SHARE)
    found = f"found {len(found_t)} of {count} random poses inside the travel"
    if 2 * near_singular > tried and closing.hold(R0, t0) < _LOOSE:
        raise DidNotConverge(
            f"The observations could not be predicted: {found}, needed all; most ways there come "
            "near a singular pose, in which motors and joints do not hold the platform: choose a "
            "home further from it, or joints that do not make the same figure on base and platform."
        )
    raise DidNotConverge(
        f"The observations could not be predicted: {found}, needed all; check the travel (limit "
        "lower, upper) and the home pose of the model."
    )


class _Closing:
    """The equations of legs with lengths, as a system for many poses at once."""

    def __init__(self, legs: Sequence[LegGeometry], frame_legs: Sequence[int]) -> None:
        self.legs = tuple(legs)
        self.columns = list(freedoms(frame_legs))
        self.driven = {j for j, leg in enumerate(legs) if leg.kind is LegKind.ACTUATED}

    def drive(self, R: Array, t: Array) -> None:
        """Let only motors that are independent at a pose draw their lengths; others follow.

        Those are taken that say most beside each other, of what the other demands leave open.
        """
        motors, rank = sorted(self.driven), self.rank(R, t)
        self.driven = set()
        count = rank - self.rank(R, t)
        if count < len(motors):
            size = np.where(np.array(self.columns) < 3, self.lengths(R, t).mean(), 1.0)
            rows = [
                pose_equations([self.legs[j]], R, t, by_local=False).by_pose[0, 0, self.columns]
                for j in motors
            ]
            held = self.system(R, t, None)[1][0] / size
            left = np.eye(len(size)) - np.linalg.pinv(held, rcond=_RANK) @ held
            order = qr((np.array(rows) / size @ left).T, mode="r", pivoting=True)[1]
            motors = [motors[k] for k in order[:count]]
        self.driven = set(motors)

    def rank(self, R: Array, t: Array) -> int:
        """Return the number of independent equations at a pose."""
        slopes = self.system(R, t, self.lengths(R, t))[1][0]
        return int(np.linalg.matrix_rank(slopes, tol=_DEPENDENT)) if slopes.size else 0

    def hold(self, R: Array, t: Array) -> float:
        """Return how well motors and joints hold the platform at a pose: 0 where singular."""
        lengths = self.lengths(R, t)
        scale = np.where(np.array(self.columns) < 3, 1.0 / lengths.mean(), 1.0)
        slopes = self.system(R, t, lengths)[1][0] * scale
        return float(np.linalg.svd(slopes, compute_uv=False)[-1]) if slopes.size else 0.0

    def lengths(self, R: Array, t: Array) -> Array:
        """Return the leg lengths, (k, n_legs) [m]."""
        A, B = np.array([leg.A for leg in self.legs]), np.array([leg.B for leg in self.legs])
        vector = np.einsum("kij,nj->kni", R, B) + t[:, None] - A
        return np.asarray(np.linalg.norm(vector, axis=2))

    def system(self, R: Array, t: Array, wanted: Array | None) -> tuple[Array, Array]:
        """Return residuals (k, m), derivatives (k, m, f); without lengths motors are free."""
        values, slopes = [np.zeros((len(t), 0))], [np.zeros((len(t), 0, 6))]
        for j, leg in enumerate(self.legs):
            found = pose_equations([leg], R, t, by_local=False)
            value, slope = found.values, found.by_pose
            if leg.kind is LegKind.ACTUATED and j in self.driven and wanted is not None:
                value[:, 0] += leg.q0 - wanted[:, j]
            elif leg.kind is LegKind.ACTUATED:
                value, slope = value[:, 1:], slope[:, 1:]
            values.append(value)
            slopes.append(slope)
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)[:, :, self.columns]

    def close(
        self, R: Array, t: Array, wanted: Array | None, iterations: int
    ) -> tuple[Array, Array]:
        """Return poses after some iterations of Newton's method, shortest steps."""
        for _ in range(iterations):
            values, slopes = self.system(R, t, wanted)
            if values.shape[1] == 0:
                break
            step = -(np.linalg.pinv(slopes, rcond=_RANK) @ values[..., None])[..., 0]
            R, t = self.moved(R, t, step)
            if np.abs(step).max(initial=0.0) < 1e-14:
                break
        return R, t

    def moved(self, R: Array, t: Array, step: Array) -> tuple[Array, Array]:
        """Return poses after a step of their possible motions."""
        full = np.zeros((len(t), 6))
        full[:, self.columns] = np.clip(step, -0.3, 0.3)
        return Rotation.from_rotvec(full[:, :3]).as_matrix() @ R, t + full[:, 3:]

    def wander(
        self, R: Array, t: Array, n: int, share: float, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """Return n poses that differ from home as far as no motor holds the platform."""
        lengths = self.lengths(R, t)
        size = float(lengths.mean())
        _, slopes = self.system(R, t, lengths)
        J = slopes[0] if slopes.shape[1] else np.zeros((1, len(self.columns)))
        null = np.eye(len(self.columns)) - np.linalg.pinv(J, rcond=1e-6) @ J
        step = rng.normal(size=(n, len(self.columns))) * share * _FREE @ null.T
        scale = np.where(np.array(self.columns) < 3, 1.0, size)
        return self.moved(np.repeat(R, n, axis=0), np.repeat(t, n, axis=0), step * scale)

    def is_closed(self, R: Array, t: Array, wanted: Array) -> BoolArray:
        """Return which poses meet what legs and lengths demand."""
        values, _ = self.system(R, t, wanted)
        redundant = values.shape[1] > len(self.columns)
        limit = (_NEARLY_CLOSED if redundant else _CLOSED) * self.lengths(R, t).mean(axis=1)
        return np.asarray(np.abs(values).max(axis=1, initial=0.0) <= limit)

    def is_regular(self, R: Array, t: Array, R0: Array, t0: Array) -> BoolArray:
        """Return which poses are as far from singular as a share of home is, on the same side."""
        J = self.system(R, t, self.lengths(R, t))[1]
        J0 = self.system(R0, t0, self.lengths(R0, t0))[1]
        if J.shape[1] == 0:
            return np.ones(len(t), dtype=np.bool_)
        s, s0 = np.linalg.svd(J, compute_uv=False), np.linalg.svd(J0, compute_uv=False)[0]
        last = int(np.sum(s0 > 1e-6 * s0[0])) - 1
        good = s[:, last] > _SINGULAR * s0[last]
        if J.shape[1] == J.shape[2]:
            good &= np.linalg.det(J) * np.linalg.det(J0) >= 0.0
        return np.asarray(good)


def _inside(lengths: Array, travel: Array, home: Array) -> BoolArray:
    """Return which rows of lengths lie inside the travel; home counts as inside."""
    slack = 1e-6 + 0.05 * (travel[:, 1] - travel[:, 0])
    low, high = np.minimum(travel[:, 0], home) - slack, np.maximum(travel[:, 1], home) + slack
    return np.asarray(np.all((lengths >= low) & (lengths <= high), axis=1))


def _one(T: RigidTransform) -> tuple[Array, Array]:
    """Return a pose as arrays of one."""
    return T.rotation.as_matrix()[None], np.asarray(T.translation)[None]


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
