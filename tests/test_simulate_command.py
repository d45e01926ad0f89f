"""``legcal simulate``: what it prints, and everything that it refuses, with nothing lost."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated import files_of, settings, small_camera

from legcal import cli
from legcal.errors import DatasetError, NotVisible, UsageError
from legcal.simulation.dataset import simulate
from legcal.simulation.folder import TRUTH_NAME
from legcal.simulation.observe import TableNoise
from legcal.simulation.request import Level, Sampling
from legcal.simulation.settings import Distribution, ParameterErrors, Spread

QUICK = ("--level", "outlines", "--poses", "1", "--views", "1")
LOOKING_AWAY = "{xyz: [1.5, 0.0, 0.2], quat_xyzw: [0.5, 0.5, 0.5, 0.5]}"


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["legcal", "simulate", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_one_command_writes_a_dataset_and_says_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(monkeypatch, "hexapod", "-o", tmp_path / "sim", *QUICK) == 0
    printed = capsys.readouterr()
    assert "hexapod: outlines, 1 image of 1 pose" in printed.out
    assert f"{tmp_path}/sim/truth/models/hexapod.yaml" in printed.out.replace("\n", "")
    assert "Cameras: 1/1" in printed.err
    assert (tmp_path / "sim" / "observations.csv").exists()


def test_json_is_one_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("--error", "joints=1mm:normal", "--error", "radii=0.1mm", "--pixel-noise", "0.2px")
    assert run(monkeypatch, "hexapod", "-o", tmp_path / "sim", *QUICK, *words, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["images"] == 1
    assert document["extreme_poses"] == 1
    assert document["views"]["c1"]["images"] == 1
    assert set(document["views"]["c1"]["legs"]) == {f"leg{j}" for j in range(1, 7)}
    truth = json.loads((tmp_path / "sim" / TRUTH_NAME).read_text())
    errors = truth["settings"]["errors"]
    assert errors["base_joints"] == {"size": 1e-3, "distribution": "normal"}
    assert errors["offsets"] == {"size": 2e-3, "distribution": "uniform"}  # the default stays
    assert truth["settings"]["sigma_px"] == 0.2
    assert 1e-6 < abs(truth["radii"]["leg1"]["leg1_tube"] - 0.010) <= 1e-4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--images", "0"), "found 0 images, needed a whole number from 1"),
        (("--poses", "0"), "found 0 poses"),
        (("--poses", "-3"), "needed a whole number"),
        (("--poses", "1.5"), "needed a whole number"),
        (("--views", "0"), "found 0 views"),
        (("--seed", "-1"), "found -1 as the seed, needed a whole number of 0 or more"),
        (
            ("--level", "outlines", "--pixel-noise", "-0.1px"),
            "--pixel-noise could not be used: found the negative",
        ),
        (("--level", "outlines", "--pixel-noise", "0.1"), "needed a number and its unit (px)"),
        (("--encoder-noise", "-2um"), "--encoder-noise could not be used: found the negative"),
        (("--encoder-noise", "2um:gauss"), "found the distribution 'gauss'"),
        (("--error", "joints=-2mm"), "--error joints could not be used: found the negative"),
        (("--error", "joints=0.1deg"), "needed a number and its unit (mm, um"),
        (("--error", "axes=2mm"), "needed a number and its unit (deg"),
        (("--error", "joint=2mm"), "did you mean 'joints'?"),
        (("--error", "2mm"), "needed KIND=SIZE"),
        (
            ("--error", "joints"),
            "found 'joints' without a size, needed KIND=SIZE; write",
        ),
        (("--error", "joints=2m"), "found '2m', needed 0 to 1m; correct it and its unit"),
        (("--poses", "1e3"), "found '1e3', neither a whole number nor a file"),
        (("--poses", "nan"), "found 'nan', neither a whole number nor a file"),
        (("--encoder-noise", "1m"), "needed at most the shortest travel of a motor, 0.148 m"),
        (("--level", "outlines", "--pixel-noise", "1e308px"), "needed 0 to 100 px; correct it"),
        (("--views", "2", "--cameras", "c.yaml"), "found both --views and --cameras"),
        (("--poses", "p.csv", "--own-poses"), "found --own-poses with a file of poses"),
        (("--camera", "none.yaml"), "none.yaml: the camera file could not be read"),
        (("--cameras", "none.yaml"), "none.yaml: the cameras file could not be read"),
        (("--appearance", "none.yaml"), "none.yaml: the appearance file could not be read"),
        (("--poses", "none.csv"), "none.csv"),
        (("--pixel-noise", "0.2px"), "found --level photographs, needed --level outlines"),
        (("--level", "axes", "--blur", "1"), "found --level axes, needed --level photographs"),
        (("--error", "twists=1deg"), "--error twists could not be used: found none in the"),
        (("--error", "radii=9mm"), "The errors of radii could not be drawn: found a size of 9 mm"),
        (("--bits", "12"), "found bits = 12, needed one of 8, 16"),
        (("--blur", "-1"), "found blur = -1"),
    ],
)
def test_wrong_options_are_refused_in_one_sentence_and_nothing_is_written(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "hexapod", "-o", "sim", *words) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("legcal: ")
    assert message in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("blurr: 1\n", "blurr could not be used: found an unknown key; did you mean 'blur'?"),
        ("blur: many\n", "blur could not be read: found 'many', needed a number"),
        ("blur: -1\n", "found blur = -1"),
        ("electrons: 1e-300\n", "found electrons = 1e-300, needed a number of at least 1"),
        ("electrons: .nan\n", "found electrons = nan"),
        ("lights: [{strength: 1}]\n", "lights.0.direction could not be read"),
        ("[1]\n", "needed 'key: value' lines"),
    ],
)
def test_a_wrong_appearance_file_is_refused(
    text: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "look.yaml"
    path.write_text(text)
    words = ("--appearance", str(path))
    assert run(monkeypatch, "hexapod", "-o", tmp_path / "sim", *words) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "sim").exists()


def test_an_appearance_file_is_used_and_options_go_over_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "look.yaml"
    path.write_text(
        "blur: 0.8\nclutter: 3\nelectrons: .inf\n"
        "lights:\n  - {direction: [0, 0, 1], strength: 0.5}\n"
    )
    words = ("--appearance", path, "--clutter", "7", "--camera", small_camera(tmp_path))
    one = ("--poses", "1", "--views", "1")
    assert run(monkeypatch, "hexapod", "-o", tmp_path / "sim", *one, *words) == 0
    look = json.loads((tmp_path / "sim" / TRUTH_NAME).read_text())["settings"]["appearance"]
    assert (look["blur"], look["clutter"], len(look["lights"])) == (0.8, 7, 1)
    assert look["electrons"] == "inf"


@pytest.mark.parametrize(
    "changes",
    [
        {"sigma_px": -0.1},
        {"sigma_px": float("nan")},
        {"sigma_px": "0.1px"},
        {"sigma_px": 1e9},
        {"readings": 2e-6},
        {"errors": None},
        {"errors": ParameterErrors(axes=0.1)},  # type: ignore[arg-type]
        {"table": TableNoise(psi="0.05")},  # type: ignore[arg-type]
        {"appearance": "clean"},
        {"seed": 1.5},
        {"readings": Spread(-1e-6)},
        {"errors": ParameterErrors(axes=Spread(float("inf")))},
        {"table": TableNoise(psi=-1.0)},
        {"table": TableNoise(x=0.0)},
        {"images": True},
        {"level": "pictures"},
        {"sampling": "best"},
        {"poses": 10**9},
        {"seed": -1},
        {"poses": 1000, "views": 100, "images": 2},
    ],
)
def test_settings_without_sense_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(UsageError, match="The dataset could not be simulated: found"):
        settings(**changes)


@pytest.mark.parametrize(("size", "distribution"), [("2mm", "uniform"), (1e-3, "flat")])
def test_spreads_without_sense_are_refused(size: float, distribution: Distribution) -> None:
    with pytest.raises(UsageError, match=r"found the size .* and the distribution"):
        Spread(size, distribution)


def test_whole_numbers_of_any_type_count(tmp_path: Path) -> None:
    found = settings(poses=np.int64(2), seed=np.uint8(3), readings=Spread(np.float64(0.0)))
    assert (found.poses, found.seed) == (2, 3)
    assert type(found.poses) is type(found.seed) is int
    with pytest.raises(UsageError, match="found 0 workers, needed a whole number of 1 or more"):
        simulate("hexapod", tmp_path / "set", found, workers=0)


def test_choices_and_paths_may_be_given_as_text() -> None:
    asked = settings(level="axes", sampling="workspace", poses="poses.csv", camera="lens.yaml")
    assert (asked.level, asked.sampling) == (Level.AXES, Sampling.WORKSPACE)
    assert (asked.poses, asked.camera) == (Path("poses.csv"), Path("lens.yaml"))


def test_a_folder_with_anything_in_it_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for force in (False, True):
        with pytest.raises(UsageError, match=r"folder with (other )?files"):
            simulate("hexapod", tmp_path, settings(), force=force)
    assert files_of(tmp_path) == {"notes.txt": b"mine"}


def test_another_dataset_is_not_replaced_even_with_force(tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text("legcal_dataset: 1\n")
    with pytest.raises(UsageError, match="needed a new or empty folder or that of an earlier"):
        simulate("hexapod", tmp_path, settings(), force=True)
    assert list(files_of(tmp_path)) == ["dataset.yaml"]


def test_force_replaces_a_simulated_dataset_and_keeps_what_is_not_its_own(tmp_path: Path) -> None:
    few = settings(poses=1, views=1)
    simulate("hexapod", tmp_path, few)
    with pytest.raises(UsageError, match=r"found a simulated dataset.*--force"):
        simulate("hexapod", tmp_path, few)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ".legcal-cache.json").write_text("{}")
    simulate("3-rps", tmp_path, settings(poses=1, views=1, level=Level.AXES), force=True)
    files = files_of(tmp_path)
    assert files["notes.txt"] == b"mine"
    assert "axes.csv" in files
    gone = {"observations.csv", ".legcal-cache.json", "models/hexapod.yaml", "urdf/hexapod.urdf"}
    assert not gone & set(files)
    assert set(json.loads(files[TRUTH_NAME])["files"]) == set(files) - {"notes.txt"}


def test_a_failure_leaves_an_earlier_dataset_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    simulate("hexapod", folder, settings(poses=1, views=1))
    before = files_of(tmp_path)
    (tmp_path / "cameras.yaml").write_text(f"views: {{c1: {{T_base_camera: {LOOKING_AWAY}}}}}\n")
    wrong = settings(poses=1, views=tmp_path / "cameras.yaml")
    with pytest.raises(NotVisible):
        simulate("hexapod", folder, wrong, force=True)
    (tmp_path / "cameras.yaml").unlink()
    assert files_of(tmp_path) == before


def test_names_in_the_truth_of_a_dataset_do_not_reach_outside_it(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    folder = tmp_path / "set"
    simulate("hexapod", folder, settings(poses=1, views=1))
    truth = json.loads((folder / TRUTH_NAME).read_text())
    truth["files"] += ["../precious.txt", str(tmp_path / "precious.txt"), 7]
    (folder / TRUTH_NAME).write_text(json.dumps(truth))
    simulate("hexapod", folder, settings(poses=1, views=1), force=True)
    assert (tmp_path / "precious.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("pose", "error", "message"),
    [
        (LOOKING_AWAY, NotVisible, "view c1: .* no image shows a leg"),
        (
            "{xyz: [0.0, 0.0, 0.2], quat_xyzw: [0, 0, 0, 1]}",
            UsageError,
            "view c1: its camera could not be placed: found it inside the machine",
        ),
        ("{xyz: [0.0, 0.0, .inf], quat_xyzw: [0, 0, 0, 1]}", DatasetError, "views.c1"),
        ("{xyz: [0.0, 0.0, 0.2], quat_xyzw: [0, 0, 0, 2]}", DatasetError, "norm 2"),
        (
            "{xyz: [0.0, 0.0, 0.2], quat_xyzw: [0, 0, 1]}",
            DatasetError,
            r"T_base_camera\.quat_xyzw could not be read: found 3 numbers, needed more",
        ),
    ],
)
def test_cameras_that_see_nothing_or_stand_in_the_machine_are_refused(
    pose: str, error: type[Exception], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "cameras.yaml"
    path.write_text(f"views: {{c1: {{T_base_camera: {pose}}}}}\n")
    with pytest.raises(error, match=message):
        simulate("hexapod", tmp_path / "set", settings(poses=1, views=path))
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("size", [(4_000_000_000, 3000), (20_000, 20_000)])
def test_cameras_whose_pictures_nothing_holds_are_refused(
    size: tuple[int, int], tmp_path: Path
) -> None:
    camera = small_camera(tmp_path, *size)
    with pytest.raises(DatasetError, match=f"found {size[0]} x {size[1]} px, needed at most 65535"):
        simulate("hexapod", tmp_path / "set", settings(poses=1, views=1, camera=camera))
    assert not (tmp_path / "set").exists()


def test_more_cameras_of_a_file_than_images_fit_are_refused(tmp_path: Path) -> None:
    place = "{T_base_camera: {xyz: [1, 0, 0.2], quat_xyzw: [0, 0, 0, 1]}}"
    path = tmp_path / "cameras.yaml"
    path.write_text(f"views: {{a: {place}, b: {place}}}\n")
    many = settings(poses=1, views=path, images=60_000)
    with pytest.raises(
        UsageError, match=r"found 120000 images \(2 views of 1 poses, 60000 of each"
    ):
        simulate("hexapod", tmp_path / "set", many)


def test_a_camera_too_far_away_is_asked_to_come_nearer(tmp_path: Path) -> None:
    place = "{xyz: [90.0, 0.0, 0.2], quat_xyzw: [-0.5, -0.5, 0.5, 0.5]}"
    path = tmp_path / "cameras.yaml"
    path.write_text(f"views: {{c1: {{T_base_camera: {place}}}}}\n")
    with pytest.raises(NotVisible, match=r"legs are at most \d.* px long .*its place is in metres"):
        simulate("hexapod", tmp_path / "set", settings(poses=1, views=path))


def test_a_machine_without_visible_legs_cannot_be_seen(tmp_path: Path) -> None:
    made = simulate("hexapod", tmp_path / "a", settings(poses=1, views=1))
    urdf = made.folder / "urdf" / "hexapod.urdf"
    urdf.write_text(re.sub(r"<visual>.*?</visual>", "", urdf.read_text()))
    with pytest.raises(NotVisible, match="no leg with a visible cylinder"):
        simulate(made.folder / "models" / "hexapod.yaml", tmp_path / "b", settings(poses=1))
