"""JSON Schemas of the formats, shipped with the package, and the headers that name them.

The files in ``schemas`` are made from the models that read and write the formats, by
``tests/format_schemas.py``. A YAML that legcal writes names its schema in its first line, relative
to itself, and the schema is written beside it: editors find it offline, wherever the folder goes.
"""

import re
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

SCHEMAS = ".schemas"  # folder of schemas beside a YAML
_HEADER = "# yaml-language-server: $schema={}/{}.json\n"
_NAMED = re.compile(re.escape(_HEADER).replace(r"\{\}", r"([\w.-]+)").encode())


def schema_names() -> list[str]:
    """Return the names of the formats that have a schema."""
    file_names = (entry.name for entry in files("legcal.files").joinpath("schemas").iterdir())
    return sorted(name.removesuffix(".json") for name in file_names)


def schema_content(name: str) -> bytes:
    """Return the content of the schema file of a format."""
    return files("legcal.files").joinpath("schemas", f"{name}.json").read_bytes()


def with_schema(name: str, text: str) -> str:
    """Return the text of a YAML with a header that names its schema."""
    return _HEADER.format(SCHEMAS, name) + text


def schemas_beside(path: Path, content: bytes) -> dict[Path, bytes]:
    """Return the schema that a YAML names, by its place beside *path*; none if it names none."""
    named = _NAMED.match(content) if path.suffix == ".yaml" else None
    if named is None or named[1].decode() != SCHEMAS or named[2].decode() not in schema_names():
        return {}
    name = named[2].decode()
    return {path.parent / SCHEMAS / f"{name}.json": schema_content(name)}


def write_schemas(path: Path) -> None:
    """Write the schema that a YAML names beside it, or nothing where there is no place for it."""
    with suppress(OSError):  # it only helps editors
        with path.open("rb") as file:
            named = schemas_beside(path, file.readline())
        for place, content in named.items():
            if not place.is_symlink() and not place.parent.is_symlink():
                place.parent.mkdir(exist_ok=True)
                place.write_bytes(content)
