"""The identifiability report and its parts: ``identify --json`` is its document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from legcal.calibration.joint_fit.part_errors import PartSigma
from legcal.files.schema import Document, SparseDocument
from legcal.paper.conditions import Condition


@dataclass(frozen=True)
class Ranks:
    """How many parameters are determined."""

    rank: int  # rank, of: directions of the parameter space that are determined, and all of them
    of: int
    weak: tuple[WeakDirection, ...]  # undetermined directions

    @property
    def complete(self) -> bool:
        """Whether all directions that move the platform are determined."""
        return all(direction.harmless for direction in self.weak)


@dataclass(frozen=True)
class WeakDirection:
    """A combination of parameters that the observations do not determine."""

    direction: str  # in words
    parameters: tuple[str, ...]  # the parameters that change, the largest first
    # by how much, when the largest changes by 1 mm (an angle by 1 mm at the leg's length) [m or
    # rad]
    components: tuple[float, ...]
    # dX_m, dE_rad: the displacement [m] and rotation [rad] of the platform that this could hide,
    # root mean square over the poses; None where the motors do not determine the pose
    dX_m: float | None
    dE_rad: float | None
    harmless: bool  # whether the platform does not move


@dataclass(frozen=True)
class RmsMotion:
    """Motion of the platform, root mean square over poses."""

    dX_m: float  # displacement of the origin of R_e [m]
    dE_rad: float  # rotation [rad]


@dataclass(frozen=True)
class Remedy:
    """Something that would help, with the rank that it gives."""

    remedy: str  # what to do
    full_rank: int  # of all parameters; fixed ones count as known
    enough: bool  # whether everything that moves the platform is determined with it


class ConditionBlock(SparseDocument):
    """A condition of the paper: a count with its numbers, or the legs that fail it."""

    name: str
    ok: bool
    needed: bool | None = None  # left out where it is
    by_analogy: bool | None = None  # left out where it is the paper's
    equations: int | None = None
    unknowns: int | None = None
    failing: list[str] | None = None  # legs

    @property
    def fails(self) -> bool:
        """Whether it is needed and does not hold."""
        return self.needed is not False and not self.ok

    @classmethod
    def of(cls, condition: Condition, legs: Sequence[str]) -> ConditionBlock:
        """Return a condition with the names of the legs that fail it."""
        return cls(
            name=condition.name,
            ok=condition.ok,
            needed=None if condition.needed else False,
            by_analogy=condition.by_analogy or None,
            equations=condition.equations,
            unknowns=condition.unknowns,
            failing=None if condition.equations is not None else [legs[j] for j in condition.legs],
        )


class PaperBlock(Document):
    """Whether all of the paper's conditions hold that are needed."""

    ok: bool


class Identifiability(SparseDocument):
    """An identifiability report, which ``legcal identify --json`` prints."""

    spatial: bool  # whether the platform moves in space and not in a plane
    legs: tuple[str, ...]  # their names
    # n, n_d, r, n_ac: legs; joint centres that define a frame; legs with a revolute joint at the
    # base; legs whose length is measured or constant
    n: int
    n_d: int
    r: int
    n_ac: int
    conditions: tuple[ConditionBlock, ...]  # the paper's, as printed
    full: Ranks  # of the joint fit
    # whether the joint fit determines all directions that move the platform
    identifiable: bool
    views: tuple[tuple[str, ...], ...]  # the legs that each view shows
    images: tuple[int, ...]  # number of images of each view
    # whether every view shows a calibration board on the base, on the platform
    board: bool
    platform_board: bool
    # standard deviation of the platform that is to be expected, rms over the poses. None where
    # something that moves the platform is not determined, or the motors
    # do not determine its pose
    platform_sigma: RmsMotion | None
    remedies: tuple[
        Remedy, ...
    ]  # changes that would determine the undetermined directions; each was tried
    notes: tuple[str, ...]
    # whether only radii determine the scale: readings are angles, and no length is stated
    scale_is_open: bool = False
    paper: PaperBlock
    # what is expected of the parts asked for (--only); left out without
    parts: tuple[PartSigma, ...] | None = None

    def document(self) -> dict[str, Any]:
        """Return the report as plain JSON types; see the documentation of the files."""
        return self.model_dump(mode="json", by_alias=True)
