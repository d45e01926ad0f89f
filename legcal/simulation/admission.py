"""Which closed configurations a machine can work in: what stands against one, in words."""

from __future__ import annotations

import numpy as np

from legcal.errors import ModelError
from legcal.geometry.types import Array
from legcal.mechanism.closing import platform_pose
from legcal.mechanism.configurations import REGULAR, beyond_travel
from legcal.mechanism.model import Mechanism
from legcal.mechanism.singularity import singularity
from legcal.simulation.clearance import Clearance

ROUNDING = 1e-9  # [rad]


class Admission:
    """What a configuration is held against: travel, joint limits, singularities, other legs.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.

    Raises
    ------
    ModelError
        If a revolute joint is outside its limits at home already.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._mechanism = mechanism
        self._clearance = Clearance(mechanism)
        limited = [
            (joint, joint.limits)
            for joint in mechanism.urdf.joints.values()
            if joint.type == "revolute" and joint.limits is not None
        ]
        self._revolutes = [joint.name for joint, _ in limited]
        self._columns = [mechanism.chain.q_index(name) for name in self._revolutes]
        self._limits = np.array([limits for _, limits in limited]).reshape(-1, 2)
        self._least = REGULAR * singularity(mechanism, mechanism.home)
        problem = self.beyond_limits(mechanism.home_configuration)
        if problem is not None:
            raise ModelError(
                f"{mechanism.yaml_path}: no pose could be drawn: found {problem} at home, needed "
                "every joint inside its limits there; correct legcal.home or the limits of the "
                "URDF."
            )

    def problem(self, configuration: Array, *, of_motors: bool = True) -> str | None:
        """Return what stands against a closed configuration, None if nothing does.

        The travel of motors is left out where their readings have been judged already.
        """
        mechanism = self._mechanism
        outside = beyond_travel(mechanism, configuration)
        if not of_motors:
            outside[list(mechanism.motors)] = False
        beyond = np.flatnonzero(outside)
        if len(beyond):
            return f"leg '{mechanism.leg_names[beyond[0]]}' outside its travel"
        problem = self.beyond_limits(configuration)
        if problem is not None:
            return problem
        T = platform_pose(mechanism, configuration)
        if singularity(mechanism, T) < self._least:
            return "the mechanism near a singularity"
        touching = self._clearance.touching(T)
        if touching is not None:
            return f"legs '{touching[0]}' and '{touching[1]}' run through each other"
        return None

    def beyond_limits(self, configuration: Array) -> str | None:
        """Return which revolute joint is outside its limits, whole turns not counted."""
        lower, upper = self._limits.T
        angles = configuration[self._columns]
        above = np.mod(angles - lower + ROUNDING, 2.0 * np.pi) - ROUNDING
        beyond = np.flatnonzero(above > upper - lower + ROUNDING)
        if not len(beyond):
            return None
        i = int(beyond[0])
        limits = f"{np.degrees(lower[i]):.1f} to {np.degrees(upper[i]):.1f} deg"
        return f"joint '{self._revolutes[i]}' outside its limits of {limits}"
