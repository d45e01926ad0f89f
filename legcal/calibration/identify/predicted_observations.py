"""Predicted observations: which legs each camera position shows, at which poses.

They are planned (cameras in default places, random poses) or those of a dataset; what they show
across each body is given with the standard deviation of an outline. Bodies are the legs, and after
them the arms that are cylinders; a view that shows a leg shows the arm that is a part of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.ordered_dataset import nominal_poses
from legcal.data.dataset import Dataset
from legcal.data.reading_units import sigmas_of_legs
from legcal.estimation.problem import Frames
from legcal.geometry.lines import cross
from legcal.geometry.motions import components
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import Actuator, ActuatorColumns, Arm, JointMotion
from legcal.machine.configurations import random_postures_of_legs
from legcal.machine.directions import leg_labels, list_in_words
from legcal.machine.equations import freedoms
from legcal.machine.leg import SIGMA_READING, Leg, LegColumns, LegKind, main_cylinders
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    is_spatial,
    moved_legs,
    parametrization_of,
)
from legcal.machine.rods import (
    actuator_index,
    actuators_of,
    arms_at,
    ends_at_poses,
    first_rods,
    joints_at,
    readings_of_rods,
)
from legcal.machine.ties import Ties, by_step, independent, machine_ties, on_ties, ties_of
from legcal.vision.board import Link
from legcal.vision.camera import shared_cameras

_TIMES = {2: "two", 3: "three", 4: "four"}
SIGMA_PX = 0.1  # of an outline across a leg, in the image
_ALONG = 1e-6  # a leg that points at the camera shows no lateral direction: least |u x ray|
FOCAL_PX = 1290.0  # 1024 x 768 pixels, 43 degrees wide
_DISTANCE = 2.5  # machine sizes
_TILT = 0.5  # [rad] from the normal of a planar machine
_SEED = 2002
_EXACT = 2.5e-7  # mean leg lengths: standard deviation of the constraints of the mechanism
_PERTURBATION = 1e-6  # of the mean leg length, and [rad]
REACHED = 20  # poses, at least, over which errors of the platform are judged
THIN = 0.02  # radius of a leg without a visible cylinder, of the mean leg length


@dataclass(frozen=True, eq=False)
class PredictedObservations:
    """Observations as they will be made, of a machine that is nearly the nominal one."""

    leg_names: tuple[str, ...]
    legs: tuple[Leg, ...]  # in R_b and R_e
    frame_legs: tuple[int, ...]  # those that define R_b and R_e
    parametrization: Parametrization
    radius: Array  # (n_legs,): radius of the cylinder that is seen of each leg [m]
    R: Array  # R, t: (k, 3, 3) and (k, 3): platform poses: rotation and position [m] of R_e in R_b
    t: Array
    # R_reached, t_reached: (w, 3, 3) and (w, 3): poses over which errors of the platform are
    # judged: those above, and more if they are few
    R_reached: Array
    t_reached: Array
    view: IntArray  # view, pose: (n_images,): the view and the pose of each image
    pose: IntArray
    seen: BoolArray  # (n_views, n_legs): the legs that each view shows
    camera: Array  # (n_views, 3): where the cameras stand in R_b [m]
    focal: Array  # (n_views,): their focal lengths [px]
    sigma_q: float  # standard deviation of a reading [m]
    # (n_views,): the views whose images show a calibration board on the base: how these cameras
    # stand to each other is known
    board: BoolArray
    # (n_images,): those that show a calibration board on the platform; none if it is empty
    platform_board: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    tie_constraints: Ties | None = None  # what ties these parameters; frames alone without it
    sigma_by_joint: Mapping[str, float] = field(default_factory=dict)  # where stated [m or rad]
    shows_arms: bool = True  # which a table of axes does not

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @property
    def n_views(self) -> int:
        """Number of camera positions."""
        return len(self.seen)

    @cached_property
    def arms(self) -> dict[int, Arm]:
        """The arms that are cylinders, by the legs that have them as parts."""
        legs = self.legs if self.shows_arms else ()
        return {j: leg.arm for j, leg in enumerate(legs) if leg.arm is not None}

    @property
    def n_bodies(self) -> int:
        """Number of legs and arms."""
        return self.n_legs + len(self.arms)

    @property
    def parts(self) -> tuple[tuple[int, str], ...]:
        """Leg of each body, and the part of an arm, "" of a leg, (n_bodies,)."""
        legs = ((j, "") for j in range(self.n_legs))
        return (*legs, *((j, arm.link) for j, arm in self.arms.items()))

    @cached_property
    def shown(self) -> BoolArray:
        """The bodies that each image shows, (n_images, n_bodies)."""
        return np.asarray(self.seen[:, [j for j, _ in self.parts]][self.view])

    @cached_property
    def body_radius(self) -> Array:
        """Radius of each body, (n_bodies,) [m]."""
        return np.append(self.radius, [arm.radius for arm in self.arms.values()])

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """Both ends of bodies in R_b at every pose, (k, n_bodies, 3) each [m]."""
        legs = self.A_at, self.arm + self.t[:, None]
        arms = [] if not self.arms else list(arms_at(self.legs, self.q).values())
        near, far = (
            np.concatenate([of_legs, *(ends[:, k : k + 1] for ends in arms)], axis=1)
            for k, of_legs in enumerate(legs)
        )
        return near, far

    @cached_property
    def body_u(self) -> Array:
        """Directions of bodies in R_b at every pose, (k, n_bodies, 3)."""
        along = self.ends[1] - self.ends[0]
        return np.asarray(along / np.linalg.norm(along, axis=2, keepdims=True))

    @cached_property
    def arms_by_local(self) -> Array:
        """Derivatives of both ends of arms by numbers of their legs, (k, n_arms, 2, 3, 21).

        Those by the line of an arm (``ActuatorColumns.ARM``) are by its motions (``Line.moved``).
        """
        derivatives = np.zeros((len(self.t), len(self.arms), 2, 3, LegColumns.COUNT))
        for a, motions in enumerate(self._motions_of_arms()):
            for end, (motion, slope) in enumerate(motions):
                derivatives[:, a, end, :, ActuatorColumns.AXIS] = motion.by_axis
                derivatives[:, a, end, :, ActuatorColumns.POINT] = motion.by_point
                derivatives[:, a, end, :, ActuatorColumns.GAIN] = motion.by_gain
                derivatives[:, a, end, :, ActuatorColumns.ARM] = motion.by_A @ slope
        return derivatives

    def _motions_of_arms(self) -> list[list[tuple[JointMotion, Array]]]:
        """Return the motion of both ends of arms, with derivatives (3, 4) by the arm's line."""
        return [
            [
                (actuator.motion(end, self.q[:, a]), slope)
                for end, slope in zip(self.arms[j].ends, self.arms[j].ends_slope(), strict=True)
            ]
            for j, actuator, a in self._carried()
            if j in self.arms
        ]

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

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return is_spatial(self.frame_legs)

    @cached_property
    def views(self) -> tuple[tuple[int, ...], ...]:
        """The legs of each view."""
        return tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in self.seen)

    @cached_property
    def A(self) -> Array:
        """Base joint centres in R_b, (n_legs, 3) [m]; on actuators at reading 0."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def actuators(self) -> tuple[Actuator, ...]:
        """What moves joints at A, each once."""
        return actuators_of(self.legs)

    @cached_property
    def carried_by(self) -> IntArray:
        """Which of the actuators moves A of each leg, (n_legs,); -1 for none."""
        return np.array(actuator_index(self.legs), dtype=np.intp)

    @cached_property
    def q(self) -> Array:
        """Readings of the actuators at every pose, (k, n_actuators) [m or rad]."""
        return readings_of_rods(self.legs, self.R, self.t)

    @cached_property
    def A_at(self) -> Array:
        """Base joint centres in R_b at every pose, (k, n_legs, 3) [m]."""
        return joints_at(self.legs, self.q)

    @cached_property
    def A_by_local(self) -> Array:
        """Their derivatives by the numbers of the legs (LegColumns), (k, n_legs, 3, 21)."""
        derivatives = np.zeros((len(self.t), self.n_legs, 3, LegColumns.COUNT))
        derivatives[..., LegColumns.A] = np.eye(3)
        for j, actuator, a in self._carried():
            motion = actuator.motion(self.legs[j].A, self.q[:, a])
            derivatives[:, j, :, LegColumns.A] = motion.by_A
            derivatives[:, j, :, ActuatorColumns.AXIS] = motion.by_axis
            derivatives[:, j, :, ActuatorColumns.POINT] = motion.by_point
            derivatives[:, j, :, ActuatorColumns.GAIN] = motion.by_gain
        return derivatives

    @cached_property
    def ends_by_reading(self) -> tuple[Array, Array]:
        """Derivatives of both ends in R_b by :attr:`q` in metres, (k, n_bodies, 3, n) each."""
        shape = len(self.t), self.n_bodies, 3, len(self.actuators)
        of_A, of_B = np.zeros(shape), np.zeros(shape)
        for j, actuator, a in self._carried():
            by_q = actuator.motion(self.legs[j].A, self.q[:, a]).by_q
            of_A[:, j, :, a] = by_q * self.unit_of_q[a]
        for body, (j, motions) in enumerate(
            zip(self.arms, self._motions_of_arms(), strict=True), start=self.n_legs
        ):
            a = int(self.carried_by[j])
            for by_reading, (motion, _) in zip((of_A, of_B), motions, strict=True):
                by_reading[:, body, :, a] = motion.by_q * self.unit_of_q[a]
        return of_A, of_B

    @cached_property
    def unit_of_q(self) -> Array:
        """A metre of every reading of :attr:`q` in its own unit, (n_actuators,)."""
        turns = np.array([actuator.turns for actuator in self.actuators], dtype=np.bool_)
        return np.where(turns, 1.0 / self.mean_length, 1.0)

    @cached_property
    def sigma_of_legs(self) -> Array:
        """Standard deviation of the reading of each leg, (n_legs,) [m or rad]."""
        return sigmas_of_legs(self.legs, self.sigma_q, self.sigma_by_joint)

    @property
    def sigma_of_q(self) -> Array:
        """Those of the readings of actuators, (n_actuators,) [m or rad]."""
        return self.sigma_of_legs[first_rods(self.legs)]

    @property
    def on_actuators(self) -> tuple[tuple[tuple[int, ...], bool], ...]:
        """The legs on each actuator, and whether it turns."""
        return tuple(
            (tuple(np.flatnonzero(self.carried_by == a).tolist()), actuator.turns)
            for a, actuator in enumerate(self.actuators)
        )

    @property
    def n_motions(self) -> int:
        """The unknowns of a pose: freedoms of the platform, and readings of actuators."""
        return len(freedoms(self.frame_legs)) + len(self.actuators)

    def _carried(self) -> list[tuple[int, Actuator, int]]:
        """Return the legs whose joint at A moves, by what, and which actuator that is."""
        return [
            (j, leg.actuator, int(self.carried_by[j]))
            for j, leg in enumerate(self.legs)
            if leg.actuator is not None
        ]

    @cached_property
    def arm(self) -> Array:
        """From the origin of R_e to B in the directions of R_b, (k, n_legs, 3) [m]."""
        return np.asarray(np.einsum("kij,nj->kni", self.R, np.array([leg.B for leg in self.legs])))

    @cached_property
    def length(self) -> Array:
        """Leg lengths at every pose, (k, n_legs) [m]."""
        return np.asarray(np.linalg.norm(self.arm + self.t[:, None] - self.A_at, axis=2))

    @cached_property
    def u(self) -> Array:
        """Leg directions in R_b at every pose, (k, n_legs, 3)."""
        return (self.arm + self.t[:, None] - self.A_at) / self.length[..., None]

    @cached_property
    def mean_length(self) -> float:
        """Mean leg length, by which angles become lengths [m]."""
        return float(self.length.mean())

    @property
    def sigma_exact(self) -> float:
        """Standard deviation of the constraints of the mechanism [m]."""
        return _EXACT * self.mean_length

    @cached_property
    def unit(self) -> Array:
        """A metre of every parameter in its own unit, (p,): angles at the leg's length."""
        lengths = np.array([unit == "m" for unit in self.parametrization.units], dtype=np.bool_)
        return np.where(lengths, 1.0, 1.0 / self.mean_length)

    @cached_property
    def local_to_parameters(self) -> Array:
        """Derivative of each leg's numbers by the parameters in metres, (n_legs, 21, p)."""
        n = LegColumns.COUNT
        scattered = [self.parametrization.scatter(np.eye(n), j) for j in range(self.n_legs)]
        return np.array(scattered).reshape(self.n_legs, n, len(self.unit)) * self.unit

    @cached_property
    def ties(self) -> Array:
        """Derivative of what ties the parameters to each other, in metres, (w, p), independent."""
        tie_constraints = self.tie_constraints or ties_of(self.legs, self.frame_legs)
        rows = tie_constraints.at(self.legs)
        return independent(rows, by_step(rows, self.parametrization.place) * self.unit)[1]

    @cached_property
    def with_length(self) -> BoolArray:
        """Which legs have a length that is measured or constant, (n_legs,)."""
        return np.array([leg.kind is not LegKind.PASSIVE for leg in self.legs], dtype=np.bool_)

    def with_board(self, *, board: bool = True, link: Link = "base") -> PredictedObservations:
        """Return the same with a calibration board on a link in all images, or in none."""
        if link == "platform":
            return replace(self, platform_board=np.full(len(self.view), board, dtype=np.bool_))
        return replace(self, board=np.full(self.n_views, board, dtype=np.bool_))

    def columns(self, kind: int) -> IntArray:
        """Return the parameters that stand for one of the numbers (:class:`LegColumns`) of legs."""
        columns_of_legs = self.parametrization.place[:, kind]
        return np.unique(columns_of_legs[columns_of_legs >= 0])


