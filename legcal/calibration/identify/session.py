"""The images of a session before the fit: poses, cameras, and the legs that each camera shows.

They are planned (cameras in default places, random poses) or those of a dataset. The machine is
nearly the nominal one: every parameter is a micrometre or less away, so that no symmetry by
accident decides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import BoardCorners
from legcal.calibration.joint_fit.parameter_choices import Choices
from legcal.calibration.joint_fit.predicted import (
    DEFAULT_NOISE,
    Contributions,
    PredictedNoise,
    information_of_images,
    predicted_corners,
    predicted_outlines,
    readings_at,
)
from legcal.calibration.joint_fit.variables import FittedLegs, Start
from legcal.calibration.ordered_dataset import nominal_poses
from legcal.data.corners import Corners, join_corners
from legcal.data.dataset import Dataset
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines, join_outlines
from legcal.data.reading_units import sigmas_of_legs
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import Frames
from legcal.geometry.lines import cross
from legcal.geometry.motions import components, look_at
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.closing import solve_poses
from legcal.machine.configurations import random_poses
from legcal.machine.equations import pose_sensitivity
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.leg import (
    LINKS,
    SIGMA_READING,
    Cylinder,
    Leg,
    LegKind,
    Link,
    radius_name,
)
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    Parametrization,
    geometries,
    moved_legs,
    parametrization_of,
)
from legcal.machine.rods import (
    actuator_index,
    ends_at_poses,
)
from legcal.machine.ties import machine_ties, on_ties
from legcal.perception.body_edges import predicted_edges
from legcal.vision.board import Board, FixedBoard, facing_board
from legcal.vision.camera import sample_camera
from legcal.vision.visibility import Bodies, visible_parts

_DISTANCE = 2.5  # machine sizes
_TILT = 0.5  # [rad] from the normal of a planar machine
_SEED = 2002
_PERTURBATION = 1e-6  # of the mean leg length, and [rad]
REACHED = 20  # poses, at least, over which errors of the platform are judged
THIN = 0.02  # radius of a leg without a visible cylinder, of the mean leg length
_BOARD = 0.5  # half side of a board on the platform, over the spread of its joints
_SQUARES = 8  # along both of its sides


@dataclass(frozen=True, eq=False)
class Session:
    """Images as they will be taken, of a machine that is nearly the nominal one."""

    machine: Machine
    legs: tuple[Leg, ...]  # in R_b and R_e, nearly the nominal ones
    parametrization: Parametrization
    R: Array  # R, t: (k, 3, 3) and (k, 3): platform poses: rotation and position [m] of R_e in R_b
    t: Array
    # R_reached, t_reached: (w, 3, 3) and (w, 3): poses over which errors of the platform are
    # judged: those above, and more if they are few
    R_reached: Array
    t_reached: Array
    view: IntArray  # view, pose: (n_images,): the view and the pose of each image
    pose: IntArray
    seen: BoolArray  # (n_views, n_legs): the legs that each view shows
    cameras: tuple[View, ...]  # of each view, where it stands in R_b
    sigma_q: Array  # (n_legs,) standard deviations of readings [m or rad]
    unread: BoolArray  # (k, n_legs): which readings are missing
    # (n_views,): the views whose images show a calibration board on the base: how these cameras
    # stand to each other is known
    board: BoolArray
    # (n_images,): those that show a calibration board on the platform; none if it is empty
    platform_board: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    boards: Mapping[Link, Board] = field(default_factory=dict)  # those whose dimensions are known
    # outlines and edges of bodies that are there; without them those that are predicted
    found: Outlines | None = None
    found_edges: Outlines | None = None

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @property
    def n_views(self) -> int:
        """Number of camera positions."""
        return len(self.seen)

    @cached_property
    def places(self) -> tuple[RigidTransform, ...]:
        """Where the camera of each view stands, T_Rb_camera."""
        places = (view.T_base_camera for view in self.cameras)
        return tuple(T for T in places if T is not None)

    @cached_property
    def motion(self) -> Array | None:
        """Motion of the platform (w, 6, p) by parameters in metres; None if it is not known."""
        poses = self.R_reached, self.t_reached
        try:
            moved = pose_sensitivity(
                self.legs, self.parametrization, self.machine.frame_legs, *poses
            )
        except NotIdentifiable:
            return None
        return moved * self.unit

    @property
    def reached(self) -> tuple[RigidTransform, ...]:
        """The poses T_Rb_Re over which errors of the platform are judged."""
        return Frames(self.R_reached, self.t_reached).motions

    @cached_property
    def fitted(self) -> FittedLegs:
        """The legs as the joint fit takes them; a leg without any visible part has a thin rod."""
        shortest, legs = self.length.min(axis=0).tolist(), list(self.legs)
        for j in self.machine.unseen_legs:
            thin = Cylinder(legs[j].name, THIN * self.mean_length, "base", 0.0, shortest[j])
            legs[j] = replace(legs[j], cylinders=(thin,))
        radii = {(j, p): r for j, leg in enumerate(legs) for p, r in leg.radius_of_part.items()}
        m = self.machine
        return FittedLegs(m.leg_names, tuple(legs), m.frame_legs, radii, m.home_of_frames)

    @property
    def radii(self) -> dict[str, float]:
        """Radii of all parts, by their names [m]."""
        names = self.machine.leg_names
        return {radius_name(names[j], part): r for (j, part), r in self.fitted.radii.items()}

    @cached_property
    def outlines(self) -> Outlines:
        """Outlines that are there, or of all that views show, whatever may hide it."""
        if self.found is not None:
            return self.found
        tables = []
        for v, view in enumerate(self.cameras):
            row = np.flatnonzero(self.view == v)
            pose = self.pose[row]
            bodies = Bodies.at(self.fitted.nominal, self.R[pose], self.t[pose], self.mean_length)
            seen = visible_parts(view.camera, self.places[v], bodies, stated=self.seen[v])
            tables.append(predicted_outlines(seen, row))
        return join_outlines(tables)

    @cached_property
    def edges(self) -> Outlines:
        """Edges of bodies that are there, or of the legs that views show."""
        if self.found_edges is not None:
            return self.found_edges
        views = [(view.camera, T) for view, T in zip(self.cameras, self.places, strict=True)]
        A, B = (end[self.pose] for end in self.ends)
        solids = [solid for solid in self.machine.occluders if solid.leg >= 0]
        return predicted_edges(solids, views, self.view, (A, B), self.seen)

    @cached_property
    def measurements(self) -> Measurements:
        """The images, with the readings of their poses."""
        q = np.where(self.unread, np.nan, readings_at(self.legs, self.R, self.t))
        return Measurements(
            views=self.cameras,
            image=("",) * len(self.view),
            view=self.view,
            pose=self.pose,
            q=q[self.pose],
            sigma_q=self.sigma_q,
        )

    def contributions(
        self,
        choices: Choices,
        noise: PredictedNoise = DEFAULT_NOISE,
        known_length: float | None = None,  # of weak priors
    ) -> Contributions:
        """Return the information of the joint fit of these images."""
        board, T_link_board = self._corners()
        start = Start(
            self.fitted.nominal,
            tuple(T.inv() for T in self.places),
            Frames(self.R, self.t).motions,
            "identify",
            *(T_link_board.get(link, RigidTransform.identity()) for link in LINKS),
        )
        return information_of_images(
            self.fitted,
            self.measurements,
            self.outlines,
            start,
            noise,
            choices,
            board=board,
            edges=self.edges,
            known_length=known_length,
        )

    def _corners(self) -> tuple[BoardCorners | None, dict[Link, RigidTransform]]:
        """Return the corners of boards in images, and the poses of boards in R_b and R_e.

        A board is centred on the joints of its link; without one of its own it is about as large.
        """
        fixed, tables, poses = list[FixedBoard](), list[Corners](), dict[Link, RigidTransform]()
        joints_of = {"base": self.ends[0][0], "platform": np.array([leg.B for leg in self.legs])}
        shown = {"base": self.board[self.view], "platform": self.platform_board}
        for link in LINKS:
            image, joints, px = np.flatnonzero(shown[link]), joints_of[link], list[Array]()
            if not len(image):
                continue
            middle = joints.mean(axis=0)
            _, spread, axes = np.linalg.svd(joints - middle)
            square = 2.0 * _BOARD * float(spread[0]) / np.sqrt(len(joints)) / (_SQUARES - 2)
            board = self.boards.get(link, Board("chessboard", _SQUARES, _SQUARES, square))
            poses[link] = facing_board(board, middle, axes[2], axes[1])
            points = poses[link].apply(board.points)
            for v, k in zip(self.view[image].tolist(), self.pose[image].tolist(), strict=True):
                in_Rb = points if link == "base" else points @ self.R[k].T + self.t[k]
                px.append(self.cameras[v].camera.project(self.places[v].inv().apply(in_Rb)))
            first = sum(one.board.n_corners for one in fixed)
            fixed.append(FixedBoard(board, link, first=first))
            tables.append(predicted_corners(fixed[-1], image, np.array(px)))
        return BoardCorners(tuple(fixed), join_corners(tables)) if fixed else None, poses

    @cached_property
    def frame(self) -> IntArray:
        """The frame in which each view shows the legs, (n_views,): with a board one for all."""
        first = int(np.argmax(self.board))
        frame = np.where(self.board, first, np.arange(self.n_views))
        return np.asarray(np.unique(frame, return_inverse=True)[1])

    @cached_property
    def views(self) -> tuple[tuple[int, ...], ...]:
        """The legs of each view."""
        return tuple(tuple(int(j) for j in np.flatnonzero(row)) for row in self.seen)

    @cached_property
    def carried_by(self) -> IntArray:
        """Which of the actuators moves A of each leg, (n_legs,); -1 for none."""
        return np.array(actuator_index(self.legs), dtype=np.intp)

    @cached_property
    def ends(self) -> tuple[Array, Array]:
        """A and B in R_b at every pose, (k, n_legs, 3) [m]."""
        return ends_at_poses(self.legs, self.R, self.t)

    @property
    def on_actuators(self) -> tuple[tuple[tuple[int, ...], bool], ...]:
        """The legs on each actuator, and whether it turns."""
        return tuple(
            (tuple(np.flatnonzero(self.carried_by == a).tolist()), actuator.turns)
            for a, actuator in enumerate(self.machine.actuators)
        )

    @cached_property
    def length(self) -> Array:
        """Leg lengths at every pose, (k, n_legs) [m]."""
        return np.asarray(np.linalg.norm(self.ends[1] - self.ends[0], axis=2))

    @cached_property
    def u(self) -> Array:
        """Leg directions in R_b at every pose, (k, n_legs, 3)."""
        return (self.ends[1] - self.ends[0]) / self.length[..., None]

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
    def with_length(self) -> BoolArray:
        """Which legs have a length that is measured or constant, (n_legs,)."""
        return np.array([leg.kind is not LegKind.PASSIVE for leg in self.legs], dtype=np.bool_)

    def with_board(self, link: Link = "base") -> Session:
        """Return the same with a calibration board on a link in all images."""
        if link == "platform":
            return replace(self, platform_board=np.ones(len(self.view), dtype=np.bool_))
        return replace(self, board=np.ones(self.n_views, dtype=np.bool_))

    def with_outlines_of(self, dataset: Dataset) -> Session:
        """Return the same with the outlines of its dataset, if it says where they are.

        The poses of cameras and of the platform have to be known.
        """
        is_placed = all(view.T_base_camera is not None for view in dataset.measurements.views)
        if dataset.observations is None or not (is_placed and dataset.machine.is_determined):
            return self
        return replace(self, found=dataset.observations, found_edges=dataset.body_edges)

    def columns(self, kind: int) -> IntArray:
        """Return the parameters that stand for one of the numbers (:class:`LegColumns`) of legs."""
        columns_of_legs = self.parametrization.place[:, kind]
        return np.unique(columns_of_legs[columns_of_legs >= 0])


def planned_session(
    machine: Machine,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    images: int = 15,  # and poses, a view
    *,
    board: bool = False,  # every image shows a calibration board on the base
    platform_board: bool = False,  # and one on the platform
    hand_held: bool = False,  # views are images of one camera in a hand
) -> Session:
    """Return a session with cameras in default places and random poses inside the travel.

    Raises DidNotConverge if the machine cannot move.
    """
    n_poses = images * len(views)
    (legs, rng), (R, t) = _random_sessions(machine, max(n_poses, REACHED))
    rng = deepcopy(rng)
    seen = np.zeros((len(views), len(legs)), dtype=np.bool_)
    for v, view in enumerate(views):
        seen[v, list(view)] = True
    A, B = ends_at_pose(legs, machine.home_of_frames)
    return Session(
        machine=machine,
        legs=legs,
        parametrization=parametrization_of(machine),
        R=R[:n_poses],
        t=t[:n_poses],
        R_reached=R,
        t_reached=t,
        view=np.repeat(np.arange(len(views)), images),
        pose=np.arange(n_poses),
        seen=seen,
        cameras=default_cameras(A, B, views, machine.spatial, rng, hand_held=hand_held),
        sigma_q=sigmas_of_legs(machine.legs, SIGMA_READING * machine.size),
        unread=np.zeros((n_poses, len(legs)), dtype=np.bool_),
        board=np.full(len(views), board, dtype=np.bool_),
        platform_board=np.full(n_poses, platform_board, dtype=np.bool_),
    )


@lru_cache(maxsize=4)
def _random_sessions(
    machine: Machine, n_poses: int
) -> tuple[tuple[tuple[Leg, ...], np.random.Generator], tuple[Array, Array]]:
    """Return :func:`perturbed_machine`, and random poses and readings."""
    legs, rng = perturbed_machine(machine)
    return (legs, rng), random_postures(machine, legs, n_poses)


def random_postures(machine: Machine, legs: Sequence[Leg], count: int) -> tuple[Array, Array]:
    """Return random poses of R_e in R_b inside the travel, where the constraints of legs hold.

    The legs are nearly those of the machine.
    """
    R, t = components(platforms_in_base(machine, random_poses(machine, count, _SEED)[1]))
    solved = solve_poses(legs, machine.frame_legs, R, t)
    return solved.R, solved.t


def recorded_session(
    # A view is taken to show the legs that it names, or all, which have a visible cylinder
    dataset: Dataset,
    *,
    twists: bool = False,  # count twists of legs and gains of actuators among the parameters
) -> Session:
    """Return the session of a dataset.

    Where readings do not give its poses, random ones inside the travel take their place.

    Raises DatasetError if readings are out of reach of the model by more than its errors may be.
    """
    machine, m = dataset.machine, dataset.measurements
    to_Rb = machine.T_base_Rb.inv()
    legs, rng = perturbed_machine(machine)
    if machine.is_determined:
        R, t = Frames.of(nominal_poses(machine, m)[0])
    else:
        R, t = random_postures(machine, legs, m.n_poses)
    parametrization = parametrization_of(machine, twists=twists)
    R_reached, t_reached = R, t
    if 3 * len(t) < len(parametrization):  # too few to tell what no pose would show
        n_drawn = 0 if machine.is_determined else len(t)  # the same poses are drawn first
        R_more, t_more = random_postures(machine, legs, REACHED - len(t) + n_drawn)
        R_reached = np.concatenate([R, R_more[n_drawn:]])
        t_reached = np.concatenate([t, t_more[n_drawn:]])
    used = np.unique(m.view)
    views = [m.views[v] for v in used]
    of_views = [[view.uses(leg.name) for leg in machine.legs] for view in views]
    seen = np.array(of_views, dtype=np.bool_)
    seen[:, list(machine.unseen_legs)] = False
    A, B = ends_at_pose(legs, machine.home_of_frames)
    shown = [np.flatnonzero(row).tolist() for row in seen]
    placed = default_cameras(A, B, shown, machine.spatial, rng)
    cameras = tuple(
        replace(
            view,
            T_base_camera=default.T_base_camera
            if view.T_base_camera is None
            else to_Rb * view.T_base_camera,
        )
        for view, default in zip(views, placed, strict=True)
    )
    return Session(
        machine=machine,
        legs=legs,
        parametrization=parametrization,
        R=R,
        t=t,
        R_reached=R_reached,
        t_reached=t_reached,
        view=np.searchsorted(used, m.view),
        pose=m.pose,
        seen=seen,
        cameras=cameras,
        sigma_q=m.sigma_q,
        unread=np.isnan(m.q_of_poses),
        board=np.isin(used, m.view[_showing(dataset, "base")]),
        platform_board=_showing(dataset, "platform"),
        boards={fixed.link: fixed.board for fixed in dataset.boards},
    )


def default_cameras(
    A: Array,  # A, B: (n_legs, 3): joint centres at home, in R_b [m]
    B: Array,
    views: Sequence[Sequence[int]],  # the legs that each view shows
    # planar machines are seen from along their normal, tilted toward the side of the legs
    spatial: bool,
    rng: np.random.Generator,
    *,
    hand_held: bool = False,
) -> tuple[View, ...]:
    """Return a camera in R_b for each view, which looks at the legs that it shows.

    No two of them stand in the same place, even if they show the same legs.
    """
    points = np.concatenate([A, B])
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = 0.5 * (A + B)
    centre = middle.mean(axis=0)
    axis = _axis(A, B) if spatial else np.array([0.0, 0.0, 1.0])
    cameras = []
    for v, seen in enumerate(views):
        target = middle[list(seen) or slice(None)].mean(axis=0)
        outward = target - centre
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
        place = look_at(centre + _DISTANCE * size * rng.uniform(0.95, 1.05) * toward, target)
        camera = replace(sample_camera(), gamma_is_given=False)
        cameras.append(View(str(v + 1), camera, place, hand_held=hand_held))
    return tuple(cameras)


def _axis(A: Array, B: Array) -> Array:
    """Return the direction from base to platform."""
    across = B.mean(axis=0) - A.mean(axis=0)
    size = float(np.linalg.norm(across))
    if size < 1e-6:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(across / size)


def perturbed_machine(machine: Machine) -> tuple[tuple[Leg, ...], np.random.Generator]:
    """Return legs near the nominal ones, and a source of chance."""
    rng = np.random.default_rng(_SEED)
    nominal, parametrization = geometries(machine), parametrization_of(machine)
    A, B = ends_at_pose(nominal, machine.home_of_frames)
    length = float(np.linalg.norm(B - A, axis=1).mean())
    scale = np.where([unit == "m" for unit in parametrization.units], length, 1.0)
    step = _PERTURBATION * scale * rng.uniform(-1.0, 1.0, len(scale))
    legs = moved_legs(nominal, parametrization.place, step)
    return on_ties(legs, nominal, machine_ties(machine), parametrization.place, scale), rng


def ends_at_pose(legs: Sequence[Leg], T: RigidTransform) -> tuple[Array, Array]:
    """Return the joint centres A and B (n_legs, 3) at a pose, in R_b."""
    A, B = ends_at_poses(legs, *components([T]))
    return A[0], B[0]


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


def legs_around(session: Session) -> list[int]:
    """Return the legs in their order around the base."""
    A, B = (end.mean(axis=0) for end in session.ends)
    points = A + B
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
