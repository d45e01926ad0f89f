"""The command line: exit codes, one sentence a problem, one JSON document."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run
from hexapod_example import Run, copy_of_the_example
from simulated import simulated

from legcal.errors import Code, DatasetError, LegcalError, ModelError, NotVisible, Problem
from legcal.simulation.settings import ParameterErrors


@pytest.mark.parametrize(
    ("words", "heavy", "printed"),
    [
        (["--help"], {"numpy", "scipy", "pinocchio", "pydantic", "rich"}, "calibrate"),
        (["calibrate", "--help"], {"numpy", "pydantic", "rich"}, "--holdout"),
        pytest.param(
            *(["inspect", "hexapod"], {"casadi", "cv2", "trimesh", "yourdfpy", "scipy.stats"}),
            "SPU",
            marks=pytest.mark.system,
        ),
        pytest.param(
            ["export", "hexapod", "--to", "correction", "-o", "missing.csv", "--json"],
            {"casadi", "cv2", "trimesh", "scipy.stats", "jinja2"},
            "needed a result",
            marks=pytest.mark.system,
        ),
        (
            ["calibrate", "missing", "-o", "out", "--json"],
            {
                *("scipy.stats", "scipy.optimize", "scipy.interpolate", "scipy.sparse.csgraph"),
                "trimesh",
            },
            "missing",
        ),
    ],
)
def test_commands_load_only_what_they_need(words: list[str], heavy: set[str], printed: str) -> None:
    script = (
        f"import sys; sys.argv = {['legcal', *words]}\n"
        "from legcal.cli import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"sys.exit(', '.join({heavy} & set(sys.modules)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert printed in done.stdout


def test_calibrate_prints_all_parameters_with_verbose(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("calibrate", example_run.folder, "-o", tmp_path / "out")
    computed = "legcal.calibration.pipeline.calibrate"
    monkeypatch.setattr(computed, lambda *_, **__: example_run.calibration)
    outcome = run(*words, "--verbose")
    assert outcome.code == 0
    assert "Joints of the platform in the link platform [mm]" in outcome.out
    assert re.search(r"leg1 +x( +-168.8750){2} +[+]0.0000 +0.0000 +defines R_e", outcome.out)
    assert "leg4.offset" in outcome.out
    assert "four steps alone" in outcome.out
    assert "Calibrated:" in outcome.out


@pytest.mark.usefixtures("without_steps")
def test_a_model_that_was_right_already_is_not_called_an_improvement(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "set", "3-rpr", errors=ParameterErrors()).folder
    outcome = run("calibrate", folder, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert "Do not load this into the controller" in outcome.said


def _diagnosed() -> LegcalError:
    """A refusal whose message counts the consequences of a mistake."""
    error = NotVisible("columns a and b appear to be swapped; 2 further problems")
    error.consequences = Problem("no leg"), Problem("the number", code=Code.BAD_CELL)
    return error


@pytest.mark.parametrize(
    ("error", "code", "kind", "said", "problems"),
    [
        (
            ZeroDivisionError("division by zero"),
            3,
            "InternalError",
            "a mistake in legcal",
            ["internal-error"],
        ),
        (KeyboardInterrupt(), 130, "Interrupted", "Stopped before the end", ["interrupted"]),
        (ModelError(["one", "two"]), 2, "ModelError", "one\ntwo", ["model-error"] * 2),
        (NotVisible("no leg"), 1, "NotVisible", "no leg", ["not-visible"]),
        (_diagnosed(), 1, "NotVisible", "2 further", ["not-visible"] * 2 + ["bad-cell"]),
    ],
)
def test_failures_have_their_exit_code_and_are_said_once(
    error: BaseException,
    code: int,
    kind: str,
    said: str,
    problems: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(model: str, **bodies: str | None) -> None:
        raise error

    monkeypatch.setattr("legcal.machine.loader.load_mechanism", fail)
    outcome = run("inspect", "hexapod")
    assert (outcome.code, outcome.out) == (code, "")
    assert said in outcome.err
    outcome = run("inspect", "hexapod", "--json")
    found = outcome.document["error"]
    assert outcome.code == code
    assert found["kind"] == kind
    assert said in found["message"]
    assert [problem["code"] for problem in found.get("problems", [])] == problems


def test_json_has_the_facts_of_what_is_wrong(tmp_path: Path) -> None:
    copy_of_the_example(tmp_path / "data")
    table = tmp_path / "data" / "measurements.csv"
    head, first, *rest = table.read_text("utf-8").splitlines()
    cells = first.split(",")[:-1]
    table.write_text("\n".join([head, ",".join([*cells, "far"]), *rest]), "utf-8")
    outcome = run("doctor", tmp_path / "data", "--json")
    assert outcome.code == 2
    error = outcome.document["error"]
    (problem,) = error["problems"]
    assert problem["code"] == "bad-cell"
    assert problem["file"] == str(table)
    assert (problem["row"], problem["line"], problem["columns"]) == (1, 2, head.split(",")[-1:])
    assert problem["found"] == "'far'"
    assert problem["needed"].startswith("a finite number")
    assert all(problem[key] in error["message"] for key in ("what", "found", "needed", "remedy"))


def test_of_many_problems_of_a_kind_a_few_are_spelt_out() -> None:
    what, needed = "the number could not be used", "a finite number"
    cells = [
        Problem(what, f"'{k}'", needed, row=k, columns=(name,), code=Code.BAD_CELL)
        for name in "ab"
        for k in range(12)
    ]
    shown = str(DatasetError([*cells, "Another sentence."])).splitlines()
    assert shown.count("... and 7 more like these.") == 2
    assert shown[-1] == "Another sentence."
    assert len(shown) == 13


@pytest.mark.parametrize(("words", "shown"), [((), "Results"), (("study",), "Commands")])
def test_without_a_command_the_help_is_shown(words: tuple[str, ...], shown: str) -> None:
    outcome = run(*words)
    assert outcome.code == 2
    assert shown in outcome.err
    assert outcome.err.endswith("\nlegcal: No command given: choose one of those above.\n")


@pytest.mark.parametrize("words", [("detect", "x", "-o", "y"), ("study", "paper", "-o", "y")])
def test_a_number_of_processes_beside_a_cluster_is_refused(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LEGCAL_CLUSTER", "tcp://127.0.0.1:1")
    outcome = run(*words, "--workers", "2")
    assert outcome.code == 2
    assert "found --workers beside a cluster" in outcome.err


def test_progress_is_shown_unless_somebody_wants_quiet(tmp_path: Path) -> None:
    words = ["simulate", "3-rpr", "--level", "outlines", "--poses", "1"]
    shown = run(*words, "-o", tmp_path / "shown")
    quiet = run(*words, "-o", tmp_path / "quiet", "--quiet")
    assert shown.code == quiet.code == 0
    assert shown.err
    assert not quiet.err
    assert quiet.out.count("\n") == shown.out.count("\n")
