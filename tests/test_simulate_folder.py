"""The folder of a simulated dataset: what ``--force`` replaces, and what it never touches."""

import io
import json
import textwrap
from pathlib import Path
from typing import Any

import pytest
from outline_tables import LEG_NAMES, outlines_of, recorded
from rich.console import Console
from simulated import files_of, settings, small_camera

import legcal
from legcal.data.outlines import format_observations
from legcal.errors import OutOfResources, UsageError
from legcal.report import simulation_table
from legcal.simulation.dataset import simulate, summary_document
from legcal.simulation.folder import TRUTH_NAME, check_dataset_destination, dataset_folder

FEW = settings(poses=1, views=1)
OWN = ("dataset.yaml", "images/c1_p01.png", "models/a.yaml", "truth/models/a.yaml")
DETECTED = format_observations(outlines_of(1), recorded(), LEG_NAMES)
EDITED = DETECTED.replace("detected", "edited", 1)


def write(folder: Path, files: dict[str, str]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)


def fill(folder: Path, content: str = "new", more: tuple[str, ...] = ()) -> None:
    write(folder, dict.fromkeys((*OWN, *more), content))
    truth = {"legcal_truth": 1, "files": [*OWN, *more, TRUTH_NAME]}
    (folder / TRUTH_NAME).write_text(json.dumps(truth))


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """An earlier simulated dataset."""
    out = tmp_path / "out"
    fill(out, "old")
    return out


def replace(out: Path) -> None:
    with dataset_folder(out, force=True) as folder:
        fill(folder)


def test_the_files_of_an_earlier_dataset_are_replaced(out: Path) -> None:
    write(out, {"notes.txt": "mine", "result/result.json": "mine", "images/.hidden": "mine"})
    replace(out)
    found = files_of(out)
    assert {found[name] for name in OWN} == {b"new"}
    assert found["notes.txt"] == found["result/result.json"] == found["images/.hidden"] == b"mine"


@pytest.mark.parametrize(
    "name",
    [
        "images/c2_p01.png",
        "images/mine/a.png",
        "axes.csv",
        "observations.csv",
        "camera_info_c2.yaml",
        "measurements.csv",
        "models/b.yaml",
        "truth/notes.txt",
        "urdf",
    ],
)
def test_a_file_of_the_user_where_a_dataset_has_its_own_is_refused_first(
    name: str, out: Path
) -> None:
    write(out, {name: "mine"})
    before = files_of(out)
    with pytest.raises(UsageError, match="nothing was changed") as refusal:
        check_dataset_destination(out, force=True)
    assert name.removesuffix("/a.png") in str(refusal.value)
    assert files_of(out) == before


def test_the_photograph_that_somebody_put_into_a_set_of_outlines_stays(tmp_path: Path) -> None:
    simulate("hexapod", tmp_path, FEW)
    write(tmp_path, {"images/c1_p01.png": "mine"})
    with pytest.raises(UsageError, match=r"images/c1_p01\.png, which an earlier simulation did"):
        simulate("hexapod", tmp_path, FEW, force=True)
    assert (tmp_path / "images" / "c1_p01.png").read_text() == "mine"


@pytest.mark.parametrize("name", ["images", "truth/models", "dataset.yaml", "images/c1_p01.png"])
def test_nothing_is_written_through_links(name: str, out: Path, tmp_path: Path) -> None:
    (out / name).rename(tmp_path / "elsewhere")
    (out / name).symlink_to(tmp_path / "elsewhere")
    before = files_of(tmp_path)
    with pytest.raises(UsageError, match=f"found {name}, which is a link"):
        replace(out)
    assert files_of(tmp_path) == before


def test_a_folder_in_the_place_of_a_file_is_refused(out: Path) -> None:
    (out / "dataset.yaml").unlink()
    (out / "dataset.yaml").mkdir()
    with pytest.raises(UsageError, match=r"found dataset\.yaml, which is a folder"):
        replace(out)


def test_what_appears_while_a_dataset_is_made_is_not_replaced(out: Path) -> None:
    def late(name: str) -> None:
        with dataset_folder(out, force=True) as folder:
            fill(folder, more=("images/c2_p01.png",))
            write(out, {name: "mine"})

    with pytest.raises(UsageError, match=r"images/c2_p01\.png, which legcal did not write"):
        late("images/c2_p01.png")
    found = files_of(out)
    assert found.pop("images/c2_p01.png") == b"mine"
    assert {found[name] for name in OWN} == {b"old"}


def test_outlines_that_a_calibration_left_go(out: Path) -> None:
    write(out, {"observations.csv": DETECTED, ".legcal-cache.json": '{"given": []}'})
    replace(out)
    assert not {"observations.csv", ".legcal-cache.json"} & set(files_of(out))


