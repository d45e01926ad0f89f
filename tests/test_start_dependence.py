"""The result of a calibration does not depend on where its search began."""

from pathlib import Path

import pytest
from start_dependence import (
    OFF,
    RECORDED,
    RECORDED_SESSIONS,
    TOLERANCE,
    Session,
    calibrated,
    difference,
    needs_steps,
    session_folder,
    with_other_model,
)
from thinned import thinned

from legcal.simulation.settings import Level


@pytest.mark.system
def test_outlines_with_outliers_give_one_result(tmp_path: Path) -> None:
    folder = session_folder("hexapod", Session("hexapod", Level.OUTLINES, 8, 3, 6), tmp_path)
    first = calibrated(folder, "nominal", steps=False)
    assert not first.solution.outlines.used.all()  # a tenth of them are wrong
    other = calibrated(folder, "staged")
    moved = calibrated(with_other_model(folder, tmp_path, 0), "nominal", steps=False)
    for end in (other, moved):
        assert difference(first, end)[0] < TOLERANCE
        assert end.solution.outlines.used_keys() == first.solution.outlines.used_keys()


@pytest.mark.parametrize("name", thinned(RECORDED_SESSIONS, ["planar"]))
def test_recorded_sessions_give_one_result_from_every_start(name: str) -> None:
    folder = RECORDED / name
    steps = needs_steps(folder)
    first = calibrated(folder, "nominal", steps=steps)
    staged = calibrated(folder, "staged")
    has_steps = not staged.dataset.machine.actuators  # where motors move joints at A there are none
    assert steps or (staged.solution.start == "staged") == has_steps
    B = {leg.name: leg.B for leg in staged.solution.legs}
    values = staged.solution.estimates.values
    assert all(
        values[f"{leg}.platform.{axis}"] == pytest.approx(x, abs=1e-12)
        for leg, ends in B.items()
        for axis, x in zip("xyz", ends, strict=True)
        if f"{leg}.platform.{axis}" in values
    )
    off = calibrated(folder, "nominal", steps=steps, off=OFF)
    for other in (staged, off):
        assert difference(first, other)[0] < TOLERANCE
        assert other.solution.outlines.used_keys() == first.solution.outlines.used_keys()
