"""A mechanism as ``legcal inspect --json`` prints it."""

from typing import Any

from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Mechanism


def describe(mechanism: Mechanism) -> dict[str, Any]:
    """Return what was found in a mechanism: legs with types, frames, mobility, diagnostics."""
    kinds = [leg.kind for leg in mechanism.legs]
    return {
        "name": mechanism.name,
        "spatial": mechanism.spatial,
        "mobility": mechanism.mobility,
        "motors": len(mechanism.motors),
        "n": mechanism.n_legs,
        "n_d": len(mechanism.frame_legs),
        "r": sum(leg.base_joint == "R" for leg in mechanism.legs),
        "n_ac": len(kinds) - kinds.count(LegKind.PASSIVE),
        "idle_spins": sum(chain.idle_spins for chain in mechanism.leg_chains),
        "legs": [_leg(leg) for leg in mechanism.legs],
        "diagnostics": list(mechanism.diagnostics),
    }


def _leg(leg: Leg) -> dict[str, Any]:
    """Return one leg of the document."""
    return {
        "name": leg.name,
        "type": leg.type,
        "actuated": leg.kind.value == "actuated",
        "kind": leg.kind.value,
        "A": [float(x) for x in leg.A],
        "B": [float(x) for x in leg.B],
        "q0": float(leg.q0),
        "sign": leg.sign,
        "base_axis": None if leg.base_axis is None else [float(x) for x in leg.base_axis],
        "platform_axis": (
            None if leg.platform_axis is None else [float(x) for x in leg.platform_axis]
        ),
        "twist": leg.twist,
        "cylinders": [{"link": c.link, "radius": c.radius} for c in leg.cylinders],
    }