@dataclass(frozen=True, eq=False)
class Across:
    """Two directions across each body at a point of its axis, over their standard deviations."""

    # (n_images, n_bodies, 2, 3): n_lat and n_dep in R_b by their sigma [1/m]; zero where the body
    # is not seen
    gradient: Array
    point: Array  # (n_images, n_bodies, 3): the points in R_b [m]

    def by_camera(self) -> Array:
        """Return derivatives (n_images, n_bodies, 2, 6) by the camera's turn and displacement."""
        turn = -cross(self.point[:, :, None], self.gradient)
        return np.concatenate([turn, -self.gradient], axis=3)


def at_base_joints(predicted: PredictedObservations) -> Across:
    """Return the predicted observations at base joint centres, and at near ends of arms."""
    return _across(predicted, predicted.ends[0][predicted.pose])


def at_platform_joints(predicted: PredictedObservations) -> Across:
    """Return the predicted observations at platform joint centres, and at far ends of arms."""
    return _across(predicted, predicted.ends[1][predicted.pose])


def _across(predicted: PredictedObservations, point: Array) -> Across:
    """Return the directions across bodies at points (n_images, n_bodies, 3)."""
    u = predicted.body_u[predicted.pose]
    ray = point - predicted.camera[predicted.view][:, None]
    distance = np.linalg.norm(ray, axis=2)
    lateral = cross(u, ray / distance[..., None])
    lateral /= np.maximum(np.linalg.norm(lateral, axis=2), _ALONG)[..., None]
    depth = cross(u, lateral)
    sigma_lateral = SIGMA_PX * distance / predicted.focal[predicted.view][:, None]
    sigma_depth = sigma_lateral * distance / predicted.body_radius
    gradient = np.stack(
        [lateral / sigma_lateral[..., None], depth / sigma_depth[..., None]], axis=2
    )
    gradient[~predicted.shown] = 0.0
    return Across(gradient, point)


