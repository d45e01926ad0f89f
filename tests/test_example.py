"""The dataset that comes with legcal: copied whole or not at all; a view found only in the end."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from command_line import run

from legcal import calibrate, load_dataset
from legcal.data import new_dataset
from legcal.errors import Cause
from legcal.perception.placement import NotPlaced, Placement
from legcal.perception.recognition import place_views

EXAMPLE = Path(__file__).parents[1] / "examples/hexapod"


def test_the_example_is_copied_and_loads(tmp_path: Path) -> None:
    copy = tmp_path / "here" / "example"
    outcome = run("example", "-o", copy)
    assert outcome.code == 0
    assert "Next:\n  legcal calibrate" in outcome.out
    copied = {path.relative_to(copy) for path in copy.rglob("*") if path.is_file()}
    own = {path.relative_to(EXAMPLE) for path in EXAMPLE.rglob("*") if path.is_file()}
    assert own - copied <= {Path("observations.csv"), Path(".legcal-cache.json")}
    assert copied <= own
    assert len(load_dataset(copy).measurements.image) == 45


def test_an_installation_without_the_example_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(new_dataset, "_EXAMPLE", "examples/none")
    outcome = run("example", "-o", tmp_path / "copy")
    assert outcome.code == 1
    assert "install it again" in outcome.err
    assert not (tmp_path / "copy").exists()


@pytest.mark.system
def test_a_view_that_is_not_recognised_at_first_is_placed_near_the_fit_to_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    n_searched = list[int]()

    def without_last(*args: Any, **options: Any) -> Placement:
        placement = place_views(*args, **options)
        n_searched.append(len(args[1]))
        if len(n_searched) > 1:
            return placement
        missed = NotPlaced("c3", Cause("its legs are not recognised"))
        cameras = (*placement.T_base_camera[:-1], None)
        return replace(placement, T_base_camera=cameras, unplaced={"c3": missed})

    monkeypatch.setattr("legcal.perception.photographs.place_views", without_last)
    calibration = calibrate(EXAMPLE, use_cache=False)
    assert n_searched == [45, 15]
    assert calibration.verdict.trustworthy
    outlines, view = calibration.solution.outlines, calibration.dataset.measurements.view
    used = view[outlines.row[outlines.used]]
    assert min((used == v).sum() for v in range(3)) > 80
    assert not [note for note in calibration.notes if "recognised" in note]
