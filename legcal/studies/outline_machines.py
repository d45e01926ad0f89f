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
_SHIPPED = {COPLANAR: "hexapod", "3-upu-tilted": "3-upu-tilted", "3-rpr": "3-rpr"}
MACHINES = (NONCOPLANAR, COPLANAR, "3-upu-tilted", "3-rpr")
MOST_LEGS = {NONCOPLANAR: 4, COPLANAR: 4}  # that a view is said to see, as in the paper


def true_mechanism(name: str) -> Mechanism:
    """Return a true machine of the studies.

    Parameters
    ----------
    name : str
        One of ``MACHINES``.
    """
    if name != NONCOPLANAR:
        return load_mechanism(_SHIPPED[name])
    flat = load_mechanism(_SHIPPED[COPLANAR])
    up = np.array([0.0, 0.0, RAISED])
    legs = tuple(
        replace(leg, A=leg.A + up, B=leg.B - up) if j % 2 else leg
        for j, leg in enumerate(geometries(flat))
    )
    with tempfile.TemporaryDirectory(prefix="legcal-study-") as folder:
        return load_mechanism(write_model_with(flat, legs, flat.home, Path(folder), {}))


def check_machines(names: tuple[str, ...]) -> None:
    """Refuse machines that the studies do not have, and those that are named twice.

    Raises
    ------
    UsageError
    """
    if not names or len(set(names)) < len(names) or not set(names) <= set(MACHINES):
        raise UsageError(
            f"The study could not be run: found the machines {', '.join(names) or 'none'}, needed "
            f"some of {', '.join(MACHINES)}, each once; choose them."
        )
