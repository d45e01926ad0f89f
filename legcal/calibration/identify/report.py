"""The identifiability report: ``identify --json`` is its document."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from legcal.calibration.identify.intrinsics import CameraIntrinsics
from legcal.calibration.identify.ranks import PlatformError, Ranks, StepRank
from legcal.calibration.identify.recommend import Recommendation
from legcal.calibration.identify.remedies import BoardReport, Remedy
from legcal.paper import Condition


@dataclass(frozen=True)
class Identifiability:
    """An identifiability report."""

    spatial: bool  # whether the platform moves in space and not in a plane
    legs: tuple[str, ...]  # their names
    # n, n_d, r, n_ac: legs; joint centres that define a frame; legs with a revolute joint at the
    # base; legs whose length is measured or constant
    n: int
    n_d: int
    r: int
    n_ac: int
    conditions: tuple[Condition, ...]  # the paper's, as printed
    staged: Ranks  # staged, full: the four default steps, and the joint fit
    full: Ranks
    # whether the joint fit determines all directions that move the platform
    identifiable: bool
    steps: tuple[StepRank, ...]  # each step, by legcal's criteria and by the printed ones
    views: tuple[tuple[str, ...], ...]  # the legs that each view shows
    images: tuple[int, ...]  # number of images of each view
    board: BoardReport  # what a calibration board on the base is needed for, and what it mends
    # standard deviation of the platform that is to be expected from outlines good to 0.1 px, rms
    # over the poses. None where something that moves the platform is not determined, or the motors
    # do not determine its pose
    platform_sigma: PlatformError | None
    remedies: tuple[Remedy, ...]  # what would mend what is missing; each was tried
    # the smallest sets of views, fewest first; None where views were given
    recommendation: tuple[Recommendation, ...] | None
    notes: tuple[str, ...]  # what the reader should know
    # what the legs tell of the cameras of a dataset with images; empty without them
    intrinsics: tuple[CameraIntrinsics, ...] = ()

    @property
    def conditions_hold(self) -> bool:
        """Whether all of the paper's conditions hold that are needed."""
        return not any(condition.fails for condition in self.conditions)

    def document(self) -> dict[str, Any]:
        """Return the report as plain JSON types; see the documentation of the files."""
        document = asdict(self)
        document["paper"] = {"ok": self.conditions_hold}
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
