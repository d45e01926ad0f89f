"""Datasets with a board: views of a camera in the hand, and the table ``corners.csv``."""

import json
import re
import tempfile
from collections.abc import Container
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from boards import CHARUCO, LENS
from command_line import run
from csv_rows import read_rows, write_rows
from dataset_folder import Folder, folder
from edits import keyed
from hypothesis import given
from hypothesis import settings as drawn
from hypothesis import strategies as st
from simulated import settings, simulated

from legcal import Calibration, calibrate, check, doctor, simulate
from legcal.calibration.identify.identifiability import identifiability_of_dataset
from legcal.data.corners import COLUMNS, Corners, read_corners, write_corners
from legcal.data.dataset import load_dataset
from legcal.data.image_choice import image_sequences
from legcal.data.image_tables import canonical_order
from legcal.data.measurements import Measurements, View
from legcal.data.reasons import USED, Reason, Rejection
from legcal.errors import DatasetError, NotIdentifiable
from legcal.vision.board import FixedBoard

__all__ = ["folder"]
BOARD = {"kind": "charuco", "squares_x": 4, "squares_y": 3, "square": 0.03, "marker": 0.02,
         "dictionary": "DICT_4X4_50"}  # fmt: skip
IN_HAND = ("c1-1,images/c1_1.png", "c1-2,images/c1_2.png")


def _write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join([",".join(COLUMNS[:-1]), *lines]) + "\n")


