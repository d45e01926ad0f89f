"""The other machines that show exactly the same as the true one, where there are any.

Where data leave directions of the parameters open, a whole family of machines has the same
outlines and the same readings: a 3-UPU that only translates may have the axes of a leg turned
together. A fit holds what is open near its nominal model, and finds, at best, the machine of the
family that stands there. Its errors are those from that machine: the family is curved, and from the
true one they would be as large as the square of what the nominal model has wrong.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.errors import DidNotConverge
from legcal.mechanism.parameters import radius_name
from legcal.refinement.choices import Choices
from legcal.refinement.legs import FittedLegs
from legcal.refinement.refine import refine
from legcal.refinement.solution import Solution
from legcal.refinement.start import Start
from legcal.refinement.state import components
from legcal.studies.outline_design import OutlineDesign
from legcal.studies.outline_session import OutlineSession

_EXACT = 1e-6  # squared standard deviations


def standing_where_held(
    design: OutlineDesign, session: OutlineSession, solution: Solution
) -> OutlineDesign:
    """Return the machine of the true one's family that stands where a fit holds what is open.

    It is fitted to the exact outlines and readings, from the solution: without noise nothing is
    left of what is determined, and what is open stays.

    Parameters
    ----------
    design : OutlineDesign
        The true machine.
    session : OutlineSession
        What was measured of it.
    solution : Solution
        What was found.

    Returns
    -------
    OutlineDesign
        With other legs, radii, cameras and poses, and the same outlines and readings.

    Raises
    ------
    DidNotConverge
        If no such machine is found.
    """
    if not solution.held:
        return design
    names = design.leg_names
    free = frozenset(radius_name(names[leg], part) for leg, part in solution.radii)
    radii = {**design.radii, **solution.radii}
    exact = refine(
        FittedLegs(names, solution.legs, design.sign, design.frame_legs, radii),
        replace(session.measurements, q=design.q[design.pose]),
        design.outlines,
        Start(solution.legs, solution.T_camera_Rb, solution.T_Rb_Re, "found"),
        choices=Choices(free=free),
    )
    if exact.cost > _EXACT or len(exact.held) != len(solution.held):
        raise DidNotConverge(
            "The errors of a fit could not be judged: found no machine that stands where it holds "
            "what is open and shows the same as the true one, needed one; this is a mistake in "
            "legcal, please report it."
        )
    R, t = components(exact.T_Rb_Re)
    return replace(
        design,
        legs=exact.legs,
        radii={**design.radii, **exact.radii},
        R=np.asarray(R),
        t=np.asarray(t),
        T_Rb_camera=tuple(T.inv() for T in exact.T_camera_Rb),
    )
