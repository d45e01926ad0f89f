"""What a calibration tells of a machine with axes, rods or too few motors."""

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from rich.console import Console
from simulated import settings

from legcal import calibrate, evaluate, load_dataset, load_mechanism, simulate
from legcal.calibration import Calibration, judge
from legcal.errors import DidNotConverge
from legcal.mechanism.parametrization import geometries
from legcal.report.result import result_document, write_result
from legcal.report.summary import summary


class Calibrated(NamedTuple):
    """A simulated dataset, what was made of it, and what was written."""

    dataset: Path
    calibration: Calibration
    output: Path
    document: dict[str, Any]


@pytest.fixture(scope="module")
def upu(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """A 3-UPU with tilted axes, of which everything but twists is looked for."""
    folder = tmp_path_factory.mktemp("upu")
    simulate("3-upu-tilted", folder / "sim", settings(poses=8, views=3))
    calibration = calibrate(folder / "sim", output=folder / "out")
    document = json.loads((folder / "out" / "result.json").read_text())
    return Calibrated(folder / "sim", calibration, folder / "out", document)


def _text(calibration: Calibration) -> str:
    """Return what people read of a calibration."""
    console = Console(file=io.StringIO(), width=1000)
    console.print(summary(calibration, Path("out")))
    text = console.file
    assert isinstance(text, io.StringIO)
    return text.getvalue()


def _numbers(entry: object) -> list[float]:
    """Return the numbers of a part of a document, in their order."""
    if isinstance(entry, dict):
        entry = list(entry.values())
    if isinstance(entry, list):
        return [number for part in entry for number in _numbers(part)]
    return [entry] if isinstance(entry, (int, float)) else []


def test_the_document_tells_axes_and_twists(upu: Calibrated) -> None:
    document, legs = upu.document, geometries(load_mechanism(upu.output / "calibrated.yaml"))
    for key in ("base_axes", "platform_axes"):
        assert list(document[key]) == ["leg1", "leg2", "leg3"]
    for name, leg in zip(document["legs"], legs, strict=True):
        assert leg.base_axis is not None
        assert leg.platform_axis is not None
        assert abs(leg.base_axis @ document["base_axes"][name]) == pytest.approx(1.0, abs=1e-12)
        across = np.cross(leg.platform_axis, document["platform_axes"][name])
        assert np.abs(across).max() < 1e-11
        assert document["twists"][name] == pytest.approx(leg.twist, abs=1e-11)
    np.testing.assert_allclose(document["offsets"], [leg.q0 for leg in legs], atol=1e-11)
    np.testing.assert_allclose(document["base_joints"], [leg.A for leg in legs], atol=1e-11)
    np.testing.assert_allclose(document["platform_joints"], [leg.B for leg in legs], atol=1e-11)


def test_the_covariance_is_that_of_the_estimated_rows(upu: Calibrated) -> None:
    rows = upu.document["parameters"]
    sigma = [row["sigma"] for row in rows if row["status"] == "estimated"]
    covariance = np.array(upu.document["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), sigma, rtol=1e-12)
    units = {row["name"]: row["unit"] for row in rows}
    assert units["leg1.base_axis.1"] == units["leg2.twist"] == "rad"
    fixed = [row for row in rows if row["status"] == "fixed"]
    assert [row["name"] for row in fixed] == [f"leg{j}.twist" for j in (1, 2, 3)]
    assert all(row["sigma"] is None for row in fixed)


def test_the_predicted_error_of_the_platform_is_the_one_it_has(upu: Calibrated) -> None:
    truth = load_dataset(upu.dataset).folder / "truth" / "models" / "3-upu-tilted.yaml"
    platform = upu.document["platform"]
    apart = evaluate(upu.output / "calibrated.yaml", truth, dataset=upu.dataset)
    assert apart.displacement.mean() < 3.0 * platform["sigma_dX_m"]
    assert apart.rotation.mean() < 3.0 * platform["sigma_dE_rad"]
    before = evaluate("3-upu-tilted", upu.output / "calibrated.yaml", dataset=upu.dataset)
    assert before.displacement.mean() == pytest.approx(platform["change_dX_m"], rel=1e-3)
    assert apart.displacement.mean() < 0.1 * before.displacement.mean()


def test_every_pose_and_the_workspace_have_their_predicted_error(upu: Calibrated) -> None:
    platform = upu.document["platform"]
    poses = platform["per_pose"]
    assert len(poses) == platform["poses"] == 24
    assert np.mean([p["sigma_dX_m"] for p in poses]) == pytest.approx(platform["sigma_dX_m"])
    assert max(p["sigma_dE_rad"] for p in poses) == platform["sigma_dE_max_rad"]
    workspace = platform["workspace"]
    assert workspace["poses"] == 100
    assert 0.0 < workspace["sigma_dX_m"] < workspace["sigma_dX_max_m"]
    told = {s["what"]: s["dX_m"] for s in platform["sensitivities"]}
    assert told["a focal length 1 % longer"] > platform["sigma_dX_m"]


def test_people_read_angles_in_degrees_and_what_mistakes_would_do(upu: Calibrated) -> None:
    text = _text(upu.calibration)
    (row,) = [row for row in upu.document["parameters"] if row["name"] == "leg2.base_axis.1"]
    line = next(line for line in text.splitlines() if line.startswith("leg2.base_axis.1"))
    assert line.split()[2:] == [
        f"{np.degrees(row['value']):.4f}",
        f"{np.degrees(row['value']):+.4f}",
        f"{np.degrees(row['sigma']):.4f}",
        "deg",
    ]
    twist = next(line for line in text.splitlines() if line.startswith("leg1.twist"))
    assert twist.split()[-2:] == ["deg", "fixed"]
    assert "over the workspace" in text
    assert "A focal length 1 % longer would move the platform by" in text
    assert "Known worst (1 sigma):" in text
    assert "-0.0000" not in text


def test_the_order_of_the_legs_in_the_model_does_not_matter(
    upu: Calibrated, tmp_path: Path
) -> None:
    shutil.copytree(upu.dataset, tmp_path / "sim")
    path = tmp_path / "sim" / "models" / "3-upu-tilted.yaml"
    model = yaml.safe_load(path.read_text())
    legs = model["legcal"]["legs"]
    model["legcal"]["legs"] = {name: legs[name] for name in ("leg3", "leg1", "leg2")}
    path.write_text(yaml.safe_dump(model, sort_keys=False))
    other = result_document(calibrate(tmp_path / "sim"))
    assert other["legs"] == ["leg3", "leg1", "leg2"]
    assert other["base_joints"] == [upu.document["base_joints"][j] for j in (2, 0, 1)]
    for key in ("base_axes", "platform_axes", "twists", "views"):
        assert other[key] == upu.document[key]
    rows = {row["name"]: row for row in upu.document["parameters"]}
    assert {row["name"]: row for row in other["parameters"]} == rows
    assert other["parameters"][0]["name"] == "leg3.base.x"
    names, others = (
        [row["name"] for row in document["parameters"] if row["status"] == "estimated"]
        for document in (upu.document, other)
    )
    where = [names.index(name) for name in others]
    covariance = np.array(upu.document["covariance"])[np.ix_(where, where)]
    np.testing.assert_array_equal(other["covariance"], covariance)
    told, expected = other["platform"], upu.document["platform"]
    for key in ("workspace", "sensitivities", "per_pose"):
        np.testing.assert_allclose(_numbers(told[key]), _numbers(expected[key]), rtol=1e-6)


def test_a_machine_whose_motors_do_not_determine_the_pose_is_judged_by_its_parameters(
    upu: Calibrated,
) -> None:
    done = upu.calibration
    dataset = replace(done.dataset, mechanism=replace(done.dataset.mechanism, mobility=4))
    free = judge(dataset, done.solution, done.steps, ())
    assert free.platform is None
    assert free.verdict.trustworthy
    assert "the motors do not determine the pose of the platform" in free.verdict.sentence
    assert result_document(free)["platform"] is None
    assert "Predicted error of the platform" not in _text(free)
    unsure = replace(done.solution, sigma=1e3 * done.solution.sigma)
    assert not judge(dataset, unsure, done.steps, ()).verdict.trustworthy


def test_a_model_that_cannot_be_loaded_as_computed_is_not_written(
    upu: Calibrated, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = upu.calibration.dataset.mechanism
    monkeypatch.setattr("legcal.report.result.reload_and_check", lambda path: other)
    with pytest.raises(DidNotConverge, match=r"its parameters differ by \d\.\de-0\d m or rad"):
        write_result(upu.calibration, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_legs_that_close_nowhere_near_home_are_not_written(upu: Calibrated, tmp_path: Path) -> None:
    solution = upu.calibration.solution
    away = replace(solution.legs[0], A=solution.legs[0].A + 5.0)
    lost = replace(upu.calibration, solution=replace(solution, legs=(away, *solution.legs[1:])))
    with pytest.raises(DidNotConverge, match="found no closed pose of its legs near"):
        write_result(lost, tmp_path / "out")
    assert not (tmp_path / "out").exists()
