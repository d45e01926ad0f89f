"""The true machines of the studies of outlines: shipped models, and one that is made of them."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.errors import UsageError
from legcal.mechanism.load import load_mechanism
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import geometries
from legcal.simulation.truth import write_model_with
from legcal.studies.truths import RAISED

COPLANAR, NONCOPLANAR = "6-spu-coplanar", "6-spu-noncoplanar"
MACHINES = (NONCOPLANAR, COPLANAR, "3-upu-tilted", "3-rpr")
SHIPPED = (
    "hexapod",
    "nategh-agheli",
    "6-sps",
    "hexapod-rod",
    "hexapod-strut",
    "3-rps",
    "3-spr",
    "3-upu",
    "3-upu-tilted",
    "tricept",
    "3-rpr",
)
_SIX_LEGS = (NONCOPLANAR, COPLANAR, *SHIPPED[:5])
MOST_LEGS = dict.fromkeys(_SIX_LEGS, 4)  # that a view is said to see, as in the paper


def true_mechanism(name: str) -> Mechanism:
    """Return a true machine of the studies.

    Parameters
    ----------
    name : str
        One of ``MACHINES``, or a shipped model.
    """
    if name not in (COPLANAR, NONCOPLANAR):
        return load_mechanism(name)
    flat = load_mechanism("hexapod")
    if name == COPLANAR:
        return flat
    up = np.array([0.0, 0.0, RAISED])
    legs = tuple(
        replace(leg, A=leg.A + up, B=leg.B - up) if j % 2 else leg
        for j, leg in enumerate(geometries(flat))
    )
    with tempfile.TemporaryDirectory(prefix="legcal-study-") as folder:
        return load_mechanism(write_model_with(flat, legs, flat.home, Path(folder), {}))


def check_machines(names: tuple[str, ...], known: tuple[str, ...]) -> None:
    """Refuse machines that a study does not have, and those that are named twice.

    Raises
    ------
    UsageError
    """
    if not names or len(set(names)) < len(names) or not set(names) <= set(known):
        raise UsageError(
            f"The study could not be run: found the machines {', '.join(names) or 'none'}, needed "
            f"some of {', '.join(known)}, each once; choose them."
        )
