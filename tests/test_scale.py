"""Machines of all sizes are calibrated alike: nothing but files is counted in metres."""

from pathlib import Path

import numpy as np
import pytest
from scaled import scaled_dataset
from simulated import simulated
from test_detector_version import FOLDER

from legcal import calibrate, load_dataset
from legcal.calibration.board import rough_placement
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.perception.photographs import place_and_measure
from legcal.progress import no_progress
from legcal.workers import in_turn

pytestmark = pytest.mark.usefixtures("without_steps")

SIZES = 0.03, 30.0  # of the usual one


def _recognised(folder: Path) -> tuple[Outlines, Array]:
    """Return the outlines of the photographs, and where their cameras are, in leg lengths."""
    data = order_dataset(load_dataset(folder), in_turn, no_progress, fingerprint="")
    seen = place_and_measure(data.photographs, rough_placement(data)[0], no_progress, in_brief=True)
    places = [T.translation for T in seen.placement.T_base_camera if T is not None]
    return seen.outlines, np.array(places) / data.machine.size


@pytest.mark.system
def test_photographs_show_the_same_legs_of_a_small_machine_and_a_large_one(tmp_path: Path) -> None:
    (small, cameras), (large, there) = (
        _recognised(scaled_dataset(FOLDER, tmp_path / f"{size}", size)) for size in SIZES
    )
    assert small.used.mean() > 0.6
    assert large.row_keys() == small.row_keys()
    assert large.reason == small.reason
    np.testing.assert_allclose(large.ends, small.ends, atol=1e-3)
    np.testing.assert_allclose(there, cameras, atol=1e-6)


def test_a_large_machine_is_known_as_well_for_its_size_as_a_small_one(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "usual", "3-rpr", poses=5).folder
    small, large = (
        calibrate(scaled_dataset(folder, tmp_path / f"{size}", size)).result for size in SIZES
    )
    assert large.observations == small.observations
    for one, other in zip(large.parameters, small.parameters, strict=True):
        unit = SIZES[1] / SIZES[0] if one.unit == "m" else 1.0
        assert (one.name, one.status) == (other.name, other.status)
        if other.sigma is not None and one.sigma is not None:
            assert one.value / unit == pytest.approx(other.value, abs=0.01 * other.sigma)
            assert one.sigma / unit == pytest.approx(other.sigma, rel=1e-3)
