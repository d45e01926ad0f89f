"""A study of outlines: one experiment, and what is asked of its sessions.

The studies of outlines repeat the same sessions (:mod:`legcal.simulation.studies.outlines`). What
differs is the judge: what it records of a session, what it says of all, and what must come out.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2, norm

from legcal.calibration import (
    Choices,
    FittedLegs,
    RefinementSettings,
    Solution,
    Start,
    cameras_from_hints,
    compress,
    eliminate,
    platform_poses,
    refine,
    start_from,
)
from legcal.data import Measurements, Outlines, View, axes_from_outlines
from legcal.errors import DidNotConverge, LegcalError, NotIdentifiable, UsageError
from legcal.geometry import Array, IntArray, components
from legcal.machine import (
    LegGeometry,
    LegKind,
    Mechanism,
    Parametrization,
    freedoms,
    geometries,
    load_mechanism,
    moved_legs,
    parametrize,
    platform_in_base,
    pose_equations,
    pose_sensitivity,
    radius_name,
    vector_of,
)
from legcal.paper import Criteria, NominalMechanism, run_steps
from legcal.simulation.cameras import mild_lens, places_around
from legcal.simulation.observe import shifted_outlines
from legcal.simulation.poses import draw_poses
from legcal.simulation.recording import outlines_of_images
from legcal.simulation.solids import PosedMachine, dressed, pose_machine
from legcal.simulation.studies.paper import RAISED, closed_poses, has_keys, moved_poses
from legcal.simulation.studies.runner import Record, failure_of, is_failure
from legcal.simulation.truth import write_model_with
from legcal.simulation.visibility import Images, Viewpoint, silhouette, take_images
from legcal.vision import Camera


@dataclass(frozen=True, eq=False)
class RunErrors:
    """The errors of one run."""

    error: Array  # (n,) of the parameters, axes as angles from the true ones [m, rad]
    of_sigma: Array  # (n,) the same over the standard deviations that the estimator states
    nse: float  # normalised squared error per parameter by the covariance that it states


def errors_record(errors: RunErrors) -> Record:
    """Return the errors of a run as a record [m, rad]."""
    return {
        "error": errors.error.tolist(),
        "of_sigma": errors.of_sigma.tolist(),
        "nse": errors.nse,
    }


def run_errors(record: Record) -> RunErrors:
    """Return the errors of the record of a fit that ended."""
    return RunErrors(np.array(record["error"]), np.array(record["of_sigma"]), record["nse"])


def is_errors(found: Any) -> bool:
    """Return whether a document has the errors of a fit, or how it failed."""
    if has_keys(found, {"failure"}):
        return is_failure(found["failure"])
    return (
        has_keys(found, {"error", "of_sigma", "nse"})
        and is_number(found["nse"])
        and all(isinstance(found[key], list) for key in ("error", "of_sigma"))
        and len(found["error"]) == len(found["of_sigma"]) > 0
        and all(map(is_number, (*found["error"], *found["of_sigma"])))
    )


def is_number(found: Any) -> bool:
    """Return whether a document is a finite number."""
    return isinstance(found, float | int) and not isinstance(found, bool) and isfinite(found)


COPLANAR, NONCOPLANAR = "6-spu-coplanar", "6-spu-noncoplanar"
MACHINES = (NONCOPLANAR, COPLANAR, "3-upu-tilted", "3-rpr")
SHIPPED = (
    "hexapod",
    "nategh-agheli",
    "6-sps",
    "hexapod-rod",
    "hexapod-strut",
    "3-rps",
    "3-spr",
    "3-upu",
    "3-upu-tilted",
    "tricept",
    "3-rpr",
)
_SIX_LEGS = (NONCOPLANAR, COPLANAR, *SHIPPED[:5])
MOST_LEGS = dict.fromkeys(_SIX_LEGS, 4)  # that a view is said to see, as in the paper


def true_mechanism(name: str) -> Mechanism:
    """Return a true machine of the studies."""
    if name not in (COPLANAR, NONCOPLANAR):
        return load_mechanism(name)
    flat = load_mechanism("hexapod")
    if name == COPLANAR:
        return flat
    up = np.array([0.0, 0.0, RAISED])
    legs = tuple(
        replace(leg, A=leg.A + up, B=leg.B - up) if j % 2 else leg
        for j, leg in enumerate(geometries(flat))
    )
    with tempfile.TemporaryDirectory(prefix="legcal-study-") as folder:
        return load_mechanism(write_model_with(flat, legs, flat.home, Path(folder), {}))


def check_machines(names: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Refuse machines that a study does not have, and those that are named twice."""
    if not names or len(set(names)) < len(names) or not set(names) <= set(known):
        raise UsageError(
            f"The study could not be run: found the machines {', '.join(names) or 'none'}, needed "
            f"some of {', '.join(known)}, each once; choose them."
        )


_SEED = 2002


