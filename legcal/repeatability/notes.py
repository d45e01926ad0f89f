"""What a reader of the measurement noise should know besides the numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.observations.measurements import Measurements
from legcal.repeatability.result import CALLED, LegNoise, MethodNoise

BIAS = (
    "Repeats show what differs between images of one pose, not the bias that they share: an edge "
    "that light, blur or rounding to whole pixels displaces in all of them shows no spread. What "
    "the detector claims allows for such bias, so that a ratio below one is expected of it."
)
RANGE = (
    "The 95 % ranges hold for normal errors: where a method falls on one edge in some images and "
    "on another in others, they are too narrow."
)
JUMP = 3.0  # ratio of spread to claim, from which an edge is said to jump: as it is, and in the
# median ratio, lest all edges of a method that claims too little do
_NAMED = 4  # places in a note


def noise_notes(measurements: Measurements, methods: Sequence[MethodNoise]) -> list[str]:
    """Return what repeats cannot tell, and what is not known of which leg.

    Parameters
    ----------
    measurements : Measurements
        The rows, whose views and poses the notes name.
    methods : sequence of MethodNoise
        Both methods.
    """
    notes = [BIAS, RANGE]
    for leg in methods[0].legs:
        if not leg.orientations:
            notes.append(f"{leg.name} is in none of the repeated images.")
    for method in methods:
        for leg in method.legs:
            if leg.orientations and not any(o.quantities for o in leg.orientations):
                notes.append(
                    f"{leg.name}: {CALLED[method.name]} found its axis in no two images of one "
                    "pose."
                )
            notes += _without_M_LS(measurements, CALLED[method.name], leg)
        notes += _jumps(measurements, method)
    return notes


def _jumps(measurements: Measurements, method: MethodNoise) -> list[str]:
    """Return a note on outlines that spread far more than the others, against what is claimed."""
    ratios = [line.ratio for leg in method.legs for o in leg.orientations for line in o.lines]
    least = JUMP * max(1.0, float(np.median(ratios))) if ratios else np.inf
    found = sorted(
        (
            (max(line.sd for line in o.lines if line.ratio > least), leg, o)
            for leg in method.legs
            for o in leg.orientations
            if any(line.ratio > least for line in o.lines)
        ),
        key=lambda jump: -jump[0],
    )
    if not found:
        return []
    places = [
        f"{leg.name} in {measurements.views[o.view].name}/{measurements.pose_labels[o.pose]} "
        f"({sd:.3f} px)"
        for sd, leg, o in found[:_NAMED]
    ]
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return [
        f"{CALLED[method.name]}: single outlines spread over {least:.2g} times as far as is "
        f"claimed of them: {', '.join(places)}{more}. Such an edge jumps between images; pooled "
        "standard deviations and upper bounds are of the jumps, medians are not."
    ]


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
