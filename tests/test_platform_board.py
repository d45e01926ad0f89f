"""A calibration board on the platform: in a fit without legs, in datasets, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_folder import folder
from edits import keyed
from fit_sessions import T_RE_BOARD, machine_session, with_boards
from simulated import settings

from legcal import calibrate, evaluate, identifiability, load_dataset, load_mechanism, simulate
from legcal.calibration.identify.identifiability import identifiability_of_dataset
from legcal.data.measurements import row_names
from legcal.data.outlines import no_outlines
from legcal.simulation.settings import Level

__all__ = ["folder"]


def test_a_board_alone_gives_the_machine_exactly_without_noise() -> None:
    """From joints that are 3 mm and axes that are 1 degree off; no image shows a leg."""
    session = machine_session("hexapod", n_poses=8)
    assert session.off(session.start.legs) > 0.002
    seen, start = with_boards(session, base=False)
    found = replace(session, outlines=no_outlines()).fit(start, board=seen)
    assert session.off(found.legs) < 1e-7
    assert found.radii == {}
    place = T_RE_BOARD.inv() * found.T_frame_board["platform"]
    assert np.linalg.norm(place.translation) < 1e-7


def test_corners_of_the_board_on_the_platform_have_noise_and_outliers_of_their_own() -> None:
    session = replace(machine_session("hexapod", n_poses=15), outlines=no_outlines())
    m = session.measurements
    seen, start = with_boards(session, seed=3)
    fixed = seen.boards[1]
    moved = fixed.has(seen.corners.corner)
    wrong = moved & (seen.corners.corner == fixed.first + 5) & (seen.corners.row % 6 == 0)
    px = seen.corners.px + np.where(wrong[:, None], [4.0, -3.0], 0.0)
    sigma = np.where(moved, 0.5, 1.0) * seen.corners.sigma_px  # said to be better than they are
    corners = replace(seen.corners, px=px, sigma_px=sigma)
    found = session.fit(start, board=replace(seen, corners=corners))
    rows = np.unique(seen.corners.row[wrong])
    assert set(found.rejected_corners) == {
        (m.views[m.view[row]].name, int(m.pose[row]), fixed.first + 5) for row in rows
    }
    said = next(note for note in found.notes if "disagree with the fit" in note)
    assert f"{fixed.first + 5} in c1, {row_names(m)[0]}" in said
    right = session.fit(start, board=seen)
    np.testing.assert_allclose(found.estimates.sigma, right.estimates.sigma, rtol=0.1)
    assert found.quality.rms_corners_px["platform"] == pytest.approx(0.05, rel=0.1)


# Datasets


@pytest.mark.system
def test_corners_of_two_boards_calibrate_a_machine_without_a_leg_or_a_rough_pose(
    tmp_path: Path,
) -> None:
    """No view names a leg."""
    folder = tmp_path / "d"
    chosen = settings(
        level=Level.OUTLINES, poses=15, views=1, board="charuco", platform_board="charuco",
        sigma_px=0.02, hints=False, seed=1,
    )  # fmt: skip
    of_boards = simulate("hexapod", folder, chosen)
    (folder / "observations.csv").unlink()
    keyed("dataset.yaml", views__c1__legs=[])(folder)
    assert identifiability_of_dataset(load_dataset(folder)).platform_board
    calibration = calibrate(folder, output=tmp_path / "r")
    assert "steps need legs in sight: there is no staged.yaml" in calibration.summary()
    result = json.loads((tmp_path / "r/result.json").read_text())
    truth = json.loads((folder / "truth/truth.json").read_text())
    error, nominal = (
        evaluate(model, of_boards.truth_path, dataset=folder).displacement.mean()
        for model in (tmp_path / "r/calibrated.yaml", of_boards.nominal)
    )
    assert error < 3.0 * result["platform"]["sigma_dX_m"]
    assert error < 0.3 * nominal
    assert list(result["views"]) == ["c1"]
    found, true = (
        np.array(place["xyz"])
        for place in (
            result["platform_board"]["T_platform_board"],
            truth["board"][1]["T_platform_board"],
        )
    )
    assert np.linalg.norm(found - true) < 0.01
    assert not [row for row in result["parameters"] if ".radius." in row["name"]]


@pytest.mark.usefixtures("without_remedies")
def test_identify_says_what_a_board_on_the_platform_determines() -> None:
    machine = load_mechanism("hexapod")
    assert not identifiability(machine, [["leg1"]], 8).identifiable
    found = identifiability(machine, [["leg1"]], 8, platform_board=True)
    assert found.identifiable
    assert found.platform_board
