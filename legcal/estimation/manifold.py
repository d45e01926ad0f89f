"""Retractions: how values of variables change by small steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry import Array, components, motions_of, turned


def add(value: Array, change: Array) -> Array:
    """Return numbers after a change, whatever shape their elements have."""
    return np.asarray(value + change.reshape(value.shape))


class Frames(NamedTuple):
    """Rigid motions T_to_from as rotations and translations.

    They move by six numbers each: a rotation vector from the left (Cayley's map) [rad], then a
    displacement [m].
    """

    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)

    @classmethod
    def of(cls, motions: Sequence[RigidTransform]) -> Frames:
        """Return the frames of rigid motions."""
        return cls(*components(motions))

    @property
    def motions(self) -> tuple[RigidTransform, ...]:
        """The same as rigid motions."""
        return motions_of(self.R, self.t)

    def moved(self, change: Array) -> Frames:
        """Return frames after changes (n, 6)."""
        return Frames(turned(self.R, change[:, :3]), self.t + change[:, 3:])
