"""Which parameters the fit looks for, which it leaves as they are, and what is known of them.

Without a choice the fit looks for all kinematic parameters except twists, and for radii with the
prior of :class:`legcal.calibration.joint_fit.state.RefinementSettings`; intrinsics are fixed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter before the fit: a mean and a standard deviation [its unit]."""

    mean: float
    sigma: float


@dataclass(frozen=True)
class Choices:
    """Choices of parameters by their full names.

    Attributes
    ----------
    fixed : frozenset of str
        Held at nominal, or at ``values``.
    free : frozenset of str
        Looked for without a prior: radii, and what is fixed without a choice.
    priors : mapping
        Looked for with this prior, in place of one that there is without a choice.
    values : mapping
        Where fixed parameters stand that are not at nominal [m, rad, px]; axes as angles from
        the nominal axis.
    notes : tuple of str
        What gave way to what.
    least_shared_px : mapping
        Standard deviations that errors which outlines share have at least, by what they are
        (:data:`legcal.calibration.joint_fit.biases.KINDS`) [px].
    """

    fixed: frozenset[str] = frozenset()
    free: frozenset[str] = frozenset()
    priors: Mapping[str, Prior] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    least_shared_px: Mapping[str, float] = field(default_factory=dict)

    def holds(self, name: str, *, by_default: bool = False) -> bool:
        """Say whether a parameter is held; ``by_default``: whether it is without a choice."""
        if name in self.fixed:
            return True
        return by_default and name not in self.free and name not in self.priors

    def document(self) -> dict[str, object]:
        """Return what was chosen as JSON has it; nothing where nothing was."""
        found = {
            "fixed": sorted(self.fixed - self.values.keys()),
            "fixed_at": dict(sorted(self.values.items())),
            "free": sorted(self.free),
            "priors": {name: [p.mean, p.sigma] for name, p in sorted(self.priors.items())},
            "least_shared_px": dict(sorted(self.least_shared_px.items())),
        }
        return {key: value for key, value in found.items() if value}


NO_CHOICES = Choices()
