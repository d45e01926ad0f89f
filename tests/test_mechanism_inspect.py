"""What ``legcal inspect`` prints."""

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from mechanisms import Layout, write_hexapod
from rich.console import Console

from legcal.machine import describe, load_mechanism
from legcal.machine.family import Family, describe_family
from legcal.machine.model_builder import create_model
from legcal.report import inspect_table


def _table(description: dict[str, object]) -> str:
    console = Console(file=io.StringIO(), width=80, highlight=False)
    console.print(inspect_table(description))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(text, str)
    return text


def test_the_document_has_every_key_of_the_contract() -> None:
    document = json.loads(json.dumps(describe(load_mechanism("hexapod")), allow_nan=False))
    assert list(document) == [
        "name", "spatial", "mobility", "motors", "n", "n_d", "r", "n_ac", "idle_spins", "legs",
        "diagnostics",
    ]  # fmt: skip
    assert [document[key] for key in ("n", "r", "n_ac", "idle_spins")] == [6, 0, 6, 0]
    assert document["name"] == "hexapod"
    assert document["spatial"] is True
    assert (document["mobility"], document["motors"], document["n_d"]) == (6, 6, 3)
    assert [leg["name"] for leg in document["legs"]] == [f"leg{j}" for j in range(1, 7)]
    leg = document["legs"][0]
    assert list(leg) == [
        "name", "type", "actuated", "kind", "A", "B", "q0", "sign", "base_axis", "platform_axis",
        "twist", "cylinders",
    ]  # fmt: skip
    assert (leg["type"], leg["actuated"], leg["kind"]) == ("SPU", True, "actuated")
    assert (leg["base_axis"], leg["platform_axis"], leg["sign"]) == (None, None, 1)
    assert {c["radius"] for c in leg["cylinders"]} == {0.01}
    assert {c["link"] for c in leg["cylinders"]} == {"leg1_b2_link", "leg1_tube"}


def test_the_table_fits_80_columns_and_shows_millimetres() -> None:
    text = _table(describe(load_mechanism("hexapod")))
    assert max(len(line) for line in text.splitlines()) <= 80
    assert "A in base [mm]" in text
    assert "mobility 6, 6 motors" in text
    row = next(line for line in text.splitlines() if line.startswith("leg5"))
    numbers = ["0.0", "270.0", "0.0", "0.0", "195.0", "0.0", "345.000"]
    assert row.split() == ["leg5", "SPU", *numbers, "+", "q", "10"]


def test_the_table_shows_signs_kinds_and_notes(tmp_path: Path) -> None:
    path = write_hexapod(tmp_path, Layout(first="S", sign=-1))
    path.write_text(path.read_text().replace("- leg2_prismatic\n", "", 1))
    text = _table(describe(load_mechanism(path)))
    assert "passive" in text
    assert "344.217 - q" in text
    assert "note: the motors do not determine the pose" in text
    assert max(len(line) for line in text.splitlines()) <= 80


@pytest.mark.parametrize(
    ("family", "found", "notes"),
    [
        ("4-RPR", "more than it needs", ["more motors than the pose needs: mobility 3"]),
        ("8-SPS", "more than it needs", ["mobility 6, motors 8", "is singular at home"]),
        ("3-SPS", "NOT determined", ["do not determine the pose: mobility 6"]),
        ("6-SS", "it cannot move", ["the platform cannot move: mobility 0"]),
    ],
)
def test_motors_that_are_too_many_or_hold_nothing_are_noted(
    family: str, found: str, notes: list[str], tmp_path: Path
) -> None:
    planar = family.endswith("RPR")
    asked = Family(
        family, "mm", base_radius=300, platform_radius=150, height=None if planar else 400
    )
    description = describe(create_model(describe_family(asked), tmp_path).machine)
    assert found in _table(description)
    told = [note for note in description["diagnostics"] if "motors" in note or "cannot" in note]
    assert len(told) == len(notes)
    assert all(note in text for note, text in zip(notes, told, strict=True))


@pytest.mark.parametrize(
    ("hidden", "note"),
    [
        ("1", "leg 'leg1' has no <visual> cylinder along its axis: it cannot be seen"),
        ("[1-3]", "legs leg1, leg2, leg3 have no <visual> cylinder along their axes: they cannot"),
    ],
)
def test_legs_that_cannot_be_seen_are_told_in_one_note(
    tmp_path: Path, hidden: str, note: str
) -> None:
    asked = Family("3-RPS", "mm", 300.0, 150.0, 400.0)
    machine = create_model(describe_family(asked), tmp_path).machine
    text = machine.urdf_path.read_text()
    text = re.sub(rf'(<link name="leg{hidden}_\w+">)<visual>.*</visual>', r"\1", text)
    machine.urdf_path.write_text(text)
    (found,) = describe(load_mechanism(machine.yaml_path))["diagnostics"]
    assert found.startswith(note)


def test_the_table_shows_axes_and_twists_where_they_are_parameters() -> None:
    machine = load_mechanism("3-upu-tilted")
    document = json.loads(json.dumps(describe(machine), allow_nan=False))
    assert (document["r"], document["n_ac"], document["idle_spins"]) == (0, 3, 0)
    assert document["legs"][0]["twist"] == machine.legs[0].twist
    text = _table(document)
    assert max(len(line) for line in text.splitlines()) <= 80
    assert "axis at base" in text
    assert f"{np.degrees(machine.legs[1].twist or 0.0):.3f}" in text
    assert "axis at base" not in _table(describe(load_mechanism("3-rpr")))
    assert describe(load_mechanism("3-rps"))["r"] == 3
    assert describe(load_mechanism("hexapod-strut"))["idle_spins"] == 1
    assert describe(load_mechanism("hexapod-strut"))["n_ac"] == 6
