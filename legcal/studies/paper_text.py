"""What the paper prints, and how its text was read where it leaves a choice."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Printed:
    """Figures of section 4.3 as printed.

    Attributes
    ----------
    dX_mm, dE_deg : float
        Means of (20).
    parameters_mm : tuple of float, optional
        The least and the largest mean error of a parameter.
    runs : int, optional
        Number of calibrations.
    """

    dX_mm: float
    dE_deg: float
    parameters_mm: tuple[float, float] | None = None
    runs: int | None = None

    def document(self) -> dict[str, Any]:
        """Return what there is as a JSON document."""
        found = asdict(self)
        if self.parameters_mm is not None:
            found["parameters_mm"] = list(self.parameters_mm)
        return {key: value for key, value in found.items() if value is not None}


PRINTED_BEFORE = Printed(dX_mm=1.0, dE_deg=0.12)
PRINTED_AFTER = Printed(dX_mm=0.08, dE_deg=0.018, parameters_mm=(0.04, 1.0), runs=100)
CONTEXT = (
    "The paper's figures are context only: the dimensions of its machine are not published. It "
    "prints orientation errors of 0.12 and 0.018 rad; only degrees fit 1 and 0.08 mm."
)
IN_DEGREES = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": read '
    "as degrees. --radians takes them to the letter: the steps then end tens of millimetres off."
)
IN_RADIANS = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": taken '
    "to the letter, as --radians asks."
)
READINGS = (
    "psi and theta are not defined: read as the tilt out of the image plane, asin(u_z), and the "
    "angle in the image, atan2(-u_x, u_y).",
    '"uniform noise with variance equal to 2mm" on the initial parameters: read as uniform '
    "within +-2 mm.",
    '"uniformly distributed noise, variance equal to 3um" on leg lengths: read as uniform within '
    "+-3 um, a standard deviation of 1.7 um; one reading for all images of a pose.",
    '"Fifteen end-effector poses": read as fifteen of each of the three camera positions, whose '
    "poses differ.",
    '"randomly selecting configurations with extreme leg lengths": every leg at random within '
    "12 % of its travel from its shortest or its longest, reached from home without a singularity.",
    '"three images are acquired" of each pose: each with its own noise. The fit and the bound use '
    "the mean of a leg's axis in them, weighted by the covariances; it holds all that they tell.",
    '"ten randomly chosen poses" of (20): leg lengths uniform in the travel, drawn anew in every '
    "run.",
    "(20) as printed: dX is the displacement of B_1 from A_1, dE the norm of the x-y-z Euler "
    "angles of the rotation between both orientations.",
    "The machine: the shipped hexapod, whose joints are coplanar, and the same with joints 2, 4 "
    "and 6 moved 30 mm out of the planes of 1, 3 and 5; cameras stand 0.9 m from its middle.",
    "one fit: started from the initial model and from cameras up to 15 mm and 1.5 deg off, not "
    "from what the steps find.",
    "bound: the Cramer-Rao bound of the same data, all used at once; the table has the errors to "
    "be expected of an estimator that reaches it. Errors of readings count as Gaussian there, "
    "with the variance of the uniform ones.",
    '"of bound": root mean square of the errors of all thirty parameters together, each measured '
    "by the covariance of the bound of its run; 1 where it is reached. +- is one standard "
    "deviation of the mean over runs.",
)
