"""Fleets: many machines, a result folder each, and one summary."""

import csv
import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from characterisation.running import fits_schema
from command_line import run as run_command
from simulated import files_of, simulated

from legcal.calibration import fleet
from legcal.calibration.fleet import FleetMachine, FleetOptions, calibrate_fleet
from legcal.calibration.pipeline import calibrate
from legcal.calibration.result_folder import load_result
from legcal.cluster import Stamp
from legcal.errors import DatasetError, OutOfResources, UsageError
from legcal.simulation.settings import Level


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of a machine, and beside it its result."""
    folder = tmp_path_factory.mktemp("machines") / "good"
    simulated(folder, "3-rpr", level=Level.OUTLINES, poses=6)
    calibrate(folder, output=folder.parent / "result")
    return folder


def _fleet(tmp_path: Path, good: Path) -> list[FleetMachine]:
    (tmp_path / "bad").mkdir(exist_ok=True)
    earlier = good.parent / "result"
    return [FleetMachine("bad", tmp_path / "bad"), FleetMachine("good", good, earlier)]


def test_failures_are_named_and_do_not_stop_the_others(tmp_path: Path, good: Path) -> None:
    out = tmp_path / "out"
    with ThreadPoolExecutor(2) as executor:
        found = calibrate_fleet(_fleet(tmp_path, good), out, workers=executor)
    bad, fine = found.machines
    assert (bad.status, bad.kind, bad.name) == ("failed", "DatasetError", "bad")
    assert "found no dataset.yaml" in bad.verdict
    assert not (out / "bad").exists()
    written = files_of(out / "good")
    assert json.loads(written.pop("made_of.json"))["dataset"] == str(good)
    assert written == files_of(good.parent / "result")
    result = load_result(out / "good").result
    assert result.platform is not None
    assert fine.sigma_dX_m == result.platform.sigma_dX_m
    assert fine.drift_dX_m is not None
    assert fine.drift_sigma_dX_m is not None
    assert fine.drift_dX_m < 1e-3 * fine.drift_sigma_dX_m
    assert json.loads((out / "summary.json").read_text()) == found.document()
    fits_schema(["fleet"], found.document())
    with (out / "summary.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["failed", fine.status]
    assert float(rows[1]["sigma_mm"]) == pytest.approx(1e3 * fine.sigma_dX_m, rel=1e-5)


def test_a_fleet_that_is_resumed_takes_results_of_its_datasets_that_are_newer(
    tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, own, calibrated = tmp_path / "out", tmp_path / "own", list[str]()
    shutil.copytree(good, own)

    def counted(dataset: Path, **arguments: object) -> object:
        calibrated.append(dataset.name)
        if dataset.name == "bad":
            raise OutOfResources("The disk is full.")
        return calibrate(dataset, **arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(fleet, "calibrate", counted)
    machines = [FleetMachine("own", own), *_fleet(tmp_path, good)[:1]]
    with pytest.raises(OutOfResources):  # no reason of a machine: the fleet stops
        calibrate_fleet(machines, out)
    assert calibrated == ["own", "bad"]
    (tmp_path / "bad").rmdir()
    monkeypatch.setattr(fleet, "calibrate", lambda *_, **__: pytest.fail("calibrated again"))
    kept = calibrate_fleet(machines[:1], out, resume=True)
    assert kept.machines[0].status != "failed"
    (own / "measurements.csv").touch()
    monkeypatch.setattr(fleet, "calibrate", counted)
    assert calibrate_fleet(machines[:1], out, resume=True) == kept
    assert calibrated == ["own", "bad", "own"]
    asked = FleetOptions({"overlays": False})
    calibrate_fleet(machines[:1], out, options=asked, resume=True)
    shutil.copytree(own, tmp_path / "other")  # as old as the first
    calibrate_fleet([FleetMachine("own", tmp_path / "other")], out, options=asked, resume=True)
    assert calibrated == ["own", "bad", "own", "own", "other"]


@pytest.mark.system
def test_machines_that_workers_do_not_see_are_sent_and_their_results_sent_back(
    tmp_path: Path, good: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machines, out = _fleet(tmp_path, good), tmp_path / "out"
    here = calibrate_fleet(machines, tmp_path / "here")
    calibrated = fleet._calibrated

    def elsewhere(options: FleetOptions, folder: Path, token: Stamp, row: Any) -> object:
        return calibrated(options, Path("/nowhere") if row[2] is None else folder, token, row)

    monkeypatch.setattr(fleet, "_calibrated", elsewhere)
    assert calibrate_fleet(machines, out) == here
    assert files_of(out) == files_of(tmp_path / "here")

    def refuse(path: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    unread = calibrate_fleet(machines, tmp_path / "unread")
    assert [one.kind for one in unread.machines] == ["DatasetError"] * 2
    assert "'Permission denied'" in unread.machines[1].verdict


def test_lists_and_words_that_make_no_fleet_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "machines.csv"
    out = tmp_path / "out"
    for text, named in (
        ("dataset,name\na,\na,\n", "2 machines of the name 'a'"),
        ("dataset,name\na,x/y\n", "the name 'x/y'"),
        ("dataset,name\na,summary.json\n", "the name 'summary.json'"),
        ("dataset,mane\na,b\n", "unknown column 'mane'"),
        ("dataset\n", "no row"),
        (f"dataset,name\na,{256 * 'x'}\n", "a folder can have"),
    ):
        table.write_text(text)
        assert run_command(monkeypatch, "calibrate", "--list", table, "-o", out) == 2
        assert named in capsys.readouterr().err
    for words, named in (
        (["a", "--resume"], "--resume with one dataset"),
        (["a", "b", "--earlier", "nowhere"], "nowhere"),
        (["a", "--earlier", "b"], "--earlier with one dataset"),
        (["a", "b", "--check", "c"], "several datasets beside --check"),
        ([], "found no DATASET"),
    ):
        assert run_command(monkeypatch, "calibrate", *words, "-o", out) == 2
        assert named in capsys.readouterr().err
    assert not out.exists()
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "notes.txt").touch()
    with pytest.raises(UsageError, match="a folder with other files"):
        calibrate_fleet([FleetMachine("a", tmp_path)], mine)
    with pytest.raises(DatasetError):
        fleet.read_fleet(tmp_path / "none.csv")


def test_machines_without_a_name_have_that_of_the_folder_of_their_dataset(tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (own / "dataset.yaml").touch()
    (own / "machines.csv").write_text("dataset\n.\ndataset.yaml\n../other\n..\n")
    machines = fleet.read_fleet(own / "machines.csv")
    assert [one.name for one in machines] == ["own", "own", "other", tmp_path.name]
    with pytest.raises(UsageError, match="the name ''"):
        calibrate_fleet([FleetMachine("", own)], tmp_path / "out")


def test_a_terminal_shows_every_failure_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    places = [tmp_path / "machines of the east" / name for name in ("first", "second")]
    for place in places:
        place.mkdir(parents=True)
    monkeypatch.setenv("COLUMNS", "50")
    run_command(monkeypatch, "calibrate", *places, "-o", tmp_path / "out", "--workers", "1")
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("a table of readings (legcal init).") == len(places)
