"""What a reader of the measurement noise should know besides the numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.observations.measurements import Measurements
from legcal.repeatability.result import LegNoise, MethodNoise

BIAS = (
    "Repeats show what differs between images of one pose, not the bias that they share: an edge "
    "that light, blur or rounding to whole pixels displaces in all of them shows no spread. What "
    "the detector claims allows for such bias, so that a ratio below one is expected of it."
)


def noise_notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what repeats cannot tell, and what is not known of which leg.

    Parameters
    ----------
    measurements : Measurements
        The rows, whose views and poses the notes name.
    methods : sequence of MethodNoise
        Both methods.
    """
    notes = [BIAS]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(
                    f"{leg.name}: {method.name} found its axis in no two images of one pose."
                )
            notes += _without_M_LS(measurements, method.name, leg)
    return notes


def _without_M_LS(measurements: Measurements, method: str, leg: LegNoise) -> list[str]:
    """Return a note on a leg that has no M_LS in some orientations."""
    without = [o for o in leg.orientations if o.inclination is not None]
    if not without:
        return []
    places = {
        f"{measurements.views[o.view].name}/{measurements.pose_labels[o.pose]}" for o in without
    }
    inclination = np.degrees(min(o.inclination for o in without if o.inclination is not None))
    return [
        f"{leg.name}: M_LS does not exist for {method} in {len(without)} of "
        f"{len(leg.orientations)} orientations ({', '.join(sorted(places))}), where the leg is "
        f"parallel to the image x axis within {inclination:.2f} deg, or to the camera's plane "
        "y = 0: M_LS would slide along it by more than its width, or lie at infinity."
    ]
