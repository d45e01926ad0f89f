"""Commands, refusals and the Python API give what was recorded."""

from __future__ import annotations

import csv
import dataclasses
import inspect
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import legcal
from characterisation.cases import CASES, Case
from characterisation.comparison import (
    NO_SCALE,
    Scale,
    differences,
    scale_of,
    without_verdict,
)
from characterisation.facts import facts
from characterisation.inputs import copy_of, made_input, remove_inputs
from characterisation.record import (
    expected_path,
    public_api,
    recorded,
)
from characterisation.refusals import REFUSALS, Refusal
from characterisation.running import run


@pytest.fixture(scope="module", autouse=True)
def _inputs() -> Iterator[None]:
    yield
    remove_inputs()


def _marked(case: Case) -> Any:
    marks = [pytest.mark.slow] * case.slow + [pytest.mark.system] * case.system
    return pytest.param(case, id=case.name, marks=marks)


@pytest.mark.parametrize("case", [_marked(case) for case in CASES])
def test_commands_give_what_was_recorded(case: Case, tmp_path: Path) -> None:
    expected = recorded(case.name)
    found = json.loads(json.dumps(case.observe(tmp_path)))
    assert expected.keys() == found.keys()
    told = [
        line
        for part in expected.keys() - {"steps"}
        for line in differences(expected[part], found[part], NO_SCALE, f".{part}")
    ]
    rough = case.is_rough
    scale = Scale({}, rough)
    for number, step in enumerate(expected.get("steps", [])):
        other = found["steps"][number]
        for part in ("document", "files"):
            own = scale_of(step.get(part, {}), rough=rough)
            scale = own if own.sigma else scale
        if rough and case.slow:  # few small images state errors near what is trusted
            step, other = without_verdict(step), without_verdict(other)
        told += differences(step, other, scale, f".steps[{number}]")
    assert told == []


@pytest.mark.parametrize("refusal", [pytest.param(r, id=r.name) for r in REFUSALS])
def test_refusals_name_what_is_wrong_and_leave_nothing(refusal: Refusal, tmp_path: Path) -> None:
    found = refusal.observe(tmp_path)
    message, changed = found.pop("message"), found.pop("changed")
    assert found == recorded("refusals")[refusal.name]
    named = [word.replace("{in}", str(tmp_path / "in")) for word in refusal.named]
    assert [word for word in named if word not in message] == []
    assert changed == []


def test_every_recorded_case_is_there() -> None:
    names = {case.name for case in CASES} | {"api", "refusals", "places"}
    assert {path.stem for path in expected_path("x").parent.glob("*.json")} == names
    assert len({case.name for case in CASES}) == len(CASES)
    assert {refusal.name for refusal in REFUSALS} == recorded("refusals").keys()


def test_the_public_api_has_the_names_and_parameters_that_it_had() -> None:
    expected, found = recorded("api"), public_api()
    assert expected.keys() <= found.keys()  # more may be added
    for name, entry in expected.items():
        first = found[name]["parameters"][: len(entry["parameters"])]  # more may follow
        assert first == entry["parameters"], name
        assert set(entry["members"]) <= set(found[name]["members"]), name


def test_python_gives_what_commands_give(tmp_path: Path) -> None:
    folder = copy_of("3-rpr-axes", tmp_path / "set")
    truth = folder / "truth/models/3-rpr.yaml"
    nominal = legcal.load_mechanism("3-rpr")
    dataset = legcal.load_dataset(folder)
    calibration = legcal.calibrate(dataset, output=tmp_path / "calibrated")
    document = recorded("3-rpr-axes")["steps"][0]["document"]
    estimated = [p for p in document["parameters"] if p["status"] == "estimated"]
    assert list(calibration.solution.estimates.names) == [p["name"] for p in estimated]
    for p, sigma in zip(estimated, calibration.solution.estimates.sigma, strict=True):
        found = {"name": p["name"], "value": calibration.solution.estimates.values[p["name"]]}
        expected = {"name": p["name"], "value": p["value"], "sigma": p["sigma"]}
        assert differences(expected, found | {"sigma": float(sigma)}) == []
    assert calibration.verdict.sentence
    assert calibration.verdict.trustworthy is document["trustworthy"]
    compared = recorded("3-rpr-axes")["steps"][1]["document"]
    apart = legcal.evaluate(tmp_path / "calibrated/calibrated.yaml", truth, dataset=folder)
    assert apart.displacement.mean() == pytest.approx(compared["dX_m"], rel=0.02)
    assert apart.rotation.mean() == pytest.approx(compared["dE_rad"], rel=0.02)
    before = legcal.evaluate(nominal, truth, dataset=folder)
    assert before.displacement.mean() > 5.0 * apart.displacement.mean()


