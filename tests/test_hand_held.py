"""Views of a camera in the hand, and datasets with a board."""

import csv

import numpy as np
import pytest
from dataset_folder import Folder, folder

from legcal.data.corners import COLUMNS
from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError

__all__ = ["folder"]
BOARD = {"kind": "charuco", "squares_x": 4, "squares_y": 3, "square": 0.03, "marker": 0.02,
         "dictionary": "DICT_4X4_50"}  # fmt: skip


def _hold(folder: Folder, view: str) -> None:
    folder.entry["board"] = BOARD
    folder.entry["views"][view]["hand_held"] = True
    folder.entry["views"][view].pop("T_base_camera", None)


def _corners(folder: Folder, places: list[tuple[str, str]], n: int = 6) -> None:
    with (folder.path / "corners.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for view, image in places:
            for k in range(n):
                writer.writerow([view, image, k, 5.0 + k, 6.0, 0.1, "used", "", "detected"])


def _refused(folder: Folder, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        load_dataset(folder.write())


def test_every_image_of_a_hand_held_view_is_a_view_in_the_order_of_rows(folder: Folder) -> None:
    _hold(folder, "c1")
    dataset = load_dataset(folder.write())
    m = dataset.measurements
    assert [view.name for view in m.views] == ["c1-1", "c1-2", "c2"]
    assert m.view.tolist() == [0, 1, 2, 2]
    assert len(dataset.camera_paths) == 3
    assert m.views[0].T_base_camera is None
    assert dataset.board is not None
    assert dataset.T_base_board is None


def test_hand_held_views_count_in_the_order_of_the_table(folder: Folder) -> None:
    _hold(folder, "c2")
    folder.rows.reverse()
    m = load_dataset(folder.write()).measurements
    assert [m.views[v].name for v in m.view] == ["c2-1", "c2-2", "c1", "c1"]
    assert m.image[0].endswith("c2_2.png")


def test_corners_belong_to_the_views_of_the_images(folder: Folder) -> None:
    _hold(folder, "c1")
    _corners(folder, [("c1-1", "images/c1_1.png"), ("c1-2", "images/c1_2.png")])
    corners = load_dataset(folder.write()).corners
    assert corners is not None
    assert np.bincount(corners.row).tolist() == [6, 6]


def test_a_camera_in_the_hand_needs_a_board(folder: Folder) -> None:
    _hold(folder, "c1")
    del folder.entry["board"]
    _refused(folder, "views.c1.hand_held could not be used: found no board, needed a calibration")


def test_a_camera_in_the_hand_has_no_one_pose(folder: Folder) -> None:
    pose = folder.entry["views"]["c1"]["T_base_camera"]
    _hold(folder, "c1")
    folder.entry["views"]["c1"]["T_base_camera"] = pose
    _refused(folder, "views.c1.T_base_camera could not be used: found one pose of a camera")


def test_a_view_may_not_have_the_name_of_an_image(folder: Folder) -> None:
    _hold(folder, "c1")
    folder.entry["views"]["c1-2"] = folder.entry["views"].pop("c2")
    for row in folder.rows[2:]:
        row["view"] = "c1-2"
    _refused(folder, "views.c1-2 could not be used: found the name that an image of the hand-held")


@pytest.mark.parametrize(("n", "found"), [(3, "3"), (0, "no")])
def test_given_corners_must_place_every_hand_held_image(folder: Folder, n: int, found: str) -> None:
    _hold(folder, "c1")
    _corners(folder, [("c1-1", "images/c1_1.png"), ("c2", "images/c2_1.png")])
    text = (folder.path / "corners.csv").read_text().splitlines()
    more = [f"c1-2,images/c1_2.png,{k},{5 + k},6,0.1,used,,edited" for k in range(n)]
    (folder.path / "corners.csv").write_text("\n".join([*text, *more]) + "\n")
    _refused(folder, f"row 2: its camera could not be placed: found {found} corners of the board")


def test_a_hand_held_image_must_be_there_or_its_corners(folder: Folder) -> None:
    _hold(folder, "c1")
    folder.rows[1]["image"] = ""
    _refused(folder, "row 2, column image: its camera could not be placed: found neither an image")


def test_corners_without_a_board_are_refused(folder: Folder) -> None:
    _corners(folder, [("c1", "images/c1_1.png")])
    _refused(folder, "corners.csv: the corners could not be used: found no board in the dataset")


def test_hand_held_is_yes_or_no(folder: Folder) -> None:
    folder.entry["views"]["c1"]["hand_held"] = 3
    _refused(folder, "views.c1.hand_held could not be read: found 3, needed true or false")


def test_the_pose_of_a_board_is_read(folder: Folder) -> None:
    pose = {"xyz": [0.1, 0.0, 0.0], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    folder.entry["board"] = BOARD | {"T_base_board": pose}
    T = load_dataset(folder.write()).T_base_board
    assert T is not None
    assert T.translation == pytest.approx([0.1, 0.0, 0.0])


def test_a_wrong_board_is_named_with_its_file(folder: Folder) -> None:
    folder.entry["board"] = BOARD | {"square": 30}
    _refused(folder, r"dataset.yaml: board.square could not be used: found 30 m")
    folder.entry["board"] = "charuco"
    _refused(folder, r"dataset.yaml: board could not be read: found 'charuco', needed a mapping")