def planned_observations(
    machine: Machine,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    images: int = 15,  # and poses, a view
    *,
    board: bool = False,  # every image shows a calibration board on the base
    platform_board: bool = False,  # and one on the platform
) -> PredictedObservations:
    """Return a session with cameras in default places and random poses inside the travel.

    It is that of a machine whose every parameter is a micrometre or less from the nominal one, so
    that no symmetry by accident decides. Raises DidNotConverge if the machine cannot move.
    """
    n_poses = images * len(views)
    (legs, length, rng), (R, t) = _random_sessions(machine, max(n_poses, REACHED))
    rng, home = deepcopy(rng), machine.home_of_frames
    A, B = ends_at_pose(legs, home)
    seen = np.zeros((len(views), len(legs)), dtype=np.bool_)
    for v, view in enumerate(views):
        seen[v, list(view)] = True
    return PredictedObservations(
        leg_names=machine.leg_names,
        legs=legs,
        frame_legs=machine.frame_legs,
        parametrization=parametrization_of(machine),
        tie_constraints=machine_ties(machine),
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
        sigma_q=SIGMA_READING * machine.size,
        board=np.full(len(views), board, dtype=np.bool_),
        platform_board=np.full(n_poses, platform_board, dtype=np.bool_),
    )


@lru_cache(maxsize=4)
def _random_sessions(
    machine: Machine, n_poses: int
) -> tuple[tuple[tuple[Leg, ...], float, np.random.Generator], tuple[Array, Array]]:
    """Return :func:`perturbed_machine`, and random poses and readings."""
    home = machine.home_of_frames
    legs, length, rng = perturbed_machine(machine, home)
    travel = travel_of(machine)
    postures = random_postures_of_legs(legs, machine.frame_legs, home, travel, n_poses, rng)
    return (legs, length, rng), postures


