"""Section 3.2: base joint centres and revolute axes in the camera frames, eqs (6) and (7).

All axes (u, M) of one leg in the images of one view meet in its base joint centre A, and are
normal to the revolute axis v of that joint:

    (M - A) x u = 0   (6)        v . u = 0   (7)

In a planar machine the axes v of a view are one common normal.

The most uncertain direction in an image is the tilt of a leg towards the camera. With weights,
directions are adjusted to the joints from all images of the view: an axis through A and the point
M, which is accurate, has a much better direction than its outlines give.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.measurements import Measurements
from legcal.data.outlines import LegAxes
from legcal.errors import NotIdentifiable
from legcal.geometry.lines import cross, turned_axis
from legcal.geometry.motions import register_points
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.paper.equations import (
    angles_of,
    axis_frames,
    axis_slope,
    joint_on_axis,
    leg_across_axis,
)
from legcal.paper.least_squares import (
    LeastSquares,
    Term,
    adjusted,
    inverse_of,
    solve_least_squares,
)
from legcal.paper.unknowns import NominalMachine

_SAME_DIRECTION = 1e-9  # minimum eigenvalue of the normalised information of different directions
_OUTLIER = 8.0  # minimum standard deviations of an outlier, or medians where these are too small
_ROUNDING = 1e-14  # relative rounding of a difference of variances
_AXIS = slice(3, 6)  # v in the covariance of a joint


@dataclass(frozen=True, eq=False)
class JointsInCamera:
    """Base joint centres and revolute axes in the frame of each view; zero where not located."""

    A: Array  # (n_views, n_legs, 3) [m]
    v: Array  # (n_views, n_legs, 3); the common normal in a plane; zero without an axis
    located: BoolArray  # (n_views, n_legs)
    # (n_views, n_legs, 6, 6) of A [m^2] and of v; zero for absent parts, and without weights
    covariance: Array
    axes: LegAxes  # of located joints; with weights, adjusted to these
    observed: LegAxes  # the same as the images gave them
    diagnostics: tuple[str, ...]  # legs that were left out of views, with reasons

    @property
    def axis_located(self) -> BoolArray:
        """Mask of the located revolute axes, (n_views, n_legs)."""
        return np.asarray(np.any(self.v != 0.0, axis=2))


def locate_joints_in_cameras(
    machine: NominalMachine, axes: LegAxes, measurements: Measurements, *, weighted: bool
) -> JointsInCamera:
    """Locate base joint centres and revolute axes in each camera frame, eqs (6) and (7).

    Raises NotIdentifiable if some leg has two different directions in no view, or if motors move
    joints at A, which the paper does not have.
    """
    if any(leg.actuator is not None for leg in machine.legs):
        raise NotIdentifiable(
            "The four steps could not be run: found joints at the base that motors move, needed "
            "joints that stay; the joint fit needs no steps."
        )
    bundles = _Bundles.of(machine, axes, measurements)
    reasons = bundles.undetermined()
    left_out = tuple(
        f"The base joint of leg {machine.leg_names[j]} in view {measurements.views[v].name} was "
        f"left out: {reason}."
        for v, j, reason in zip(bundles.view, bundles.leg, reasons, strict=True)
        if reason
    )
    clear = np.array([not reason for reason in reasons], dtype=np.bool_)
    missing = np.setdiff1d(np.arange(machine.n_legs), bundles.leg[clear]).tolist()
    if missing:
        raise NotIdentifiable(
            [
                f"The base joint of leg {machine.leg_names[j]} could not be located: found no view "
                "that shows the leg in two different directions, needed one; add images in which "
                "it is visible."
                for j in missing
            ]
            + list(left_out)
        )
    axes = axes.choose(np.flatnonzero(clear[bundles.of_axis]))
    joints = _Bundles.of(machine, axes, measurements).joints(
        machine, measurements, weighted=weighted
    )
    joints = replace(joints, diagnostics=(*left_out, *joints.diagnostics))
    joints = _with_axes(machine, joints, measurements, weighted=weighted)
    return oriented(machine, joints) if machine.spatial else joints


# Joint centres


@dataclass(frozen=True, eq=False)
class _Bundles:
    """The axes of each leg in each view, which meet in its base joint."""

    axes: LegAxes
    view: IntArray  # (n,)
    leg: IntArray  # (n,)
    of_axis: IntArray  # (k,): the bundle of each axis
    problem: LeastSquares  # (6), three unknowns a bundle

    @classmethod
    def of(cls, machine: NominalMachine, axes: LegAxes, measurements: Measurements) -> _Bundles:
        """Return the bundles of a session, by view and leg, with (6) of all of them."""
        key = measurements.view[axes.row] * machine.n_legs + axes.leg
        distinct, of_axis = np.unique(key, return_inverse=True)
        view, leg = np.divmod(distinct, machine.n_legs)
        place = 3 * of_axis.reshape(-1, 1) + np.arange(3)
        term = Term(joint_on_axis(), place, (axes.u, axes.M, axes.basis), axes.covariance)
        problem = LeastSquares("The base joints (eq 6)", (term,), np.zeros(3 * len(leg)))
        return cls(axes, view, leg, of_axis.ravel(), problem)

    def undetermined(self) -> list[str]:
        """Return for each bundle why (6) has no unique solution, or ""."""
        reasons = []
        count = np.bincount(self.of_axis, minlength=len(self.leg)).tolist()
        for n, F in zip(
            count, self._blocks(self.problem.jacobian(self.problem.start)), strict=True
        ):
            if np.linalg.eigvalsh(F)[0] > _SAME_DIRECTION * n:
                reasons.append("")
            elif n == 1:
                reasons.append(
                    "it was found in one image, and at least two different directions are needed"
                )
            else:
                reasons.append(f"its direction is the same in all {n} images, and two are needed")
        return reasons

    def joints(
        self, machine: NominalMachine, measurements: Measurements, *, weighted: bool
    ) -> JointsInCamera:
        """Return the joints by (6), and the axes, adjusted to them with weights."""
        solution, left_out = solve_least_squares(self.problem), tuple[str, ...]()
        axes = observed = self.axes
        C = np.zeros((len(self.leg), 3, 3))
        if weighted:
            problem = replace(self.problem, start=solution.x)
            solution = solve_least_squares(problem, weighted=True)
            C = np.array([inverse_of(F) for F in self._blocks(solution.jacobian)])
        joint = solution.x.reshape(-1, 3)
        if weighted:
            of_axis = joint[self.of_axis], C[self.of_axis]
            axes, chi = _adjusted(axes, self.problem.terms[0], *of_axis)
            right, left_out = _without_outliers(machine, axes, chi, measurements)
            axes, observed = axes.choose(right), observed.choose(right)
        shape = len(measurements.views), machine.n_legs
        A, located = np.zeros((*shape, 3)), np.zeros(shape, dtype=np.bool_)
        covariance = np.zeros((*shape, 6, 6))
        located[self.view, self.leg], A[self.view, self.leg] = True, joint
        covariance[self.view, self.leg, :3, :3] = C
        return JointsInCamera(A, np.zeros_like(A), located, covariance, axes, observed, left_out)

    def _blocks(self, jacobian: csc_array[np.float64]) -> list[Array]:
        """Return the information matrices (3, 3) of the unknowns of each bundle."""
        F = (jacobian.T @ jacobian).tocsr()
        return [F[k : k + 3, k : k + 3].toarray() for k in range(0, 3 * len(self.leg), 3)]


def _adjusted(axes: LegAxes, term: Term, local: Array, C: Array) -> tuple[LegAxes, Array]:
    """Return the likeliest axes given an equation, and their contradictions in standard deviations.

    The first errors of the equation are the errors of the directions; C (k, n, n) are the
    covariances of its unknowns.
    """
    if term.covariance is None:
        return axes, np.zeros(len(axes))
    errors, covariance, chi = adjusted(term.function, local, term.observed, term.covariance, C)
    u = axes.u + np.einsum("kia,ki->ka", axes.basis, errors[:, :2])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    e1 = axes.basis[:, 0] - u * np.sum(u * axes.basis[:, 0], axis=1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    left = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))[:, :2, :2]
    before = np.trace(axes.covariance[:, :2, :2], axis1=1, axis2=2)
    variances, directions = np.linalg.eigh(left)
    variances = np.maximum(variances, _ROUNDING * before[:, None])
    of_axes = axes.covariance.copy()
    of_axes[:, :2, :2] = directions * variances[:, None] @ np.swapaxes(directions, 1, 2)
    basis = np.stack([e1, cross(u, e1)], axis=1)
    return replace(axes, u=u, basis=basis, covariance=of_axes), chi


def adjusted_to_base(
    machine: NominalMachine,
    joints: JointsInCamera,
    A: Array,  # (n_views, n_legs, 3) in the cameras [m]
    of_A: Array,  # (n_views, n_legs, 3, 3), its covariances
    measurements: Measurements,
) -> JointsInCamera:
    """Return joints at A, with axes adjusted to it and revolute axes by the adjusted directions.

    Axes that miss A by far are left out.
    """
    axes = joints.observed
    of_axis = measurements.view[axes.row], axes.leg
    index = np.full((len(axes), 3), -1)
    term = Term(joint_on_axis(), index, (axes.u, axes.M, axes.basis), axes.covariance)
    covariance = joints.covariance.copy()
    covariance[:, :, :3, :3] = of_A
    better, chi = _adjusted(axes, term, A[of_axis], of_A[of_axis])
    right, left_out = _without_outliers(machine, axes, chi, measurements)
    joints = replace(
        joints,
        A=A,
        covariance=covariance,
        axes=better.choose(right),
        observed=axes.choose(right),
        diagnostics=(*joints.diagnostics, *left_out),
    )
    return oriented(machine, _with_axes(machine, joints, measurements, weighted=True))


def _without_outliers(
    machine: NominalMachine, axes: LegAxes, chi: Array, measurements: Measurements
) -> tuple[IntArray, tuple[str, ...]]:
    """Return the indices of axes near their joint, by chi (n,) in sigmas, and words for outliers.

    Outliers are usually wrong outlines.
    """
    wrong = chi > _OUTLIER * max(1.0, float(np.median(chi)))
    left_out = tuple(
        f"Leg {machine.leg_names[j]} in image {measurements.image[row] or row + 1} was left out of "
        "steps 3 and 4: its axis misses its base joint by far; check its outlines."
        for j, row in zip(axes.leg[wrong].tolist(), axes.row[wrong].tolist(), strict=True)
    )
    return np.flatnonzero(~wrong), left_out


# Revolute axes


@dataclass(frozen=True, eq=False)
class AcrossAxes:
    """Directions of legs that are normal to axes of bodies, (7)."""

    u: Array  # (n, 3)
    basis: Array  # (n, 2, 3)
    R: Array  # (n, 3, 3): from each body to the frame of u
    covariance: Array  # (n, 8, 8) of u, and of steps of the body
    axis: IntArray  # (n,) the axis each is normal to: 0, 1 and so on

    @cached_property
    def scatter(self) -> Array:
        """Sums of u u' in the body by axis, (n_axes, 3, 3)."""
        sums, u = (
            np.zeros((int(self.axis.max()) + 1, 3, 3)),
            np.einsum("nij,ni->nj", self.R, self.u),
        )
        np.add.at(sums, self.axis, u[:, :, None] * u[:, None, :])
        return sums

    def term(self, v: Array) -> Term:
        """Return (7) with axes that begin at v (n_axes, 3)."""
        index = 2 * self.axis[:, None] + np.arange(2)
        observed = self.u, self.basis, self.R, axis_frames(v)[self.axis]
        return Term(leg_across_axis(), index, observed, self.covariance)

    def solve(self, *, weighted: bool) -> tuple[Array, Array, Array]:
        """Return start axes v (n_axes, 3), rotations (n_axes, 2) from there, and covariances."""
        v = np.linalg.eigh(self.scatter)[1][:, :, 0]  # the unweighted solution
        n = len(v)
        problem = LeastSquares("The revolute axes (eq 7)", (self.term(v),), np.zeros(2 * n))
        solution, columns = (
            solve_least_squares(problem, weighted=weighted),
            np.arange(2 * n).reshape(n, 2),
        )
        C = solution.covariances(columns) if weighted else np.zeros((n, 2, 2))
        return v, solution.x[columns], C


