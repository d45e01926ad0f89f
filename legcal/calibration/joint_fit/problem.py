"""From a state to residuals and derivatives: the chain rule around the residuals.

A measurement in the image depends on both ends of a leg in the camera frame; these depend on
joints, camera and platform pose. Rotations change by Cayley's map from the left: a camera turns in
its own frame, a platform about the origin of R_e in the directions of R_b.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from legcal.calibration.joint_fit.biases import SharedShifts
from legcal.calibration.joint_fit.choices import Choices
from legcal.calibration.joint_fit.constraints import Start, with_values
from legcal.calibration.joint_fit.observations import (
    ObservedAxes,
    ObservedBoard,
    ObservedOutlines,
    Readings,
    no_board,
    observed_axes,
    readings,
)
from legcal.calibration.joint_fit.residuals import (
    Places,
    Rows,
    axis_residual,
    corner_residual,
    encoder_residual,
    outline_residual,
    places,
    prior_residual,
)
from legcal.calibration.joint_fit.state import FittedLegs, Layout, State, intrinsic_of
from legcal.data import Measurements
from legcal.geometry import Array, IntArray, components, cross
from legcal.machine import LegGeometry, freedoms, n_bonds, tied_twist, tied_twist_slope, turn_slope
from legcal.vision import (
    Camera,
    intrinsic_names,
    shared_cameras,
    undistort_derivatives,
    with_intrinsics,
)


@dataclass(frozen=True, eq=False)
class Couplings:
    """The unknowns of all measurements, by what they measure.

    Attributes
    ----------
    outlines, readings, axes, corners : Places
    """

    outlines: Places
    readings: Places
    axes: Places
    corners: Places


def couple(
    layout: Layout,
    outlines: ObservedOutlines,
    encoders: Readings,
    axes: ObservedAxes,
    board: ObservedBoard,
) -> Couplings:
    """Return what outlines, readings, axes and corners of the board depend on."""
    place, n_kept, n_poses = layout.place, layout.n_kept, layout.n_poses
    of_outlines = np.concatenate(
        [
            place[outlines.leg, :6],
            layout.camera[outlines.view],
            layout.radius[outlines.radius, None],
            layout.bias[outlines.bias_index],
            layout.intrinsic[outlines.view],
        ],
        axis=1,
    )
    of_axes = np.concatenate([place[axes.leg, :6], layout.camera[axes.view]], axis=1)
    of_corners = np.concatenate(
        [
            layout.camera[board.view],
            _for_each(layout.board, len(board)),
            _for_each(layout.board_scale, len(board)),
            layout.intrinsic[board.view],
        ],
        axis=1,
    )
    no_pose = np.zeros(len(board), dtype=np.intp)  # their derivatives by it are zero
    return Couplings(
        places(of_outlines, outlines.pose, n_kept, n_poses),
        places(place[encoders.leg, :7], encoders.pose, n_kept, n_poses),
        places(of_axes, axes.pose, n_kept, n_poses),
        places(of_corners, no_pose, n_kept, n_poses),
    )


def _for_each(position: IntArray, n: int) -> IntArray:
    """Return the same positions for each of n measurements."""
    return np.broadcast_to(position, (n, len(position)))


_BASE_AXIS, _PLATFORM_AXIS, _TWIST = slice(7, 9), slice(9, 11), 11  # among the numbers of a leg
_ANGLES = slice(7, 12)


@dataclass(frozen=True, eq=False)
class Priors:
    """Gaussian priors on single named unknowns.

    Attributes
    ----------
    layout : Layout
    position : (n,) array of int
        Positions in x.
    mean, sigma : (n,) array
        Means and standard deviations [m, rad, px].
    """

    layout: Layout
    position: IntArray
    mean: Array
    sigma: Array

    def __len__(self) -> int:
        return len(self.position)

    def linearize(self, state: State, legs: FittedLegs) -> tuple[Array, Array]:
        """Return whitened residuals (n,) and derivatives (n, n_kept) of all priors."""
        value = named_values(state, self.layout, legs)[self.position]
        data = np.column_stack([self.mean, 1.0 / self.sigma])
        r, slope = prior_residual().evaluate(value[:, None], data)
        J = np.zeros((len(self), self.layout.n_kept))
        if len(self):
            by_x = np.eye(self.layout.n_named)
            if np.isin(self.position, self.layout.place[:, _ANGLES]).any():
                by_x = named_jacobian(state, self.layout, legs)
            J[:, : len(by_x)] = slope[:, 0] * by_x[self.position]
        return r[:, 0], J


def named_values(state: State, layout: Layout, legs: FittedLegs) -> Array:
    """Return the values of the named unknowns, (n_named,), in the order of x."""
    kinematic = legs.vector(state.legs)[layout.kinematic < layout.size]
    radii = state.radii[layout.radius < layout.size]
    scale = state.board_scale[layout.board_scale < layout.size]
    return np.concatenate([kinematic, radii, state.biases, _intrinsics(state, layout), scale])


@lru_cache(maxsize=2)  # several ask for it at one state
def named_jacobian(state: State, layout: Layout, legs: FittedLegs) -> Array:
    """Return the derivative (n_named, n_named) of the values of named unknowns by x.

    It is one but for axes.
    """
    J = np.eye(layout.n_named)
    free = layout.kinematic < layout.size
    for leg, nominal, place, number in zip(
        state.legs, legs.nominal, layout.place, legs.parametrization.place, strict=True
    ):
        both = (leg.base_axis, nominal.base_axis), (leg.platform_axis, nominal.platform_axis)
        for columns, axes in zip((_BASE_AXIS, _PLATFORM_AXIS), both, strict=True):
            if np.all(place[columns] >= layout.size):
                continue
            by = np.zeros((len(free), 2))
            by[number[columns]] = turn_slope(*axes)
            if columns is _PLATFORM_AXIS and number[_TWIST] >= 0:
                by[number[_TWIST]] = -tied_twist_slope(leg, nominal)
            for x, column in zip(place[columns], by.T, strict=True):
                if x < layout.size:
                    J[: layout.n_kinematic, x] = column[free]
    J.flags.writeable = False
    return J


def _intrinsics(state: State, layout: Layout) -> Array:
    """Return the values of the intrinsics that are unknowns, in their order."""
    positions, first = np.unique(layout.intrinsic, return_index=True)
    n_keys = max(len(layout.intrinsic_keys), 1)
    return np.array(
        [
            intrinsic_of(state.cameras[place // n_keys], layout.intrinsic_keys[place % n_keys])
            for position, place in zip(positions.tolist(), first.tolist(), strict=True)
            if position < layout.size
        ]
    )


@dataclass(frozen=True, eq=False)
class FirstValues:
    """Where radii, intrinsics and the size of the board begin; those that are fixed stay there.

    Attributes
    ----------
    radii : (n_radii,) array
        Radii [m].
    cameras : tuple of Camera
        The camera of each view.
    board_scale : float
        Factor on the dimensions of the calibration board.
    """

    radii: Array
    cameras: tuple[Camera, ...]
    board_scale: float = 1.0


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A fit, built and not yet solved.

    Attributes
    ----------
    legs : FittedLegs
    choices : Choices
        What is fixed, freed or known.
    layout : Layout
    outlines : ObservedOutlines
    readings : Readings
    axes : ObservedAxes
    board : ObservedBoard
        The corners of a calibration board that stands on the base.
    priors : Priors
    first : FirstValues
        Where what no start tells begins.
    couplings : Couplings
        The unknowns of each measurement.
    named : tuple of str
        Names of the first unknowns of x: kinematic parameters, radii, biases, intrinsics, the size
        of the calibration board.
    named_units : tuple of str
        Their units: ``m``, ``rad``, ``px`` or none.
    held : (w, n_kept) array
        Orthonormal directions of x that the solver must not move along.
    rejected_corners : tuple of (int, int)
        View and number of the corners of the board that were left out.
    """

    legs: FittedLegs
    choices: Choices
    layout: Layout
    outlines: ObservedOutlines
    readings: Readings
    axes: ObservedAxes
    board: ObservedBoard
    priors: Priors
    first: FirstValues
    couplings: Couplings
    named: tuple[str, ...]
    named_units: tuple[str, ...]
    held: Array
    rejected_corners: tuple[tuple[int, int], ...] = ()

    @property
    def n_unknowns(self) -> int:
        """Number of unknowns; a pose counts with the freedoms that its constraints leave."""
        bound = 6 - len(freedoms(self.legs.frame_legs)) + sum(map(n_bonds, self.legs.nominal))
        return self.layout.n_kept + max(6 - bound, 0) * self.layout.n_poses

    @property
    def n_equations(self) -> int:
        """Number of residuals, priors left out."""
        return (
            2 * len(self.outlines) + len(self.readings) + 4 * len(self.axes) + 2 * len(self.board)
        )

    def begin(self, start: Start) -> State:
        """Return the state at a start, with everything that is fixed at its value."""
        return State(
            self.tied(with_values(start.legs, self.legs, self._fixed())),
            self.first.radii,
            np.zeros(len(self.layout.bias)),
            self.first.cameras,
            *components(start.T_camera_Rb),
            *components(start.T_Rb_Re),
            *components([start.T_Rb_board]),
            np.array([self.first.board_scale]),
        )

    def tied(self, geometry: tuple[LegGeometry, ...]) -> tuple[LegGeometry, ...]:
        """Return legs whose fixed angles are where they are fixed, whatever turned the axes.

        Turning an axis away and back on another way leaves what is tied to it turned about it, and
        turning it by one of its angles changes the other a little.
        """
        moved = geometry
        if self._half_fixed:
            at = {i: value for i, value in self._fixed().items() if i in self._half_fixed}
            moved = with_values(moved, self.legs, at)
        return tuple(
            replace(leg, twist=tied_twist(leg, nominal, self._fixed_twist(j, nominal.twist)))
            if nominal.twist is not None and leg.platform_joint == "" and not self._is_free(j, -1)
            else leg
            for j, (leg, nominal) in enumerate(zip(moved, self.legs.nominal, strict=True))
        )

    def _is_free(self, leg: int, number: int) -> bool:
        """Say whether one of the numbers of a leg is an unknown."""
        return bool(self.layout.place[leg, number] < self.layout.size)

    def _fixed_twist(self, leg: int, nominal: float) -> float:
        return self.choices.values.get(f"{self.legs.names[leg]}.twist", nominal)

    def _fixed(self) -> dict[int, float]:
        """Return the values of the kinematic parameters that are no unknowns, by their number."""
        legs, layout = self.legs, self.layout
        values = legs.vector(legs.nominal)
        return {
            i: self.choices.values.get(name, float(values[i]))
            for i, name in enumerate(legs.parametrization.names)
            if layout.kinematic[i] >= layout.size
        }

    @cached_property
    def _half_fixed(self) -> frozenset[int]:
        """The angles of axes that are fixed where the other one is not."""
        place, found = self.legs.parametrization.place, set[int]()
        for j in range(self.legs.n_legs):
            for pair in ((7, 8), (9, 10)):
                fixed = [n for n in pair if place[j, n] >= 0 and not self._is_free(j, n)]
                if len(fixed) == 1:
                    found.add(int(place[j, fixed[0]]))
        return frozenset(found)

    def measured_ends(self, state: State) -> tuple[Array, Array]:
        """Return the ends of outlines on the sensor plane, and how they move with intrinsics.

        Returns
        -------
        xy : (n, 2, 2) array
            Both ends.
        by_intrinsics : (n, 2, 2, n_keys) array
            Their derivatives by the intrinsics that are unknowns.
        """
        return self._on_sensor(state, self.outlines.view, self.outlines.feet, self.outlines.pixels)

    def measured_corners(self, state: State) -> tuple[Array, Array]:
        """Return the corners of the board on the sensor plane, and how they move with intrinsics.

        Returns
        -------
        xy : (n, 2) array
        by_intrinsics : (n, 2, n_keys) array
        """
        return self._on_sensor(state, self.board.view, self.board.feet, self.board.pixels)

    def _on_sensor(
        self, state: State, view: IntArray, feet: Array, pixels: Array
    ) -> tuple[Array, Array]:
        """Return points (n, ..., 2) of images on the sensor plane, and (n, ..., 2, n_keys)."""
        keys = self.layout.intrinsic_keys
        xy, slopes = feet.copy(), np.zeros((*feet.shape, len(keys)))
        if not keys:
            return xy, slopes
        for v in np.unique(view):
            camera, of_view = state.cameras[v], view == v
            known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
            seen = pixels[of_view]
            xy[of_view] = camera.undistort(seen)
            some = np.zeros((*seen.shape, len(keys)))
            some[..., known] = undistort_derivatives(camera, seen, [keys[k] for k in known])
            slopes[of_view] = some
        return xy, slopes


