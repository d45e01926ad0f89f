"""What ``legcal calibrate --check`` tells: whether something has moved, and what."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from legcal.dataset.folder import Dataset
from legcal.refinement.held_out import PlatformPair
from legcal.refinement.moved import Explanation, Movement
from legcal.refinement.solution import Solution
from legcal.report.earlier_result import EarlierResult

if TYPE_CHECKING:
    from rich.console import RenderableType

_SHOWN = 3  # explanations


@dataclass(frozen=True, eq=False)
class Check:
    """The result of :func:`legcal.check`.

    Attributes
    ----------
    dataset : Dataset
        The new images; its ``mechanism`` is the calibrated model of the earlier result.
    earlier : EarlierResult
        What was tested.
    solution : Solution
        The fit of the new images by themselves.
    movement : Movement
        The test; ``movement.moved`` is its answer.
    at_platform : PlatformPair
        How far the platform by the new images is from that by the earlier result, root mean square
        over the poses, and one standard deviation of this if nothing moved.
    notes : tuple of str
        What else a reader should know.
    """

    dataset: Dataset
    earlier: EarlierResult
    solution: Solution
    movement: Movement
    at_platform: PlatformPair
    notes: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The answer in words."""
        movement, pair = self.movement, self.at_platform
        told = (
            f"probability {_probability(movement.p_value)} if nothing did, significance "
            f"{100 * movement.significance:g} %"
        )
        known = (
            f"{1e3 * pair.expected_displacement:.3f} mm / "
            f"{np.degrees(pair.expected_rotation):.4f} deg (1 sigma)"
        )
        if not movement.moved:
            return (
                f"Nothing has moved as far as these images can tell ({told}); they know the "
                f"platform against the earlier result to {known}."
            )
        found = f"{1e3 * pair.displacement:.3f} mm / {np.degrees(pair.rotation):.4f} deg"
        return (
            f"Something has moved ({told}): the platform is {found} from where the earlier result "
            f"has it, known to {known}; calibrate again."
        )

    def document(self) -> dict[str, Any]:
        """Return the document that ``--json`` prints."""
        movement, pair = self.movement, self.at_platform
        return {
            "legcal_check": 1,
            "result": str(self.earlier.folder),
            "moved": movement.moved,
            "significance": movement.significance,
            "p_value": movement.p_value,
            "statistic": movement.statistic,
            "dof": movement.dof,
            "of": len(self.earlier.names),
            "noise_dof": movement.noise_dof,
            "verdict": self.sentence,
            "explanations": [_explanation(e) for e in movement.explanations],
            "platform": {
                "dX_m": pair.displacement,
                "dE_rad": pair.rotation,
                "sigma_dX_m": pair.expected_displacement,
                "sigma_dE_rad": pair.expected_rotation,
            },
            "images": self.dataset.measurements.n_rows,
            "residuals": {
                "chi2": self.solution.chi2,
                "dof": self.solution.dof,
                "rms_px": self.solution.rms_px,
            },
            "notes": list(self.notes),
        }


def check_summary(check: Check) -> RenderableType:
    """Return what people read."""
    from rich.console import Group
    from rich.text import Text

    movement = check.movement
    images = check.dataset.measurements.n_rows
    lines = [f"Note: {note}" for note in check.notes]
    lines.append(
        f"{images} image{'s' * (images != 1)} compared with {check.earlier.folder}: {movement.dof} "
        f"of {len(check.earlier.names)} directions of the parameters, "
        f"statistic {movement.statistic:.1f}."
    )
    lines += _explanation_lines(movement)
    style = "bold red" if movement.moved else "bold green"
    return Group(*(Text(line) for line in lines), Text(check.sentence, style=style))


def _explanation_lines(movement: Movement) -> list[str]:
    """Return what explains a movement."""
    if not movement.explanations:
        return []
    first = movement.explanations[0]
    if first.p_value < movement.significance:
        return [
            f"No single leg explains it; {first.change.what} explains most "
            f"({_amount(first)}; {first.remaining:.1f} of {movement.statistic:.1f} are left)."
        ]
    lines = [f"It is explained by {first.change.what}: {_amount(first)}."]
    others = [e.change.what for e in movement.explanations[1 : 1 + _SHOWN]]
    if others:
        lines.append(f"These images cannot tell that from: {', '.join(others)}.")
    return lines


def _amount(explanation: Explanation) -> str:
    """Return by how much something changed, in words."""
    change = explanation.change
    parts = []
    for name, unit, value, sigma in zip(
        change.components,
        change.units,
        explanation.values.tolist(),
        explanation.sigma.tolist(),
        strict=True,
    ):
        scale, shown = (1e3, "mm") if unit == "m" else (180.0 / np.pi, "deg")
        parts.append(f"{name} {scale * value:+.3f} {shown} (1 sigma {scale * sigma:.3f})")
    return ", ".join(parts)


def _explanation(explanation: Explanation) -> dict[str, Any]:
    """Return an explanation as JSON has it."""
    change = explanation.change
    return {
        "what": change.what,
        "components": list(change.components),
        "units": list(change.units),
        "values": explanation.values.tolist(),
        "sigma": explanation.sigma.tolist(),
        "remaining": explanation.remaining,
        "p_value": explanation.p_value,
    }


def _probability(p: float) -> str:
    """Return a probability as people read it."""
    return "below 1e-6" if p < 1e-6 else f"{p:.2g}"
