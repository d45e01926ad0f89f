"""Calibrated models of every class: written, loaded again, the same numbers, and closed."""

import re
from pathlib import Path

import numpy as np
import pytest

from legcal.errors import ModelError
from legcal.machine import (
    Leg,
    Machine,
    geometries,
    home_of_legs,
    load_mechanism,
    moved_legs,
    parametrization_of,
    vector_of,
    with_platform_foot,
)
from legcal.machine.model_writer import reload_and_check, write_calibrated_yaml, write_urdf


def _other_legs(nominal: Machine, size: float) -> tuple[Leg, ...]:
    """Return legs whose every parameter is wrong by so much [m, and ten times that in rad]."""
    parametrization = parametrization_of(nominal, twists=True)
    unit = np.where([unit == "m" for unit in parametrization.units], size, 10.0 * size)
    signs = np.random.default_rng(2).choice([-1.0, 1.0], len(unit))
    legs = moved_legs(geometries(nominal), parametrization.place, unit * signs)
    return with_platform_foot(legs, np.asarray(nominal.T_platform_Re.inv().translation))


@pytest.mark.parametrize("name", ["3-rpr", "3-rps", "3-upu-tilted", "hexapod-rod", "tricept"])
def test_a_model_with_other_axes_and_rods_gets_the_home_where_it_closes(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    legs = _other_legs(nominal, 3e-3)
    home = home_of_legs(nominal, legs, 0.2)
    assert home is not None
    write_urdf(nominal, legs, tmp_path / "calibrated.urdf")
    write_calibrated_yaml(nominal, tmp_path / "calibrated.yaml", "calibrated.urdf", home)
    written = reload_and_check(tmp_path / "calibrated.yaml")
    away = written.home.inv() * home
    assert float(np.abs(away.translation).max()) < 1e-9
    found = geometries(written)
    parametrization = parametrization_of(nominal, twists=True)
    here = vector_of(parametrization, found, legs)
    np.testing.assert_allclose(here, vector_of(parametrization, legs, legs), atol=1e-11)


def test_only_the_numbers_of_home_change_in_the_yaml(tmp_path: Path) -> None:
    nominal = load_mechanism("3-rps")
    legs = _other_legs(nominal, 3e-3)
    write_urdf(nominal, legs, tmp_path / "calibrated.urdf")
    write_calibrated_yaml(nominal, tmp_path / "calibrated.yaml", "calibrated.urdf")
    without = (tmp_path / "calibrated.yaml").read_text()
    with pytest.raises(ModelError, match=r"legcal\.home could not be used"):
        load_mechanism(tmp_path / "calibrated.yaml")
    home = home_of_legs(nominal, legs, 0.2)
    write_calibrated_yaml(nominal, tmp_path / "calibrated.yaml", "calibrated.urdf", home)
    text = (tmp_path / "calibrated.yaml").read_text()
    number = r"-?\d[\d.e-]*"
    assert re.sub(number, "#", text) == re.sub(number, "#", without)
    differing = sum(a != b for a, b in zip(text.split(), without.split(), strict=True))
    assert 3 <= differing <= 7
