"""Geometry that is nearly or quite degenerate: the right answer, or what is missing, by name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from csv_rows import read_rows, write_rows
from edits import keyed
from machines import made
from scipy.spatial.transform import RigidTransform, Rotation
from simulated import simulated

import legcal
from legcal import Machine, calibrate
from legcal.errors import DidNotConverge

pytestmark = pytest.mark.usefixtures("without_steps")


def tripod(folder: Path, platform_radius: float) -> Machine:
    """Return a 3-UPU that translates; with a platform as wide as its base it is singular."""
    turns = [Rotation.from_euler("z", a, degrees=True) for a in (0, 120, 240)]
    base, platform = (
        [turn.apply([radius, 0.0, 0.0]).tolist() for turn in turns]
        for radius in (320.0, platform_radius)
    )
    return made(
        folder, name="3-upu", type="3-UPU", base_joints=base, platform_joints=platform,
        offsets=420, travel=[0, 160], home={"xyz": [0, 0, 500], "rpy_deg": [0, 0, 0]},
    )  # fmt: skip


@pytest.mark.system
def test_a_reading_that_the_nominal_model_does_not_reach_is_used_and_told(tmp_path: Path) -> None:
    """Legs that are all 6 mm shorter in the model than on the machine, which nearly meet there."""
    model = legcal.load_mechanism("3-rpr")
    turned = Rotation.from_euler("z", 12, degrees=True)
    near = legcal.inverse_kinematics(model, RigidTransform.from_components([0, 0, 0], turned))
    q = [*np.random.default_rng(7).uniform(0.035, 0.12, (9, 3)).tolist(), near]
    joints = [str(leg.prismatic) for leg in model.legs]
    write_rows(tmp_path / "poses.csv", [dict(zip(joints, row, strict=True)) for row in q])
    made_set = simulated(tmp_path / "set", "3-rpr", poses=tmp_path / "poses.csv")
    short = made(
        tmp_path, name="short", type="3-RPR", offsets=224, travel=[0, 140],
        base_joints=[[0, -400, 0], [346.41, 200, 0], [-346.41, 200, 0]],
        platform_joints=[[0, -140, 0], [121.24, 70, 0], [-121.24, 70, 0]],
        radius={"tube": 12, "rod": 8}, home={"xyz": [20, -10, 0], "rpy_deg": [0, 0, 35]},
    )  # fmt: skip
    with pytest.raises(
        DidNotConverge, match="the legs no longer close or the mechanism is singular"
    ):
        legcal.forward_kinematics(short, near)
    dataset = replace(legcal.load_dataset(made_set.folder), machine=short)
    calibration = calibrate(dataset, output=tmp_path / "out")
    assert "The nominal model cannot reach the readings of view c1, p10: residuals" in " ".join(
        calibration.notes
    )
    assert calibration.verdict.trustworthy
    calibrated = tmp_path / "out" / "calibrated.yaml"
    apart = legcal.evaluate(calibrated, made_set.truth_path, dataset=made_set.folder)
    assert apart.displacement.max() < 2e-4


@pytest.mark.usefixtures("without_remedies")
def test_a_3_upu_near_its_constraint_singularity_is_refused_and_at_it_is_named(
    tmp_path: Path,
) -> None:
    wide = {radius: tmp_path / f"{radius:.0f}" for radius in (150.0, 310.0, 319.9)}
    for folder in wide.values():
        folder.mkdir()
    models = {radius: tripod(folder, radius) for radius, folder in wide.items()}
    for radius, is_identifiable in ((150.0, True), (310.0, False)):
        legs = models[radius].leg_names
        report = legcal.identifiability(models[radius], [legs] * 3, 4)
        assert report.identifiable == is_identifiable
        assert is_identifiable != any("nearly singular at home" in note for note in report.notes)
    assert any("is singular at home" in note for note in models[319.9].diagnostics)


@pytest.mark.system
def test_a_leg_that_no_view_shows_is_found_from_its_readings(tmp_path: Path) -> None:
    """Its encoder says where it is, once the views list the legs that they show."""
    made_set = simulated(tmp_path / "set", "hexapod", poses=6, seed=1)
    folder, five = made_set.folder, [f"leg{j}" for j in range(1, 6)]
    rows = read_rows(folder / "observations.csv")
    write_rows(folder / "observations.csv", [row for row in rows if row["leg"] in five])
    keyed("dataset.yaml", views__c1__legs=five, views__c2__legs=five)(folder)
    calibration = calibrate(folder, output=tmp_path / "out")
    assert calibration.verdict.trustworthy
    assert calibration.solution.estimates.status["leg6.base.z"] == "estimated"
    nominal, calibrated = (
        legcal.evaluate(model, made_set.truth_path, dataset=folder).displacement.mean()
        for model in (calibration.dataset.machine, tmp_path / "out" / "calibrated.yaml")
    )
    assert calibrated < 0.1 * nominal