def recorded_observations(
    # A view is taken to show the legs that have axes in it; without a table of axes those that it
    # names, or all, which have a visible cylinder
    dataset: Dataset,
    *,
    twists: bool = False,  # count twists of legs and gains of actuators among the parameters
) -> PredictedObservations:
    """Return the session of a dataset.

    Where readings do not give its poses, random ones inside the travel take their place.

    Raises DatasetError if readings are out of reach of the model by more than its errors may be.
    """
    machine, m = dataset.machine, dataset.measurements
    to_Rb, home = machine.T_base_Rb.inv(), machine.home_of_frames
    legs, length, rng = perturbed_machine(machine, home)
    if machine.is_determined:
        R, t = Frames.of(nominal_poses(machine, m)[0])
    else:
        travel = travel_of(machine)
        R, t = random_postures_of_legs(legs, machine.frame_legs, home, travel, m.n_poses, rng)
    parametrization = parametrization_of(machine, twists=twists)
    R_reached, t_reached = R, t
    if 3 * len(t) < len(parametrization):  # too few to tell what no pose would show
        more = random_postures_of_legs(
            legs, machine.frame_legs, home, travel_of(machine), REACHED - len(t), rng
        )
        R_reached, t_reached = np.concatenate([R, more[0]]), np.concatenate([t, more[1]])
    used = np.unique(m.view)
    views = [m.views[v] for v in used]
    seen = np.array(
        [[bool(leg.cylinders) and view.uses(leg.name) for leg in machine.legs] for view in views]
    )
    if dataset.axes is not None:
        shown_legs = np.zeros((len(m.views), len(machine.leg_names)), dtype=np.bool_)
        shown_legs[m.view[dataset.axes.row], dataset.axes.leg] = True
        seen = shown_legs[used]
    A, B = ends_at_pose(legs, home)
    shown = [np.flatnonzero(row).tolist() for row in seen]
    camera = default_cameras(A, B, shown, machine.spatial, rng)
    for v, view in enumerate(views):
        if view.T_base_camera is not None:
            camera[v] = (to_Rb * view.T_base_camera).translation
    return PredictedObservations(
        leg_names=machine.leg_names,
        legs=legs,
        frame_legs=machine.frame_legs,
        parametrization=parametrization,
        tie_constraints=machine_ties(machine),
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
        sigma_by_joint=m.sigma_by_joint,
        board=np.isin(used, m.view[_showing(dataset, "base")]),
        platform_board=_showing(dataset, "platform"),
        shows_arms=dataset.axes is None,
    )


