"""Draws of configurations: followed from home to random readings, or come to by a random walk."""

from __future__ import annotations

from collections import Counter

import numpy as np

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.mechanism.closing import slider_columns
from legcal.mechanism.configurations import beyond_travel, strolled
from legcal.mechanism.following import follow
from legcal.mechanism.model import Mechanism
from legcal.simulation.admission import Admission
from legcal.simulation.extremes import near_ends

TRIES = 60  # draws for each pose
FULL_EXTREME, FULL = 12, 2  # of them over all of the travel; the next nearer to home
NEARER = 0.85  # each
LEARNED = 6  # draws before those that reached the last pose; extremes are tried first always
WAY = (0.25, 0.5, 0.75, 1.0)  # parts of the way from home: no leg goes through another before
SHORTEST = 0.25  # of such a part; what is harder to reach is drawn again


class Draws:
    """Draws of configurations, and what stood against those that were none.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    rng : numpy.random.Generator
        Source of chance.
    extreme : bool
        Whether readings are drawn near the ends of the travel, and not anywhere in it.

    Attributes
    ----------
    problems : Counter of str
        How often what stood in the way.

    Raises
    ------
    ModelError
        If a joint is outside its limits at home already.
    """

    def __init__(self, mechanism: Mechanism, rng: np.random.Generator, *, extreme: bool) -> None:
        self._mechanism, self._rng, self._extreme = mechanism, rng, extreme
        self._admission = Admission(mechanism)
        self._here = mechanism.home_configuration
        self._home = self._here[slider_columns(mechanism, mechanism.motors)[0]]
        travel = np.array([mechanism.legs[j].travel for j in mechanism.motors]).reshape(-1, 2)
        self._lower, self._upper = travel.T
        self._tried = 0  # draws until the last pose was reached
        self.problems: Counter[str] = Counter()

    def next(self) -> Array | None:
        """Return the next configuration, None if many draws were in vain."""
        return self._followed() if self._mechanism.is_determined else self._walked()

    def said(self) -> str:
        """Return what stood in the way most often, in words."""
        found = [f"{count} times {what}" for what, count in self.problems.most_common(3)]
        return ", ".join(found)

    def _followed(self) -> Array | None:
        """Return what is followed from home to drawn readings of the motors."""
        start = 0 if self._extreme else max(0, self._tried - LEARNED)
        full = FULL_EXTREME if self._extreme else FULL
        for tried in range(start, start + TRIES):
            found = self._reached(self._readings(NEARER ** max(0, tried + 1 - full)))
            if not isinstance(found, str):
                self._tried = tried
                return found
            self.problems[found] += 1
        return None

    def _reached(self, readings: Array) -> Array | str:
        """Return the configuration at readings, or what stands in the way, there or before."""
        configuration = self._mechanism.home_configuration
        for part in WAY:
            q = readings if part == 1.0 else self._home + part * (readings - self._home)
            try:
                configuration = follow(
                    self._mechanism, configuration, q, shortest=SHORTEST, on_the_chain=True
                )
            except DidNotConverge:
                return "legs that cannot have such lengths at the same time"
            problem = self._admission.problem(configuration, of_motors=part == 1.0)
            if problem is not None:
                return problem
        return configuration

    def _walked(self) -> Array | None:
        """Return where a random walk on the closed configurations comes to."""
        for _ in range(TRIES):
            there = strolled(self._mechanism, self._here, self._rng)
            problem = self._admission.problem(there)
            if problem is None or beyond_travel(self._mechanism, there).any():
                self._here = there  # walks never lead further out of the travel
            if problem is None:
                return there
            self.problems[problem] += 1
        return None

    def _readings(self, nearer: float) -> Array:
        """Return drawn readings of the motors, taken nearer to home by a factor [m]."""
        part = self._rng.random(len(self._home))
        if self._extreme:
            part = near_ends(self._rng.integers(0, 2, len(self._home)), part)
        q = self._lower + part * (self._upper - self._lower)
        if nearer < 1.0:
            q = np.clip(self._home + nearer * (q - self._home), self._lower, self._upper)
        return np.asarray(q)