def with_measurements(
    problem: FitProblem,
    measurements: Measurements,
    outlines: ObservedOutlines,
    biases: SharedShifts,
) -> FitProblem:
    """Return a problem with the same unknowns but shifts, and other images without axes and board.

    Parameters
    ----------
    problem : FitProblem
    measurements : Measurements
        Of the same views.
    outlines : ObservedOutlines
        Their outlines; the parts of the problem come first in theirs, others have known radii.
    biases : SharedShifts
        The shifts that these outlines share.
    """
    layout = problem.layout.of_poses(measurements.n_poses)
    of_others = np.full(len(outlines.parts) - len(layout.parts), layout.size, dtype=np.intp)
    radius = np.concatenate([layout.radius, of_others])
    other = replace(
        problem,
        layout=replace(layout, radius=radius, parts=outlines.parts),
        outlines=outlines,
        readings=readings(measurements, problem.legs),
        axes=observed_axes(None, measurements, problem.legs),
        board=no_board(),
    )
    return with_biases(other, biases)


def with_biases(problem: FitProblem, biases: SharedShifts) -> FitProblem:
    """Return a problem in which outlines share unknown shifts, in place of those it had.

    Parameters
    ----------
    problem : FitProblem
    biases : SharedShifts
    """
    old = problem.layout
    n_old, n_new = len(old.bias), len(biases.names)
    first = int(old.bias[0]) if n_old else _first_after_radii(old)

    def moved(position: IntArray) -> IntArray:
        later = np.where(position >= first + n_old, position + n_new - n_old, position)
        return np.asarray(later, dtype=np.intp)

    layout = replace(
        old,
        place=moved(old.place),
        kinematic=moved(old.kinematic),
        radius=moved(old.radius),
        bias=first + np.arange(n_new, dtype=np.intp),
        intrinsic=moved(old.intrinsic),
        camera=moved(old.camera),
        board_scale=moved(old.board_scale),
        board=moved(old.board),
        n_kept=old.n_kept + n_new - n_old,
    )
    priors = problem.priors
    known = ~np.isin(priors.position, old.bias)
    outlines = replace(problem.outlines, bias_index=biases.index, bias_shift=biases.shift)
    held = np.zeros((len(problem.held), layout.n_kept))
    kept = np.r_[0:first, first + n_old : old.n_kept]
    held[:, moved(kept)] = problem.held[:, kept]
    return replace(
        problem,
        layout=layout,
        outlines=outlines,
        priors=Priors(
            layout,
            np.concatenate([moved(priors.position[known]), layout.bias]),
            np.concatenate([priors.mean[known], np.zeros(n_new)]),
            np.concatenate([priors.sigma[known], biases.sigmas]),
        ),
        named=_inserted(problem.named, biases.names, first, n_old),
        named_units=_inserted(problem.named_units, biases.units, first, n_old),
        held=held,
        couplings=couple(layout, outlines, problem.readings, problem.axes, problem.board),
    )