def orientations_of(dataset: Dataset, predicted: PredictedObservations) -> Array:
    """Return R of the camera of every used view in R_b, (n_views, 3, 3).

    Cameras whose place the dataset does not give look at the legs.
    """
    to_Rb, views = dataset.machine.T_base_Rb.inv(), dataset.measurements.views
    orientations = looking_at(predicted)
    for v, view in enumerate(views[i] for i in np.unique(dataset.measurements.view).tolist()):
        if view.T_base_camera is not None:
            orientations[v] = (to_Rb * view.T_base_camera).rotation.as_matrix()
    return orientations


def cameras_of(dataset: Dataset) -> tuple[str, ...]:
    """Return the name of the camera of every used view: that of the first view that has it."""
    m = dataset.measurements
    owners = shared_cameras([view.name for view in m.views], [view.camera for view in m.views])
    return tuple(owners[v] for v in np.unique(m.view).tolist())


def looking_at(predicted: PredictedObservations) -> Array:
    """Return orientations (n_views, 3, 3) of cameras that look at the legs of their views."""
    middle = 0.5 * (predicted.A_at + predicted.arm + predicted.t[:, None]).mean(axis=0)
    orientations = []
    for place, shown in zip(predicted.camera, predicted.seen, strict=True):
        z = (middle[shown] if shown.any() else middle).mean(axis=0) - place
        z /= np.linalg.norm(z)
        x = cross(np.eye(3)[np.argmin(np.abs(z))], z)
        x /= np.linalg.norm(x)
        orientations.append(np.column_stack([x, cross(z, x), z]))
    return np.array(orientations).reshape(-1, 3, 3)


