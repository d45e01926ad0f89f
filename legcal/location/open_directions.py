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
from legcal.location.pose_pairs import Frames

OPEN = 0.1  # [rad], and of the length of the machine
HARDLY = 2e-3  # of the best seen direction: what no pose of a machine shows better is its own
_PART = 0.03  # of a unit direction: what is less is not named
_SAME_AXIS = 0.02  # of the largest rotations: what is less is about the same axis

BLOCKS = (slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))  # base, its turn, tool, its turn


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


@dataclass(frozen=True)
class OpenPart:
    """A part of the frames that is open.

    Attributes
    ----------
    frame : {"base", "tool"}
        Whose.
    kind : {"position", "orientation"}
        Of what.
    directions : tuple of tuple of float
        Unit vectors: of the base in the base link, of the tool in the platform link.
    """

    frame: str
    kind: str
    directions: tuple[tuple[float, ...], ...]

    @property
    def words(self) -> str:
        """What is open, for people."""
        whose = "the base in the world" if self.frame == "base" else "the tool in the platform"
        link = "the base" if self.frame == "base" else "the platform"
        start = f"the {self.kind} of {whose}"
        if len(self.directions) == 3:
            return start
        if len(self.directions) == 2:
            normal = np.cross(*np.array(self.directions))
            return f"{start} across {direction_words(normal)} of {link}"
        link = "its own axes" if self.frame == "base" else link
        how = "along" if self.kind == "position" else "about"
        return f"{start} {how} {direction_words(self.directions[0])} of {link}"


def open_parts(basis: Array, frames: Frames) -> list[OpenPart]:
    """Return which parts of the frames some open directions (12, k) move."""
    parts = []
    for block, frame, kind in zip(
        BLOCKS,
        ("base", "base", "tool", "tool"),
        ("position", "orientation", "position", "orientation"),
        strict=True,
    ):
        rows = basis[block]
        if frame == "base":
            rows = frames.R_base.T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        found = [tuple(_signed(u).tolist()) for u in U[:, s > _PART].T]
        if found:
            parts.append(OpenPart(frame, kind, tuple(found)))
    return parts


def joined(parts: list[OpenPart]) -> str:
    """Return parts in one phrase, the tool's first."""
    words = [part.words for part in sorted(parts, key=lambda part: part.frame != "tool")]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def direction_words(v: Array | tuple[float, ...]) -> str:
    """Return a direction with two digits."""
    v = _signed(np.asarray(v) / np.linalg.norm(v))
    return "(" + ", ".join(f"{x:.3g}" for x in np.round(v, 2) + 0.0) + ")"


def _signed(v: Array) -> Array:
    """Return a direction with its largest component positive."""
    return np.asarray(v if v[np.argmax(np.abs(v))] > 0.0 else -v)


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