@dataclass(frozen=True, eq=False)
class OutlineDesign:
    """A true machine, its poses, its cameras and its outlines without noise."""

    leg_names: tuple[str, ...]  # names of the legs
    legs: tuple[LegGeometry, ...]  # the true legs in R_b and R_e
    sign: IntArray  # (n_legs,) leg length = sign * q + q0
    frame_legs: tuple[int, ...]  # the legs that define R_b and R_e
    radii: dict[tuple[int, str], float]  # true radius [m] of each (leg index, part)
    home: RigidTransform  # T_Rb_Re of the pose that the model calls home
    R: Array  # R, t: (n_poses, 3, 3) the true poses of R_e in R_b [m]
    t: Array
    q: Array  # (n_poses, n_legs) exact readings [m]; zero for constant legs, NaN for passive ones
    camera: Camera  # intrinsics of all cameras
    T_Rb_camera: tuple[RigidTransform, ...]  # their true poses
    seen: tuple[tuple[str, ...] | None, ...]  # the legs that each view is said to see; None for all
    view: IntArray  # view, pose: (n_rows,) view and pose of each image
    pose: IntArray
    outlines: Outlines  # what the images show, exactly, with the covariance of the noise

    @property
    def parametrization(self) -> Parametrization:
        """The kinematic parameters."""
        return parametrize(self.leg_names, self.legs, self.frame_legs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is to be found: the kinematic parameters, then the radii observed."""
        radii = (radius_name(self.leg_names[leg], part) for leg, part in self.parts)
        return (*self.parametrization.names, *radii)

    @property
    def parts(self) -> tuple[tuple[int, str], ...]:
        """Leg index and part of each radius that is observed, by leg and name."""
        shown = zip(self.outlines.leg.tolist(), self.outlines.part, strict=True)
        return tuple(sorted(set(shown)))


@lru_cache(maxsize=32)  # a study goes through all of its machines in every run
def design_of(name: str, n_views: int, n_poses: int, sigma_px: float) -> OutlineDesign:
    """Return the design of a machine; the same one in all processes."""
    mechanism = true_mechanism(name)
    rng = np.random.default_rng(_SEED)
    lens = mild_lens()
    drawn = draw_poses(mechanism, n_views * n_poses, rng)
    machines = pose_machine(mechanism, dressed(mechanism), drawn)
    places = places_around(mechanism, machines, [lens] * n_views, rng)
    views = tuple(Viewpoint(f"c{v + 1}", lens, T) for v, T in enumerate(places))
    images = take_images(mechanism.legs, machines, views, 1, shared_poses=False)
    legs = geometries(mechanism)
    R, t = closed_poses(
        legs, mechanism.frame_legs, *_arrays([platform_in_base(mechanism, T) for T in drawn.poses])
    )
    closed = _standing(mechanism, machines, R, t)
    outlines = outlines_of_images(images, closed, views, sigma_px, None)
    seen = _best_legs(images, n_views, MOST_LEGS.get(name, mechanism.n_legs))
    outlines = _only(outlines, np.array([j in seen[images.view[r]] for r, j in _keys(outlines)]))
    return OutlineDesign(
        leg_names=mechanism.leg_names,
        legs=legs,
        sign=mechanism.sign.astype(np.intp),
        frame_legs=mechanism.frame_legs,
        radii={
            (j, part): radius
            for j, leg in enumerate(mechanism.legs)
            for part, radius in leg.radius_of_part.items()
        },
        home=platform_in_base(mechanism, mechanism.home),
        R=R,
        t=t,
        q=_readings(legs, mechanism.sign, R, t),
        camera=lens,
        T_Rb_camera=tuple(mechanism.T_base_Rb.inv() * T for T in places),
        seen=tuple(
            None if len(s) == mechanism.n_legs else tuple(mechanism.leg_names[j] for j in s)
            for s in seen
        ),
        view=images.view,
        pose=images.pose,
        outlines=outlines,
    )


def _standing(
    mechanism: Mechanism, machines: Sequence[PosedMachine], R: Array, t: Array
) -> list[PosedMachine]:
    """Return a machine with its joint centres where the equations of its legs put them."""
    B = np.array([leg.B for leg in geometries(mechanism)])
    placed = np.einsum("kij,lj->kli", R, B) + t[:, None]
    return [
        replace(machine, B=np.asarray(mechanism.T_base_Rb.apply(points)))
        for machine, points in zip(machines, placed, strict=True)
    ]


def _best_legs(images: Images, n_views: int, most: int) -> list[list[int]]:
    """Return the legs, as many as asked for, that are seen longest in each view."""
    found = []
    for v in range(n_views):
        rows = np.flatnonzero(images.view == v)
        length = [[leg.length_px * leg.is_seen for leg in images.shown[r]] for r in rows]
        order = np.argsort(-np.mean(length, axis=0), kind="stable")
        found.append(sorted(order[:most].tolist()))
    return found


def _keys(outlines: Outlines) -> list[tuple[int, int]]:
    """Return the image and the leg of each outline."""
    return list(zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True))


def _only(outlines: Outlines, chosen: Array) -> Outlines:
    """Return some of the outlines."""
    index = np.flatnonzero(chosen)
    return Outlines(
        row=outlines.row[index],
        leg=outlines.leg[index],
        part=tuple(outlines.part[i] for i in index),
        edge=outlines.edge[index],
        h=outlines.h[index],
        ends=outlines.ends[index],
        covariance=outlines.covariance[index],
        used=outlines.used[index],
        reason=("",) * len(index),
        source=("detected",) * len(index),
    )


def _readings(legs: Sequence[LegGeometry], sign: Array, R: Array, t: Array) -> Array:
    """Return the readings of all legs at poses (n_poses, n_legs) [m]."""
    q = np.zeros((len(t), len(legs)))
    for j, leg in enumerate(legs):
        if leg.kind is LegKind.PASSIVE:
            q[:, j] = np.nan
        elif leg.kind is LegKind.ACTUATED:
            length = np.linalg.norm(R @ leg.B + t - leg.A, axis=-1)
            q[:, j] = sign[j] * (length - leg.q0)
    return q


def _arrays(poses: Sequence[RigidTransform]) -> tuple[Array, Array]:
    """Return rotation matrices and positions of poses."""
    together = RigidTransform.concatenate(list(poses))
    rotation: Rotation = together.rotation
    return rotation.as_matrix(), np.asarray(together.translation)


@dataclass(frozen=True)
class StartErrors:
    """How wrong the nominal model and the rough camera poses are."""

    length: float  # of every coordinate of the joints, every offset and constant length [m]
    angle: float  # of every axis [rad]
    # camera_shift, camera_turn: of every camera, in any direction and about any axis [m], [rad]
    camera_shift: float
    camera_turn: float
    # whether all errors have this size, up or down, in any direction; else it is the most that they
    # have, and they are uniform
    full: bool


@dataclass(frozen=True)
class Noise:
    """What is measured how well."""

    # standard deviation of an edge point [px]; every pixel along an outline has one
    sigma_px: float = 0.1
    sigma_q: float = 2e-6  # standard deviation of a reading [m]
    # standard deviation of the nominal radii, as a part of the true ones
    radius_sigma: float = 0.02


@dataclass(frozen=True, eq=False)
class OutlineSession:
    """What was measured, and what was known before."""

    # images, readings and rough camera poses. The base link's frame is R_b
    measurements: Measurements
    outlines: Outlines  # outlines in the images, with their covariances
    leg_names: tuple[str, ...]  # names of the legs
    nominal: tuple[LegGeometry, ...]  # the nominal legs in R_b and R_e
    sign: IntArray  # (n_legs,) leg length = sign * q + q0
    frame_legs: tuple[int, ...]  # the legs that define R_b and R_e
    radii: dict[tuple[int, str], float]  # nominal radius [m] of each (leg index, part)
    # T_Rb_Re of the pose that the nominal model calls home; its legs meet near it
    home: RigidTransform


def draw_session(
    design: OutlineDesign, noise: Noise, errors: StartErrors, rng: np.random.Generator
) -> OutlineSession:
    """Return a measurement of a design."""
    step = _parameter_errors(design.parametrization, errors, rng)
    return OutlineSession(
        measurements=_measurements(design, noise, errors, rng),
        outlines=_outlines(design, rng),
        leg_names=design.leg_names,
        nominal=moved_legs(design.legs, design.parametrization.place, step),
        sign=design.sign,
        frame_legs=design.frame_legs,
        radii={
            part: radius * float(1.0 + noise.radius_sigma * rng.normal())
            for part, radius in design.radii.items()
        },
        home=design.home,
    )


def _parameter_errors(
    parametrization: Parametrization, errors: StartErrors, rng: np.random.Generator
) -> Array:
    """Return by how much the nominal parameters are wrong [m, rad]."""
    unit = rng.uniform(-1.0, 1.0, len(parametrization))
    if errors.full:
        unit = np.sign(unit)
        for place in parametrization.place:
            for axis in (place[7:9], place[9:11]):
                if axis[0] >= 0:
                    unit[axis] = _direction(rng, 2)
    is_angle = np.array([u == "rad" for u in parametrization.units], dtype=np.bool_)
    return np.asarray(np.where(is_angle, errors.angle, errors.length) * unit)


def _measurements(
    design: OutlineDesign, noise: Noise, errors: StartErrors, rng: np.random.Generator
) -> Measurements:
    """Return readings with noise and views with rough camera poses."""
    is_read = [leg.kind is LegKind.ACTUATED for leg in design.legs]
    q = design.q + np.where(is_read, noise.sigma_q, 0.0) * rng.normal(size=design.q.shape)
    views = tuple(
        View(f"c{v + 1}", design.camera, _rough(T, errors, rng), seen)
        for v, (T, seen) in enumerate(zip(design.T_Rb_camera, design.seen, strict=True))
    )
    image = ("",) * len(design.view)
    return Measurements(views, image, design.view, design.pose, q[design.pose], noise.sigma_q)


def _rough(T: RigidTransform, errors: StartErrors, rng: np.random.Generator) -> RigidTransform:
    """Return the pose of a camera as somebody noted it."""
    shift, turn = (1.0, 1.0) if errors.full else rng.random(2)
    turned = Rotation.from_rotvec(errors.camera_turn * turn * _direction(rng, 3))
    moved = errors.camera_shift * shift * _direction(rng, 3)
    return RigidTransform.from_components(T.translation + moved, turned * T.rotation)


def _direction(rng: np.random.Generator, n: int) -> Array:
    """Return a unit vector (n,) that points anywhere."""
    v = rng.normal(size=n)
    return np.asarray(v / np.linalg.norm(v))


def _outlines(design: OutlineDesign, rng: np.random.Generator) -> Outlines:
    """Return outlines with noise."""
    exact = design.outlines
    root = np.linalg.cholesky(exact.covariance)
    offsets = np.einsum("nij,nj->ni", root, rng.normal(size=(len(exact), 2)))
    h, ends = shifted_outlines(design.camera, exact.h, exact.ends, offsets)
    return replace(exact, h=h, ends=ends)


_EXACT = 1e-6  # squared standard deviations


def standing_where_held(
    design: OutlineDesign, session: OutlineSession, solution: Solution
) -> OutlineDesign:
    """Return the machine of the true one's family that stands where a fit holds what is open.

    It is fitted to the exact outlines and readings, from the solution: without noise nothing is
    left of what is determined, and what is open stays.
    """
    if not solution.held:
        return design
    names = design.leg_names
    free = frozenset(radius_name(names[leg], part) for leg, part in solution.radii)
    radii = {**design.radii, **solution.radii}
    exact = refine(
        FittedLegs(names, solution.legs, design.sign, design.frame_legs, radii),
        replace(session.measurements, q=design.q[design.pose]),
        design.outlines,
        Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "found"),
        choices=Choices(free=free),
    )
    if exact.cost > _EXACT or len(exact.held) != len(solution.held):
        raise DidNotConverge(
            "The errors of a fit could not be judged: found no machine that stands where it holds "
            "what is open and shows the same as the true one, needed one; this is a mistake in "
            "legcal, please report it."
        )
    R, t = components(exact.T_Rb_Re)
    return replace(
        design,
        legs=exact.legs,
        radii={**design.radii, **exact.radii},
        R=np.asarray(R),
        t=np.asarray(t),
        T_Rb_camera=tuple(T.inv() for T in exact.T_camera_Rb),
    )


_STEP = 1e-6  # [m] or [rad] of differences
_RANK = 1e-9  # of the largest singular value
_DETERMINED = 1e-12  # of the largest eigenvalue of the scaled information


@dataclass(frozen=True, eq=False)
class Bound:
    """The bound of a design."""

    # names, units: the kinematic parameters, then the radii that are observed; ``m`` or ``rad``
    names: tuple[str, ...]
    units: tuple[str, ...]
    covariance: Array  # (n, n) [m^2], [m rad], [rad^2]; axes count as angles from the true ones

    @property
    def sigma(self) -> Array:
        """Standard deviations (n,) [m, rad]."""
        return np.sqrt(np.diagonal(self.covariance))


def bound_of(design: OutlineDesign, sigma_q: float, radius_sigma: float) -> Bound:
    """Return the Cramer-Rao bound of all outlines, all readings and what is known of the radii."""
    rows = information_of(design, sigma_q, radius_sigma)
    units = (*design.parametrization.units, *("m" for _ in design.parts))
    return Bound(design.names, units, _inverse(rows, design.names))


def information_of(design: OutlineDesign, sigma_q: float, radius_sigma: float) -> Array:
    """Return what all outlines, all readings and what is known of the radii say of a machine."""
    parts = design.parts
    n_cameras, n_parameters = 6 * len(design.T_Rb_camera), len(design.parametrization)
    rows = [*_rows_of_poses(design, sigma_q)]
    known = np.zeros((len(parts), n_cameras + n_parameters + len(parts)))
    radius = np.array([design.radii[part] for part in parts])
    known[:, n_cameras + n_parameters :] = np.diag(1.0 / (radius_sigma * radius))
    rows.append(known)
    return compress(eliminate(np.concatenate(rows)[None], n_cameras))


def _rows_of_poses(design: OutlineDesign, sigma_q: float) -> list[Array]:
    """Return what the images and readings of each pose say of cameras, parameters and radii."""
    n_cameras, n_parameters = 6 * len(design.T_Rb_camera), len(design.parametrization)
    by_pose, by_shared = _outline_rows(design)
    demands = pose_equations(design.legs, design.R, design.t)
    by_parameters = demands.by_parameters(design.parametrization)
    held, read = ~demands.measured, demands.measured
    columns, pose = list(freedoms(design.frame_legs)), design.pose[design.outlines.row]
    parameters = slice(n_cameras, n_cameras + n_parameters)
    found = []
    for k in range(len(design.t)):
        F, G = demands.by_pose[k][:, columns], by_parameters[k]
        of_readings = np.zeros((int(read.sum()), by_shared.shape[-1]))
        of_readings[:, parameters] = G[read] / sigma_q
        seen = pose == k
        own = np.concatenate([by_pose[seen].reshape(-1, 6)[:, columns], F[read] / sigma_q])
        shared = np.concatenate([by_shared[seen].reshape(-1, by_shared.shape[-1]), of_readings])
        follow, free = _allowed(F[held], G[held])
        shared[:, parameters] += own @ follow
        wide = np.concatenate([own @ free, shared], axis=1)
        found.append(eliminate(wide[None], free.shape[1]))
    return found


def _allowed(F: Array, G: Array) -> tuple[Array, Array]:
    """Return how a pose follows xi where F d_pose + G d_xi = 0, and its free motions."""
    _, singular, right = np.linalg.svd(F)
    rank = int(np.sum(singular > _RANK * singular.max(initial=1.0)))
    return -np.linalg.pinv(F, rcond=_RANK) @ G, right[rank:].T


def _outline_rows(design: OutlineDesign) -> tuple[Array, Array]:
    """Return whitened derivatives of all outlines, (n, 2, 6) by their pose and (n, 2, m) by others.

    The others are six motions of each camera, then the kinematic parameters, then the radii.
    """
    truth = _Numbers(design.legs, design.R, design.t, design.T_Rb_camera, design.radii)
    motions, unit = np.eye(6), np.eye(len(design.parametrization))
    of_poses = [partial(_with_poses, truth, motion) for motion in motions]
    of_others = [
        *(
            partial(_with_camera, truth, v, motion)
            for v in range(len(truth.T_Rb_camera))
            for motion in motions
        ),
        *(partial(_with_legs, truth, design.parametrization.place, step) for step in unit),
        *(partial(_with_radius, truth, part) for part in design.parts),
    ]
    ends = design.camera.undistort(design.outlines.ends)
    whitening = np.linalg.inv(np.linalg.cholesky(design.outlines.covariance))
    by_pose, by_others = (
        np.stack([_derivative(design, ends, change) for change in changes], axis=-1)
        for changes in (of_poses, of_others)
    )
    return whitening @ by_pose, whitening @ by_others


@dataclass(frozen=True, eq=False)
class _Numbers:
    """All that decides what images show."""

    legs: Sequence[LegGeometry]
    R: Array
    t: Array
    T_Rb_camera: Sequence[RigidTransform]
    radii: Mapping[tuple[int, str], float]


def _with_poses(truth: _Numbers, motion: Array, size: float) -> _Numbers:
    R, t = moved_poses(truth.R, truth.t, size * motion)
    return replace(truth, R=R, t=t)


def _with_camera(truth: _Numbers, view: int, motion: Array, size: float) -> _Numbers:
    cameras, step = list(truth.T_Rb_camera), size * motion
    cameras[view] = RigidTransform.from_components(
        cameras[view].translation + step[3:],
        Rotation.from_rotvec(step[:3]) * cameras[view].rotation,
    )
    return replace(truth, T_Rb_camera=cameras)


def _with_legs(truth: _Numbers, place: IntArray, step: Array, size: float) -> _Numbers:
    return replace(truth, legs=moved_legs(truth.legs, place, size * step))


def _with_radius(truth: _Numbers, part: tuple[int, str], size: float) -> _Numbers:
    return replace(truth, radii={**truth.radii, part: truth.radii[part] + size})


def _derivative(design: OutlineDesign, ends: Array, change: Callable[[float], _Numbers]) -> Array:
    """Return the derivative (n, 2) [px] of offsets by a step that is taken both ways."""
    ahead, behind = (_offsets(design, ends, change(size)) for size in (_STEP, -_STEP))
    return (ahead - behind) / (2.0 * _STEP)


def _offsets(design: OutlineDesign, ends: Array, numbers: _Numbers) -> Array:
    """Return how far (n, 2) [px] the ends of the true outlines are from those of some numbers."""
    shown, legs, cameras = design.outlines, numbers.legs, numbers.T_Rb_camera
    pose, view, leg = design.pose[shown.row], design.view[shown.row], shown.leg
    A, B = np.array([x.A for x in legs])[leg], np.array([x.B for x in legs])[leg]
    along = np.einsum("nij,nj->ni", numbers.R[pose], B) + numbers.t[pose] - A
    u = along / np.linalg.norm(along, axis=1)[:, None]
    turn = np.array([T.rotation.as_matrix().T for T in cameras])[view]
    centre = np.array([T.translation for T in cameras])[view]
    radius = [numbers.radii[key] for key in zip(leg.tolist(), shown.part, strict=True)]
    h, _ = silhouette(
        np.einsum("nij,nj->ni", turn, u),
        np.einsum("nij,nj->ni", turn, A - centre),
        np.array(radius),
    )
    own = h[np.arange(len(leg)), shown.edge - 1]
    return design.camera.line_offset(own[:, None], ends)


def _inverse(rows: Array, names: Sequence[str]) -> Array:
    """Return the covariance of whitened rows, which must determine everything."""
    information = rows.T @ rows
    diagonal = np.diagonal(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    value, vector = np.linalg.eigh(scale[:, None] * information * scale)
    if value[0] < _DETERMINED * value[-1] or not np.all(diagonal > 0.0):
        worst = np.argsort(-np.abs(vector[:, 0]))[:3]
        raise NotIdentifiable(
            "The bound of a simulated machine could not be computed: found that its images do not "
            f"determine {', '.join(names[i] for i in worst)}, needed all parameters; add views."
        )
    turned = scale[:, None] * vector
    return np.asarray((turned / value) @ turned.T)


@dataclass(frozen=True, eq=False)
class Determined:
    """Independent parts of the errors of the kinematic parameters, and their covariance."""

    parts: Array  # (r, p) what errors [m, rad] are multiplied with
    covariance: Array  # (r, r) of the products

    @property
    def rank(self) -> int:
        """How many directions of the parameters are determined."""
        return len(self.parts)

    def nse(self, error: Array) -> float:
        """Return the normalised squared error of errors (p,) [m, rad] for each direction."""
        sigma = np.sqrt(np.diagonal(self.covariance))
        z = (self.parts @ error) / sigma
        correlation = self.covariance / np.outer(sigma, sigma)
        return float(z @ np.linalg.solve(correlation, z)) / self.rank


def as_stated(design: OutlineDesign, solution: Solution) -> Determined:
    """Return what a fit says of the errors of its values; axes as angles from the nominal ones."""
    known = solution.parametrization.names  # twists too, which are fixed
    place, unit = [known.index(name) for name in design.parametrization.names], _unit(design)
    parts = _across(solution.held_basis[:, place] / unit) / unit
    covariance = solution.value_covariance[np.ix_(place, place)]
    return Determined(parts, np.asarray(parts @ covariance @ parts.T))


def at_best(
    design: OutlineDesign, sigma_q: float, radius_sigma: float, n_held: int = 0
) -> Determined:
    """Return the Cramer-Rao bound of a machine of which some directions are held."""
    n, unit = len(design.parametrization), _unit(design)
    rows = information_of(design, sigma_q, radius_sigma)
    radii_first = np.concatenate([rows[:, n:], rows[:, :n] * unit], axis=1)
    own = compress(eliminate(radii_first[None], rows.shape[1] - n))
    _, _, directions = np.linalg.svd(own)
    parts = _across(directions[n - n_held :])
    seen = np.linalg.qr(own @ parts.T, mode="r")
    root = np.linalg.inv(seen)
    return Determined(parts / unit, np.asarray(root @ root.T))


def _across(directions: Array) -> Array:
    """Return a basis (n - w, n) of what is perpendicular to directions (w, n)."""
    n = directions.shape[1]
    return np.asarray(null_space(directions).T) if len(directions) else np.eye(n)


def _unit(design: OutlineDesign) -> Array:
    """Return a metre of each parameter in its own unit: angles count at the mean leg length."""
    ends = np.einsum("kij,lj->kli", design.R, [leg.B for leg in design.legs]) + design.t[:, None]
    length = float(np.linalg.norm(ends - [leg.A for leg in design.legs], axis=-1).mean())
    is_length = np.array([u == "m" for u in design.parametrization.units], dtype=np.bool_)
    return np.where(is_length, 1.0, 1.0 / length)


def one_fit(session: OutlineSession, radius_sigma: float) -> Solution:
    """Return what one fit of everything finds from the nominal model and rough cameras."""
    legs = FittedLegs(
        session.leg_names, session.nominal, session.sign, session.frame_legs, session.radii
    )
    settings = RefinementSettings(radius_sigma=radius_sigma)
    start = nominal_start(session, legs)
    return refine(legs, session.measurements, session.outlines, start, settings)


def nominal_start(session: OutlineSession, legs: FittedLegs) -> Start:
    """Return the nominal model, moved from home to the readings, and the rough cameras."""
    measurements = session.measurements
    cameras = cameras_from_hints(measurements, RigidTransform.identity())
    home = (session.home,) * measurements.n_poses
    return start_from(session.nominal, measurements, legs, cameras, home, "nominal")


def errors_of(design: OutlineDesign, session: OutlineSession, solution: Solution) -> RunErrors:
    """Return the errors of what was found."""
    missing = [name for name in design.names if solution.status.get(name) != "estimated"]
    if missing:
        raise NotIdentifiable(
            f"The errors of a fit could not be judged: found that {', '.join(missing)} were not "
            "estimated, needed all parameters; give the machine more images."
        )
    names, kinematic = design.names, design.parametrization
    radii = np.array([design.radii[part] for part in design.parts])
    found = np.array([solution.values[name] for name in names])
    truth = np.concatenate([vector_of(kinematic, design.legs, session.nominal), radii])
    of_truth, from_truth = (
        vector_of(kinematic, legs, design.legs) for legs in (design.legs, solution.legs)
    )
    place = [solution.names.index(name) for name in names]
    sigma = solution.sigma[place]
    correlation = solution.covariance[np.ix_(place, place)] / np.outer(sigma, sigma)
    of_sigma = (found - truth) / sigma
    nse = float(of_sigma @ np.linalg.solve(correlation, of_sigma)) / len(names)
    of_radii = found[len(kinematic) :] - radii
    return RunErrors(np.concatenate([from_truth - of_truth, of_radii]), of_sigma, nse)


class Misses(NamedTuple):
    """Root mean square errors of the platform over poses."""

    displacement: float  # of the origin of R_e [m]
    rotation: float  # angle [rad]


def platform_misses(design: OutlineDesign, legs: Sequence[LegGeometry]) -> Misses:
    """Return how far from the truth legs put the platform at the exact readings, rms over poses.

    See :func:`platform_errors`.
    """
    shift, turn = platform_errors(design, legs)
    return Misses(float(np.sqrt(np.mean(shift**2))), float(np.sqrt(np.mean(turn**2))))


def platform_errors(design: OutlineDesign, legs: Sequence[LegGeometry]) -> tuple[Array, Array]:
    """Return how far from the truth legs put the platform at the exact readings."""
    together = RigidTransform.from_components(design.t, Rotation.from_matrix(design.R))
    poses = tuple(together[k] for k in range(len(design.t)))
    lengths = design.sign * design.q + np.array([leg.q0 for leg in legs])
    there = platform_poses(legs, lengths, poses, design.frame_legs)
    shift = [T.translation - T_true.translation for T, T_true in zip(there, poses, strict=True)]
    turn = [
        (T_true.rotation.inv() * T.rotation).magnitude()
        for T, T_true in zip(there, poses, strict=True)
    ]
    return np.linalg.norm(shift, axis=1), np.array(turn)


def predicted_misses(design: OutlineDesign, solution: Solution) -> Misses:
    """Return what the covariance of a solution says of them."""
    follow = pose_sensitivity(
        solution.legs, solution.parametrization, design.frame_legs, design.R, design.t
    )
    variance = np.einsum(
        "kia,ab,kib->ki", follow, solution.kinematic_covariance, follow, optimize=True
    )
    turn, shift = variance[:, :3].sum(axis=1), variance[:, 3:].sum(axis=1)
    return Misses(float(np.sqrt(shift.mean())), float(np.sqrt(turn.mean())))


LEVEL = 0.999  # of sampling bands
COVERED, COVERAGE = 0.95, (0.94, 0.96)
INSIDE = float(norm.ppf(0.5 + 0.5 * COVERED))  # standard deviations on either side
_WIDE = float(norm.ppf(0.5 + 0.5 * LEVEL))
_TOGETHER = 10  # runs: what is believed of the spread of coverage before any, see below


@dataclass(frozen=True)
class Figure:
    """A figure over all parameters, and what it must be."""

    name: str  # ``ratio``, ``nse`` or ``coverage``
    value: float  # what it is
    # low, high: its limits: those that are asked for, or those of chance where the runs are so few
    # that chance leads beyond them
    low: float
    high: float
    by_chance: bool  # whether the limits are those of chance

    @property
    def is_met(self) -> bool:
        """Whether it is within its limits."""
        return self.low <= self.value <= self.high

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        return {
            "value": self.value,
            "limits": [self.low, self.high],
            "limits_of_chance": self.by_chance,
            "met": self.is_met,
        }


def figure_remarks(machine: str, n: int, figures: tuple[Figure, ...]) -> list[str]:
    """Return which figures of n runs are outside their limits, and which limits are of chance."""
    said = [
        f"{machine}: {figure.name} is {figure.value:.4f}, outside {figure.low:.4f} to "
        f"{figure.high:.4f}."
        for figure in figures
        if not figure.is_met
    ]
    few = [figure.name for figure in figures if figure.by_chance]
    if few:
        said.append(
            f"{machine}: {n} runs are too few for the limits of {', '.join(few)}; "
            "those of chance are taken."
        )
    return said


def band_of_ratio(n: int) -> tuple[float, float]:
    """Return where 99.9 % of all root mean squares of n unit Gaussians are."""
    n = max(n, 1)
    low, high = (float(chi2.ppf(0.5 + sign * 0.5 * LEVEL, n)) / n for sign in (-1.0, 1.0))
    return low**0.5, high**0.5


def ratio_figure(value: float, n: int, n_parameters: int, largest: float) -> Figure:
    """Return the figure of all errors over the bound; below it is as wrong as far above it."""
    low, high = band_of_ratio(n * n_parameters)
    return Figure("ratio", value, low, max(largest, high), high > largest)


def nse_figure(value: float, n: int, n_parameters: int, limits: tuple[float, float]) -> Figure:
    """Return the figure of all normalised squared errors."""
    low, high = (limit**2 for limit in band_of_ratio(n * n_parameters))
    by_chance = low < limits[0] or high > limits[1]
    return Figure("nse", value, min(limits[0], low), max(limits[1], high), by_chance)


def coverage_figure(value: float, spread: float, n: int) -> Figure:
    """Return the figure of all intervals; intervals of one run hold the truth together or not."""
    together = COVERED * (1.0 - COVERED)
    variance = (n * spread**2 + _TOGETHER * together) / (n + _TOGETHER)
    half = _WIDE * np.sqrt(variance / max(n, 1))
    by_chance = bool(half > COVERED - COVERAGE[0])
    low, high = min(COVERAGE[0], COVERED - half), max(COVERAGE[1], COVERED + half)
    return Figure("coverage", value, float(low), float(high), by_chance)


def staged_legs(session: OutlineSession, criteria: Criteria) -> tuple[LegGeometry, ...]:
    """Return the legs that the four steps find from the axes which the outlines give."""
    radii = {part: radius for (_, part), radius in session.radii.items()}
    axes = axes_from_outlines(session.outlines, session.measurements, radii)
    mechanism = NominalMechanism(
        session.leg_names, session.nominal, session.sign, session.frame_legs
    )
    return run_steps(mechanism, axes, session.measurements, criteria=criteria).legs


IN_WORDS = (
    "Machines: the shipped hexapod (coplanar), the same with joints 2, 4 and 6 moved 30 mm out "
    "of the planes of 1, 3 and 5 (non-coplanar), the shipped 3-upu-tilted and 3-rpr."
)
SHIPPED_IN_WORDS = "Machines: the shipped models are the true ones."


def readings(noise: Noise, errors: StartErrors, n_views: int, n_poses: int) -> tuple[str, ...]:
    """Return how an experiment is made, one sentence each."""
    return (
        f"{n_views} cameras of 1024 x 768 px see {n_poses} extreme poses each, no two the same; of "
        "a machine with six legs or more each is said to see the four legs that it sees best. "
        "Machine, poses and cameras are drawn once: the bound is one matrix, at the truth.",
        f"Every pixel along an outline is an edge point with {noise.sigma_px:g} px of white noise "
        "(1 sigma): the covariance of a fitted line is known. Readings have "
        f"{1e6 * noise.sigma_q:g} um.",
        f"Nominal radii are Gaussian, {100.0 * noise.radius_sigma:g} % (1 sigma), and so is what "
        "the fit takes them for.",
        _start(errors),
        "The fit sees outlines, readings, the nominal model and the rough camera poses. It "
        "estimates the noise and guards against wrong outlines as in any calibration. Twists of "
        "legs without an S joint are known (`legcal calibrate` has a prior on them).",
    )


def _start(errors: StartErrors) -> str:
    """Return how wrong what the fit starts from is."""
    length, angle = f"{1e3 * errors.length:g} mm", f"{np.rad2deg(errors.angle):g} deg"
    shift = f"{1e3 * errors.camera_shift:g} mm"
    turn = f"{np.rad2deg(errors.camera_turn):g} deg"
    if errors.full:
        return (
            f"In every run the nominal model is wrong by {length}, up or down, in every coordinate "
            f"of a joint and every offset, and by {angle} in every axis, in any direction; every "
            f"camera pose by {shift} and {turn}, in any direction and about any axis."
        )
    return (
        f"In every run the nominal model is wrong by up to {length} in every coordinate of a joint "
        f"and every offset, and by up to {angle} in both angles of every axis (uniform); every "
        f"camera pose by up to {shift} and {turn}."
    )


RecordOf = Callable[[OutlineDesign, OutlineSession], Record]
"""Says what an estimator makes of a session; raises a LegcalError where it makes nothing of it."""


@dataclass(frozen=True)
class OutlineExperiment:
    """Calibrations from outlines whose covariance is known."""

    errors: StartErrors  # how wrong the nominal model and the rough camera poses are
    machines: tuple[str, ...] = MACHINES  # which machines
    noise: Noise = field(default_factory=Noise)  # what is measured how well
    # n_views, n_poses: cameras, and the poses that each of them sees; no two see the same
    n_views: int = 3
    n_poses: int = 15
    known: tuple[str, ...] = MACHINES  # the machines to choose from

    def __post_init__(self) -> None:
        check_machines(self.machines, self.known)

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a session beside its seed."""
        return {key: value for key, value in asdict(self).items() if key != "known"}

    @property
    def readings(self) -> tuple[str, ...]:
        """How it is made, one sentence each."""
        told = IN_WORDS if self.known == MACHINES else SHIPPED_IN_WORDS
        return (told, *readings(self.noise, self.errors, self.n_views, self.n_poses))

    def design(self, machine: str) -> OutlineDesign:
        """Return what is the same in all sessions of a machine."""
        return design_of(machine, self.n_views, self.n_poses, self.noise.sigma_px)

    def session(self, machine: str, rng: np.random.Generator) -> OutlineSession:
        """Return a session of a machine."""
        return draw_session(self.design(machine), self.noise, self.errors, rng)

    def judged(self, seed: np.random.SeedSequence, record_of: RecordOf) -> Record:
        """Return by machine what is to be kept of one session, or how the estimator failed.

        The session of a machine does not depend on which others there are.
        """
        seeds = dict(zip(self.known, seed.spawn(len(self.known)), strict=True))
        record: Record = {}
        for machine in self.machines:
            session = self.session(machine, np.random.default_rng(seeds[machine]))
            try:
                record[machine] = record_of(self.design(machine), session)
            except LegcalError as error:
                record[machine] = {"failure": failure_of(error)}
        return record


if TYPE_CHECKING:
    from rich.console import RenderableType


class Finding(Protocol):
    """What all sessions of a machine showed."""

    @property
    def is_met(self) -> bool:
        """Whether it is what must come out."""

    def document(self) -> dict[str, Any]:
        """Return it as a JSON document."""


F = TypeVar("F", bound=Finding)
F_co = TypeVar("F_co", bound=Finding, covariant=True)


class Tally(Protocol[F_co]):
    """Takes the records of one machine one by one."""

    def add(self, record: Record) -> None:
        """Count a session, or how the judge could make nothing of it."""

    def found(self) -> F_co:
        """Return what they showed."""


class Judge(Protocol[F]):
    """What is asked of every session. It is sent to worker processes, and must pickle."""

    @property
    def name(self) -> str:
        """Name of the study on the command line."""

    def record(
        self, experiment: OutlineExperiment, design: OutlineDesign, session: OutlineSession
    ) -> Record:
        """Return what is kept of a session; a LegcalError is kept as a failure."""

    def is_record(self, found: Any) -> bool:
        """Return whether a document is what :meth:`record` returns, or such a failure."""

    def tally(self, experiment: OutlineExperiment, machine: str) -> Tally[F]:
        """Return what takes the records of a machine."""

    def table(self, found: Sequence[F], readings: Sequence[str]) -> RenderableType:
        """Return what was found of all machines for people."""

    def files(self, found: Sequence[F], readings: Sequence[str]) -> dict[str, bytes]:
        """Return the files that belong to it by name."""


@dataclass(frozen=True)
class OutlineStudy(Generic[F]):
    """Many sessions of every machine before one judge."""

    judge: Judge[F]  # what is asked
    experiment: OutlineExperiment  # the sessions

    @property
    def name(self) -> str:
        """Its name on the command line."""
        return self.judge.name

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that decides a run beside its seed."""
        return self.experiment.settings

    def one_run(self, seed: np.random.SeedSequence) -> Record:
        """Return by machine what the judge keeps of one session."""
        return self.experiment.judged(seed, partial(self.judge.record, self.experiment))

    def is_record(self, found: Any) -> bool:
        """Return whether a document has what the judge keeps of every machine."""
        machines = set(self.experiment.machines)
        return has_keys(found, machines) and all(map(self.judge.is_record, found.values()))

    def summary(self, records: Iterable[Record]) -> OutlineSummary[F]:
        """Return what all runs showed."""
        machines = self.experiment.machines
        tallies = {name: self.judge.tally(self.experiment, name) for name in machines}
        for record in records:
            for machine, tally in tallies.items():
                tally.add(record[machine])
        found = tuple(tally.found() for tally in tallies.values())
        return OutlineSummary(self.judge, found, self.experiment.readings)


@dataclass(frozen=True, eq=False)
class OutlineSummary(Generic[F]):
    """What a study of outlines hands back."""

    judge: Judge[F]  # what was asked
    machines: tuple[F, ...]  # what was found, in the order in which machines were asked for
    readings: tuple[str, ...]  # how the experiment was made, one sentence each

    def document(self) -> dict[str, Any]:
        """Return the document of ``--json``."""
        return {
            "machines": [found.document() for found in self.machines],
            "met": all(found.is_met for found in self.machines),
            "readings": list(self.readings),
        }

    def table(self) -> RenderableType:
        """Return the table for people."""
        return self.judge.table(self.machines, self.readings)

    def files(self) -> dict[str, bytes]:
        """Return the files that belong to it."""
        return self.judge.files(self.machines, self.readings)