@pytest.mark.parametrize(
    ("table", "cache"),
    [
        (EDITED, '{"given": []}'),
        (DETECTED, '{"given": [["c1", "images/c1_p01.png"]]}'),
        (DETECTED, "{"),
        (DETECTED, "[]"),
        ("view\n\0\xe9", '{"given": [1]}'),
    ],
)
def test_outlines_that_somebody_gave_or_corrected_stay(table: str, cache: str, out: Path) -> None:
    write(out, {"observations.csv": table, ".legcal-cache.json": cache})
    before = files_of(out)
    with pytest.raises(UsageError, match=r"observations\.csv, which an earlier simulation did not"):
        replace(out)
    assert files_of(out) == before


@pytest.mark.parametrize("named", ["notes.txt", "result/a.csv", "..", "", "images/../notes.txt"])
def test_a_truth_that_names_other_files_does_not_reach_them(named: str, out: Path) -> None:
    write(out, {"notes.txt": "mine", "result/a.csv": "mine"})
    truth = {"legcal_truth": 1, "files": [*OWN, TRUTH_NAME, named]}
    (out / TRUTH_NAME).write_text(json.dumps(truth))
    replace(out)
    found = files_of(out)
    assert found["notes.txt"] == found["result/a.csv"] == b"mine"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("n" * 300, "'File name too long', needed a path that can be created"),
        ("file/sub", "file is a file, needed a path that can be created"),
        ("file", "found a file of that name"),
    ],
)
def test_a_path_where_no_folder_can_be_is_refused(name: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UsageError, match=message):
        simulate("hexapod", tmp_path / name, FEW)
    assert files_of(tmp_path) == {"file": b"mine"}


def test_a_name_of_the_greatest_length_is_a_name(tmp_path: Path) -> None:
    with dataset_folder(tmp_path / ("ä" * 127), force=False) as folder:
        fill(folder)
    assert (tmp_path / ("ä" * 127) / "dataset.yaml").exists()


def test_what_cannot_be_written_names_the_folder_that_was_asked_for(tmp_path: Path) -> None:
    def full(out: Path) -> None:
        with dataset_folder(out, force=False) as folder:
            raise OutOfResources(f"{folder}: found 'No space left on device'.")

    with pytest.raises(OutOfResources, match=f"^{tmp_path}/out: found 'No space") as refusal:
        full(tmp_path / "out")
    assert "legcal-part" not in str(refusal.value)
    assert files_of(tmp_path) == {}


def test_an_empty_text_is_no_folder_for_a_dataset() -> None:
    with pytest.raises(UsageError, match="dataset could not be written: found an empty text"):
        simulate("hexapod", "", FEW)


@pytest.mark.parametrize("images", [1, 2])
def test_what_can_be_done_next_is_said(images: int, tmp_path: Path) -> None:
    out = tmp_path / "my set"
    few = settings(
        level="photographs", poses=1, views=1, images=images, camera=small_camera(tmp_path)
    )
    console = Console(width=400, record=True, file=io.StringIO())
    made = simulate("hexapod", out, few)
    console.print(simulation_table(summary_document(made), repeated=images > 1))
    said = console.export_text()
    assert f"calibrate with: legcal calibrate '{out}' -o OUT\n" in said
    truth = out / "truth" / "models" / "hexapod.yaml"
    assert f"judge with: legcal evaluate OUT/calibrated.yaml '{truth}'\n" in said
    assert (f"measure noise with: legcal noise '{out}'\n" in said) == (images > 1)


def test_photographs_tell_the_gamma_of_their_camera(tmp_path: Path) -> None:
    look = legcal.Appearance(gamma=1.8, clutter=0, samples=13)
    few = {"poses": 1, "views": 1, "camera": small_camera(tmp_path)}
    told = {
        level: legcal.load_dataset(simulate("hexapod", tmp_path / level, chosen).folder)
        for level, chosen in (
            ("photographs", settings(level="photographs", appearance=look, **few)),
            ("outlines", settings(level="outlines", **few)),
        )
    }
    gammas = {level: d.measurements.views[0].camera.gamma for level, d in told.items()}
    assert gammas == {"photographs": 1.8, "outlines": 1.0}


def test_the_python_of_the_description_of_simulated_datasets_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parents[1] / "docs" / "simulate.md").read_text()
    code = text[
        text.index("    settings = legcal.Sim") : text.index("Metres and radians; `errors`")
    ]
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"legcal": legcal}
    exec(textwrap.dedent(code), names)
    assert names["made"].seen.shape == (60, 6)
    assert 1e-4 < names["apart"].displacement.mean() < 2e-3


@pytest.mark.parametrize("name", legcal.__all__)
def test_every_public_name_is_found(name: str) -> None:
    assert getattr(legcal, name) is not None