def _first_after_radii(layout: Layout) -> int:
    """Return where biases stand if there are none yet."""
    return layout.n_kinematic + int(np.sum(layout.radius < layout.size))


def _inserted(
    names: tuple[str, ...], new: tuple[str, ...], first: int, n_old: int
) -> tuple[str, ...]:
    """Return names with others in place of *n_old* from *first* on."""
    return (*names[:first], *new, *names[first + n_old :])


def unknown_intrinsics(
    views: Sequence[str], cameras: Sequence[Camera], owners: Sequence[str], choices: Choices
) -> tuple[IntArray, tuple[str, ...], tuple[str, ...]]:
    """Return the unknown intrinsic of each view (n_views, n_keys), what they are, their names."""
    asked = {*choices.free, *choices.priors}
    names = [
        f"{view}.{key}"
        for view, camera in zip(views, cameras, strict=True)
        if view in owners
        for key in intrinsic_names(camera)
        if f"{view}.{key}" in asked
    ]
    keys = tuple(dict.fromkeys(name.rsplit(".", 1)[1] for name in names))
    number = {name: i for i, name in enumerate(names)}
    index = [[number.get(f"{owner}.{key}", -1) for key in keys] for owner in owners]
    return np.array(index, dtype=np.intp).reshape(len(views), len(keys)), keys, tuple(names)


