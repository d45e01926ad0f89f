"""Positions of joints at readings, and their motion by a calibration or a weak direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.drawing import motor_lines
from legcal.machine.leg import Leg
from legcal.machine.model import Machine
from legcal.machine.parameters import Parametrization
from legcal.machine.rods import ends_in_base, first_rods

if TYPE_CHECKING:
    from legcal.calibration.documents import Result

FACTORS = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000)
_SHOWN = 0.12  # default displayed size of the largest change, relative to the machine
_HELD = 0.0025  # length of a step along a held direction, in leg lengths


class PlacedModel(NamedTuple):
    """The visible geometry of a model at k poses, in the base link [m]."""

    A: Array  # (k, n_legs, 3)
    B: Array  # (k, n_legs, 3)
    anchors: Array  # (n_motors, 3) positions of motors that move joints at A
    standing: Array  # (n_motors, 2, 3) their rails and axes
    moving: Array  # (k, m, 2, 3) carriages, arms, and bars between the joints of one motor

    def moved_towards(self, other: PlacedModel, share: float) -> PlacedModel:
        """Return the geometry at a share of the difference to another model, or beyond it."""
        return PlacedModel(*(a + share * (b - a) for a, b in zip(self, other, strict=True)))

    def first_step(self, other: PlacedModel, size: float) -> int:
        """Return the default index of ``FACTORS`` for the difference to another model."""
        moved = max(float(np.abs(other.A - self.A).max()), float(np.abs(other.B - self.B).max()))
        wanted = _SHOWN * size / max(moved, 1e-12)
        return max(k for k, factor in enumerate(FACTORS) if factor <= max(wanted, 1.0))


def placed_model(
    machine: Machine,
    legs: Sequence[Leg],
    q: Array,
    near: Sequence[RigidTransform],
    *,
    by_readings: bool = True,
) -> PlacedModel:
    """Return the geometry of legs in R_b and R_e, motors and platform at readings q (k, n).

    Poses T_Rb_Re are solved *near* others, which are kept unless *by_readings*. Motors are fixed in
    the base link, even if A defines R_b.
    """
    poses = near
    if by_readings:
        from legcal.calibration.joint_fit.platform import poses_at_readings

        poses = poses_at_readings(machine, legs, q, near)
    frame = machine.T_base_Rb
    A, B = ends_in_base(legs, frame, *components(poses), q[:, first_rods(legs)])
    turn = frame.rotation.as_matrix()
    lines = motor_lines(legs, (A - frame.translation) @ turn)
    return PlacedModel(A, B, *(points @ turn.T + frame.translation for points in lines))


def directions(
    result: Result, parameters: Parametrization, length: float
) -> list[tuple[str, Array]]:
    """Return steps of the parameters (p,) along weak and held directions, with words.

    Weak steps are one standard deviation long, held ones a small fraction of the leg *length* [m],
    which also weights rotations.
    """
    names = list(parameters.names)
    steps = []
    for weak in result.weakest:
        step = np.zeros(len(names))
        for name, component in zip(weak.parameters, weak.components, strict=True):
            if name in names:
                i = names.index(name)
                per = length if parameters.units[i] == "rad" else 1.0
                step[i] = weak.sigma_m * component / per
        if np.any(step):
            steps.append((f"1 sigma along: {weak.in_words}", step))
    order = [result.kinematic.names.index(name) for name in names]
    for words, row in zip(result.held, result.kinematic.held, strict=False):
        step = _HELD * length * np.array(row)[order]
        steps.append((f"{1e3 * _HELD * length:.2g} mm along a held direction: {words}", step))
    return steps