def test_every_image_of_a_hand_held_view_is_a_view_in_the_order_of_rows(folder: Folder) -> None:
    folder.entry["views"]["c1"]["hand_held"] = True
    del folder.entry["views"]["c1"]["T_base_camera"]
    pose = {"xyz": [0.1, 0.0, 0.0], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    folder.entry["board"] = BOARD | {"T_base_board": pose}
    lines = [f"{place},{k},{5 + k},6,0.1,used,,detected" for place in IN_HAND for k in range(6)]
    _write(folder.path / "corners.csv", lines)
    dataset = load_dataset(folder.write())
    m = dataset.measurements
    assert [view.name for view in m.views] == ["c1-1", "c1-2", "c2"]
    assert m.view.tolist() == [0, 1, 2, 2]
    assert len(dataset.camera_paths) == 3
    assert m.views[0].T_base_camera is None
    T_base_board = dataset.boards[0].T_link_board
    assert T_base_board is not None
    assert T_base_board.translation == pytest.approx([0.1, 0.0, 0.0])
    assert dataset.corners is not None
    assert np.bincount(dataset.corners.row).tolist() == [6, 6]


@pytest.mark.system
def test_an_image_in_the_hand_that_the_board_does_not_place_is_left_out_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parameters are those without this image; of many images that is refused."""
    monkeypatch.setattr("legcal.calibration.doctor.diagnose", lambda *_: ())
    folder = tmp_path / "d"
    chosen = settings(poses=8, board="chessboard", hand_held=True)
    simulate("hexapod", folder, chosen)
    first = read_rows(folder / "corners.csv")
    scattered = np.random.default_rng(1).normal(0.0, 3.0, (len(first), 2))

    def calibrated(views: Container[str]) -> Calibration:
        rows = [
            row | {"u": float(row["u"]) + off[0], "v": float(row["v"]) + off[1]}
            if row["view"] in views
            else row
            for row, off in zip(first, scattered.tolist(), strict=True)
        ]
        write_rows(folder / "corners.csv", rows)
        return calibrate(folder)

    found = calibrated(["c1-3"])
    (note,) = [note for note in found.notes if "left out" in note]
    assert note.startswith("view c1-3: ")
    assert note in [one.what for one in doctor(folder).findings if one.severity == "warning"]
    assert re.search(r"found [234]\.?\d* px from the best pose of the chessboard", note)
    without = calibrate(folder, output=tmp_path / "out", leave_out="c1-3").solution.estimates
    assert found.solution.estimates.values == pytest.approx(without.values, abs=1e-9)
    assert note in calibrate(folder, leave_out="c1-1").notes
    checked = check(folder, tmp_path / "out")
    assert note in checked.notes
    assert not checked.movement.moved
    judged = run("identify", folder, "--noise", tmp_path / "out", "--json").document["notes"]
    assert [note.split(":")[0] for note in judged if "T_base_camera" in note] == ["view c1-3"]
    with pytest.raises(DatasetError, match="view c1-3: its camera could not be placed") as refused:
        calibrated([f"c1-{k}" for k in range(1, 9)] + ["c2-1"])
    found_by_doctor = [one.what for one in doctor(folder).findings if one.severity == "error"]
    assert set(refused.value.problems) <= set(found_by_doctor)


@pytest.mark.system
def test_a_camera_in_the_hand_that_no_step_relates_to_the_machine_is_refused_for_that(
    tmp_path: Path,
) -> None:
    """The board places all images to each other: none of them is to be taken again."""
    chosen = settings(poses=5, board="chessboard", hand_held=True)
    simulate("linear-delta", tmp_path / "d", chosen)
    with pytest.raises(NotIdentifiable, match=r"no camera could be placed.*T_base_board"):
        calibrate(tmp_path / "d")
    notes = identifiability_of_dataset(load_dataset(tmp_path / "d")).notes
    assert any(note.startswith("views c1-1, ") and "no T_base_camera" in note for note in notes)


@pytest.mark.system
def test_a_right_board_is_not_accused_where_the_legs_hardly_tell_the_scale(tmp_path: Path) -> None:
    """Readings are angles; the first minimum ends 0.1 % off in the scale, which counts 70 times."""
    folder = tmp_path / "d"
    chosen = settings(poses=8, views=3, seed=0, board="charuco", hand_held=True)
    simulate("delta", folder, chosen)
    truth = json.loads((folder / "truth/truth.json").read_text())["board"]["T_base_board"]
    rough = {**truth, "xyz": [round(x + 0.004, 4) for x in truth["xyz"]]}
    keyed("dataset.yaml", board__T_base_board=rough)(folder)
    found = calibrate(folder, leave_out="c3-5").solution
    assert found.estimates.values["board.scale"] == pytest.approx(1.0, abs=1e-4)


# The table of corners.

MEASUREMENTS = Measurements(
    views=(View("c2", LENS), View("c1", LENS)),
    image=("a.png", "b.png", "c.png"),
    view=np.array([0, 0, 1]),
    pose=np.arange(3),
    q=np.zeros((3, 1)),
    sigma_q=np.full(1, 1e-6),
)
BOARDS = (FixedBoard(CHARUCO, "base"),)
KEYS = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, CHARUCO.n_corners - 1)),
    min_size=1,
    max_size=8,
    unique=True,
)


@st.composite
def tables(draw: st.DrawFn) -> Corners:
    row, corner = np.array(draw(KEYS), dtype=np.intp).T
    n = len(row)
    number = st.floats(-0.5, 340.0)
    px = np.array(draw(st.lists(st.tuples(number, number), min_size=n, max_size=n)))
    sigma = np.array(draw(st.lists(st.floats(1e-3, 5.0), min_size=n, max_size=n)))
    used = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))
    reason = tuple(USED if u else Rejection(Reason.OTHER, 'far, "off"') for u in used)
    source = tuple(draw(st.lists(st.sampled_from(["detected", "edited"]), min_size=n, max_size=n)))
    return Corners(row, corner, px, sigma, used, reason, source)


def _same(one: Corners, other: Corners) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in vars(one))


@drawn(deadline=None, max_examples=40)
@given(tables())
def test_corners_are_read_as_they_were_written_and_put_in_order(corners: Corners) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "corners.csv"
        write_corners(path, corners, MEASUREMENTS)
        assert _same(read_corners(path, BOARDS, MEASUREMENTS), corners)
    order = canonical_order(MEASUREMENTS, ["leg1"])
    back = order.restore(order.reorder(corners))
    assert _same(back, corners.choose(np.lexsort([corners.corner, corners.row])))


def test_an_edited_corner_wins_and_a_rejected_one_needs_no_place(tmp_path: Path) -> None:
    lines = [
        "c2,a.png,3,10.0,20.0,0.1,used,,detected",
        "c2,a.png,4,11.0,20.0,0.1,used,,detected",
        "c2,a.png,3,10.5,20.5,0.2,used,,edited",
        "c2,a.png,5,,,,rejected,hidden,edited",
    ]
    _write(tmp_path / "corners.csv", lines)
    corners = read_corners(tmp_path / "corners.csv", BOARDS, MEASUREMENTS)
    assert corners.corner.tolist() == [4, 3, 5]
    assert corners.px[:2, 0].tolist() == [11.0, 10.5]
    assert corners.used.tolist() == [True, True, False]
    write_corners(tmp_path / "again.csv", corners, MEASUREMENTS)
    assert "c2,a.png,5,,,,rejected,hidden,edited" in (tmp_path / "again.csv").read_text()


@pytest.mark.system
def test_a_camera_in_the_hand_has_one_order_of_images(tmp_path: Path) -> None:
    made = simulated(
        tmp_path / "set", "hexapod", views=1, poses=24, board="charuco", hand_held=True
    )
    dataset = load_dataset(made.folder, check_images=False)
    m = dataset.measurements
    (sequence,) = image_sequences(m, {})
    assert len(sequence) == m.n_rows == 24
    q = m.q.copy()
    q[sequence[10:], 1] += 1e-3
    doubt = calibrate(replace(dataset, measurements=replace(m, q=q))).doubts[0]
    assert doubt.code == "encoder"
    assert "leg2" in doubt.what