def test_python_simulates_locates_and_judges(tmp_path: Path) -> None:
    level: Any = "axes"  # names instead of members, as in docs/simulate.md
    normal: Any = "normal"
    settings = legcal.SimulationSettings(
        level=level, poses=2, seed=1, views=1,
        errors=legcal.ParameterErrors(
            base_joints=legcal.Spread(1e-3), offsets=legcal.Spread(5e-4, normal)
        ),
        readings=legcal.Spread(2e-6, normal), table=legcal.TableNoise(x=1e-4),
    )  # fmt: skip
    made = legcal.simulate("3-rpr", tmp_path / "sim", settings)
    apart = legcal.evaluate(made.nominal, made.truth)
    assert 0.0 < apart.displacement.mean() < 0.01
    assert made.measurements is not None
    assert made.seen is not None
    report = legcal.identifiability(made.nominal, [["leg1", "leg2", "leg3"]])
    assert report.full.of == 9
    assert report.document()["n"] == 3
    given = made_input("tool-poses")
    location = legcal.locate(given / "hexapod/models/hexapod.yaml", given / "hexapod.csv")
    legcal.write_location(location, tmp_path / "cell.yaml")
    assert legcal.load_location(tmp_path / "cell.yaml").status == location.status == "located"
    with pytest.raises(legcal.LegcalError) as refused:
        legcal.load_mechanism("octopod")
    assert refused.value.exit_code == 2
    assert len(refused.value.problems) == 1


def _reversed_table(path: Path) -> None:
    with path.open(newline="") as file:
        header, *rows = [line[::-1] for line in csv.reader(file)]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows[::-1]])


def _reversed_session(folder: Path) -> None:
    """Turn around the order of views, rows and columns."""
    for path in folder.glob("*.csv"):
        _reversed_table(path)
    entry = yaml.safe_load((folder / "dataset.yaml").read_text())
    entry["views"] = dict(reversed(entry["views"].items()))
    (folder / "dataset.yaml").write_text(yaml.safe_dump(entry, sort_keys=False))


def _calibrated(folder: Path, *words: str, many: bool = False) -> Any:
    command = ["calibrate", str(folder), "-o", f"{folder}-result", "--json", *words]
    return facts(run(command, many=many).document)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["3-rpr-axes", "3-rpr-outlines"])
def test_order_does_not_matter(name: str, tmp_path: Path) -> None:
    found = []
    for change in (lambda folder: None, _reversed_session):
        folder = copy_of(name, tmp_path / change.__name__.strip("<>"))
        change(folder)
        found.append({p["name"]: p for p in _calibrated(folder)["parameters"]})
    one, other = found
    assert one.keys() == other.keys()
    for parameter, row in one.items():
        if row["sigma"]:
            assert abs(row["value"] - other[parameter]["value"]) < 1e-5 * row["sigma"]
            assert other[parameter]["sigma"] == pytest.approx(row["sigma"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod-photographs", "3-upu-photographs"])
def test_cached_fresh_and_parallel_runs_agree(name: str, tmp_path: Path) -> None:
    folder = copy_of(name, tmp_path / "set")
    found = []
    for words, many in ((), False), ((), False), (("--fresh",), True):
        result = _calibrated(folder, *words, many=many)
        found.append((result, (folder / "observations.csv").read_bytes()))
        assert (folder / ".legcal-cache.json").exists()
    (first, outlines), (cached, again), (parallel, others) = found
    assert again == others == outlines
    assert parallel == first  # bit by bit
    assert differences(first, cached, scale_of(first), "") == []
    for one, other in zip(first["parameters"], cached["parameters"], strict=True):
        if one["sigma"]:  # from another start
            assert abs(one["value"] - other["value"]) <= 1e-5 * one["sigma"]
        elif one["status"] == "fixed":
            assert one["value"] == other["value"]


def test_what_is_recorded_holds_no_sentence() -> None:
    for path in expected_path("x").parent.glob("*.json"):
        texts = re.findall(r'"([^"]*)"', path.read_text())
        assert [text for text in texts if re.search(r"[a-z]+ [a-z]+ [a-z]+", text)] == []


def test_settings_of_simulations_can_be_changed() -> None:
    assert {"level", "poses", "views", "seed", "errors"} <= {
        field.name for field in dataclasses.fields(legcal.SimulationSettings)
    }
    assert legcal.Appearance.clean() is not None
    assert inspect.isclass(legcal.Follower)
