"""The main commands on a machine of carriages and on one of arms, from simulated outlines."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from command_line import run

from legcal.calibration.result_folder import load_result
from legcal.machine.loader import load_mechanism
from legcal.simulation.dataset import simulate
from legcal.simulation.settings import SimulationSettings


@pytest.mark.system
@pytest.mark.parametrize(("name", "unit"), [("hexaglide", "mm"), ("delta", "deg")])
def test_commands_know_that_joints_at_A_move(
    name: str,
    unit: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def said(*words: str, code: int = 0) -> str:
        """Return what a command prints."""
        assert run(monkeypatch, *words) == code
        return capsys.readouterr().out

    session, out, table = (str(tmp_path / part) for part in ("session", "out", "correction.csv"))
    if name == "hexaglide":
        measured = {"leg1.base:leg3.base": 1e-4}
        settings = SimulationSettings(level="outlines", poses=5, lengths=measured)
        assert simulate(name, session, settings).to_measure == ""
    else:
        words = ("simulate", name, "-o", session, "--level", "outlines", "--poses", "5", "-q")
        printed = "".join(said(*words).split())  # long paths are broken
        assert f"{session}-oOUT--lengthleg1.base:leg1.platform=MEASURED" in printed
    truth = load_mechanism(tmp_path / "session" / "truth" / "models" / f"{name}.yaml")
    stated = yaml.safe_load((tmp_path / "session" / "dataset.yaml").read_text()).get("parameters")
    if name == "hexaglide":
        value, sigma = stated["lengths"]["leg1.base:leg3.base"].removesuffix("mm").split("+-")
        distance = float(np.linalg.norm(truth.A_base[0] - truth.A_base[2]))
        assert float(sigma) == 0.1
        assert 0.0 < abs(float(value) - 1e3 * distance) < 0.5
    known = ["--set", f"leg1.length={truth.legs[0].q0!r}+-0.00005"] * (name == "delta")
    assert "where their motors read 0" in said(
        "calibrate", session, "-o", out, "-q", "--verbose", *known
    )
    scene = (tmp_path / "out" / "report.html").read_text()
    assert " ".join([*known, "--holdout"]) in scene  # what fixes the scale stays in the command
    ends = [
        np.array(json.JSONDecoder().raw_decode(part)[0]) for part in scene.split('"standing": ')[1:]
    ]
    assert len(ends) >= 2  # of both models
    assert {rails.shape for rails in ends} == {(len(truth.actuators), 2, 3)}

    found = load_result(out).document
    nominal = load_mechanism(name)
    for actuator, before in zip(truth.actuators, nominal.actuators, strict=True):
        block = (found.actuators or {})[actuator.joint]
        in_Rb = actuator.in_frame(truth.T_base_Rb.inv().as_matrix())
        calibrated = np.array(block.axis if actuator.turns else block.direction)
        start = before.in_frame(nominal.T_base_Rb.inv().as_matrix())
        off, was = (np.linalg.norm(np.cross(in_Rb.axis, axis)) for axis in (calibrated, start.axis))
        assert off < 0.3 * was

    corrected = said("export", out, "--to", "correction", "-o", table, "--nodes", "2", "--json")
    figures = json.loads(corrected)
    assert figures["residual"]["rms_dX_m"] < 0.2 * figures["uncorrected"]["rms_dX_m"]
    if name == "delta":  # whose scale nothing fixes here
        free = ["--set", "*.radius.*=free"]
        assert run(monkeypatch, "calibrate", session, "-o", tmp_path / "never", "-q", *free) == 1
        refusal = " ".join(capsys.readouterr().err.split())
        assert "the overall scale is undetermined" in refusal
        assert "--length leg1.base:leg1.platform=MEASURED" in refusal
        looked = json.loads(said("doctor", session, "--json", "-q", code=1))
        assert [one["column"] for one in looked["encoders"]] == list(truth.motor_names)
        assert {one["unit"] for one in looked["encoders"]} == {"rad"}
        assert json.loads(said("identify", session, "--json"))["scale_is_open"]
        written = tmp_path / "session" / "dataset.yaml"
        length = "{'leg1.base:leg1.platform': 400+-0.5mm}"
        written.write_text(f"{written.read_text()}parameters: {{lengths: {length}}}\n")
        assert not json.loads(said("identify", session, "--json"))["scale_is_open"]
    inspected = said("inspect", name)
    assert all(f"{joint} " in inspected for joint in truth.motor_names)
    assert f" {unit}" in inspected
