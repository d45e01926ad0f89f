"""The true machine: the nominal model with drawn errors, written as a model of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from legcal.mechanism.model import Mechanism
from legcal.simulation.errors import ParameterErrors


def write_true_model(
    nominal: Mechanism, errors: ParameterErrors, rng: np.random.Generator, folder: Path
) -> Mechanism:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a machine with errors, and load it.

    Parameters
    ----------
    nominal : Mechanism
        The nominal model.
    errors : ParameterErrors
        How large the errors are.
    rng : numpy.random.Generator
        Source of the errors.
    folder : Path
        The folder that gets ``models`` and ``urdf``.

    Returns
    -------
    Mechanism
        The true machine, as loaded from these files.

    Raises
    ------
    ModelError
        If no machine with such errors closes.
    """
    raise NotImplementedError
