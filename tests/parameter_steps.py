"""Legs with other parameters, and the models that are written of them, for tests."""

from pathlib import Path

import numpy as np

from legcal.geometry.types import Array
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.model_writer import write_calibrated_yaml, write_urdf
from legcal.machine.parameters import Parametrization, geometries, moved_legs, reframed


def random_covariance(
    parametrization: Parametrization, rng: np.random.Generator, rank: int, sigma: float
) -> Array:
    """Return the root (p, rank) of a covariance, parameters known to about sigma [m, rad]."""
    return np.asarray(sigma * rng.normal(size=(len(parametrization), rank)) / np.sqrt(rank))


def written_with(
    nominal: Machine, parametrization: Parametrization, step: Array, folder: Path
) -> Machine:
    """Return a mechanism with changed parameters, as loaded from the files written of it."""
    folder.mkdir(exist_ok=True)
    origin = np.asarray(nominal.T_platform_Re.inv().translation)
    legs = reframed(
        moved_legs(geometries(nominal), parametrization.place, step), nominal.frame_legs, origin
    )
    write_urdf(nominal, legs, folder / "other.urdf")
    write_calibrated_yaml(nominal, folder / "other.yaml", "other.urdf")
    return load_mechanism(folder / "other.yaml")