def chosen_cameras(measurements: Measurements, choices: Choices) -> tuple[Camera, ...]:
    """Return the camera of each view with the intrinsics that are fixed at given values."""
    views = measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    cameras = []
    for view, owner in zip(views, owners, strict=True):
        given = {
            key: choices.values[f"{owner}.{key}"]
            for key in intrinsic_names(view.camera)
            if f"{owner}.{key}" in choices.values
        }
        cameras.append(with_intrinsics(view.camera, given) if given else view.camera)
    return tuple(cameras)


@dataclass(frozen=True, eq=False)
class Linearization:
    """Whitened residuals of all kinds at a state.

    Attributes
    ----------
    outlines, readings, axes, corners : Rows
        Two, one, four and two rows a measurement.
    prior_r, prior_J : (n,) and (n, n_kept) array
    """

    outlines: Rows
    readings: Rows
    axes: Rows
    corners: Rows
    prior_r: Array
    prior_J: Array


@dataclass(frozen=True, eq=False)
class _Ends:
    """Both ends of legs in the camera frame, and what their derivatives are made of."""

    A: Array  # (n, 3) from the camera, in its directions, and B likewise
    B: Array
    A_turned: Array  # without the camera's place
    B_turned: Array
    arm: Array  # (n, 3) from the origin of R_e to B, in R_b
    R_camera: Array  # (n, 3, 3)
    R_pose: Array

    def with_radius(self, slope: Array) -> tuple[Array, Array]:
        """Return the same with what comes after the ends: radius, biases, intrinsics."""
        J, J_pose = self.by_unknowns(slope[..., :6])
        return np.concatenate([J, slope[..., 6:]], axis=-1), J_pose

    def by_unknowns(self, slope: Array) -> tuple[Array, Array]:
        """Return derivatives by A, B, camera and by the pose from those by both ends."""
        by_A, by_B = slope[..., :3], slope[..., 3:6]
        a, b = by_A @ self.R_camera, by_B @ self.R_camera
        turn = cross(self.A_turned[:, None], by_A) + cross(self.B_turned[:, None], by_B)
        J = np.concatenate([a, b @ self.R_pose, turn, by_A + by_B], axis=-1)
        return J, np.concatenate([cross(self.arm[:, None], b), b], axis=-1)


