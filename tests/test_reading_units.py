"""Readings in degrees, radians and pulses of servos, stated and taken for each other."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import Outcome, run
from csv_rows import read_rows, write_rows
from dataset_folder import SERVOS, dataset_of_readings
from machines import ROOT, read_table
from scaled import scaled_dataset
from simulated import simulated
from test_init import own_folder

from legcal import LegcalError, load_dataset, load_mechanism
from legcal.data.reading_units import sigmas_of
from legcal.descriptions.new_model import create_model
from legcal.errors import DatasetError, ModelError, UsageError
from legcal.machine.model_writer import write_model

ANGLES = 0.5 * np.sin(np.arange(24.0).reshape(4, 6))  # [rad]
BOTH_WAYS = np.concatenate([ANGLES, -ANGLES])
PHOTOGRAPHS = [f"IMG_{k}.jpg" for k in range(4)]
PULSES = {"centre_us": 1500, "us_per_deg": 11.1}


def pulses(angles: np.ndarray, centre: float = 1500.0, per_degree: float = 11.1) -> np.ndarray:
    return np.asarray(centre + per_degree * np.degrees(angles))


def test_units_of_each_motor_give_joint_values_and_their_sigmas(tmp_path: Path) -> None:
    given = pulses(ANGLES)
    given[:, 1] = pulses(ANGLES[:, 1], 1520.0, -10.0)
    given[:, 2] = np.degrees(ANGLES[:, 2])
    given[:, 3] = ANGLES[:, 3]
    servo = {"unit": "us", **PULSES}
    units: dict[str, Any] = dict.fromkeys(SERVOS, servo)
    units |= {
        "servo2": {"unit": "us", "centre_us": 1520, "us_per_deg": -10},
        "servo3": "deg",
        "servo4": "rad",
    }
    sigmas = {"servo3": 0.1, "servo4": "0.2deg", "servo5": 3.0, "servo6": "4us"}
    found = load_dataset(
        dataset_of_readings(tmp_path, given, {"readings": units, "encoder_sigma": sigmas}),
        check_images=False,
    ).measurements
    np.testing.assert_allclose(found.q, ANGLES, atol=1e-8)
    wanted = [0.5, 0.5, 0.1, 0.2, 3.0 / 11.1, 4.0 / 11.1]
    np.testing.assert_allclose(np.degrees(found.sigma_q), wanted)


def test_a_sigma_of_a_motor_that_there_is_not_is_refused_with_the_closest_name() -> None:
    legs = load_mechanism("servo-hexapod").legs
    with pytest.raises(UsageError, match=r"found one of 'servo7', .*did you mean 'servo"):
        sigmas_of({"servo1": 1e-3, "servo7": 1e-3}, legs)


def servo_table(folder: Path, **changes: Any) -> Path:
    """Write the table of the servo hexapod with pulses in place of angles."""
    table = yaml.safe_load((ROOT / "models/tables/servo-hexapod.yaml").read_text())
    for entry in table["actuators"].values():
        del entry["travel_deg"]
        entry |= {"travel_us": [1000.5, 1999.5], **PULSES, **changes}
    path = folder / "servos.yaml"
    path.write_text(yaml.safe_dump(table | {"name": "servos"}, sort_keys=False))
    return path


def test_a_model_in_inches_is_named_by_readings_that_hardly_use_its_travel(tmp_path: Path) -> None:
    session = simulated(tmp_path / "set", "hexapod", poses=12).folder
    in_inches = scaled_dataset(session, tmp_path / "inches", 1.0 / 0.0254)
    for name in ("dataset.yaml", "measurements.csv"):
        shutil.copy(session / name, in_inches / name)
    with pytest.raises(DatasetError, match=r"if its lengths are inches, needed a model in metres"):
        load_dataset(in_inches, check_images=False)
    rows = read_rows(session / "measurements.csv")
    for row in rows:  # of a model that is right
        row |= {x: f"{0.01 * float(row[x])}" for x in row if x.endswith("_prismatic")}
    write_rows(session / "measurements.csv", rows)
    assert np.ptp(load_dataset(session, check_images=False).measurements.q) < 1.5e-3


def test_a_model_keeps_the_pulses_of_its_servos(tmp_path: Path) -> None:
    machine = create_model(read_table(servo_table(tmp_path)), tmp_path).machine
    np.testing.assert_allclose(machine.actuators[0].travel, np.radians([-45.0, 45.0]))
    again = load_mechanism(write_model(machine, tmp_path / "again")[0])
    assert [a.pulses for a in again.actuators] == [a.pulses for a in machine.actuators]
    model = str(tmp_path / "models/servos.yaml")
    found = load_dataset(
        dataset_of_readings(tmp_path, pulses(ANGLES), {"readings": "us"}, model), check_images=False
    ).measurements
    np.testing.assert_allclose(found.q, ANGLES, atol=1e-8)
    with pytest.raises(ModelError, match=r"actuators.servo1.*found no us_per_deg"):
        read_table(servo_table(tmp_path, us_per_deg=None))
    with pytest.raises(ModelError, match=r"actuators.servo1.*us_per_deg 0.*5.6 to 11.1"):
        read_table(servo_table(tmp_path, us_per_deg=0))


def test_motors_that_turn_the_other_way_are_told_by_a_travel_that_is_uneven(tmp_path: Path) -> None:
    """Where the travel goes further one way, less than half of reversed readings are outside."""
    angles = np.radians(20.0 + 100.0 * np.sin(np.arange(24.0).reshape(8, 3)) / 2.0)
    arms = ("arm1", "arm2", "arm3")
    entry = {"encoder_sigma": dict.fromkeys(arms, 1e-4)}
    folder = dataset_of_readings(tmp_path, angles, entry, "delta", arms)
    load_dataset(folder, check_images=False)
    dataset_of_readings(tmp_path, -angles, entry, "delta", arms)
    with pytest.raises(LegcalError) as caught:
        load_dataset(folder)
    (said,) = caught.value.problems
    assert "columns arm1, arm2, arm3" in said
    assert "opposite sign" in said


def test_sigmas_of_motors_that_turn_endlessly_are_at_most_a_share_of_a_turn() -> None:
    endless = replace(load_mechanism("delta").legs[0], travel=(-np.inf, np.inf))
    assert sigmas_of("70deg", [endless]) == {"arm1": pytest.approx(np.radians(70.0))}
    with pytest.raises(UsageError, match="found 80 deg, needed at most 20% of a turn, 72 deg"):
        sigmas_of("80deg", [endless])


@pytest.mark.parametrize(
    ("headings", "scale", "words", "sigma_deg"),
    [
        ("{}", "rad", (), 0.0057),
        ("{}", "deg", (), 0.0057),
        ("{} [deg]", "deg", ("--encoder-sigma", "0.2deg"), 0.2),
        ("{}_us", "us", (), 0.5),
        ("{}", "us", ("--encoder-sigma", "3us"), 3.0 / 11.1),
    ],
)
def test_init_takes_angles_and_pulses(
    headings: str,
    scale: str,
    words: tuple[str, ...],
    sigma_deg: float,
    tmp_path: Path,
) -> None:
    own_folder(tmp_path, PHOTOGRAPHS)
    given = {"rad": ANGLES, "deg": np.degrees(ANGLES), "us": pulses(ANGLES)}[scale]
    model = "servo-hexapod"
    if scale == "us":
        model = str(create_model(read_table(servo_table(tmp_path)), tmp_path).yaml_path)
    assert init(tmp_path, given, headings, words, model).code == 0
    rows = read_rows(tmp_path / "dataset/measurements.csv")
    found = [[float(row[name]) for name in SERVOS] for row in rows]
    np.testing.assert_allclose(found, ANGLES, atol=1e-4)
    measurements = load_dataset(tmp_path / "dataset").measurements
    np.testing.assert_allclose(np.degrees(measurements.sigma_q), sigma_deg, rtol=0.01)


def init(
    folder: Path,
    given: np.ndarray,
    headings: str,
    words: tuple[str, ...],
    model: str = "servo-hexapod",
) -> Outcome:
    """Return what legcal init says of a table of readings."""
    table = [",".join(headings.format(name) for name in SERVOS)]
    table += [",".join(f"{x:.4f}" for x in row) for row in given]
    (folder / "own.csv").write_text("\n".join(table) + "\n")
    return run(
        "init", folder / "photos", "--readings", folder / "own.csv", "--model",
        model, "-o", folder / "dataset", *words,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("headings", "given", "words", "named"),
    [
        ("{}_us", pulses(ANGLES), (), ("pulses of servos", "'servo1'", "legcal.motors")),
        ("{}", pulses(ANGLES), (), ("1182.01", "-45 to 45 deg", "legcal.motors")),
        ("{} [mm]", ANGLES, (), ("found mm of 'servo1', which turns",)),
        ("{}", ANGLES, ("--unit", "mm"), ("no motor that slides",)),
        ("{}", ANGLES, ("--lengths",), ("--lengths", "leave out")),
        ("{}", ANGLES, ("--encoder-sigma", "2um"), ("'2um'", "deg")),
        ("{} [rad]", np.degrees(ANGLES), (), ("look like readings in deg",)),
        ("{} [deg]", BOTH_WAYS, (), ("% in rad", "state rad in the headings")),
    ],
)
def test_what_init_cannot_make_of_angles(
    headings: str,
    given: np.ndarray,
    words: tuple[str, ...],
    named: tuple[str, ...],
    tmp_path: Path,
) -> None:
    own_folder(tmp_path, PHOTOGRAPHS)
    outcome = init(tmp_path, given, headings, words)
    assert outcome.code == 2
    said = outcome.said
    assert said.count("legcal: ") == 1
    assert all(word in said for word in named), said
    assert not (tmp_path / "dataset").exists()
