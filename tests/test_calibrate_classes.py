"""Machines of every class from outlines, and images that cannot do it: one sentence, no result."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from simulated import settings

from legcal import calibrate, evaluate
from legcal.calibration.joint_fit.platform import poses_at_readings
from legcal.errors import LegcalError, NotIdentifiable, NotVisible
from legcal.machine import geometries, load_mechanism, pose_differences
from legcal.simulation.dataset import simulate

Row = dict[str, str]


@pytest.mark.parametrize("model", [pytest.param("3-upu", marks=pytest.mark.slow), "tricept"])
def test_a_machine_of_any_class_comes_much_nearer_to_its_truth(model: str, tmp_path: Path) -> None:
    made = simulate(model, tmp_path / "set", settings(poses=8, views=3))
    found = calibrate(made.folder, output=tmp_path / "result")
    before = evaluate(made.nominal.yaml_path, made.truth_path, dataset=made.folder)
    after = evaluate(tmp_path / "result/calibrated.yaml", made.truth_path, dataset=made.folder)
    assert found.verdict.trustworthy
    assert before.displacement.mean() > 1e-3
    assert after.displacement.mean() < 0.1 * before.displacement.mean()
    twists = {n: s for n, s in found.solution.status.items() if n.endswith(".twist")}
    assert twists
    assert "fixed" not in twists.values()
    legs = found.steps.legs
    assert legs is not None
    staged = json.loads((tmp_path / "result/result.json").read_text())["stages"]["staged"]
    names = found.dataset.machine.leg_names
    assert staged["twists"] == {
        name: leg.twist for name, leg in zip(names, legs, strict=True) if leg.twist is not None
    }
    assert staged["platform_axes"].keys() == staged["twists"].keys()


@pytest.mark.parametrize(
    "model",
    [
        "3-rpr",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("3-spr", "3-rps", "3-upu-tilted", "6-sps", "hexapod-rod", "hexapod-strut")
        ),
    ],
)
def test_the_steps_alone_come_nearer_to_the_truth(model: str, tmp_path: Path) -> None:
    made = simulate(model, tmp_path / "set", settings(poses=8, views=3))
    found = calibrate(made.folder, transformation="cross_product")
    assert found.steps.failure == ""
    legs, machine = found.steps.legs, found.dataset.machine
    assert legs is not None
    T, q = found.solution.T_Rb_Re, found.dataset.measurements.q
    true, nominal, staged = (
        poses_at_readings(machine, g, q, T)
        for g in (geometries(load_mechanism(made.truth_path)), geometries(machine), legs)
    )
    before, after = (pose_differences(poses, true)[0].mean() for poses in (nominal, staged))
    assert before > 1e-3
    assert after < 0.2 * before


@pytest.fixture(scope="module")
def hexapod(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Outlines of a hexapod, whose poses two views share."""
    folder = tmp_path_factory.mktemp("hexapod") / "set"
    return simulate("hexapod", folder, settings(poses=6, views=2, shared_poses=True)).folder


def _chosen(
    given: Path, folder: Path, images: Callable[[Row], bool], outlines: Callable[[Row], bool]
) -> Path:
    """Copy a dataset with some of its images and outlines."""
    shutil.copytree(given, folder)
    rows = _filtered(folder / "measurements.csv", images)
    names = {(row["view"], row["pose"]) for row in rows}
    _filtered(
        folder / "observations.csv",
        lambda row: (row["view"], row["image"]) in names and outlines(row),
    )
    return folder


def _filtered(path: Path, wanted: Callable[[Row], bool]) -> list[Row]:
    """Keep some rows of a table."""
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = [row for row in reader if wanted(row)]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, reader.fieldnames or ())
        writer.writeheader()
        writer.writerows(rows)
    return rows


def _all(row: Row) -> bool:
    return True


@pytest.mark.parametrize(
    ("images", "outlines", "error", "message"),
    [
        (
            lambda row: (row["view"], row["pose"]) == ("c1", "p01"),
            _all,
            NotIdentifiable,
            r"determine \d+ of 30 at best",
        ),
        (lambda row: row["pose"] == "p01", _all, NotIdentifiable, r"determine \d+ of 30 at best"),
        (_all, lambda row: row["leg"] != "leg3", NotVisible, "no used outline of leg3 in any"),
    ],
    ids=["one image", "one pose twice", "one leg missing"],
)
def test_images_that_cannot_do_it_are_refused_in_one_sentence(
    hexapod: Path,
    tmp_path: Path,
    images: Callable[[Row], bool],
    outlines: Callable[[Row], bool],
    error: type[LegcalError],
    message: str,
) -> None:
    folder = _chosen(hexapod, tmp_path / "set", images, outlines)
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(error, match=message) as refused:
        calibrate(folder, output=tmp_path / "out")
    assert len(refused.value.problems) == 1
    assert not (tmp_path / "out").exists()
    assert sorted(path.name for path in folder.iterdir()) == before


def test_fewer_observations_than_unknowns_are_refused(hexapod: Path, tmp_path: Path) -> None:
    told: dict[tuple[str, str], str] = {}

    def one_of_each_image(row: Row) -> bool:
        image = row["view"], row["image"]
        if image in told or (row["leg"] in told.values() and len(set(told.values())) < 6):
            return False
        told[image] = row["leg"]
        return True

    folder = _chosen(hexapod, tmp_path / "set", _all, one_of_each_image)
    _filtered(folder / "measurements.csv", lambda row: (row["view"], row["pose"]) in told)
    with pytest.raises(NotIdentifiable, match=r"readings give \d+ equations for \d+ unknowns"):
        calibrate(folder, output=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_leg_that_views_leave_out_is_left_to_the_readings(hexapod: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(hexapod, tmp_path / "set"))
    text = (folder / "dataset.yaml").read_text()
    legs = "    legs: [leg1, leg2, leg4, leg5, leg6]\n    T_base_camera:"
    (folder / "dataset.yaml").write_text(text.replace("    T_base_camera:", legs))
    with pytest.raises(NotIdentifiable, match=r"determine 29 of 30 at best .* offset of leg 3"):
        calibrate(folder)  # six poses are too few for that, and images of it are not asked for
