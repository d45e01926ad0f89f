"""The four steps on the sessions of the studies of outlines."""

from __future__ import annotations

from legcal.mechanism.leg_geometry import LegGeometry
from legcal.observations.leg_axes import axes_from_outlines
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.run import run_steps
from legcal.studies.outline_session import OutlineSession


def staged_legs(session: OutlineSession, criteria: Criteria) -> tuple[LegGeometry, ...]:
    """Return the legs that the four steps find from the axes which the outlines give.

    Parameters
    ----------
    session : OutlineSession
        What was measured, and what was known before. Rough camera poses are not looked at.
    criteria : {"default", "literal"}
        legcal's criteria, or those that are printed.

    Raises
    ------
    NotIdentifiable, NotVisible, DidNotConverge
        As :func:`legcal.stages.run.run_steps` does.
    """
    radii = {part: radius for (_, part), radius in session.radii.items()}
    axes = axes_from_outlines(session.outlines, session.measurements, radii)
    mechanism = NominalMechanism(
        session.leg_names, session.nominal, session.sign, session.frame_legs
    )
    return run_steps(mechanism, axes, session.measurements, criteria=criteria).legs
