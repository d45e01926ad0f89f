"""The ranks of a session: of each step, of the four together, and of everything at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.identify import literal, steps
from legcal.identify.elimination import compress
from legcal.identify.full import (
    WhitenedDemands,
    by_cameras,
    demands_of,
    image_rows,
    of_parameters,
)
from legcal.identify.session import Session
from legcal.identify.weak import (
    PlatformMotion,
    Ranks,
    determined,
    undetermined,
    weak_directions,
)


@dataclass(frozen=True)
class StepRank:
    """The rank of one step's equations.

    Attributes
    ----------
    name : str
        ``joints_in_cameras``, ``base_joints``, ``offsets`` or ``platform_joints``.
    criteria : {"default", "literal"}
        legcal's criteria, or the paper's as printed: (6) and (7), (9), (14), (16).
    rank, of : int
        Unknowns that are determined, and all of them. Those of the first step are joints and
        axes in the camera frames; the others are parameters.
    """

    name: str
    criteria: str
    rank: int
    of: int


@dataclass(frozen=True, eq=False)
class Analysis:
    """What a session says of the parameters.

    Attributes
    ----------
    session : Session
        The session.
    known : (m, p) array or None
        What is known of the parameters without looking, as whitened rows [1/m].
    """

    session: Session
    known: Array | None = None

    def elsewhere(self, session: Session, poses: IntArray) -> Analysis:
        """Return the analysis of other images of the same machine, at some of the same poses."""
        other = Analysis(session, self.known)
        other.__dict__.update(motion=self.motion, demands=self.demands.at(poses))
        return other

    def with_board(self, *, board: bool = True) -> Analysis:
        """Return the analysis of the same images with a calibration board in all or in none."""
        session = self.session.with_board(board=board)
        other = self.elsewhere(session, np.arange(len(session.t)))
        other.__dict__.update(images=self.images)
        return other

    @cached_property
    def images(self) -> Array:
        """What the images say."""
        return image_rows(self.session)

    @cached_property
    def demands(self) -> WhitenedDemands:
        """What readings and legs demand."""
        return demands_of(self.session)

    @cached_property
    def located(self) -> steps.Located:
        """Step 1."""
        return steps.locate_joints(self.session)

    @cached_property
    def distances(self) -> tuple[Array, Array, IntArray]:
        """The distances of steps 3 and 4."""
        return steps.distance_rows(self.session, self.located)

    @cached_property
    def default_steps(self) -> tuple[steps.Step, ...]:
        """Steps 2, 3 and 4, default criteria."""
        return (
            steps.identify_base(self.session, self.located),
            steps.offsets_from_distances(self.session, *self.distances),
            steps.identify_platform(self.session, self.located, self.images, self.demands),
        )

    @cached_property
    def literal_steps(self) -> tuple[steps.Step, ...]:
        """Steps 2, 3 and 4 as printed."""
        rows, weight, key = self.distances
        return (
            literal.scalar_products(self.session, self.located),
            literal.consecutive_distances(rows, weight, key, self.default_steps[1].columns),
            literal.mean_distances(self.session, weight, key),
        )

    @cached_property
    def of_cameras(self) -> Array:
        """Everything at once, of cameras and parameters, (m, 6 n_frames + p)."""
        return by_cameras(self.session, self.images, self.demands)

    @cached_property
    def information(self) -> Array:
        """Everything at once, (p, p)."""
        found = of_parameters(self.session, self.of_cameras)
        return found if self.known is None else compress(np.concatenate([found, self.known]))

    @cached_property
    def motion(self) -> PlatformMotion:
        """What the platform does."""
        return PlatformMotion(self.session)

    @cached_property
    def staged(self) -> Ranks:
        """The four default steps together."""
        weak = tuple(
            direction
            for step in self.default_steps
            for direction in weak_directions(
                self.session,
                self.motion,
                undetermined(self.session, step.information),
                step.columns,
            )
        )
        n_p = len(self.session.unit)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def full(self) -> Ranks:
        """Everything at once."""
        basis = undetermined(self.session, self.information)
        weak = weak_directions(self.session, self.motion, basis)
        n_p = len(self.session.unit)
        return Ranks(n_p - len(weak), n_p, weak)

    @cached_property
    def step_ranks(self) -> tuple[StepRank, ...]:
        """The rank of each step, default and as printed."""
        first = ("joints_in_cameras", self.located.rank, self.located.of)
        found = [
            StepRank(first[0], "default", *first[1:]),
            StepRank(first[0], "literal", *first[1:]),
        ]
        for default, printed in zip(self.default_steps, self.literal_steps, strict=True):
            for criteria, step in (("default", default), ("literal", printed)):
                rank = determined(self.session, step.information)
                found.append(StepRank(step.name, criteria, rank, len(step.columns)))
        return tuple(found)


def missing(session: Session, rows: Array, motion: PlatformMotion) -> int:
    """Return how many directions that move the platform rows of all parameters leave open."""
    return len(motion.split(undetermined(session, rows))[0])


def scattered(step: steps.Step, n_parameters: int) -> Array:
    """Return a step's rows by all parameters; the others count as known."""
    rows = np.zeros((len(step.information) + n_parameters, n_parameters))
    rows[: len(step.information), step.columns] = step.information
    known = np.setdiff1d(np.arange(n_parameters), step.columns)
    rows[len(step.information) + known, known] = 1e12
    return rows
