"""Machines of all sizes are calibrated alike: nothing but files is counted in metres."""

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from scaled import scaled_dataset
from simulated import simulated
from six_photographs import FOLDER
from thinned import thinned

from legcal import calibrate, load_dataset
from legcal.calibration.board import rough_placement
from legcal.calibration.documents import Result
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.perception.outline import measure_in_brief
from legcal.perception.photographs import place_and_measure
from legcal.progress import no_progress
from legcal.workers import in_turn


@cache
def _usual(model: str) -> tuple[Path, Result]:
    folder = Path(mkdtemp()) / "usual"
    simulated(folder, model, poses=5)
    return folder, calibrate(folder).result


def _recognised(folder: Path) -> tuple[Outlines, Array]:
    """Return the outlines of the photographs, and where their cameras are, in leg lengths."""
    data = order_dataset(load_dataset(folder), in_turn, no_progress, fingerprint="")
    seen = place_and_measure(
        data.photographs, rough_placement(data)[0], no_progress, method=measure_in_brief
    )
    places = [T.translation for T in seen.placement.T_base_camera if T is not None]
    return seen.outlines, np.array(places) / data.machine.size


def test_photographs_show_the_same_legs_of_a_machine_of_any_size(tmp_path: Path) -> None:
    usual, cameras = _recognised(scaled_dataset(FOLDER, tmp_path / "usual", 1.0))
    assert usual.used.mean() > 0.6
    for size in (0.03, 30.0):
        outlines, there = _recognised(scaled_dataset(FOLDER, tmp_path / f"{size}", size))
        assert outlines.row_keys() == usual.row_keys()
        assert outlines.reason == usual.reason
        np.testing.assert_allclose(outlines.ends, usual.ends, atol=1e-3)
        np.testing.assert_allclose(there, cameras, atol=1e-6)


@pytest.mark.parametrize("size", [0.03, 30.0])
@pytest.mark.parametrize("model", thinned(["hexapod", "3-upu", "3-rpr"], ["3-rpr"]))
def test_a_machine_of_any_size_is_known_as_well_for_its_size(
    model: str, size: float, tmp_path: Path
) -> None:
    folder, usual = _usual(model)
    found = calibrate(scaled_dataset(folder, tmp_path / "scaled", size)).result
    assert found.observations == usual.observations
    for one, other in zip(found.parameters, usual.parameters, strict=True):
        unit = size if one.unit == "m" else 1.0
        assert (one.name, one.status) == (other.name, other.status)
        if other.sigma is not None and one.sigma is not None:
            assert one.value / unit == pytest.approx(other.value, abs=0.01 * other.sigma)
            assert one.sigma / unit == pytest.approx(other.sigma, rel=1e-3)