def _with_axes(
    machine: NominalMachine, joints: JointsInCamera, measurements: Measurements, *, weighted: bool
) -> JointsInCamera:
    """Return joints with the revolute axes, or the common normals of a plane, by (7)."""
    axes = joints.axes
    rows = np.flatnonzero(machine.revolute[axes.leg] | (not machine.spatial))
    if not len(rows):
        return joints
    some, R = axes.choose(rows), np.tile(np.eye(3), (len(rows), 1, 1))
    view, leg = measurements.view[some.row], some.leg
    axis = np.unique(view * machine.n_legs + leg * machine.spatial, return_inverse=True)[1].ravel()
    covariance = np.zeros((len(rows), 8, 8))
    covariance[:, :2, :2] = some.covariance[:, :2, :2]
    across = AcrossAxes(some.u, some.basis, R, covariance, axis)
    start, turns, C = across.solve(weighted=weighted)
    if weighted:
        better, _ = _adjusted(some, across.term(start), turns[axis], C[axis])
        parts = {name: getattr(axes, name).copy() for name in ("u", "basis", "covariance")}
        for name, part in parts.items():
            part[rows] = getattr(better, name)
        axes = replace(axes, **parts)
    axes_v, covariances = joints.v.copy(), joints.covariance.copy()
    axes_v[view, leg] = turned_axis(start, angles_of(turns))[axis]
    slope = np.array([axis_slope(*turned) for turned in zip(start, turns, strict=True)])
    covariances[view, leg, _AXIS, _AXIS] = (slope @ C @ np.swapaxes(slope, 1, 2))[axis]
    return replace(joints, v=axes_v, covariance=covariances, axes=axes)


