"""What ``legcal inspect`` and ``legcal evaluate`` say and draw of machines, hostile names too."""

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run
from csv_rows import read_rows, write_rows
from edits import keyed
from hexapod_example import ROOT
from machines import created_hexapod, regular
from rich.console import Console
from scipy.spatial.transform import Rotation
from simulated import simulated

from legcal import evaluate, load_mechanism
from legcal.calibration.evaluation import Evaluation
from legcal.descriptions.new_model import create_model
from legcal.errors import DidNotConverge
from legcal.machine.inspection import machine_document
from legcal.machine.model import readings_at
from legcal.machine.model_writer import write_calibrated_yaml, write_urdf
from legcal.machine.parameters import geometries
from legcal.machine.picture import draw_machine
from legcal.report.machine import inspect_table


def test_counts_of_the_paper_follow_from_legs_and_motors() -> None:
    expected = {  # n, n_d, r, n_ac, idle spins
        "hexapod": (6, 3, 0, 6, 0),
        "hexapod-strut": (7, 3, 0, 6, 1),
        "6-sps": (6, 3, 0, 6, 6),
        "3-rpr": (3, 2, 3, 3, 0),
    }
    for name, counts in expected.items():
        document = machine_document(load_mechanism(name))
        assert tuple(document[key] for key in ("n", "n_d", "r", "n_ac", "idle_spins")) == counts


@pytest.mark.parametrize(
    ("legs", "found", "notes"),
    [
        ("4-RPR", "more than it needs", ["more motors than the pose needs: mobility 3"]),
        ("8-SPS", "NOT determined", ["motors 8, which hold only 5", "is singular at home"]),
        ("3-SPS", "NOT determined", ["do not determine the pose: mobility 6"]),
    ],
)
def test_motors_that_are_too_many_or_hold_nothing_are_noted(
    legs: str, found: str, notes: list[str], tmp_path: Path
) -> None:
    description = machine_document(create_model(regular(legs), tmp_path).machine)
    console = Console(file=io.StringIO(), width=80, highlight=False)
    console.print(inspect_table(description))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert found in text
    assert max(len(line) for line in text.splitlines()) <= 80
    said = [note for note in description["diagnostics"] if "motors" in note or "cannot" in note]
    assert len(said) == len(notes)
    assert all(note in text for note, text in zip(notes, said, strict=True))


def test_the_mobility_is_that_of_other_poses_where_home_is_singular(tmp_path: Path) -> None:
    """Legs of a 3-UPU that are parallel leave the platform two turns more, at home alone."""
    machine = create_model(regular("3-UPU", platform_radius=300.0), tmp_path).machine
    assert machine.mobility == 3
    assert any("is singular at home" in note for note in machine.diagnostics)


def test_readings_that_one_model_does_not_reach_are_left_out_and_named(tmp_path: Path) -> None:
    made = simulated(tmp_path / "set", "3-rpr", poses=6, shared_poses=True)
    truth = load_mechanism(made.truth_path)
    leg, *others = geometries(truth)  # of a machine that is near a singularity at home
    write_urdf(truth, [replace(leg, q0=leg.q0 - 0.05), *others], tmp_path / "other.urdf")
    other = tmp_path / "other.yaml"
    write_calibrated_yaml(truth, other, "other.urdf")

    (made.folder / "observations.csv").unlink()
    table = made.folder / "measurements.csv"
    rows = read_rows(table)
    for k, row in enumerate(rows):
        row["image"] = f"{k}.png"

    def compared(kept: list[int], *models: Path) -> Evaluation:
        write_rows(table, [rows[k] for k in kept])
        return evaluate(*models, dataset=made.folder)

    everything = list(range(len(rows)))
    found = compared(everything, other, made.truth_path)
    document = found.document()
    n, off = document["left_out"], [row - 1 for row in document["unreached"]]
    assert 0 < n < 6
    assert len(off) == 2 * n  # both views show every pose
    assert len(found.displacement) == document["poses"] == 6 - n
    rest = compared([k for k in everything if k not in off], other, made.truth_path)
    assert rest.document()["left_out"] == 0
    np.testing.assert_allclose(rest.displacement, found.displacement, atol=1e-9)
    with pytest.raises(DidNotConverge, match="no row whose readings both reach") as refusal:
        compared(off, other, made.truth_path)
    assert refusal.value.exit_code == 1