def linearize(problem: FitProblem, state: State, whitening: Array) -> Linearization:
    """Return whitened residuals and derivatives of all measurements at a state.

    Parameters
    ----------
    problem : FitProblem
    state : State
    whitening : (n_outlines, 2, 2) array
        Lower triangular T of each outline: T C T^T = 1 [1/px]; zero leaves an outline out.
    """
    r, J = problem.priors.linearize(state, problem.legs)
    return Linearization(
        outline_rows(problem, state).whitened(whitening),
        _reading_rows(problem, state),
        _axis_rows(problem, state),
        corner_rows(problem, state),
        r,
        J,
    )


def outline_rows(problem: FitProblem, state: State) -> Rows:
    """Return the offsets (n, 2) [px] of all outlines with their derivatives."""
    o = problem.outlines
    ends = _ends_in_camera(state, o.leg, o.view, o.pose)
    xy, by_intrinsics = problem.measured_ends(state)
    n = len(o)
    radius = state.radii[o.radius, None]
    local = np.concatenate([ends.A, ends.B, radius, xy.reshape(n, 4)], axis=1)
    r, slope = outline_residual().evaluate(local, o.constants)
    if not o.bias_index.shape[1] and not by_intrinsics.shape[-1]:
        return Rows(r, slope[..., :7], ends.with_radius)
    r = r - np.einsum("nc,ncq->nq", state.biases[o.bias_index], o.bias_shift)
    along = slope[..., 7:].reshape(n, 2, 2, 2)  # by (end, coordinate)
    others = [
        -np.swapaxes(o.bias_shift, 1, 2),
        np.einsum("nqec,neck->nqk", along, by_intrinsics),
    ]
    return Rows(r, np.concatenate([slope[..., :7], *others], axis=-1), ends.with_radius)


