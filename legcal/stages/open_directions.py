"""What the poses leave open in step 4: refused where it moves the platform, else held at nominal.

The axes of a 3-UPU that only translates are an example: the poses show the difference of its axes
on base and platform and not both, and the platform does not move with what they do not
show. Steps hold such directions where the nominal model has them, and name them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, IntArray
from legcal.mechanism.directions import SHOWN, sparse_basis, split_by_motion
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.parameter_words import describe_direction
from legcal.mechanism.sensitivity import pose_sensitivity
from legcal.stages.least_squares import Term
from legcal.stages.nominal import NominalMechanism
from legcal.stages.platform_unknowns import (
    BASE_TURNS,
    PLATFORM_TURNS,
    PlatformUnknowns,
    turned_axis,
    turns_of,
)

_OPEN = 10.0  # mean leg lengths, or [rad]: what is known worse is not determined at all
_POOR = 0.1  # the same: nominal models know it better, and the platform does not ask for it
_NEAR = 0.03  # [rad], how far axes may be from the nominal ones, about
_HARMLESS = 0.01  # of the change of the parameters: the platform hardly moves
_TURNS = slice(7, 12)  # of both axes, and the twist: places among the numbers of a leg
_STEP = 1e-6  # [rad], of differences
_EXACT = 1e-6  # of the mean leg length: how exactly what is open is held


@dataclass(frozen=True, eq=False)
class OpenDirections:
    """Directions of unknowns that the poses leave open and with which the platform stays.

    Attributes
    ----------
    basis : (w, n) array
        In the unknowns in metres, angles at the mean leg length, orthonormal.
    length : float
        Mean leg length [m].
    sentences : tuple of str
        What is held, in words.
    """

    basis: Array
    length: float
    sentences: tuple[str, ...] = ()

    def holding(self, unit: Array, nominal: Array) -> Term:
        """Return the residuals that hold these directions of the first unknowns at nominal.

        Parameters
        ----------
        unit : (n,) array
            A metre of each unknown in its own unit.
        nominal : (n,) array
            The nominal values.
        """
        n = len(unit)
        rows = self.basis / unit / (_EXACT * self.length)
        index = np.tile(np.arange(n), (len(rows), 1))
        return Term(_projection(n), index, (rows, rows @ nominal))


def open_directions(
    mechanism: NominalMechanism,
    unknowns: PlatformUnknowns,
    information: Array,
    legs: tuple[LegGeometry, ...],
    poses: tuple[Array, Array],
    wanted: IntArray | None = None,
) -> OpenDirections:
    """Return the open directions that do no harm.

    Parameters
    ----------
    mechanism : NominalMechanism
        The mechanism.
    unknowns : PlatformUnknowns
        The unknowns of step 4.
    information : (m, n) array
        Whitened rows by the unknowns: derivatives of residuals in standard deviations.
    legs : tuple of LegGeometry
        Where the information was taken.
    poses : (k, 3, 3) and (k, 3) array
        Platform poses in R_b that were seen; without any every direction counts as moving it.
    wanted : (n,) array of int, optional
        Which unknowns the information is about; all without it.

    Returns
    -------
    OpenDirections

    Raises
    ------
    NotIdentifiable
        If an open direction moves the platform.
    """
    wanted = np.arange(len(unknowns)) if wanted is None else wanted
    length = mean_length(legs, poses)
    unit = metres(unknowns, length)[wanted]
    _, singular, vectors = np.linalg.svd(
        np.vstack([information * unit, np.zeros((len(unit),) * 2)])
    )
    poor, unseen = (vectors[singular * sigma * length < 1.0] for sigma in (_POOR, _OPEN))
    if not len(poor):
        return OpenDirections(poor, length)
    motion = _motion(mechanism, unknowns, legs, poses, length)
    motion = None if motion is None else motion[:, :, wanted]
    moving, _ = split_by_motion(motion, unseen, length, _HARMLESS)
    if len(moving):
        _refuse(mechanism, unknowns, sparse_basis(moving), wanted)
    _, still = split_by_motion(motion, poor, length, _HARMLESS)
    sentences = tuple(
        f"Step 4 left {_in_words(mechanism, unknowns, row, wanted)} at nominal: the poses hardly "
        "show it, and the platform does not move with it."
        for row in sparse_basis(still)
    )
    return OpenDirections(still, length, sentences)


def closure_turns(unknowns: PlatformUnknowns) -> IntArray:
    """Return which unknowns turn axes of legs without an S joint, or change their twists."""
    closed = [j for j, leg in enumerate(unknowns.nominal) if leg.twist is not None]
    index = np.unique(unknowns.place[closed][:, _TURNS])
    return np.asarray(index[index >= 0])


def near_nominal(index: IntArray) -> tuple[Term, ...]:
    """Return residuals that keep turns from nominal axes, by their places, near zero.

    Poses that leave them open let them go anywhere, to where the platform moves otherwise.
    """
    if not len(index):
        return ()
    rows = np.full((len(index), 1), 1.0 / _NEAR)
    return (Term(_projection(1), index[:, None], (rows, np.zeros(len(index)))),)


def metres(unknowns: PlatformUnknowns, length: float) -> Array:
    """Return a metre of every unknown in its own unit, (n,): angles at the mean leg length."""
    return np.where(unknowns.is_angle, 1.0 / length, 1.0)


def mean_length(legs: Sequence[LegGeometry], poses: tuple[Array, Array]) -> float:
    """Return the mean leg length [m] over poses in R_b, that of the offsets without any."""
    R, t = poses
    if not len(R):
        return float(np.mean([leg.q0 for leg in legs if np.isfinite(leg.q0)]))
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    ends = np.einsum("kij,lj->kli", R, B) + t[:, None]
    return float(np.linalg.norm(ends - A, axis=2).mean())


def _motion(
    mechanism: NominalMechanism,
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    poses: tuple[Array, Array],
    length: float,
) -> Array | None:
    """Return how the platform moves with each unknown in metres, (k, 6, n); None if unknown."""
    if not len(poses[0]):
        return None
    everything = unknowns.parametrization
    try:
        moved = pose_sensitivity(legs, everything, mechanism.frame_legs, *poses)
    except NotIdentifiable:
        return None
    for place, leg, nominal in zip(everything.place, legs, unknowns.nominal, strict=True):
        for columns, axis, start in (
            (BASE_TURNS, leg.base_axis, nominal.base_axis),
            (PLATFORM_TURNS, leg.platform_axis, nominal.platform_axis),
        ):
            if axis is not None and start is not None and place[columns].min() >= 0:
                moved[:, :, place[columns]] @= _other_basis(axis, start)
    return np.asarray(moved[:, :, unknowns.parameters] * metres(unknowns, length))


def _other_basis(axis: Array, nominal: Array) -> Array:
    """Return turns about the basis of an axis by turns from the nominal one, (2, 2)."""
    here = turns_of(axis, nominal)
    ends = [turned_axis(nominal, here + step) for step in _STEP * np.eye(2)]
    slopes = [(np.asarray(end) - axis) / _STEP for end in ends]
    e1, e2 = normal_basis(axis)
    return np.array([[-e2 @ slope, e1 @ slope] for slope in slopes]).T


def _refuse(
    mechanism: NominalMechanism, unknowns: PlatformUnknowns, rows: Array, wanted: IntArray
) -> None:
    """Raise NotIdentifiable in geometric words."""
    shown = np.abs(rows) > SHOWN * np.abs(rows).max(axis=1, keepdims=True)
    names = [unknowns.names[wanted[i]] for i in np.flatnonzero(shown.any(axis=0))]
    joints = [n for n in names if n.rpartition(".")[0].endswith(".platform")]
    if len(joints) == len(names):
        legs = [leg for leg in mechanism.leg_names if any(n.startswith(f"{leg}.") for n in names)]
        raise NotIdentifiable(
            f"The platform joints could not be tied together: those of {', '.join(legs)} can "
            "move without any image noticing; needed images of three or more legs at once that "
            "share legs with each other; add images that show several legs at once."
        )
    first = _in_words(mechanism, unknowns, rows[0], wanted)
    more = f", and {len(rows) - 1} more such directions" if len(rows) > 1 else ""
    raise NotIdentifiable(
        f"The platform could not be identified: found that {first} can change without any image "
        f"noticing{more}, although the platform moves with it; needed each such leg at poses that "
        "differ more, together with three legs of known length; add such images."
    )


def _in_words(
    mechanism: NominalMechanism, unknowns: PlatformUnknowns, row: Array, wanted: IntArray
) -> str:
    """Return a direction in words."""
    shown = np.flatnonzero(np.abs(row) > SHOWN * np.abs(row).max())
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    return describe_direction([unknowns.names[wanted[i]] for i in shown], mechanism.leg_names)


@cache
def _projection(n: int) -> ca.Function:
    """Return (x; row, target) -> row . x - target."""
    x, row, target = ca.SX.sym("x", n), ca.SX.sym("row", n), ca.SX.sym("target")
    return ca.Function("projection", [x, row, target], [ca.dot(row, x) - target])