def oriented(machine: NominalMachine, joints: JointsInCamera) -> JointsInCamera:
    """Return joints with the signs of their axes according to the nominal axes.

    An axis in a camera is a line: (7) gives it up to its sign, but products of vectors need a sign.
    The nominal base is registered with the joints of each view, and each axis takes the sign of its
    nominal axis. Where two rotations about a line of joints fit equally well, the sign is
    arbitrary. The sign of an axis does not matter if its joint is alone in the view.
    """
    v_camera = joints.v.copy()
    for v, with_axis in enumerate(joints.axis_located):
        v_seen, nominal = v_camera[v, with_axis], machine.base_normals[with_axis]
        A_Rb, A_camera = points_in_both(machine, joints, v)
        poses, _ = candidate_camera_poses(A_Rb, nominal, A_camera, v_seen)
        if poses:
            predicted = poses[0].rotation.inv().apply(nominal)
            is_opposite = np.sum(predicted * v_seen, axis=1, keepdims=True) < 0.0
            v_camera[v, with_axis] *= np.where(is_opposite, -1.0, 1.0)
    return replace(joints, v=v_camera)


def points_in_both(
    machine: NominalMachine, joints: JointsInCamera, view: int
) -> tuple[Array, Array]:
    """Return the joints of the base (n, 3) that a view locates, in R_b and in the camera [m]."""
    located = joints.located[view]
    return machine.A[located], joints.A[view, located]


