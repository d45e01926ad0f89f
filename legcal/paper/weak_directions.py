"""Directions of the unknowns of step 4 that the poses do not determine.

Those that move the platform are refused, the others fixed where the nominal model has them, and
named. The axes of a 3-UPU that only translates are an example: the poses determine the difference
of its axes on base and platform and not both, and the platform does not move with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.axes import axis_angles
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.machine.directions import SHOWN, describe_direction, sparse_basis, split_by_motion
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import Leg, LegColumns
from legcal.paper.gibbs import axis_slope, gibbs_of
from legcal.paper.least_squares import Term
from legcal.paper.nominal import NominalMachine
from legcal.paper.unknowns import Unknowns

_MAX_SIGMA = 10.0  # mean leg lengths, or [rad]: what is known worse is not determined at all
_POOR_SIGMA = 0.1  # the same: nominal models know it better, unless the platform moves with it
_SIGMA_NOMINAL = 0.03  # [rad] of axes, about
_MAX_MOTION = 0.01  # of the platform, in the change of the parameters, that counts as none
_SIGMA_FIXED = 1e-6  # of the mean leg length


def nominal_prior(index: IntArray) -> tuple[Term, ...]:
    """Return the prior of turns, by their places, that keeps axes near the nominal ones.

    Axes that the poses do not determine would end anywhere, where the platform moves otherwise.
    """
    if not len(index):
        return ()
    rows = np.full((len(index), 1), 1.0 / _SIGMA_NOMINAL)
    return (Term(_projection(1), index[:, None], (rows, np.zeros(len(index)))),)


def fix_weak_directions(
    machine: NominalMachine,
    unknowns: Unknowns,
    information: Array,
    legs: tuple[Leg, ...],
    poses: tuple[Array, Array],
    nominal: Array,
    wanted: IntArray | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """Return the residuals that fix what the poses do not determine at *nominal*, and its names.

    ``information`` (m, n) are whitened rows by the ``wanted`` unknowns (all without it), taken at
    ``legs``; ``poses`` are the observed R (k, 3, 3) and t (k, 3) in R_b: without any every
    direction counts as moving the platform. Raises NotIdentifiable if a direction moves it.
    """
    wanted = np.arange(len(unknowns)) if wanted is None else wanted
    n, length = len(wanted), _mean_length(legs, poses)
    metre = np.where(unknowns.is_angle, 1.0 / length, 1.0)  # angles count at the mean leg length
    unit = metre[wanted]
    _, singular, vectors = np.linalg.svd(np.vstack([information * unit, np.zeros((n, n))]))
    poor, undetermined = (
        vectors[singular * sigma * length < 1.0] for sigma in (_POOR_SIGMA, _MAX_SIGMA)
    )
    if not len(poor):
        return (), ()
    motion = _platform_motion(machine, unknowns, legs, poses)
    motion = None if motion is None else (motion * metre)[:, :, wanted]
    moving, _ = split_by_motion(motion, undetermined, length, _MAX_MOTION)
    names = [unknowns.names[i] for i in wanted]
    if len(moving):
        _refuse(machine, names, sparse_basis(moving))
    _, harmless = split_by_motion(motion, poor, length, _MAX_MOTION)
    if not len(harmless):
        return (), ()
    rows = harmless / unit / (_SIGMA_FIXED * length)
    index = np.tile(np.arange(n), (len(rows), 1))
    return (Term(_projection(n), index, (rows, rows @ nominal)),), tuple(
        f"Step 4 left {_in_words(machine, names, row)} at nominal: the poses hardly "
        "show it, and the platform does not move with it."
        for row in sparse_basis(harmless)
    )


@cache
def _projection(n: int) -> ca.Function:
    """Return (x; row, target) -> row . x - target."""
    x, row, target = ca.SX.sym("x", n), ca.SX.sym("row", n), ca.SX.sym("target")
    return ca.Function("projection", [x, row, target], [ca.dot(row, x) - target])


def _mean_length(legs: Sequence[Leg], poses: tuple[Array, Array]) -> float:
    """Return the mean leg length [m] over poses in R_b, that of the offsets without any."""
    R, t = poses
    if not len(R):
        return float(np.mean([leg.q0 for leg in legs if np.isfinite(leg.q0)]))
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    ends = np.einsum("kij,lj->kli", R, B) + t[:, None]
    return float(np.linalg.norm(ends - A, axis=2).mean())


def _platform_motion(
    machine: NominalMachine,
    unknowns: Unknowns,
    legs: tuple[Leg, ...],
    poses: tuple[Array, Array],
) -> Array | None:
    """Return how the platform moves with each unknown, (k, 6, n); None without determined poses."""
    if not len(poses[0]):
        return None
    every = unknowns.parametrization
    try:
        motion = pose_sensitivity(legs, every, machine.frame_legs, *poses)
    except NotIdentifiable:
        return None
    for place, leg, start in zip(every.place, legs, unknowns.start, strict=True):
        for columns, axis, nominal in (
            (LegColumns.BASE_AXIS, leg.base_axis, start.base_axis),
            (LegColumns.PLATFORM_AXIS, leg.platform_axis, start.platform_axis),
        ):
            if axis is not None and nominal is not None and place[columns].min() >= 0:
                # Turns about the basis of the axis, by turns from the nominal one.
                slope = axis_slope(nominal, gibbs_of(axis_angles(axis, nominal)))
                e1, e2 = normal_basis(axis)
                motion[:, :, place[columns]] @= np.stack([-e2 @ slope, e1 @ slope])
    return np.asarray(motion[:, :, unknowns.parameters])


def _refuse(machine: NominalMachine, names: Sequence[str], rows: Array) -> None:
    """Raise NotIdentifiable in geometric words."""
    shown = np.abs(rows) > SHOWN * np.abs(rows).max(axis=1, keepdims=True)
    changing = [names[i] for i in np.flatnonzero(shown.any(axis=0)).tolist()]
    if all(name.rpartition(".")[0].endswith(".platform") for name in changing):
        legs = [
            leg for leg in machine.leg_names if any(name.startswith(f"{leg}.") for name in changing)
        ]
        raise NotIdentifiable(
            f"The platform joints could not be tied together: those of {', '.join(legs)} can "
            "move without any image noticing; needed images of three or more legs at once that "
            "share legs with each other; add images that show several legs at once."
        )
    first = _in_words(machine, names, rows[0])
    more = f", and {len(rows) - 1} more such directions" if len(rows) > 1 else ""
    raise NotIdentifiable(
        f"The platform could not be identified: found that {first} can change without any image "
        f"noticing{more}, although the platform moves with it; needed each such leg at poses that "
        "differ more, together with three legs of known length; add such images."
    )


def _in_words(machine: NominalMachine, names: Sequence[str], row: Array) -> str:
    """Return a direction in words."""
    shown = np.flatnonzero(np.abs(row) > SHOWN * np.abs(row).max())
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    return describe_direction([names[i] for i in shown.tolist()], machine.leg_names)