def default_cameras(
    A: Array,  # A, B: (n_legs, 3): joint centres at home, in R_b [m]
    B: Array,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    # planar machines are seen from along their normal, tilted toward the side of the legs
    spatial: bool,
    rng: np.random.Generator,
) -> Array:
    """Return the position of a camera for each view.

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
        outward = (middle[list(seen) or slice(None)] - centre).mean(axis=0)
        outward -= axis * (outward @ axis)
        if np.linalg.norm(outward) < 0.02 * size:  # legs all around: any side will do
            outward = cross(axis, rng.normal(size=3))
        outward /= np.linalg.norm(outward)
        side = cross(axis, outward)
        turn, lift = rng.uniform(-0.15, 0.15), rng.uniform(0.05, 0.3)
        if not spatial:
            lift = 0.5 * np.pi - _TILT + rng.uniform(-0.1, 0.1)
        toward = np.cos(turn) * outward + np.sin(turn) * side
        toward = np.cos(lift) * toward + np.sin(lift) * axis
        places.append(centre + _DISTANCE * size * rng.uniform(0.95, 1.05) * toward)
    return np.array(places).reshape(-1, 3)


def cameras_for(predicted: PredictedObservations, views: Sequence[Sequence[int]]) -> Array:
    """Return the default positions of further cameras, (n_views, 3) in R_b [m]."""
    B = (predicted.arm + predicted.t[:, None]).mean(axis=0)
    rng = np.random.default_rng(_SEED + 1)
    return default_cameras(predicted.A_at.mean(axis=0), B, views, predicted.spatial, rng)


def _axis(A: Array, B: Array) -> Array:
    """Return the direction from base to platform."""
    across = B.mean(axis=0) - A.mean(axis=0)
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(across / size)


def perturbed_machine(
    machine: Machine, home: RigidTransform
) -> tuple[tuple[Leg, ...], float, np.random.Generator]:
    """Return legs near the nominal ones, their mean length at home [m], and a source of chance."""
    rng = np.random.default_rng(_SEED)
    nominal = geometries(machine)
    A, B = ends_at_pose(nominal, home)
    length = float(np.linalg.norm(B - A, axis=1).mean())
    parametrization = parametrization_of(machine)
    scale = np.where([unit == "m" for unit in parametrization.units], length, 1.0)
    legs = perturbed(nominal, parametrization, length, rng)
    return on_ties(legs, nominal, machine_ties(machine), parametrization.place, scale), length, rng


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


def ends_at_pose(legs: Sequence[Leg], T: RigidTransform) -> tuple[Array, Array]:
    """Return the joint centres A and B (n_legs, 3) at a pose, in R_b."""
    A, B = ends_at_poses(legs, *components([T]))
    return A[0], B[0]


def travel_of(machine: Machine) -> Array:
    """Return shortest and longest length of each leg, (n_legs, 2) [m].

    Of rods on actuators it is the travel of these [m or rad].
    """
    travels = []
    for leg in machine.legs:
        if leg.actuator is not None:
            travels.append(list(leg.actuator.travel))
        elif leg.kind is LegKind.CONSTANT:
            travels.append([leg.q0, leg.q0])
        else:
            travels.append(sorted(leg.length_at(q) for q in leg.travel))
    return np.array(travels)


def _showing(dataset: Dataset, link: Link) -> BoolArray:
    """Return the mask of images with the board on a link; all if not searched yet."""
    rows, fixed, corners = (
        range(dataset.measurements.n_rows),
        dataset.board_on(link),
        dataset.corners,
    )
    if fixed is None or corners is None:
        return np.full(len(rows), fixed is not None, dtype=np.bool_)
    return np.isin(rows, corners.row[corners.used & fixed.has(corners.corner)])


def _focal(K: Array) -> float:
    """Return the mean focal length [px]."""
    return float(np.sqrt(K[0, 0] * K[1, 1]))


def legs_around(predicted: PredictedObservations) -> list[int]:
    """Return the legs in their order around the base."""
    A = predicted.A_at.mean(axis=0)
    points = A + (predicted.arm + predicted.t[:, None]).mean(axis=0)
    centred = points - points.mean(axis=0)
    _, _, basis = np.linalg.svd(A - A.mean(axis=0))
    angle = np.arctan2(centred @ basis[1], centred @ basis[0])
    return [int(j) for j in np.argsort(angle, kind="stable")]


def neighbours(ring: Sequence[int], size: int) -> list[tuple[int, ...]]:
    """Return all groups of so many neighbours, (size,) each, in the order of the legs."""
    n = len(ring)
    groups = (
        tuple(sorted(ring[(start + k) % n] for k in range(min(size, n)))) for start in range(n)
    )
    return list(dict.fromkeys(groups))


def ring_distance(ring: Sequence[int], leg: int, others: Sequence[int]) -> int:
    """Return the number of steps around the base from a leg to the nearest of others."""
    place = {j: k for k, j in enumerate(ring)}
    steps = (abs(place[leg] - place[other]) for other in others)
    return min((min(s, len(ring) - s) for s in steps), default=0)


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {list_in_words([labels[leg_names[j]] for j in legs])}"


def views_in_words(views: Sequence[str]) -> str:
    """Return views one after the other, equal ones once: ``1,2,3 from two places``."""
    said = []
    for view in dict.fromkeys(views):
        times = list(views).count(view)
        said.append(view if times == 1 else f"{view} from {_TIMES.get(times, times)} places")
    return "; ".join(said)
