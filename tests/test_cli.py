"""The command line: exit codes, one sentence a problem, one JSON document."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from hexapod_example import HEXAPOD, TRUTH, Run, copy_of_the_example

from legcal import cli
from legcal.version import __version__


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """Run the command line in this process and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["legcal", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_help_and_version_load_nothing_heavy() -> None:
    script = (
        "import sys; sys.argv = ['legcal', '--help']\n"
        "from legcal.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'casadi', 'pinocchio', 'cv2', 'yourdfpy', 'pydantic'}\n"
        "sys.exit(', '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for command in ("inspect", "identify", "calibrate", "evaluate"):
        assert command in done.stdout


def test_version_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"legcal {__version__}\n"


def test_inspect_prints_a_table_of_80_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(monkeypatch, "inspect", "hexapod") == 0
    out = capsys.readouterr().out
    assert "SPU" in out
    assert max(len(line) for line in out.splitlines()) <= 80


def test_inspect_json_is_one_document(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "inspect", "hexapod", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["mobility"] == document["motors"] == 6
    assert document["n_d"] == 3
    assert [leg["type"] for leg in document["legs"]] == ["SPU"] * 6


def test_evaluate_json_has_the_errors_of_eq_20(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "evaluate", "hexapod", TRUTH, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["poses"] == 100
    assert 1e-3 < document["dX_m"] < 2e-3
    assert document["dX_max_m"] >= document["dX_m"]
    assert len(document["parameters"]) == 30
    first = document["parameters"][0]
    assert first["difference"] == pytest.approx(first["value"] - first["reference"])


def test_evaluate_prints_millimetres_and_degrees(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "evaluate", "hexapod", TRUTH, "--dataset", HEXAPOD) == 0
    out = capsys.readouterr().out
    assert "45 poses" in out
    assert "leg6.offset" in out


def test_calibrate_prints_the_table_and_the_verdict(
    example_run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, "calibrate", example_run.folder, "-o", tmp_path / "out") == 0
    captured = capsys.readouterr()
    assert "leg4.platform.z" in captured.out
    assert "four steps alone" in captured.out
    assert "Calibrated:" in captured.out
    assert "Joint fit" in captured.err
    assert (tmp_path / "out/calibrated.urdf").exists()


def test_calibrate_json_is_the_result_document(
    example_run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ("calibrate", example_run.folder, "-o", tmp_path / "out", "--json")
    assert run(monkeypatch, *words) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "out/result.json").read_text())


def test_a_model_that_was_right_already_is_not_called_an_improvement(
    example_run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = copy_of_the_example(tmp_path / "again")
    for name in ("observations.csv", ".legcal-cache.json"):
        (folder / name).unlink(missing_ok=True)
    (folder / "observations.csv").write_text((example_run.folder / "observations.csv").read_text())
    entry = (folder / "dataset.yaml").read_text()
    calibrated = example_run.output / "calibrated.yaml"
    (folder / "dataset.yaml").write_text(
        entry.replace("mechanism: models/hexapod.yaml", f"mechanism: {calibrated}")
    )
    assert run(monkeypatch, "calibrate", folder, "-o", tmp_path / "out") == 1
    assert "Do not load this into the controller" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("words", "code", "kind", "said"),
    [
        (("inspect", "nowhere.yaml"), 2, "ModelError", "nowhere.yaml"),
        (("inspect",), 2, "UsageError", "MODEL"),
        (("inspect", "hexapod", "--colour"), 2, "UsageError", "--colour"),
        (("calibrate", "nowhere", "-o", "out"), 2, "DatasetError", "nowhere"),
        (("calibrate", "nowhere"), 2, "UsageError", "--output"),
        (("evaluate", "hexapod", "nowhere.urdf"), 2, "ModelError", "nowhere.urdf"),
        (("frobnicate",), 2, "UsageError", "frobnicate"),
    ],
)
def test_wrong_use_is_said_in_one_sentence_and_in_json(
    words: tuple[str, ...],
    code: int,
    kind: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *words) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert run(monkeypatch, *words, "--json") == code
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert document["error"]["kind"] == kind
    assert said in document["error"]["message"]
    assert list(tmp_path.iterdir()) == []


def test_every_problem_of_a_dataset_is_listed_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copy_of_the_example(tmp_path / "spoiled")
    table = (folder / "measurements.csv").read_text().splitlines()
    table[3] = table[3].replace(table[3].split(",")[2], "nan")
    table[7] = table[7].replace(table[7].split(",")[4], "12.5")
    table[9] = table[9].rsplit(",", 1)[0]
    (folder / "measurements.csv").write_text("\n".join(table) + "\n")
    assert run(monkeypatch, "calibrate", folder, "-o", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 3
    for row in (3, 7, 9):
        assert sum(f"row {row} " in line for line in lines) == 1
    assert not (tmp_path / "out").exists()


def test_a_mistake_of_legcal_is_called_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(model: str) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("legcal.machine.load_mechanism", broken)
    assert run(monkeypatch, "inspect", "hexapod") == 3
    err = capsys.readouterr().err
    assert "mistake in legcal" in err
    assert "report" in err


def test_stopping_by_hand_is_no_mistake(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(model: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("legcal.machine.load_mechanism", stopped)
    assert run(monkeypatch, "inspect", "hexapod") == 130
    assert "Stopped before the end" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "place"),
    [
        (("simulate", "hexapod", "-o", ""), "-o"),
        (("simulate", "hexapod", "-o", "sim", "--poses="), "--poses="),
        (("simulate", "", "-o", "sim"), "simulate"),
        (("calibrate", ".", "-o", ""), "-o"),
        (("calibrate", ".", "--output="), "--output="),
        (("study", "paper", "-o", ""), "-o"),
    ],
)
def test_an_empty_word_is_not_taken_for_the_current_folder(
    words: tuple[str, ...],
    place: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *words) == 2
    assert f"found an empty text after '{place}', needed a name" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [(), ("study",)])
def test_without_a_command_the_help_is_shown(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, *words) == 2
    printed = capsys.readouterr()
    assert "Commands" in printed.out
    assert printed.err == "legcal: Nothing was done: found no command, needed one of those above.\n"
