"""Absolute scale of a machine: from a measured length, or from radii alone.

Encoders of arms measure angles, and passive legs have none. Without a measured length, such a
machine at twice the size, with rods twice as thick and cameras twice as far, gives the same
measurements.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from legcal.calibration.joint_fit.diagnostics import RADIUS_SIGMAS, stated_parameters
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.sensitivity import Sensitivity
from legcal.calibration.joint_fit.variables import State
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine.leg import LegColumns
from legcal.machine.parameter_id import ParameterId
from legcal.machine.rods import actuators_of

SCALE = "an error of the scale, known from radii alone, by one standard deviation"
_FEWEST = 3  # radii
_SPREAD = 0.25  # of their common difference
_LENGTHS = {"base", "platform", "offset", "length"}  # kinds of parameters with a length


def has_length(problem: FitProblem) -> bool:
    """Whether a length was measured or stated: a reading, a board, a parameter.

    A list, not a rank test as ``is_scale_open`` of identify, since it is used after failed fits.
    """
    stated = {
        ParameterId.parse(name).kind for name in stated_parameters(problem) if ":" not in name
    }
    return (
        bool(_witnesses_in_images(problem))
        or any(":" in name for name in problem.choices.priors)
        or bool(stated & _LENGTHS)
    )


@contextmanager
def explaining_missing_scale(problem: FitProblem) -> Iterator[None]:
    """Prepend to a failure that radii alone determine the scale, if they do."""
    try:
        yield
    except (DidNotConverge, NotIdentifiable) as failure:
        if has_length(problem):
            raise
        raise type(failure)(
            [
                "The joint fit failed, and no measured length determines the scale: there is "
                "neither a reading of a leg nor a board, and radii alone hardly determine the "
                "platform joints; "
                + (
                    "measure a distance of two joints and state it (--length), or put a "
                    "calibration board on the base."
                    if problem.legs.n_actuators
                    else "put a calibration board on the platform and one on the base, give a leg "
                    "an encoder, or state measured coordinates of joints (--set)."
                ),
                *failure.facts,
            ]
        ) from None


def sensitivity_to_scale(
    problem: FitProblem, state: State, covariance: Array
) -> tuple[Sensitivity, ...]:
    """Return the change of parameters with one sigma of a scale that is known from radii alone.

    *covariance* is of the kept unknowns. The scale is the relative change of the mean length of
    rods; its share of the covariance would vanish with one measured length.
    """
    parametrization = problem.legs.parametrization
    column = parametrization.place[:, LegColumns.LENGTH]
    rods = np.flatnonzero(column >= 0)
    if not len(rods) or has_length(problem):
        return ()
    by_scale = np.zeros(len(parametrization))
    by_scale[column[rods]] = 1.0 / (len(rods) * np.array([state.legs[j].q0 for j in rods]))
    n = problem.n_kinematic
    by_scale = by_scale[problem.free]
    moved = covariance[:n, :n] @ by_scale
    step = np.zeros((len(parametrization), 1))
    step[problem.free, 0] = moved / np.sqrt(by_scale @ moved)
    return (Sensitivity(SCALE, step),)


def scale_witnesses(problem: FitProblem) -> list[str]:
    """Return what says how large the machine is, besides radii and the nominal model, in words."""
    priors = problem.choices.priors
    lengths = [n for n in priors if ":" in n or ParameterId.parse(n).kind in _LENGTHS]
    return [*_witnesses_in_images(problem), *(f"the stated {name}" for name in lengths)]


def _witnesses_in_images(problem: FitProblem) -> list[str]:
    """Return the measured lengths that images come with: readings, a board."""
    actuators = actuators_of(problem.legs.nominal)
    read = problem.observed.actuator_readings.actuator.tolist()
    has_travel = len(problem.readings) > 0 or any(not actuators[a].turns for a in read)
    has_board = any(len(corners) for corners in problem.boards)
    return ["the travel of the motors"] * has_travel + ["the calibration board"] * has_board


def single_witness(problem: FitProblem) -> str:
    """Return a sentence on a scale that one witness alone says, "" where there are more or none."""
    witnesses = scale_witnesses(problem)
    if len(witnesses) != 1:
        return ""
    return (
        f"The scale of the machine rests on {witnesses[0]} alone: an error of that would not show "
        "in photographs; a measured length beside it would (--length, --set)."
    )


def scale_notes(problem: FitProblem, state: State) -> tuple[str, ...]:
    """Return a note on radii that are all larger or smaller than the model's by one factor."""
    free = problem.block("radii").unknown[:, 0] >= 0
    nominal = np.array([problem.legs.radii[part] for part in problem.outlines.parts])
    change = (state.radii / nominal - 1.0)[free]
    if len(change) < _FEWEST:
        return ()
    common = float(np.median(change))
    alike = bool(np.all(np.abs(change - common) < _SPREAD * abs(common)))
    if not alike or abs(common) < RADIUS_SIGMAS * problem.settings.radius_sigma:
        return ()
    way = "smaller" if common < 0.0 else "larger"
    return (
        f"All fitted radii are {1e2 * abs(common):.0f} % {way} than the model's, so the whole "
        "result may be scaled by that factor; check the unit and the scale of the encoders, or "
        "the radii of the model.",
    )
