"""The result of a calibration does not depend on where its search began."""

import sys
from pathlib import Path

import pytest
from thinned import thinned

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from start_dependence import (
    TOLERANCE,
    Session,
    calibrated,
    difference,
    session_folder,
    with_other_model,
)

from legcal.simulation.settings import Level

OUTLINES = {
    "hexapod": Session("hexapod", Level.OUTLINES, 8, 3, 6),
    "linear-delta": Session("linear-delta", Level.OUTLINES, 10, 3, 6),
}


@pytest.mark.system
@pytest.mark.parametrize("name", thinned(OUTLINES, ["hexapod"]))
def test_outlines_with_outliers_give_one_result(name: str, tmp_path: Path) -> None:
    folder = session_folder(name, OUTLINES[name], tmp_path)
    first = calibrated(folder, "nominal", steps=False)
    assert not first.solution.outlines.used.all()  # a tenth of them are wrong
    other = calibrated(folder, "staged")
    moved = calibrated(with_other_model(folder, tmp_path, 0), "nominal", steps=False)
    for end in (other, moved):
        assert difference(first, end)[0] < TOLERANCE
        assert end.solution.outlines.used_keys() == first.solution.outlines.used_keys()
