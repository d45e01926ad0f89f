"""``legcal identify``: the document, the tables, and what is refused."""

import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hexapod_example import HEXAPOD
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanisms import SHIPPED_URDF, SHIPPED_YAML
from thinned import thinned

import legcal
from legcal import cli
from legcal.calibration.identify.identifiability import identifiability_of_dataset
from legcal.calibration.identify.report import WeakDirection
from legcal.calibration.identify.session import recorded_session
from legcal.data.dataset import load_dataset
from legcal.errors import UsageError
from legcal.machine import Machine
from legcal.machine.family import Family, describe_family
from legcal.machine.new_model import create_model
from legcal.report.identify import _hidden, _two_digits

PAPER = ("leg1,leg2,leg3,leg4", "leg3,leg4,leg5,leg6", "leg1,leg2,leg5,leg6")
MODELS = sorted(path.stem for path in SHIPPED_YAML.parent.glob("*.yaml"))


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """Run the command line in this process and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["legcal", "identify", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


@cache
def loaded(name: str) -> Machine:
    return legcal.load_mechanism(name)


def options(views: tuple[str, ...]) -> Iterator[str]:
    for view in views:
        yield from ("--view", view)


def test_json_is_one_document_with_the_keys_of_the_contract(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "hexapod", *options(PAPER), "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert {k: document[k] for k in ("spatial", "n", "n_d", "r", "n_ac")} == {
        "spatial": True, "n": 6, "n_d": 3, "r": 0, "n_ac": 6,
    }  # fmt: skip
    assert document["conditions"][0] == {
        "name": "eq12", "equations": 18, "unknowns": 12, "ok": True,
    }  # fmt: skip
    assert [c["name"] for c in document["conditions"]] == [
        "eq12", "eq15", "eq17", "every_leg_seen", "two_directions", "three_legs_at_once",
    ]  # fmt: skip
    assert document["paper"] == {"ok": True}
    assert document["staged"] == document["full"] == {"rank": 30, "of": 30, "weak": []}
    assert document["identifiable"] is True
    assert document["recommendation"] is None
    assert document["views"] == [view.split(",") for view in PAPER]


def test_the_api_returns_the_same_object() -> None:
    machine = loaded("hexapod")
    views = [view.split(",") for view in PAPER]
    first, again = (legcal.identifiability(machine, views, images=5) for _ in range(2))
    assert first.document() == again.document()
    assert (first.full.rank, first.conditions_hold, first.images) == (30, True, (5, 5, 5))
    assert first == again


@pytest.mark.parametrize("name", thinned(MODELS, ["hexapod", "3-rpr", "3-upu", "tricept"]))
@pytest.mark.parametrize("views", [(), ((0, 1), (1, 2))])
def test_tables_fit_80_columns_and_say_the_verdict(
    name: str,
    views: tuple[tuple[int, ...], ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    legs = yaml.safe_load((SHIPPED_YAML.parent / f"{name}.yaml").read_text())["legcal"]["legs"]
    chosen = tuple(",".join(list(legs)[j] for j in view) for view in views)
    assert run(monkeypatch, name, *options(chosen)) == 0
    out = capsys.readouterr().out
    assert max(len(line) for line in out.splitlines()) <= 80
    assert "dentifiable: the joint fit" in out or "NOT identifiable" in out
    assert ("smallest sets of views" in out) == (not views)


def test_weak_directions_and_remedies_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    weak = ("leg1,leg2,leg3,leg4,leg5", "leg1,leg2,leg3,leg4,leg5", "leg5,leg6")
    assert run(monkeypatch, "hexapod", *options(weak)) == 0
    out = capsys.readouterr().out
    assert "z of base joint 6" in out
    assert "add a fourth camera position" in out
    assert "calibration starts from the nominal model" in " ".join(out.split())


@pytest.mark.parametrize(
    ("words", "code", "kind", "said"),
    [
        (("hexapod", "--view", "leg1,lge2"), 2, "UsageError", "View 1 could not be used: found 'l"),
        (("hexapod", "--view", "leg1,lge2"), 2, "UsageError", "did you mean 'leg2'?"),
        (("hexapod", "--view", ""), 2, "UsageError", "found an empty text after '--view'"),
        (("hexapod", "--view", ","), 2, "UsageError", "found no leg, needed at least one"),
        (("hexapod", "--view", "leg1,,leg2"), 2, "UsageError", "found '', needed a leg"),
        (("hexapod", "--view", "leg1, leg1"), 2, "UsageError", "found leg 'leg1' 2 times"),
        (("hexapod", "--images", "0"), 2, "UsageError", "found 0 images a view"),
        (("hexapod", "--images", "2001"), 2, "UsageError", "found 2001 images a view, needed at"),
        (
            ("hexapod", *options(("leg1",) * 51)),
            2,
            "UsageError",
            "found 51 of them, needed",
        ),
        (("hexapod", "--images", "many"), 2, "UsageError", "'--images'"),
        ((HEXAPOD, "--view", "leg1"), 2, "UsageError", "could not be judged with --view"),
        ((HEXAPOD, "--images", "3"), 2, "UsageError", "could not be judged with --images"),
        (("nowhere.yaml",), 2, "ModelError", "nowhere.yaml"),
        ((), 2, "UsageError", "MODEL|DATASET"),
    ],
)
def test_refusals_are_one_sentence_in_one_document(
    words: tuple[str | Path, ...],
    code: int,
    kind: str,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(monkeypatch, *words, "--json") == code
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["kind"] == kind
    assert said in error["message"]


def test_numbers_beyond_sense_are_told_as_bounds() -> None:
    def hidden(dX_m: float, dE_rad: float) -> tuple[str, str]:
        return _hidden(WeakDirection("x", ("leg1.base.x",), (1.0,), dX_m, dE_rad, False))

    assert hidden(0.0123, 0.01) == ("12.30", "0.573")
    assert hidden(14.9, 50.0) == ("> 1000", "> 180")
    assert [_two_digits(x) for x in (0.0123, 12.3, 114.0)] == ["0.012", "12", "110"]


def test_all_problems_of_views_are_told_at_once() -> None:
    machine = loaded("hexapod")
    views: list[Any] = [["leg7"], [], ["leg1", "leg1"], ["leg1", 2], "leg1"]
    with pytest.raises(UsageError) as refused:
        legcal.identifiability(machine, views, images=-1)
    assert len(refused.value.problems) == 6
    assert "View 4 could not be used: found 2, needed names" in refused.value.problems[-2]
    assert "found the text 'leg1'" in refused.value.problems[-1]


def test_a_dataset_is_judged_by_its_own_readings_cameras_and_legs(tmp_path: Path) -> None:
    dataset = load_dataset(HEXAPOD, check_images=False)
    session, m = recorded_session(dataset), dataset.measurements
    assert (session.n_views, len(session.view), len(session.t)) == (3, m.n_rows, m.n_poses)
    q = (session.length - dataset.machine.q0) * dataset.machine.sign
    np.testing.assert_allclose(q, m.q[m.first_rows], atol=1e-5)
    to_Rb = dataset.machine.T_base_Rb.inv()
    for camera, view in zip(session.camera, m.views, strict=True):
        if view.T_base_camera is not None:
            np.testing.assert_allclose(camera, (to_Rb * view.T_base_camera).translation)
    found = identifiability_of_dataset(dataset)
    assert found.identifiable
    assert found.recommendation is None
    assert (found.full.rank, sum(found.images)) == (30, m.n_rows)


def test_the_legs_of_a_datasets_views_count(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    entry = yaml.safe_load((HEXAPOD / "dataset.yaml").read_text())
    entry["mechanism"] = str((HEXAPOD / entry["mechanism"]).resolve())
    for view in entry["views"].values():
        view["legs"] = ["leg1", "leg2"]
        camera = HEXAPOD / view["camera"]
        (tmp_path / view["camera"]).write_text(camera.read_text())
    (tmp_path / "dataset.yaml").write_text(yaml.safe_dump(entry))
    table = entry["measurements"]
    (tmp_path / table).write_text((HEXAPOD / table).read_text())
    assert run(monkeypatch, tmp_path, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["views"] == [["leg1", "leg2"]] * 3
    assert not document["paper"]["ok"]


def test_without_enough_motors_ranks_are_told_and_what_is_not_predicted(tmp_path: Path) -> None:
    entry = yaml.safe_load(SHIPPED_YAML.read_text())
    entry["name_mot"] = entry["name_mot"][:-1]
    entry["legcal"]["urdf"] = "hexapod.urdf"
    (tmp_path / "hexapod.urdf").write_text(SHIPPED_URDF.read_text())
    (tmp_path / "hexapod.yaml").write_text(yaml.safe_dump(entry))
    machine = legcal.load_mechanism(tmp_path / "hexapod.yaml")
    found = legcal.identifiability(machine, [machine.leg_names] * 2)
    assert (found.full.rank, found.full.of, found.n_ac) == (29, 29, 5)
    assert found.platform_sigma is None
    assert "5 motors do not determine the pose" in found.notes[0]
    few = legcal.identifiability(machine, [["leg1", "leg2"]])
    assert few.full.weak[0].dX_m is None
    assert not few.identifiable


def test_what_is_odd_about_a_machine_is_noted(tmp_path: Path) -> None:
    asked = Family("6-SPS", "mm", 300.0, 150.0, 400.0, 60.0, 60.0)  # regular hexagons
    machine = create_model(describe_family(asked), tmp_path).machine
    text = machine.urdf_path.read_text()
    text = re.sub(r'(<link name="leg1_\w+">)<visual>.*</visual>', r"\1", text)
    machine.urdf_path.write_text(text)
    *_, hidden, singular = legcal.identifiability(
        legcal.load_mechanism(machine.yaml_path), [machine.leg_names]
    ).notes
    assert hidden.startswith("The model has no <visual> cylinder along leg 1:")
    assert singular.startswith("The mechanism is singular at home: the platform moves")


@settings(deadline=None, max_examples=10)
@given(data=st.data())
def test_any_views_of_any_model_are_judged(data: st.DataObject) -> None:
    machine = loaded(data.draw(st.sampled_from(MODELS)))
    view = st.sets(st.sampled_from(machine.leg_names), min_size=1).map(sorted)
    views = data.draw(st.lists(view, min_size=1, max_size=3))
    images = data.draw(st.integers(1, 6))
    found = legcal.identifiability(machine, views, images=images)
    document = found.document()
    json.dumps(document, allow_nan=False)
    for ranks in (found.staged, found.full):
        assert ranks.rank + len(ranks.weak) == ranks.of
    assert found.identifiable == all(d.harmless for d in found.full.weak)
    if images > 4 and found.staged.complete:  # a step takes those before it as known: with hardly
        assert found.full.complete  # any data it determines what all together hardly do
