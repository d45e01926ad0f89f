"""An identifiability report: what was judged, and what was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from legcal.calibration.identify.ranks import PlatformError, Ranks, StepRank
from legcal.calibration.identify.remedies import (
    BoardReport,
    CameraIntrinsics,
    Recommendation,
    Remedy,
)
from legcal.paper import Condition


@dataclass(frozen=True)
class Paper:
    """What the paper's conditions say together.

    Attributes
    ----------
    ok : bool
        Whether all of them hold.
    """

    ok: bool


@dataclass(frozen=True)
class Identifiability:
    """An identifiability report.

    Attributes
    ----------
    spatial : bool
        Whether the platform moves in space and not in a plane.
    legs : tuple of str
        Their names.
    n, n_d, r, n_ac : int
        Legs; joint centres that define a frame; legs with a revolute joint at the base; legs whose
        length is measured or constant.
    conditions : tuple of Condition
        The paper's, as printed.
    paper : Paper
        All of them together.
    staged, full : Ranks
        The four default steps, and everything at once.
    identifiable : bool
        Whether everything at once determines all directions that move the platform.
    steps : tuple of StepRank
        Each step, by legcal's criteria and by the printed ones.
    views : tuple of tuples of str
        The legs that each view shows.
    images : tuple of int
        Number of images of each view.
    board : BoardReport
        What a calibration board on the base is needed for, and what it mends.
    platform_sigma : PlatformError or None
        Standard deviation of the platform that is to be expected from outlines good to 0.1 px,
        rms over the poses. None where something that moves the platform is not determined, or the
        motors do not determine its pose.
    remedies : tuple of Remedy
        What would mend what is missing; each was tried.
    recommendation : tuple of Recommendation or None
        The smallest sets of views, fewest first; None where views were given.
    notes : tuple of str
        What the reader should know.
    intrinsics : tuple of CameraIntrinsics
        What the legs tell of the cameras of a dataset with images; empty without them.
    """

    spatial: bool
    legs: tuple[str, ...]
    n: int
    n_d: int
    r: int
    n_ac: int
    conditions: tuple[Condition, ...]
    paper: Paper
    staged: Ranks
    full: Ranks
    identifiable: bool
    steps: tuple[StepRank, ...]
    views: tuple[tuple[str, ...], ...]
    images: tuple[int, ...]
    board: BoardReport
    platform_sigma: PlatformError | None
    remedies: tuple[Remedy, ...]
    recommendation: tuple[Recommendation, ...] | None
    notes: tuple[str, ...]
    intrinsics: tuple[CameraIntrinsics, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the report as plain JSON types; see the documentation of the files."""
        document = asdict(self)
        document["conditions"] = [_condition(c, self.legs) for c in self.conditions]
        document["board"]["with"] = document["board"].pop("with_board")
        return {key: _plain(value) for key, value in document.items()}


def _condition(condition: Condition, legs: Sequence[str]) -> dict[str, Any]:
    """Return a condition as a document: a count with its numbers, or the legs that fail it."""
    document: dict[str, Any] = {"name": condition.name, "ok": condition.ok}
    if not condition.needed:
        document["needed"] = False
    if condition.equations is not None:
        document |= {"equations": condition.equations, "unknowns": condition.unknowns}
    else:
        document["failing"] = [legs[j] for j in condition.legs]
    return document


def _plain(value: Any) -> Any:
    """Return tuples as lists, all the way down."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(inner) for inner in value]
    return value
