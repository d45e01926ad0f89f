"""What the four steps ask of a mechanism."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

from numpy.typing import NDArray

from legcal.mechanism.parameters import KinematicParameters

Criteria = Literal["default", "literal"]


class NominalMechanism(Protocol):
    """A mechanism with point-like joints, as in :class:`legcal.mechanism.model.Mechanism`."""

    @property
    def leg_names(self) -> Sequence[str]:
        """Names of the legs, for messages."""

    @property
    def n_legs(self) -> int:
        """Number of legs."""

    @property
    def sign(self) -> NDArray[Any]:
        """Sign of q in the leg length, (n_legs,): L = sign q + q0."""

    @property
    def frame_legs(self) -> tuple[int, ...]:
        """The legs whose joint centres define R_b and R_e."""

    @property
    def parameters(self) -> KinematicParameters:
        """Nominal parameters: the start of steps 2, 3 and 4."""
