"""Choices of parameters in dataset.yaml, in a call and on the command line."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from dataset_folder import Folder, folder

from legcal import calibrate, cli
from legcal.calibration.joint_fit.choices import Choices, Prior, known_parameters, resolve
from legcal.data.dataset import load_dataset
from legcal.data.overrides import overrides_of_call
from legcal.errors import DatasetError, UsageError

__all__ = ["folder"]


def chosen(folder: Folder, block: dict[str, Any], **call: Any) -> Choices:
    folder.entry["parameters"] = block
    dataset = load_dataset(folder.write())
    known = known_parameters(dataset.machine, dataset.measurements.views)
    return resolve([*dataset.overrides, *overrides_of_call(**call)], known)


def test_a_dataset_without_the_block_chooses_nothing(folder: Folder) -> None:
    assert load_dataset(folder.path).overrides == ()
    assert chosen(folder, {}) == Choices()


def test_the_block_says_what_a_call_can_say(folder: Folder) -> None:
    block = {
        "priors": {"leg1.offset": "350±0.1 mm", "c2.fx": {"value": 81.0, "sigma": 0.5}},
        "fixed": ["leg2.*.z", "leg3.offset=0.35"],
        "free": ["*.radius.*"],
    }
    call: dict[str, Any] = {"priors": {"leg1.offset": (0.35, 1e-4), "c1.fx": (81.0, 0.5)}}
    call |= {"fixed": block["fixed"], "free": block["free"]}
    by_file = chosen(folder, block)
    assert by_file == chosen(folder, {}, **call)
    assert by_file.priors["leg1.offset"] == Prior(0.35, 1e-4)
    assert by_file.notes == ()


def test_a_run_that_says_the_same_needs_no_note(folder: Folder) -> None:
    block = {"priors": {"leg1.offset": "0.35±0.0001"}, "fixed": ["leg2.offset"]}
    assert chosen(folder, block, priors=["leg1.offset=350±0.1mm"]).notes == ()
    assert "leg2.offset gave way" in chosen(folder, block, free=["*.offset"]).notes[0]


@pytest.mark.parametrize(
    ("block", "found"),
    [
        ({"prior": {}}, r"parameters\.prior could not be used: found an unknown key; did you mean"),
        ({"priors": ["leg1.offset"]}, r"parameters\.priors could not be read: .*needed a mapping"),
        ({"priors": {"leg1.offset": 0.35}}, r"parameters\.priors\.leg1\.offset .*found 0\.35, nee"),
        (
            {"priors": {"leg1.offset": None}},
            r"priors\.leg1\.offset .*found nothing, needed a value",
        ),
        (
            {"priors": {"leg1.offset": {"value": 0.35}}},
            r"leg1\.offset .*needed a value and its sig",
        ),
        ({"priors": {"leg1.offset": {"value": 0.35, "sigma": 0.0}}}, "found the sigma 0, needed"),
        ({"priors": {"leg1.offset": "0.35±-0.1"}}, r"found the sigma -0\.1, needed a finite one"),
        (
            {"priors": {"leg1.offset": {"value": 0.35, "sigma": float("inf")}}},
            "found the sigma inf",
        ),
        ({"fixed": "leg1.offset"}, r"parameters\.fixed could not be read: .*needed a list"),
        ({"fixed": ["leg1.offset=x"]}, r"parameters\.fixed\.0 .*found 'x', needed a number"),
        ({"free": [{"leg1": "offset"}]}, r"parameters\.free\.0 could not be read: .*needed a text"),
    ],
)
def test_a_malformed_block_is_refused(folder: Folder, block: dict[str, Any], found: str) -> None:
    folder.entry["parameters"] = block
    folder.write()
    with pytest.raises(DatasetError, match=rf"dataset\.yaml: .*{found}"):
        load_dataset(folder.path)


@pytest.mark.parametrize(
    ("block", "found"),
    [
        (
            {"fixed": ["leg9.offset"]},
            r"parameters\.fixed 'leg9\.offset' could not be used: found a",
        ),
        ({"priors": {"leg1.offset": "9±1"}}, r"parameters\.priors\.leg1\.offset could not .*9 m"),
        (
            {"fixed": ["leg1.offset"], "free": ["*.offset"]},
            r"found .*fixed 'leg1\.offset' and .*fr",
        ),
    ],
)
def test_a_block_that_does_not_fit_the_machine_is_refused(
    folder: Folder, block: dict[str, Any], found: str
) -> None:
    with pytest.raises(DatasetError, match=rf"dataset\.yaml: {found}|{found}"):
        chosen(folder, block)


def test_a_call_is_refused_before_any_work(folder: Folder, tmp_path: Path) -> None:
    before = sorted(folder.path.rglob("*"))
    for call in ({"free": ["leg9.offset"]}, {"priors": {"leg1.offset": (0.35, 0.0)}}):
        with pytest.raises(UsageError, match="could not be used"):
            calibrate(folder.path, output=tmp_path / "out", **call)
    assert not (tmp_path / "out").exists()
    assert sorted(folder.path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--prior", "leg1.offset=0.35±0"], "The prior 'leg1.offset=0.35±0' could not be used"),
        (["--prior", "leg1.ofset=0.35±1mm"], "did you mean 'leg1.offset'?"),
        (["--fix", "leg1.offset", "--free", "*.offset"], "both fixed and freed"),
        (
            ["--prior", "leg1.offset=.3+-.1", "--prior", "leg1.offset=.4+-.1"],
            "two different priors",
        ),
    ],
)
def test_the_command_refuses_in_one_sentence(
    folder: Folder,
    words: list[str],
    found: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = folder.path.parent / "out"
    command = ["legcal", "calibrate", str(folder.path), "-o", str(out), "--json", *words]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["kind"] == "UsageError"
    assert found in error["message"]
    assert "\n" not in error["message"]
    assert not out.exists()