def test_a_singular_home_comes_with_the_motion_that_is_free_and_the_nearest_good_home(
    tmp_path: Path,
) -> None:
    """A hexapod whose platform is turned by 90 degrees can turn with all motors locked."""
    made = created_hexapod(tmp_path).machine
    model, folder = made.yaml_path.name, made.yaml_path.parent
    turned = made.home.rotation * Rotation.from_euler("z", 90, degrees=True)
    keyed(model, legcal__home__quat_xyzw=turned.as_quat().tolist())(folder)
    machine = load_mechanism(made.yaml_path)
    (note,) = [note for note in machine.diagnostics if "is singular at home" in note]
    assert "can turn about (0, 0, 1) and move along (0, 0, 1) of the base there" in note
    found = re.search(r"xyz: \[(.*?)\], quat_xyzw: \[(.*?)\]", note)
    assert found is not None
    xyz, quat = ([float(x) for x in group.split(",")] for group in found.groups())
    keyed(model, legcal__home={"xyz": xyz, "quat_xyzw": quat})(folder)
    assert not any("singular" in note for note in load_mechanism(made.yaml_path).diagnostics)


def test_inspect_tells_travel_home_and_lengths_and_draws_the_machine(tmp_path: Path) -> None:
    svg = tmp_path / "machine.svg"
    created = created_hexapod(tmp_path)
    model, urdf = created.yaml_path, created.machine.urdf_path
    urdf.write_text(re.sub(r'radius="[^"]*"', 'radius="0.0123456"', urdf.read_text()))
    outcome = run("inspect", model, "--picture", svg)
    assert outcome.code == 0
    machine = load_mechanism(model)
    q = 1e3 * readings_at(machine, machine.home)[1]
    assert f"leg2 0.00 to 170.00 250.00 to 420.00 {q:.2f} {q + 250.0:.2f}" in outcome.said
    assert "platform at (0.00, 0.00, 300.00) mm in the base" in outcome.said
    assert "12.35" in outcome.said
    assert svg.read_bytes() == draw_machine(machine).markup().encode()
    assert run("inspect", model, "--picture", svg).code == 0
    svg.write_text("mine")
    for place, word in ((svg, "another file"), (tmp_path / "machine.png", ".svg")):
        outcome = run("inspect", model, "--picture", place)
        assert outcome.code == 2
        assert word in outcome.err
    assert svg.read_text() == "mine"


def test_hostile_names_do_nothing_in_a_terminal(tmp_path: Path) -> None:
    """Escape sequences, changes of direction and markup in names of files and links."""
    odd = "\x1b]0;me\x07[red]\u202e"
    urdf = (ROOT / "urdf/3-rpr.urdf").read_text()
    folder = tmp_path / odd
    folder.mkdir()
    (folder / f"{odd}.urdf").write_text(urdf.replace('"platform"', '"plat[red]form"'))
    entry = yaml.safe_load((ROOT / "models/3-rpr.yaml").read_text())
    entry["legcal"] |= {"urdf": f"{odd}.urdf", "platform": "plat[red]form"}
    model = folder / f"{odd}.yaml"
    model.write_text(yaml.safe_dump(entry))
    for words in (
        ("inspect", model, "--picture", folder / f"{odd}.svg", "--write", folder / "copy"),
        ("evaluate", model, model),
        ("inspect", folder / "none"),
        ("new", "--template", "-o", folder, "--name", "mine"),
        ("new", "--family", "delta", "-o", folder),
    ):  # fmt: skip
        outcome = run(*words)
        assert not {"\x1b", "\x07", "\u202e"} & set(outcome.out + outcome.err), words
        assert outcome.code == (2 if "none" in str(words[1]) else 0), outcome.err
    drawn = (folder / f"{odd}.svg").read_text()
    assert not {"\x1b", "\u202e"} & set(drawn)
