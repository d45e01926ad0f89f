"""Directions that nothing determines: a readable basis, and what they do to the platform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.identify.elimination import compress
from legcal.identify.session import Session
from legcal.identify.steps import LARGEST_SIGMA
from legcal.mechanism.directions import SHOWN, sparse_basis, split_by_motion
from legcal.mechanism.parameter_words import describe_direction
from legcal.mechanism.sensitivity import pose_sensitivity

_ERROR = 1e-3  # [m], the largest component of a direction whose effect is told
_HARMLESS = 1e-3  # of that: the platform does not move


@dataclass(frozen=True)
class PlatformError:
    """How far the platform moves, root mean square over poses.

    Attributes
    ----------
    dX_m : float
        Displacement of the origin of R_e [m].
    dE_rad : float
        Rotation [rad].
    """

    dX_m: float
    dE_rad: float


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the observations do not determine.

    Attributes
    ----------
    direction : str
        In words.
    parameters : tuple of str
        The parameters that change, the largest first.
    components : tuple of float
        By how much, when the largest changes by 1 mm (an angle by 1 mm at the leg's length)
        [m or rad].
    dX_m, dE_rad : float or None
        The displacement [m] and rotation [rad] of the platform that this could hide, root mean
        square over the poses; None where the motors do not determine the pose.
    harmless : bool
        Whether the platform does not move.
    """

    direction: str
    parameters: tuple[str, ...]
    components: tuple[float, ...]
    dX_m: float | None
    dE_rad: float | None
    harmless: bool


@dataclass(frozen=True)
class Ranks:
    """How many parameters are determined.

    Attributes
    ----------
    rank, of : int
        Directions of the parameter space that are determined, and all of them.
    weak : tuple of WeakDirection
        The others.
    """

    rank: int
    of: int
    weak: tuple[WeakDirection, ...]

    @property
    def complete(self) -> bool:
        """Whether all directions that move the platform are determined."""
        return all(direction.harmless for direction in self.weak)


class PlatformMotion:
    """How the platform moves with the parameters, over the poses that a session reaches."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.by_metres: Array | None = None
        self.why_not = ""
        try:
            moved = pose_sensitivity(
                session.legs,
                session.parametrization,
                session.frame_legs,
                session.R_reached,
                session.t_reached,
            )
        except NotIdentifiable as error:
            self.why_not = str(error)
            return
        self.by_metres = moved * session.unit

    def effect(self, direction: Array) -> PlatformError | None:
        """Return what a direction (p,) in metres does."""
        if self.by_metres is None:
            return None
        moved = self.by_metres @ direction
        turn, shift = (float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in np.split(moved, 2, 1))
        return PlatformError(shift, turn)

    def sigma(self, information: Array) -> PlatformError | None:
        """Return the standard deviation of the platform that information leaves."""
        if self.by_metres is None:
            return None
        _, singular, basis = np.linalg.svd(information)
        seen = singular > _limit(self.session)
        spread = self.by_metres @ (basis[seen].T / singular[seen])
        turn, shift = (
            float(np.sqrt(np.mean(np.sum(x**2, (1, 2))))) for x in np.split(spread, 2, 1)
        )
        return PlatformError(shift, turn)

    def split(self, basis: Array) -> tuple[Array, Array]:
        """Return a space (w, p) as that which moves the platform and that which does not."""
        return split_by_motion(self.by_metres, basis, self.session.mean_length, _HARMLESS)


def determined(session: Session, information: Array) -> int:
    """Return the rank of whitened rows: directions known to better than a leg's length."""
    singular = np.linalg.svd(compress(information), compute_uv=False)
    return int(np.sum(singular > _limit(session)))


def undetermined(session: Session, information: Array) -> Array:
    """Return an orthonormal basis (w, c) of the directions that rows (m, c) do not determine."""
    _, singular, basis = np.linalg.svd(compress(information))
    return np.asarray(basis[singular <= _limit(session)])


def weak_directions(
    session: Session, motion: PlatformMotion, basis: Array, columns: IntArray | None = None
) -> tuple[WeakDirection, ...]:
    """Return the directions of a space in words, those that move the platform first.

    Parameters
    ----------
    session : Session
        Where names and units come from.
    motion : PlatformMotion
        What the platform does.
    basis : (w, c) array
        The space, in metres.
    columns : (c,) array of int, optional
        Which parameters; all without it.
    """
    wide = basis
    if columns is not None:
        wide = np.zeros((len(basis), len(session.unit)))
        wide[:, columns] = basis
    parts = motion.split(wide)
    return tuple(
        _direction(session, motion, row, harmless)
        for part, harmless in zip(parts, (False, True), strict=True)
        for row in sparse_basis(part)
    )


def _direction(
    session: Session, motion: PlatformMotion, row: Array, harmless: bool
) -> WeakDirection:
    """Return a direction with its largest component at 1 mm."""
    row = row * (_ERROR / row[np.argmax(np.abs(row))])
    shown = np.flatnonzero(np.abs(row) > SHOWN * _ERROR)
    shown = shown[np.argsort(-np.abs(row[shown] / _ERROR).round(3), kind="stable")]
    names = tuple(session.parametrization.names[i] for i in shown)
    effect = motion.effect(row)
    return WeakDirection(
        describe_direction(names, session.leg_names),
        names,
        tuple(float((row * session.unit)[i]) for i in shown),
        None if effect is None else effect.dX_m,
        None if effect is None else effect.dE_rad,
        harmless,
    )


def _limit(session: Session) -> float:
    """Return the least singular value that counts [1/m]."""
    return 1.0 / (LARGEST_SIGMA * session.mean_length)
