"""What the measured poses leave open: directions in which the frames can move unseen, in words.

A direction is open if nothing is known of it, or less than a tenth of a radian or of the machine's
length. Where other poses of the machine would tell, that is a reason to refuse; where no pose of
its workspace would (it only translates, or moves in a plane), it belongs to the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.geometry.types import Array, BoolArray
from legcal.location.fit import SINGULAR
from legcal.location.open_part import Frame, Kind, OpenPart, direction_of, direction_words
from legcal.location.pose_pairs import Frames

OPEN = 0.1  # [rad], and of the length of the machine
HARDLY = 2e-3  # of the best seen direction: what no pose of a machine shows better is its own
_PART = 0.03  # of a unit direction: what is less is not named
_SAME_AXIS = 0.02  # of the largest rotations: what is less is about the same axis

BLOCKS: tuple[tuple[slice, Frame, Kind], ...] = (
    (slice(0, 3), "base", "position"),
    (slice(3, 6), "base", "orientation"),
    (slice(6, 9), "tool", "position"),
    (slice(9, 12), "tool", "orientation"),
)  # of a step


def open_directions(design: Array, *, oriented: bool) -> Array:
    """Return an orthonormal basis (12, k) of the directions that a design leaves open.

    Parameters
    ----------
    design : (m, 12) array
        Whitened derivatives by a step in units of the machine's length and radians.
    oriented : bool
        Whether orientations of the tool were measured at all; without, that of the tool in the
        platform is not looked for.
    """
    return _unseen(design, oriented, lambda s: (s < SINGULAR * s[0]) | (s * OPEN < 1.0))


def beyond_the_machine(basis: Array, jacobian: Array, *, oriented: bool) -> Array:
    """Return those open directions (12, k) of some poses that the machine's workspace would tell.

    Parameters
    ----------
    basis : (12, k) array
        What the measured poses leave open.
    jacobian : (m, 12) array
        Derivatives of poses all over the workspace by a step, both in units of the machine's
        length and radians: geometry alone, whatever the noise.
    oriented : bool
        As for :func:`open_directions`.
    """
    own = _unseen(jacobian, oriented, lambda s: s < HARDLY * s[0])
    U, s, _ = np.linalg.svd(basis - own @ (own.T @ basis), full_matrices=False)
    return np.asarray(U[:, s > 0.5])


def _unseen(design: Array, oriented: bool, is_open: Callable[[Array], BoolArray]) -> Array:
    """Return the right singular vectors (12, k) whose singular values are too small."""
    n = 12 if oriented else 9
    _, s, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    s = np.concatenate([s, np.zeros(n - len(s))])
    chosen = is_open(s)
    basis = np.zeros((12, int(chosen.sum())))
    basis[:n] = Vt[chosen].T
    return basis


def open_parts(basis: Array, frames: Frames) -> list[OpenPart]:
    """Return which parts of the frames some open directions (12, k) move."""
    parts = []
    for block, frame, kind in BLOCKS:
        rows = basis[block]
        if frame == "base":
            rows = frames.R_base.T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        found = [direction_of(u) for u in U[:, s > _PART].T]
        if found:
            parts.append(OpenPart(frame, kind, tuple(found)))
    return parts


@dataclass(frozen=True, eq=False)
class Variety:
    """How platform poses differ.

    Attributes
    ----------
    axes : (r, 3) array
        Independent axes that they are turned about, in the base link, the first ones first.
    n_shifts : int
        Independent directions in which they are displaced.
    """

    axes: Array
    n_shifts: int

    @property
    def words(self) -> str:
        """How they differ, after "poses that"."""
        turns = (
            "do not turn",
            f"all turn about one axis, {direction_words(self.axes[0])} of the base"
            if len(self.axes)
            else "",
            "turn about two axes",
            "turn about all axes",
        )[len(self.axes)]
        shifts = ("stay in place", "move along a line", "move in a plane", "move in space")
        return f"{turns} and {shifts[self.n_shifts]}"


def variety(R: Array, t: Array, length: float) -> Variety:
    """Return how poses R (n, 3, 3), t (n, 3) [m] differ; a length makes rotations comparable."""
    turns = (Rotation.from_matrix(R) * Rotation.from_matrix(R).mean().inv()).as_rotvec()
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    size = np.sqrt(len(t))
    axes = Vt[(s > _SAME_AXIS * s[0]) & (s / size > 1e-6)]
    moves = np.linalg.svd(t - t.mean(axis=0), compute_uv=False)
    n_shifts = int(np.sum((moves > _SAME_AXIS * moves[0]) & (moves / size > 1e-6 * length)))
    return Variety(axes, n_shifts)


def needed_words(found: Variety, possible: Variety, scatter: str) -> str:
    """Return how the poses scatter if that matters, what they need and what to do."""
    if len(found.axes) < min(2, len(possible.axes)):
        several = "two axes" if len(possible.axes) > 1 else "an axis"
        more = "tilted about another axis too" if len(found.axes) else "turned against each other"
        return f", needed rotations about {several}; add poses that are {more}"
    if found.n_shifts < possible.n_shifts:
        return (
            f", needed displacements in {possible.n_shifts} directions; add poses that are "
            "displaced in another direction too"
        )
    return (
        f", with a scatter of {scatter}, needed more or better ones, further apart; add some from "
        "all over the workspace"
    )
