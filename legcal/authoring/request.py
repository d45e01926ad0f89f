"""What a person asks for: a table, or a family with its dimensions."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from legcal.authoring.families import Family, describe_family
from legcal.authoring.machine import Description
from legcal.authoring.table import read_table
from legcal.errors import UsageError


def described(
    table: Path | None,
    *,
    family: str | None,
    unit: str | None,
    name: str | None,
    dimensions: Mapping[str, Any],
) -> Description:
    """Return the machine that a table or a family describes.

    Parameters
    ----------
    table : Path or None
        A YAML or CSV file.
    family : str or None
        Number and type of the legs, instead of a table.
    unit : {"m", "mm"} or None
        The unit of all lengths; a table may state it itself.
    name : str or None
        The name of the model, instead of the default one.
    dimensions : mapping
        Attributes of :class:`legcal.authoring.families.Family`; None where nothing was said.

    Raises
    ------
    UsageError
        If not exactly one of table and family is given, or dimensions come with a table.
    ModelError
        With all problems of the table.
    """
    told = {key: value for key, value in dimensions.items() if value is not None}
    if (table is None) == (family is None):
        found = "neither" if table is None else "both"
        raise UsageError(
            f"The model could not be written: found {found} of a table and --family, needed one; "
            "give a YAML or CSV table, or --family 6-UPS with its dimensions."
        )
    if unit not in (None, "m", "mm"):
        raise UsageError(
            f"The unit could not be used: found '{unit}', needed mm or m; correct --unit."
        )
    if table is None:
        return describe_family(Family(family=str(family), unit=unit, name=name, **told))
    if told:
        options = ", ".join(f"--{key.replace('_', '-')}" for key in told)
        raise UsageError(
            f"The model could not be written: found {options} beside a table, needed them with "
            "--family only; write them in the table."
        )
    return read_table(table, unit, name)