# Candidate camera poses, in closed form: three joints not on a line determine the pose. Joints on
# one line leave a rotation about it, which revolute axes across the line determine as lines: often
# uniquely, sometimes with several nearly equal solutions, such as both sides of the plane of a
# planar machine.

_ON_A_LINE = 0.05  # maximum ratio of the spreads of collinear joints across and along their line
_ALONG = 0.1  # minimum sine of the angle between the line and an axis that determines a camera
_MAX_DIFFERENCE = 0.07  # between mean squared sines of angles to axes of equivalent candidates
_TURNS = 720


def candidate_camera_poses(
    A_Rb: Array, v_Rb: Array, A_camera: Array, v_camera: Array
) -> tuple[list[RigidTransform], bool]:
    """Return the candidates of T_Rb_camera, most likely first, and whether they are all.

    Joints (n, 3) and revolute axes (r, 3) of a view are given in the model and in the camera; axes
    are lines without a sign. There are no candidates for fewer than two separate joints.
    The flag is False if the pose is one of a continuum, rotated about the line of the joints.
    """
    if len(A_Rb) < 2:
        return [], False
    _, spread, directions = np.linalg.svd(A_Rb - A_Rb.mean(axis=0))
    if spread[0] <= 1e-6 * float(np.linalg.norm(A_Rb, axis=1).max()):
        return [], False
    if len(A_Rb) > 2 and spread[1] > _ON_A_LINE * spread[0]:
        return [register_points(A_camera, A_Rb)], True
    line = directions[0]
    across = np.linalg.norm(cross(v_Rb, line), axis=1) > _ALONG
    T_camera_Rb = _laid_along(A_Rb, line, A_camera)
    if not across.any():
        return [T_camera_Rb.inv()], False
    along, middle = T_camera_Rb.rotation.apply(line), A_camera.mean(axis=0)
    v = T_camera_Rb.rotation.apply(v_Rb[across])
    poses = []
    for turn in _candidate_turns(along, v, v_camera[across]):
        rotation = Rotation.from_rotvec(turn * along)
        about = RigidTransform.from_components(middle - rotation.apply(middle), rotation)
        poses.append((about * T_camera_Rb).inv())
    return poses, True