def offsets_of(problem: FitProblem, state: State) -> Array:
    """Return the offsets (n, 2) [px] of all outlines at a state."""
    return outline_rows(problem, state).r


def _reading_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened closures of all legs with readings."""
    e = problem.readings
    arm = _arms(state)[e.pose, e.leg]
    R_pose = state.R_pose[e.pose]
    local = np.column_stack([state.A[e.leg], state.t_pose[e.pose] + arm, state.lengths[e.leg]])
    r, slope = encoder_residual().evaluate(local, e.length[:, None])

    def chain(slope: Array) -> tuple[Array, Array]:
        b = slope[..., 3:6]
        J = np.concatenate([slope[..., :3], b @ R_pose, slope[..., 6:]], axis=-1)
        return J, np.concatenate([cross(arm[:, None], b), b], axis=-1)

    return Rows(r, slope, chain).scaled(1.0 / e.sigma)


def _axis_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened residuals of all measured axes."""
    a = problem.axes
    ends = _ends_in_camera(state, a.leg, a.view, a.pose)
    r, slope = axis_residual().evaluate(
        np.concatenate([ends.A, ends.B], axis=1),
        np.concatenate([a.M, a.basis.reshape(-1, 6)], axis=1),
    )
    return Rows(r, slope, ends.by_unknowns).whitened(a.whitening)


def corner_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened residuals of the corners of a calibration board; no pose moves them."""
    c = problem.board
    R_camera = state.R_camera[c.view]
    arm = c.point @ state.R_board[0].T
    grown = state.board_scale[0] * arm
    turned = _times(R_camera, grown + state.t_board)
    xy, by_intrinsics = problem.measured_corners(state)
    local = np.concatenate([turned + state.t_camera[c.view], xy], axis=1)
    r, slope = corner_residual().evaluate(local, c.constants)

    def chain(slope: Array) -> tuple[Array, Array]:
        in_camera = slope[..., :3]
        in_base = in_camera @ R_camera
        J = np.concatenate(
            [
                cross(turned[:, None], in_camera),
                in_camera,
                cross(grown[:, None], in_base),
                in_base,
                in_base @ arm[..., None],
                slope[..., 3:] @ by_intrinsics,
            ],
            axis=-1,
        )
        return J, np.zeros((*slope.shape[:2], 6))

    by_sigma = 1.0 / c.sigma[:, None]
    return Rows(by_sigma * r, by_sigma[..., None] * slope, chain)


def _ends_in_camera(state: State, leg: IntArray, view: IntArray, pose: IntArray) -> _Ends:
    """Return both ends of legs in the camera frames of views at poses."""
    R_camera, t = state.R_camera[view], state.t_camera[view]
    arm = _arms(state)[pose, leg]
    A = (state.A @ np.swapaxes(state.R_camera, 1, 2))[view, leg]
    B = _times(R_camera, state.t_pose[pose] + arm)
    return _Ends(A + t, B + t, A, B, arm, R_camera, state.R_pose[pose])


def _arms(state: State) -> Array:
    """Return what leads from the origin of R_e to B in R_b, (n_poses, n_legs, 3)."""
    return np.asarray(state.B @ np.swapaxes(state.R_pose, 1, 2))


def _times(R: Array, v: Array) -> Array:
    """Return R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])
