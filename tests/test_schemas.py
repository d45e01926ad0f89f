"""JSON Schemas take what legcal reads and writes, and refuse simple faults as it does."""

import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from command_line import run
from format_schemas import FILES, FOLDER, ROOT
from hexapod_example import Run
from simulated import simulated

from legcal.cli.app import commands
from legcal.data.dataset_file import read_dataset_file
from legcal.descriptions.table import read_description
from legcal.errors import LegcalError
from legcal.files.folder import schema_names
from legcal.files.schema import read_yaml
from legcal.machine.files import read_mechanism_file
from legcal.vision.camera_file import read_camera

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema (extra test) is not installed")

SHIPPED = [
    path
    for folder in ("examples", "models", "tests/data")
    for path in sorted((ROOT / folder).rglob("*.yaml"))
]
HEADER = re.compile(r"# yaml-language-server: \$schema=(\.schemas/([\w-]+)\.json)\n")


@cache
def _validator(name: str) -> Any:
    schema = json.loads((FOLDER / f"{name}.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def _check(name: str, document: object) -> None:
    problems = [error.message for error in _validator(name).iter_errors(document)]
    assert problems == [], name


def _named(path: Path) -> str:
    """Return the schema that the header of a YAML names, which is beside it as it is shipped."""
    header = HEADER.match(path.read_text(encoding="utf-8"))
    assert header is not None, path
    beside = path.parent / header[1]
    assert beside.read_bytes() == (FOLDER / f"{header[2]}.json").read_bytes()
    return header[2]


def test_every_shipped_file_fits_the_schema_that_it_names() -> None:
    assert len(SHIPPED) > 20
    for path in SHIPPED:
        found = read_yaml(path, "file")
        known = {"legcal_dataset": "dataset", "legcal_table": "table", "camera_matrix": "camera"}
        name = next((kind for key, kind in known.items() if key in found), "mechanism")
        _check(name, found)
        if not path.is_relative_to(ROOT / "tests"):
            assert _named(path) == name


def test_what_is_written_names_a_schema_beside_it_that_it_fits(
    example_run: Run, tmp_path: Path
) -> None:
    simulated(tmp_path / "set", "3-rpr", views=3, poses=6)
    assert run("new", "--template", "-o", tmp_path).code == 0
    assert run("new", tmp_path / "my-hexapod.yaml", "-o", tmp_path).code == 0
    assert run("inspect", "3-rps", "--write", tmp_path).code == 0
    written = [path for path in tmp_path.rglob("*.yaml") if "truth" not in path.parts]
    written += sorted(example_run.output.glob("*.yaml"))
    assert len(written) >= 7
    kinds = set()
    for path in written:
        kinds.add(_named(path))
        _check(_named(path), yaml.safe_load(path.read_bytes()))
    assert kinds == set(FILES)


def test_printed_documents_fit_their_schemas(example_run: Run) -> None:
    """Those of other commands are held against theirs in ``command_line.py``."""
    _check("result", json.loads((example_run.output / "result.json").read_text()))
    document = run("evaluate", "hexapod", "hexapod", "--json").document
    _check("evaluate", document)
    assert not _validator("evaluate").is_valid({**document, "poses": "many"})
    _check("error", run("export", "hexapod", "--to", "gcode", "-o", "x", "--json").document)


def test_every_command_that_prints_a_document_has_a_schema() -> None:
    own = {"calibrate": "result", "camera": "camera-calibration", "detect": "doctor"}
    every = typer.main.get_command(commands()).commands  # type: ignore[attr-defined]
    parameters = {name: {p.name for p in found.params} for name, found in every.items()}
    printing = {name for name, found in parameters.items() if "as_json" in found} | {"study"}
    assert len(printing) > 15
    assert {own.get(name, name) for name in printing} <= set(schema_names())


def _faulty(document: Mapping[str, Any], keys: str, value: object) -> dict[str, Any]:
    """Return a document with another value at a place; None removes the key."""
    found: dict[str, Any] = json.loads(json.dumps(document))
    *above, last = keys.split(".")
    here: Any = found
    for key in above:
        here = here.setdefault(key, {}) if isinstance(here, dict) else here[int(key)]
    if value is None:
        del here[last]
    else:
        here[last] = value
    return found


EXAMPLE = ROOT / "examples/hexapod"
READERS: Mapping[str, tuple[Path, Any]] = {
    "dataset": (EXAMPLE / "dataset.yaml", read_dataset_file),
    "mechanism": (EXAMPLE / "models/hexapod.yaml", read_mechanism_file),
    "table": (ROOT / "models/tables/hexapod.yaml", read_description),
    "camera": (EXAMPLE / "camera_info.yaml", read_camera),
}


@pytest.mark.parametrize(
    ("name", "keys", "value"),
    [
        ("dataset", "views", None),
        ("dataset", "legcal_dataset", 2),
        ("dataset", "encoder_sigma", "2 um"),
        ("dataset", "views.c1.gama", 2.2),
        ("dataset", "views.c1.legs", "leg1"),
        ("dataset", "parameters.priors", {"leg1.length": [0.42, 0.0]}),
        ("mechanism", "closed_loop", [["a", "b", "c"]]),
        ("mechanism", "legcal.platfrom", "platform"),
        ("mechanism", "legcal.home.xyz", [0.0, 0.0]),
        ("table", "base_joints", [[1.0]]),
        ("table", "unit", "inch"),
        ("table", "radius", {"tube": -1.0}),
        ("table", "travel", [0.0, 1.0, 2.0]),
        ("camera", "image_width", 0),
        ("camera", "camera_matrix.data", "K"),
    ],
)
def test_simple_faults_are_refused_by_schema_and_by_reading(
    name: str, keys: str, value: object, tmp_path: Path
) -> None:
    path, read = READERS[name]
    right = read_yaml(path, "file")
    _check(name, right)
    wrong = _faulty(right, keys, value)
    assert not _validator(name).is_valid(wrong)
    place = tmp_path / path.name
    place.write_text(yaml.safe_dump(wrong), encoding="utf-8")
    with pytest.raises(LegcalError, match=re.escape(keys.split(".")[0])):
        read(place)
