"""Quantities with their units."""

import pytest

from legcal.errors import UsageError
from legcal.files.quantity import ANGLE, LENGTH, PIXELS, parse_quantity


@pytest.mark.parametrize(
    ("text", "units", "value"),
    [
        ("2mm", LENGTH, 2e-3),
        ("2 um", LENGTH, 2e-6),
        ("1e-3m", LENGTH, 1e-3),
        (".5cm", LENGTH, 5e-3),
        ("180deg", ANGLE, 3.141592653589793),
        ("2mrad", ANGLE, 2e-3),
        ("0.1px", PIXELS, 0.1),
        ("0", LENGTH, 0.0),
    ],
)
def test_quantities_are_in_si(text: str, units: dict[str, float], value: float) -> None:
    assert parse_quantity(text, units, "--x") == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("text", ["2", "2deg", "mm", "", "2 mm mm", "nan mm", "inf", "1e999m"])
def test_a_number_without_its_unit_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"--x could not be used.*number and its unit.*0\.5mm"):
        parse_quantity(text, LENGTH, "--x")


def test_a_negative_quantity_is_refused() -> None:
    with pytest.raises(UsageError, match="negative '-2mm', needed zero or more"):
        parse_quantity("-2mm", LENGTH, "--x")
