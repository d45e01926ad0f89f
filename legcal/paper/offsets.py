"""Section 3.4: offsets q0 of the legs from the distances between their ends, eqs (13) and (14).

A leg ends in B = A + (q + q0) u (13). The distance between the ends of two legs is constant over
poses: consecutive positions of each view are compared (14),

    C_2 = sum over pairs of legs (j, g) and positions k of (|B_j B_g|_k+1 - |B_j B_g|_k)^2
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.data.measurements import Measurements
from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LegColumns
from legcal.paper.equations import change_of_distance, end_of_leg
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.least_squares import (
    LeastSquares,
    Term,
    evaluated,
    solve_least_squares,
    undetermined,
)
from legcal.paper.unknowns import NominalMachine, Unknowns, hold_at_nominal, left_near_nominal

_APART = 1e-3  # [mean leg lengths] minimum distance of separate platform joints


@dataclass(frozen=True, eq=False)
class LegDirections:
    """Legs of (13), the input of steps 3 and 4: by group, then by leg."""

    group: IntArray  # (n,): index of the pose and view of each leg
    view: IntArray  # (n,)
    leg: IntArray  # (n,)
    A: Array  # (n, 3): base joint centres in the frame of the group [m]
    of_A: Array  # (n, 3, 3): covariances of A [m^2]
    u: Array  # (n, 3): unit directions from base to platform
    basis: Array  # (n, 2, 3): e1, e2 normal to u
    reading: Array  # (n,) sign * q [m], length less offset; zero if constant, NaN if passive
    covariance: Array  # (n, 3, 3) of u along e1 and e2 [rad^2], and of the reading [m^2]

    def __len__(self) -> int:
        return len(self.leg)

    def groups(self) -> list[IntArray]:
        """Return the indices of the legs of each group."""
        order = np.argsort(self.group, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(self.group[order])) + 1)

    @property
    def columns(self) -> Array:
        """The legs in the form of (13), (n, 13)."""
        basis = self.basis.reshape(-1, 6)
        return np.hstack([self.A, self.u, self.reading[:, None], basis])

    def ends(self, q0: Array) -> Array:
        """Return B = A + (q + q0) u of (13) in the frame of each group, (n, 3) [m]."""
        return evaluated(end_of_leg(), q0[self.leg, None], self.columns)


def leg_directions(
    machine: NominalMachine, joints: JointsInCamera, measurements: Measurements
) -> LegDirections:
    """Return the legs of step 1 in each camera; images of one pose are averaged."""
    axes = joints.axes
    key = np.stack([measurements.view[axes.row], measurements.pose[axes.row], axes.leg], axis=1)
    distinct, first, inverse, count = np.unique(
        key, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    total = np.zeros((len(distinct), 3))
    np.add.at(total, inverse.ravel(), axes.u)
    u = total / np.linalg.norm(total, axis=1, keepdims=True)
    v, k, j = distinct.T
    q = measurements.q[axes.row[first], j]
    basis = normal_basis(u)
    onto = basis @ np.swapaxes(axes.basis[first], 1, 2)
    covariance = np.zeros((len(j), 3, 3))
    of_u = axes.covariance[first, :2, :2] / count[:, None, None]
    covariance[:, :2, :2] = onto @ of_u @ np.swapaxes(onto, 1, 2)
    covariance[:, 2, 2] = measurements.sigma_q[j] ** 2
    return LegDirections(
        group=v * measurements.n_poses + k,
        view=v,
        leg=j,
        A=joints.A[v, j],
        of_A=joints.covariance[v, j, :3, :3],
        u=u,
        basis=basis,
        reading=machine.sign[j] * np.where(machine.constant[j], 0.0, q),
        covariance=covariance,
    )


def identify_offsets(
    machine: NominalMachine, directions: LegDirections, *, weighted: bool
) -> tuple[NominalMachine, tuple[str, ...]]:
    """Return the machine with offsets and constant lengths by (14), and nominal values in words.

    Raises NotIdentifiable if the distances do not determine every offset, and DidNotConverge.
    """
    pairs, unknowns = pairs_apart(machine, directions), Unknowns.of_lengths(machine)
    problem = build_consecutive(machine, directions)
    with_held, held = problem, np.zeros(0, dtype=np.intp)
    if weighted:
        with_held, held = hold_at_nominal(problem, machine, unknowns, weighted=True)
    x = solve_least_squares(with_held, weighted=weighted).x
    _check_identifiable(machine, directions, pairs, undetermined(problem.jacobian(x)))
    left = left_near_nominal("Step 3 (14)", machine, unknowns, held)
    return replace(machine, legs=unknowns.legs(x, machine.legs)), left


def build_consecutive(machine: NominalMachine, directions: LegDirections) -> LeastSquares:
    """Build the criterion C_2 of (14): distances are equal in consecutive positions of a view."""
    pairs, unknowns = pairs_apart(machine, directions), Unknowns.of_lengths(machine)
    last: dict[tuple[int, ...], int] = {}
    consecutive = []
    for k, (a, b) in enumerate(pairs):
        key = (int(directions.view[a]), int(directions.leg[a]), int(directions.leg[b]))
        if key in last:
            consecutive.append((last[key], k))
        last[key] = k
    _check_any(consecutive, "view shows the same two legs in two images")
    before, after = np.array(consecutive, dtype=np.intp).T
    observed = tuple(np.swapaxes(directions.columns[pairs[k]], 1, 2) for k in (before, after))
    covariance = np.zeros((len(before), 12, 12))
    for k, rows in enumerate((*pairs[before].T, *pairs[after].T)):
        covariance[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = directions.covariance[rows]
    index = unknowns.place[directions.leg[pairs[after]], LegColumns.LENGTH]
    term = Term(change_of_distance(), index, observed, covariance)
    return LeastSquares("The offsets (eq 14)", (term,), unknowns.vector(machine.legs))


def pairs_of_legs(directions: LegDirections, q0: Array) -> IntArray:
    """Return the pairs of legs of each group, g > j, that have offsets: the set AC of (14)."""
    finite = np.isfinite(q0[directions.leg])
    pairs = [
        pair
        for group in directions.groups()
        for pair in combinations(group[finite[group]].tolist(), 2)
    ]
    _check_any(pairs, "image shows two legs of known length whose base joints are located")
    return np.array(pairs, dtype=np.intp)


def pairs_apart(machine: NominalMachine, directions: LegDirections) -> IntArray:
    """Return the pairs of :func:`pairs_of_legs` whose distance depends on their offsets.

    Two legs that meet in one platform joint are at distance zero for any offsets; a leg that is
    fixed to the platform ends on it for any offset.
    """
    q0, B = machine.offsets, machine.B
    pairs = pairs_of_legs(directions, q0)
    legs = directions.leg[pairs]
    gap = np.linalg.norm(B[legs[:, 0]] - B[legs[:, 1]], axis=1)
    length = directions.reading + q0[directions.leg]
    apart = gap > _APART * float(np.mean(length[np.isfinite(length)]))
    chosen: IntArray = pairs[apart & ~machine.on_platform[legs].any(axis=1)]
    _check_any(
        chosen.tolist(),
        "image shows two legs that turn against the platform and end in different places of it",
    )
    return chosen


# Refusals


def _check_any(observations: Sequence[object], missing: str) -> None:
    """Refuse a criterion without observations; *missing* are the missing ones in words."""
    if not observations:
        raise NotIdentifiable(
            f"The offsets could not be identified: no {missing}; needed images at different poses "
            "that show several legs at once; add such images."
        )


def _check_identifiable(
    machine: NominalMachine,
    directions: LegDirections,
    pairs: IntArray,
    loose: BoolArray,
) -> None:
    """Refuse offsets that can change without changing any distance."""
    with_offset = np.flatnonzero(np.isfinite(machine.offsets))
    loose = loose & ~machine.on_platform[with_offset]
    if not loose.any():
        return
    names, reasons = [machine.leg_names[j] for j in with_offset[loose]], []
    for leg in with_offset[loose]:
        mine = pairs[np.any(directions.leg[pairs] == leg, axis=1)]
        n_poses = len(np.unique(directions.group[mine[:, 0]]))
        if n_poses == 0:
            reasons.append("is in no image together with a leg that ends elsewhere on the platform")
        elif n_poses < 3:
            reasons.append(f"is together with others in {n_poses} pose{'s' * (n_poses > 1)}")
        else:
            reasons.append(f"hardly turns against the legs seen with it in {n_poses} poses")
    why = "; ".join(f"{name} {reason}" for name, reason in zip(names, reasons, strict=True))
    raise NotIdentifiable(
        f"The offsets could not be identified: no distance between leg ends fixes that of "
        f"{', '.join(names)} ({why}); needed each leg in images of at least three different "
        "poses together with other legs that end elsewhere on the platform and turn against it; "
        "add images that show several legs at once."
    )
