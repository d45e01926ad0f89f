"""Each doubt is raised by what it is about, and every answer of a calibration follows the list."""

import ast
import io
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from command_line import run
from edits import GONE, Edit, document, each_row, keyed
from hexapod_example import Run
from lxml import html
from rich.console import Console
from simulated import simulated

from legcal import (
    Calibration,
    Machine,
    SimulationSettings,
    calibrate,
    load_dataset,
    load_mechanism,
    load_result,
    simulate,
)
from legcal.calibration import doubts, verdict
from legcal.calibration.documents import Doubt
from legcal.calibration.doubts import model_error
from legcal.calibration.joint_fit.held_out import cross_validate
from legcal.calibration.joint_fit.scale import ALL_READINGS
from legcal.calibration.joint_fit.sensitivity import FITTED_CAMERA, WrongIntrinsic
from legcal.calibration.result import REFUSED
from legcal.calibration.session_changes import Kind
from legcal.calibration.verdict import judge
from legcal.machine.tolerance import TYPICAL, Tolerance
from legcal.report.calibration import next_steps, summary
from legcal.simulation.settings import Level

pytestmark = pytest.mark.usefixtures("without_steps")
RESULTS = Path(__file__).parents[1] / "docs/results.md"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outlines of a planar machine in three views."""
    return simulated(tmp_path_factory.mktemp("doubts") / "set", "3-rpr", poses=10, views=3).folder


@pytest.fixture(scope="module")
def calibrated(
    session: Path, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[Edit], Calibration]:
    """Calibrations of that session after something was done to it, each made once."""

    @cache
    def after(spoil: Edit) -> Calibration:
        folder = _copy(session, tmp_path_factory.mktemp("spoiled"))
        spoil(folder)
        return calibrate(folder)

    return after


def _nothing(folder: Path) -> None:
    pass


@pytest.fixture(scope="module")
def healthy(calibrated: Callable[[Edit], Calibration]) -> Calibration:
    """The calibration of that session."""
    return calibrated(_nothing)


def _copy(session: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(session, tmp_path / "set"))


def _rejected(is_out: Callable[[dict[str, str]], bool], why: str = "faint") -> Edit:
    def change(row: dict[str, str]) -> None:
        if is_out(row):
            row |= {"verdict": "rejected", "reason": why}

    return each_row("observations.csv", change)


def _number(name: str) -> int:
    return int(name[1:])


def _backlash(row: dict[str, str]) -> None:
    if _number(row["pose"]) % 2:
        row["leg1_prismatic"] = str(float(row["leg1_prismatic"]) + 1e-3)


BACKLASH = each_row("measurements.csv", _backlash)


def _stretched(row: dict[str, str]) -> None:
    for name in row:
        if name not in ("view", "image", "pose"):
            row[name] = repr(0.94 * float(row[name]))


def _overrated(row: dict[str, str]) -> None:
    row |= {name: repr(0.1 * float(row[name])) for name in ("s00", "s01", "s11")}


def _tolerance_and_hint(found: dict[str, Any]) -> None:
    found["tolerance"] = {"joints": "20 um"}
    found["views"]["c2"]["T_base_camera"]["xyz"][0] += 0.3


_stated_wrongly = document("dataset.yaml", _tolerance_and_hint)


@pytest.mark.parametrize(
    ("code", "spoil", "said"),
    [
        ("noise", each_row("observations.csv", _overrated), "all views scatter"),
        ("reading_noise", BACKLASH, "leg1 scatter"),
        ("view_left_out", _rejected(lambda row: row["view"] == "c3"), "view c3"),
        ("images_left_out", _rejected(lambda row: _number(row["image"]) % 3 == 0), "10 of 30"),
        ("few_outlines", _rejected(lambda row: row["edge"] == "1"), "50 %"),
        (
            "not_round",
            _rejected(lambda row: "_rod" in row["part"] and _number(row["image"]) % 3 > 0, "width"),
            "leg1_rod",
        ),
        ("tolerance", _stated_wrongly, "tolerance 0.02"),
        ("strayed_camera", _stated_wrongly, "view c2"),
        ("scale", each_row("measurements.csv", _stretched), "travel of the motors alone"),
    ],
)
def test_a_doubt_is_raised_by_what_it_is_about(
    code: str, spoil: Edit, said: str, calibrated: Callable[[Edit], Calibration]
) -> None:
    calibration = calibrated(spoil)
    (doubt,) = [one for one in calibration.doubts if one.code == code]
    assert said in doubt.what
    assert not calibration.verdict.trustworthy
    assert not calibration.verdict.is_to_be_refused
    assert calibration.verdict.sentence.startswith("In doubt: the platform moves by ")
    assert "known to " in calibration.verdict.sentence


def _length(machine: Machine, other: str, times: float = 1.0) -> str:
    """Return the distance of the base joints of leg1 and another leg as somebody stated it."""
    base = dict(zip(machine.leg_names, machine.A_base, strict=True))
    length = 1e3 * times * float(np.linalg.norm(base["leg1"] - base[other]))
    return f"leg1.base:{other}.base={length:.6f}+-0.05mm"


def test_the_witness_of_the_scale_that_others_contradict_is_named_alone(session: Path) -> None:
    true = load_mechanism(next((session / "truth/models").glob("*.yaml")))
    calibration = calibrate(session, priors=[_length(true, "leg2", 1.02)])
    (doubt,) = calibration.doubts
    assert doubt.code == "scale"
    assert "the machine is 2 % larger than by" in doubt.what
    wrong = "the stated leg1.base:leg2.base"
    assert f"the likelier wrong is {wrong}, as the others agree without it" in doubt.what
    assert doubt.sigma_dX_m is not None
    assert calibration.platform is not None
    assert doubt.sigma_dX_m > calibration.platform.sigma.mean_displacement


def test_a_stated_length_that_is_the_nominal_one_is_asked_about(session: Path) -> None:
    nominal = _length(load_dataset(session).machine, "leg2")
    beside_travel = calibrate(session, priors=[nominal])
    assert any("is the nominal one to all digits" in note for note in beside_travel.notes)


@pytest.mark.system
def test_a_nominal_length_alone_puts_a_result_in_doubt(tmp_path: Path) -> None:
    settings = SimulationSettings(level=Level.OUTLINES, poses=6, views=2, seed=1)
    folder = simulate("delta", tmp_path / "set", settings).folder
    alone = calibrate(folder, priors=[_length(load_dataset(folder).machine, "leg3")])
    assert [one.code for one in alone.doubts] == ["nominal_length"]
    assert "was it measured?" in alone.verdict.sentence


def _judged(calibration: Calibration, **changes: Any) -> Calibration:
    solution = replace(calibration.solution, **changes)
    return judge(calibration.dataset, solution, calibration.steps, ())


def test_a_camera_that_is_contradicted_has_its_effect_on_the_platform(healthy: Calibration) -> None:
    solution = healthy.solution
    shared = solution.sensitivities[ALL_READINGS]
    focal = 0.01 * shared
    fx, change, sigma = np.array([[500.0], [0.02], [0.003]])
    wrong = WrongIntrinsic("focal_length", "c1", fx, change, sigma, 7.0, np.zeros((2, 5)))
    changes = {
        "camera_doubts": (wrong,),
        "sensitivities": {ALL_READINGS: shared, FITTED_CAMERA: focal},
    }
    found = _judged(healthy, **changes)
    (doubt,) = found.doubts
    assert found.platform is not None
    effect = found.platform.effects[FITTED_CAMERA]
    assert (doubt.code, doubt.sigma_dX_m) == ("camera", effect.mean_displacement)
    assert model_error(found.doubts) == (effect.mean_displacement, effect.mean_rotation)
    by_half = 0.7 * found.platform.change.mean_displacement / effect.mean_displacement
    for size in (by_half, 1e4):  # the cause of too small an improvement comes first
        large = {"sensitivities": {FITTED_CAMERA: size * focal}}
        found = _judged(healthy, **changes | large)
        assert [one.code for one in found.doubts] == ["camera", "no_improvement"]
        assert found.doubts[1].remedy.endswith("calibrate the camera again")
        assert found.doubts[0].is_grave == (size > by_half)
        assert found.verdict.is_to_be_refused


def test_too_small_an_improvement_is_said_before_what_has_no_part_in_it(
    healthy: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, place = Doubt("few_outlines", "few", "a"), Doubt("strayed_camera", "far", "b")
    monkeypatch.setattr(verdict, "doubts_of", lambda *_: (place, camera))
    monkeypatch.setattr(verdict, "TRUSTED_SIGMAS", 1e6)
    found = _judged(healthy)
    codes = [one.code for one in found.doubts]
    assert codes == ["few_outlines", "no_improvement", "strayed_camera"]
    assert "do not show that this model is better" in found.doubts[1].what
    assert found.doubts[1].remedy.startswith("keep the nominal one, or take many more images")
    monkeypatch.setattr(verdict, "platform_accuracy", lambda *_: None)
    found = _judged(healthy)
    assert found.doubts[1].what.startswith("the change of joints and lengths is ")


def test_a_platform_no_better_known_than_built_has_tolerances_as_its_next_step(
    healthy: Calibration,
) -> None:
    """As well as is stated, else as printed machines are; not of what has had them as priors."""

    def offered(calibration: Calibration) -> list[str]:
        steps = next_steps(calibration, "out", "legcal calibrate set --output=out")
        return [one.what for one in steps if one.command.endswith(" out-zeros --only zeros")]

    kinematic, machine = healthy.solution.kinematic, healthy.dataset.machine
    assert healthy.platform is not None
    known = (healthy.platform.workspace or healthy.platform.sigma).mean_displacement
    assert offered(healthy) == []
    times = (0.6e-3 / known) ** 2
    vague = _judged(healthy, kinematic=replace(kinematic, covariance=times * kinematic.covariance))
    (what,) = offered(vague)
    assert "machine_kind" in what
    stated = replace(machine, tolerance=replace(machine.tolerance, joints=0.5 * known))
    (what,) = offered(replace(healthy, dataset=replace(healthy.dataset, machine=stated)))
    assert "machine_kind" not in what


def test_left_out_images_contradict_a_model_that_was_led_away(healthy: Calibration) -> None:
    posterior = healthy.solution.posterior
    found = cross_validate(posterior.problem, posterior.state)
    assert found is not None
    assert 0.7 < found.ratio < 1.2
    assert found.gain == pytest.approx(1.0, abs=0.1)
    first, *others = posterior.state.legs
    away = replace(first, B=first.B + np.array([0.03, 0.0, 0.0]))
    state = replace(posterior.state, legs=(away, *others))
    codes = {one.code for one in _judged(healthy, posterior=replace(posterior, state=state)).doubts}
    assert {"left_out", "no_better"} <= codes


def _documented() -> dict[str, set[str]]:
    """Return the lights of each code in the table of the documentation."""
    rows = [line.split("|") for line in RESULTS.read_text().splitlines() if line.startswith("| `")]
    lights = dict[str, set[str]]()
    for row in rows:
        for code in re.findall(r"`(\w+)`", row[1]):
            colours = {light for light in ("amber", "red") if light in row[2]}
            lights[code] = lights.get(code, set()) | colours
    return {code: colours for code, colours in lights.items() if colours}


def test_every_doubt_is_documented_with_its_light() -> None:
    files = (Path(module.__file__ or "") for module in (doubts, verdict))
    made = dict[str, set[str]]()
    for call in (node for file in files for node in ast.walk(ast.parse(file.read_text()))):
        if not (isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Doubt"):
            continue
        code = call.args[0]
        is_grave = any(keyword.arg == "is_grave" for keyword in call.keywords)
        if isinstance(code, ast.Constant):
            made.setdefault(str(code.value), set()).add("red" if is_grave else "amber")
    made |= {kind: {"amber"} for kind in (doubts.CAMERA, doubts.TOLERANCE, *get_args(Kind))}
    assert made == _documented()


# One of each set of lights, and those that have a part of their own in the verdict
SHOWN = {frozenset(lights): code for code, lights in sorted(_documented().items())}


@pytest.mark.parametrize("code", sorted({*SHOWN.values(), doubts.CAMERA, "nominal_length"}))
def test_verdict_document_summary_and_next_step_follow_any_doubt(
    code: str, healthy: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    for light in _documented()[code]:
        doubt = Doubt(code, "something is wrong", "mend it", 1e-6, 1e-6, light == "red")
        monkeypatch.setattr(verdict, "doubts_of", lambda *_, one=doubt: (one,))
        found = _judged(healthy)
        assert not found.verdict.trustworthy
        assert found.verdict.is_to_be_refused == (light == "red")
        heading = {"red": "Do not load this into the controller", "amber": "In doubt"}[light]
        assert found.verdict.sentence.startswith(f"{heading}: the platform moves by ")
        assert "what is in doubt may add 0.001 mm" in found.verdict.sentence
        document = found.result.document()
        names = ("code", "what", "sigma_dX_m", "sigma_dE_rad", "remedy")
        assert (document["trustworthy"], document["verdict"]) == (False, found.verdict.sentence)
        assert document["doubts"] == [{name: getattr(doubt, name) for name in names}]
        assert found.verdict.sentence in found.summary()
        first = next_steps(found, "out", "")[0]
        assert first.what == "Something is wrong. Mend it, and calibrate again."


@pytest.mark.parametrize("count", [0, 8])
def test_the_first_screen_has_24_lines_of_80_columns(
    count: int, healthy: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    what = "the readings of leg3 scatter by 0.117 mm where 0.002 mm are stated, as commands would"
    remedy = "read the encoders in place of the commands, or state encoder_sigma: 0.117 mm"
    doubts = tuple(Doubt("readings", what, remedy, 1e-6, 1e-6, False) for _ in range(count))
    monkeypatch.setattr(verdict, "doubts_of", lambda *_: doubts)
    found = _judged(healthy)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(summary(found, Path("out"), "legcal calibrate dataset -o out"))
    lines = console.export_text().splitlines()
    assert len(lines) <= 24
    assert " ".join(" ".join(lines).split()).startswith(found.verdict.sentence)
    assert max(map(len, lines)) <= 80
    assert ("Next: " in "".join(lines)) == (count == 0)
    assert "Written to out." in " ".join(lines)


@pytest.mark.parametrize("spoil", [_nothing, BACKLASH])
def test_exit_code_document_summary_and_page_agree(
    spoil: Edit,
    calibrated: Callable[[Edit], Calibration],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calibration, out = calibrated(spoil), tmp_path / "result"
    folder = calibration.dataset.folder
    again = Run(folder, out, calibration, ()).written_again
    monkeypatch.setattr("legcal.calibration.pipeline.calibrate", again)
    outcome = run("calibrate", folder, "-o", out, "--json")
    code, printed = outcome.code, outcome.document
    following = printed.pop("next")  # in what is printed alone
    written = load_result(out).result
    read = load_result(out).verdict
    assert (read.sentence, read.doubts) == (calibration.verdict.sentence, calibration.doubts)
    amber, red = Doubt("camera", "a", "b"), Doubt("no_improvement", "c", "d", is_grave=True)
    changes = {"doubts": (amber, red), "verdict": REFUSED}
    led = replace(load_result(out), document=written.model_copy(update=changes)).verdict
    assert led.doubts == (amber, red)
    page: Any = html.document_fromstring((out / "report.html").read_text())
    light, first = (
        page.xpath("//section[@id='verdict']/@class")[0],
        page.xpath("string((//section[@id='next']//li)[1])"),
    )
    assert written.document() == printed
    assert following[0]["what"] in first
    assert printed["verdict"] in page.xpath("string(//section[@id='verdict'])")
    assert printed["verdict"] in load_result(out).summary()
    if spoil is _nothing:
        assert (code, printed["trustworthy"], printed["doubts"]) == (0, True, [])
        assert "good" in light
        assert "Load calibrated.urdf" in first
    else:
        assert (code, printed["trustworthy"]) == (1, False)
        doubt = printed["doubts"][0]
        assert doubt["what"][1:] in first
        assert doubt["remedy"][1:] in first
        assert doubt["what"][1:] in printed["verdict"]
        assert "doubtful" in light
        assert "Load calibrated.urdf" not in page.xpath("string(//section[@id='next'])")


def test_tolerances_are_stated_with_units_or_by_the_kind_of_machine(
    session: Path, tmp_path: Path
) -> None:
    folder = _copy(session, tmp_path)
    stated = {"joints": "0.3 mm", "axes": "0.5 deg", "lengths": 1e-4, "zeros": "5 deg"}
    stated["travel"] = "0.02%"
    keyed("dataset.yaml", tolerance=stated)(folder)
    tolerance = load_dataset(folder).machine.tolerance
    assert tolerance == Tolerance(3e-4, np.radians(0.5), 1e-4, None, np.radians(5.0), 2e-4)
    model = next((folder / "models").glob("*.yaml"))
    keyed(model.name, legcal__machine_kind="printed")(model.parent)
    assert load_dataset(folder).machine.tolerance == tolerance
    keyed("dataset.yaml", tolerance=GONE)(folder)
    assert load_dataset(folder).machine.tolerance == TYPICAL["printed"]