def _laid_along(A_Rb: Array, line: Array, A_camera: Array) -> RigidTransform:
    """Return a T_camera_Rb that aligns collinear joints, with any rotation about their line."""
    height = (A_Rb - A_Rb.mean(axis=0)) @ line
    seen_line = height @ (A_camera - A_camera.mean(axis=0))
    of_seen, of_line = axis_frames(np.array([seen_line / np.linalg.norm(seen_line), line]))
    rotation = Rotation.from_matrix(of_seen @ of_line.T)
    shift = A_camera.mean(axis=0) - rotation.apply(A_Rb.mean(axis=0))
    return RigidTransform.from_components(shift, rotation)


def _candidate_turns(along: Array, v: Array, v_seen: Array) -> Array:
    """Return the rotations about a unit vector that align axes v (r, 3) with v_seen, best first."""
    turn = 2.0 * np.pi / _TURNS * np.arange(_TURNS)
    axial = (v @ along)[:, None] * along
    across = v - axial
    product = (
        np.sum(v_seen * axial, axis=1)
        + np.cos(turn)[:, None] * np.sum(v_seen * across, axis=1)
        + np.sin(turn)[:, None] * np.sum(v_seen * cross(along, across), axis=1)
    )
    error = 1.0 - np.mean(product**2, axis=1)
    least = np.flatnonzero((error <= np.roll(error, 1)) & (error < np.roll(error, -1)))
    least = least[np.argsort(error[least], kind="stable")]
    return np.asarray(turn[least[error[least] < error.min() + _MAX_DIFFERENCE]])
