"""The estimator that the studies of outlines measure: one fit, as ``legcal calibrate`` makes it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.mechanism.parametrization import vector_of
from legcal.refinement.legs import FittedLegs
from legcal.refinement.refine import refine
from legcal.refinement.settings import RefinementSettings
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start, cameras_from_hints, start_from
from legcal.studies.bound_record import RunErrors
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_session import OutlineSession


def one_fit(session: OutlineSession, radius_sigma: float) -> Solution:
    """Return what one fit of everything finds from the nominal model and rough cameras.

    Parameters
    ----------
    session : OutlineSession
        What was measured, and what was known before.
    radius_sigma : float
        Standard deviation of the nominal radii, as a part of them.

    Raises
    ------
    NotIdentifiable, DidNotConverge
        As :func:`legcal.refinement.refine.refine` does.
    """
    legs = FittedLegs(
        session.leg_names, session.nominal, session.sign, session.frame_legs, session.radii
    )
    settings = RefinementSettings(radius_sigma=radius_sigma)
    start = nominal_start(session, legs)
    return refine(legs, session.measurements, session.outlines, start, settings)


def nominal_start(session: OutlineSession, legs: FittedLegs) -> Start:
    """Return the nominal model, moved from home to the readings, and the rough cameras."""
    measurements = session.measurements
    cameras = cameras_from_hints(measurements, RigidTransform.identity())
    home = (session.home,) * measurements.n_poses
    return start_from(session.nominal, measurements, legs, cameras, home, "nominal")


def errors_of(design: OutlineDesign, session: OutlineSession, solution: Solution) -> RunErrors:
    """Return the errors of what was found.

    Parameters
    ----------
    design : OutlineDesign
        The truth.
    session : OutlineSession
        What was measured: the solution counts axes from its nominal ones.
    solution : Solution
        What was found.

    Raises
    ------
    NotIdentifiable
        If a parameter was held or fixed.
    """
    missing = [name for name in design.names if solution.status.get(name) != "estimated"]
    if missing:
        raise NotIdentifiable(
            f"The errors of a fit could not be judged: found that {', '.join(missing)} were not "
            "estimated, needed all parameters; give the machine more images."
        )
    names, kinematic = design.names, design.parametrization
    radii = np.array([design.radii[part] for part in design.parts])
    found = np.array([solution.values[name] for name in names])
    truth = np.concatenate([vector_of(kinematic, design.legs, session.nominal), radii])
    of_truth, from_truth = (
        vector_of(kinematic, legs, design.legs) for legs in (design.legs, solution.legs)
    )
    place = [solution.names.index(name) for name in names]
    sigma = solution.sigma[place]
    correlation = solution.covariance[np.ix_(place, place)] / np.outer(sigma, sigma)
    of_sigma = (found - truth) / sigma
    nse = float(of_sigma @ np.linalg.solve(correlation, of_sigma)) / len(names)
    of_radii = found[len(kinematic) :] - radii
    return RunErrors(np.concatenate([from_truth - of_truth, of_radii]), of_sigma, nse)
