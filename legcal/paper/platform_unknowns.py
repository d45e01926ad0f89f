"""The unknowns of step 4, and which of them the poses leave open.

What is open is refused where it moves the platform, and else held where the nominal model has it
and named. The axes of a 3-UPU that only translates are an example: the poses show the difference
of its axes on base and platform and not both, and the platform does not move with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.machine import (
    N_LOCAL,
    SHOWN,
    Leg,
    Parametrization,
    describe_direction,
    parametrize,
    pose_sensitivity,
    sparse_basis,
    split_by_motion,
    tied_twist,
)
from legcal.paper.least_squares import Term
from legcal.paper.motions import turned_axis, turned_axis_slope, turns_of
from legcal.paper.nominal import NominalMachine

# Places among the twelve numbers of a leg
OF_B, LENGTH, BASE_TURNS, PLATFORM_TURNS, TWIST = slice(3, 6), 6, slice(7, 9), slice(9, 11), 11
_OF_AXES = slice(7, 12)  # turns of both, and the twist

_OPEN = 10.0  # mean leg lengths, or [rad]: what is known worse is not determined at all
_POOR = 0.1  # the same: nominal models know it better, and the platform does not ask for it
_NEAR = 0.03  # [rad], how far axes may be from the nominal ones, about
_HARMLESS = 0.01  # of the change of the parameters: the platform hardly moves
_HELD = 1e-6  # of the mean leg length: how exactly what is open is held


@dataclass(frozen=True, eq=False)
class PlatformUnknowns:
    """Where the numbers of each leg stand among the shared unknowns of step 4."""

    parametrization: Parametrization  # of all parameters of the mechanism
    # (n,), rising, which of them: free coordinates of B [m], offsets and lengths [m], turns of
    # universal axes at the base and of axes at the platform, changes of twists [rad]
    parameters: IntArray
    nominal: tuple[Leg, ...]  # what turns of axes and changes of twists count from

    @classmethod
    def of(cls, machine: NominalMachine, *, free_twists: bool = False) -> PlatformUnknowns:
        """Return the unknowns of a mechanism; twists are held unless they are freed."""
        legs = machine.legs
        everything = parametrize(machine.leg_names, legs, machine.frame_legs, twists=free_twists)
        wanted = np.ones((len(legs), N_LOCAL), dtype=np.bool_)
        wanted[:, :3] = False
        wanted[:, BASE_TURNS] = np.array([[leg.base_joint != "R"] for leg in legs])
        place = everything.place[wanted & (everything.place >= 0)]
        return cls(everything, np.sort(place), legs)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def place(self) -> IntArray:
        """Place of each leg's twelve numbers among the unknowns, (n_legs, 12); -1 if known."""
        place = np.full(len(self.parametrization) + 1, -1, dtype=np.intp)
        place[self.parameters] = np.arange(len(self))
        return np.asarray(place[self.parametrization.place])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.parametrization.names[i] for i in self.parameters)

    @property
    def is_angle(self) -> BoolArray:
        """Which unknowns are angles [rad] and no lengths [m], (n,)."""
        return np.array([self.parametrization.units[i] == "rad" for i in self.parameters])

    @property
    def of_closure(self) -> IntArray:
        """Which unknowns are turns of axes and twists of legs without an S joint."""
        closed = [j for j, leg in enumerate(self.nominal) if leg.twist is not None]
        index = np.unique(self.place[closed][:, _OF_AXES])
        return np.asarray(index[index >= 0])

    @property
    def held(self) -> Array:
        """Coordinates of B that are no unknowns, at nominal, (n_legs, 3) [m]; zero the others."""
        B = np.array([leg.B for leg in self.nominal])
        return np.where(self.place[:, OF_B] < 0, B, 0.0)

    def vector(self, legs: Sequence[Leg]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = np.zeros(self.place.shape)
        for row, leg, nominal in zip(local, legs, self.nominal, strict=True):
            row[OF_B], row[LENGTH] = leg.B, leg.q0
            for columns, axis, start in (
                (BASE_TURNS, leg.base_axis, nominal.base_axis),
                (PLATFORM_TURNS, leg.platform_axis, nominal.platform_axis),
            ):
                if axis is not None and start is not None:
                    row[columns] = turns_of(axis, start)
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        """Return legs with the unknowns at values x (n,)."""
        padded = np.append(x, 0.0)
        found = []
        for leg, nominal, place, B in zip(legs, self.nominal, self.place, self.held, strict=True):
            local = padded[place]
            moved = replace(
                leg,
                B=local[OF_B] + B,
                q0=float(local[LENGTH]) if place[LENGTH] >= 0 else leg.q0,
                base_axis=leg.base_axis
                if place[BASE_TURNS.start] < 0
                else turned(nominal.base_axis, local[BASE_TURNS]),
                platform_axis=turned(nominal.platform_axis, local[PLATFORM_TURNS]),
            )
            if nominal.twist is not None:
                twist = nominal.twist + float(local[TWIST])
                moved = replace(moved, twist=tied_twist(moved, nominal, twist))
            found.append(moved)
        return tuple(found)


def turned(axis: Array | None, turns: Array) -> Array | None:
    """Return the axis to which two turns take another one, if there is one."""
    return None if axis is None else turned_axis(axis, turns)


def near_nominal(index: IntArray) -> tuple[Term, ...]:
    """Return residuals that keep turns from nominal axes, by their places, near zero.

    Poses that leave them open let them go anywhere, to where the platform moves otherwise.
    """
    if not len(index):
        return ()
    rows = np.full((len(index), 1), 1.0 / _NEAR)
    return (Term(_projection(1), index[:, None], (rows, np.zeros(len(index)))),)


def held_at_nominal(
    machine: NominalMachine,
    unknowns: PlatformUnknowns,
    information: Array,
    legs: tuple[Leg, ...],
    poses: tuple[Array, Array],
    nominal: Array,
    wanted: IntArray | None = None,
) -> tuple[tuple[Term, ...], tuple[str, ...]]:
    """Return the residuals that hold what the poses leave open, and what this is in words.

    ``information`` (m, n) are whitened rows by the ``wanted`` unknowns (all without it), taken at
    ``legs``; ``poses`` R (k, 3, 3) and t (k, 3) in R_b were seen: without any every direction
    counts as moving the platform. Raises NotIdentifiable if an open direction moves it.
    """
    wanted = np.arange(len(unknowns)) if wanted is None else wanted
    n, length = len(wanted), _mean_length(legs, poses)
    metre = np.where(unknowns.is_angle, 1.0 / length, 1.0)  # angles count at the mean leg length
    unit = metre[wanted]
    _, singular, vectors = np.linalg.svd(np.vstack([information * unit, np.zeros((n, n))]))
    poor, unseen = (vectors[singular * sigma * length < 1.0] for sigma in (_POOR, _OPEN))
    if not len(poor):
        return (), ()
    motion = _motion(machine, unknowns, legs, poses)
    motion = None if motion is None else (motion * metre)[:, :, wanted]
    moving, _ = split_by_motion(motion, unseen, length, _HARMLESS)
    names = [unknowns.names[i] for i in wanted]
    if len(moving):
        _refuse(machine, names, sparse_basis(moving))
    _, still = split_by_motion(motion, poor, length, _HARMLESS)
    if not len(still):
        return (), ()
    rows = still / unit / (_HELD * length)
    index = np.tile(np.arange(n), (len(rows), 1))
    return (Term(_projection(n), index, (rows, rows @ nominal)),), tuple(
        f"Step 4 left {_in_words(machine, names, row)} at nominal: the poses hardly "
        "show it, and the platform does not move with it."
        for row in sparse_basis(still)
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


def _motion(
    machine: NominalMachine,
    unknowns: PlatformUnknowns,
    legs: tuple[Leg, ...],
    poses: tuple[Array, Array],
) -> Array | None:
    """Return how the platform moves with each unknown, (k, 6, n); None if unknown."""
    if not len(poses[0]):
        return None
    everything = unknowns.parametrization
    try:
        motion = pose_sensitivity(legs, everything, machine.frame_legs, *poses)
    except NotIdentifiable:
        return None
    for place, leg, nominal in zip(everything.place, legs, unknowns.nominal, strict=True):
        for columns, axis, start in (
            (BASE_TURNS, leg.base_axis, nominal.base_axis),
            (PLATFORM_TURNS, leg.platform_axis, nominal.platform_axis),
        ):
            if axis is not None and start is not None and place[columns].min() >= 0:
                motion[:, :, place[columns]] @= _other_basis(axis, start)
    return np.asarray(motion[:, :, unknowns.parameters])


def _other_basis(axis: Array, nominal: Array) -> Array:
    """Return turns about the basis of an axis by turns from the nominal one, (2, 2)."""
    slope = turned_axis_slope(nominal, turns_of(axis, nominal))
    e1, e2 = normal_basis(axis)
    return np.stack([-e2 @ slope, e1 @ slope])


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
