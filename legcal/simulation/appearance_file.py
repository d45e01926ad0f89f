"""The file that says how simulated photographs look: the fields of an appearance, in YAML.

Fields that it does not name keep their defaults::

    blur: 0.8
    clutter: 30
    electrons: .inf
    lights:
      - {direction: [0.5, -0.8, 1.1], strength: 0.9}
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from dataclasses import Field as DataclassField
from functools import cache
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from pydantic import Field, create_model

from legcal.files.schema import FileSchema, parse_yaml, read_text, validate
from legcal.simulation.rendering.appearance import Appearance, Light


def read_appearance(path: Path) -> Appearance:
    """Return the appearance that a file describes.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    DatasetError
        With one sentence for each value that cannot be read.
    UsageError
        If a number makes no sense.
    """
    found = parse_yaml(read_text(path, "appearance file"), path, "appearance file")
    entry = validate(_schema(), found, path)
    values = {name: getattr(entry, name) for name in entry.model_fields_set}
    if "lights" in values:
        values["lights"] = tuple(Light(**light.model_dump()) for light in values["lights"])
    return Appearance(**values)


@cache
def _schema() -> type[FileSchema]:
    """Return the schema of the file."""
    light = _schema_of(Light, {})
    electrons = Annotated[float, Field(allow_inf_nan=True)]  # .inf: no noise
    other_types = {"lights": tuple[light, ...], "electrons": electrons}  # type: ignore[valid-type]
    return _schema_of(Appearance, other_types)


def _schema_of(described: type[Any], other_types: dict[str, Any]) -> type[FileSchema]:
    """Return the schema of a dataclass."""
    types = get_type_hints(described) | other_types
    columns: dict[str, Any] = {f.name: (types[f.name], _default(f)) for f in fields(described)}
    return create_model(described.__name__, __base__=FileSchema, **columns)


def _default(field: DataclassField[Any]) -> Any:
    """Return the default of a field, or that it must be given."""
    return ... if field.default is MISSING else field.default
