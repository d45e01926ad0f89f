"""The true machines of the studies."""

from __future__ import annotations

from dataclasses import replace

from legcal.mechanism.parameters import KinematicParameters
from legcal.simulation.machine import Machine, hexapod

RAISED = 0.030  # [m]


def coplanar_hexapod() -> Machine:
    """Return the shipped hexapod: all base joints in one plane, all platform joints in another."""
    return hexapod()


def noncoplanar_hexapod() -> Machine:
    """Return that hexapod with joints 2, 4 and 6 moved out of the planes of 1, 3 and 5.

    They are 30 mm higher at the base and 30 mm lower at the platform.
    """
    machine = hexapod()
    A, B = machine.parameters.base_joints.copy(), machine.parameters.platform_joints.copy()
    A[1::2, 2] += RAISED
    B[1::2, 2] -= RAISED
    return replace(machine, parameters=KinematicParameters(A, B, machine.parameters.offsets))
