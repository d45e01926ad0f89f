"""The measurement noise as one JSON document, in SI units, radians and pixels."""

from __future__ import annotations

from typing import Any

from legcal.repeatability.quantities import QUANTITIES
from legcal.repeatability.result import OUTLINE, LegNoise, MethodNoise, Noise
from legcal.repeatability.samples import LegOrientation
from legcal.repeatability.spread import Spread, pool


def noise_document(noise: Noise) -> dict[str, Any]:
    """Return the document of ``legcal noise --json``."""
    counts = [len(group.rows) for group in noise.repeats]
    return {
        "legcal_noise": 1,
        "mechanism": noise.dataset.mechanism.name,
        "images": sum(counts),
        "orientations": len(counts),
        "repeats": {"least": min(counts), "most": max(counts)},
        "methods": {method.name: _method(noise, method) for method in noise.methods},
        "difference": {
            "all": _difference(noise, None),
            **{leg.name: _difference(noise, leg.name) for leg in noise.methods[0].legs},
        },
        "notes": list(noise.notes),
    }


def _difference(noise: Noise, leg: str | None) -> dict[str, float] | None:
    found = noise.difference(leg)
    return None if found is None else {"mean": found[0], "rms": found[1]}


def _method(noise: Noise, method: MethodNoise) -> dict[str, Any]:
    return {
        "legs": [_leg(noise, leg) for leg in method.legs],
        "all": {name: _spread(method.spread(name)) for name in (*QUANTITIES, OUTLINE)},
        "upper_bound": {
            name: None if (spread := method.spread(name)) is None else spread.largest
            for name in (*QUANTITIES, OUTLINE)
        },
        "upper_bound_at": {
            name: None if (o := method.bounding(name)) is None else _place(noise, o)
            for name in (*QUANTITIES, OUTLINE)
        },
    }


def _place(noise: Noise, orientation: LegOrientation) -> dict[str, str]:
    return {
        "leg": noise.dataset.mechanism.leg_names[orientation.leg],
        "view": noise.view_names[orientation.view],
        "pose": noise.pose_labels[orientation.pose],
    }


def _leg(noise: Noise, leg: LegNoise) -> dict[str, Any]:
    return {
        "leg": leg.name,
        "images": leg.images,
        "axes": leg.axes,
        "outlines": sum(o.outlines for o in leg.orientations),
        "outlines_found": sum(o.outlines_found for o in leg.orientations),
        "without_M_LS": leg.without_M_LS,
        **{name: _spread(leg.spread(name)) for name in (*QUANTITIES, OUTLINE)},
        "orientations": [_orientation(noise, o) for o in leg.orientations],
    }


def _orientation(noise: Noise, orientation: LegOrientation) -> dict[str, Any]:
    line = pool(orientation.lines)
    return {
        "view": noise.view_names[orientation.view],
        "pose": noise.pose_labels[orientation.pose],
        "images": orientation.images,
        "axes": orientation.axes,
        **{
            name: orientation.quantities[name].sd if name in orientation.quantities else None
            for name in QUANTITIES
        },
        OUTLINE: None if line is None else line.sd,
    }


def _spread(spread: Spread | None) -> dict[str, Any] | None:
    if spread is None:
        return None
    low, high = spread.ratio_range
    return {
        "sd": spread.sd,
        "claimed": spread.claimed,
        "ratio": spread.ratio,
        "ratio_low": low,
        "ratio_high": high,
        "median": spread.median,
        "largest": spread.largest,
        "dof": spread.dof,
        "samples": spread.samples,
    }
