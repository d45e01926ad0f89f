"""The table of outlines as a cache: what is detected again, what is kept, what wins."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dataset_folder import JOINTS, Folder, folder, hexapod
from outline_tables import assert_same, outlines_of

from legcal.data.cache import fingerprint, plan_dataset, plan_detection, store_outlines
from legcal.data.dataset import CACHE_NAME, OBSERVATIONS_NAME, Dataset, load_dataset
from legcal.data.outlines import (
    Outlines,
    is_edited,
    join_outlines,
    merge_edited,
    no_outlines,
    write_observations,
)
from legcal.errors import DatasetError
from legcal.geometry.types import BoolArray
from legcal.perception.photographs import detection_settings

__all__ = ["folder"]

ALL = np.ones(4, dtype=np.bool_)
NOT_ONE = ALL.copy()
NOT_ONE[1] = False
NONE = ~ALL
SETTINGS = {"blur": 0.4, "parts": ["rod"]}


def edited(outlines: Outlines) -> Outlines:
    return replace(outlines, source=("edited",) * len(outlines))


def row_mask(*rows: int) -> BoolArray:
    mask = NONE.copy()
    mask[list(rows)] = True
    return mask


# The rules, without files.


def test_without_a_table_every_image_is_detected() -> None:
    plan = plan_detection(None, NOT_ONE, None, "now", NONE)
    np.testing.assert_array_equal(plan.detect, [0, 2, 3])
    assert len(plan.keep) == 0
    assert not plan.given.any()


def test_given_table_is_used_as_it_is() -> None:
    table = outlines_of(1)
    plan = plan_detection(table, ALL, None, "now", NONE)
    assert len(plan.detect) == 0
    assert_same(plan.keep, table)
    assert plan.given.all()


def test_images_that_a_given_table_leaves_out_are_detected_if_there_is_a_file() -> None:
    table = outlines_of(1, rows=(0,))
    plan = plan_detection(table, NOT_ONE, None, "now", NONE)
    np.testing.assert_array_equal(plan.detect, [2, 3])
    assert_same(plan.keep, table)
    np.testing.assert_array_equal(plan.given, row_mask(0))


def test_images_with_only_edited_rows_are_detected_and_the_edited_rows_kept() -> None:
    table = join_outlines([outlines_of(1, rows=(0, 1)), edited(outlines_of(2, rows=(2, 3)))])
    plan = plan_detection(table, ALL, None, "now", NONE)
    np.testing.assert_array_equal(plan.detect, [2, 3])
    assert_same(plan.keep, table)
    np.testing.assert_array_equal(plan.given, row_mask(0, 1))


def test_table_of_the_same_fingerprint_is_used_as_it_stands() -> None:
    table = join_outlines([outlines_of(1, rows=(0, 1)), edited(outlines_of(2, rows=(2,)))])
    plan = plan_detection(table, ALL, "now", "now", row_mask(0))
    assert len(plan.detect) == 0
    assert_same(plan.keep, table)
    np.testing.assert_array_equal(plan.given, row_mask(0))


def test_table_of_another_fingerprint_keeps_only_its_edited_rows() -> None:
    by_hand = edited(outlines_of(2, rows=(0, 2)))
    table = join_outlines([outlines_of(1, rows=(1, 3)), by_hand])
    plan = plan_detection(table, ALL, "then", "now", NONE)
    np.testing.assert_array_equal(plan.detect, [0, 1, 2, 3])
    assert_same(plan.keep, by_hand)


def test_rows_that_cannot_be_detected_again_are_kept() -> None:
    table = outlines_of(1)
    plan = plan_detection(table, NOT_ONE, "then", "now", NONE)
    np.testing.assert_array_equal(plan.detect, [0, 2, 3])
    assert set(plan.keep.row.tolist()) == {1}


def test_given_rows_survive_a_change_of_everything_else() -> None:
    plan = plan_detection(outlines_of(1), ALL, "then", "now", row_mask(0, 1))
    np.testing.assert_array_equal(plan.detect, [2, 3])
    assert set(plan.keep.row.tolist()) == {0, 1}
    np.testing.assert_array_equal(plan.given, row_mask(0, 1))


def test_given_rows_that_the_user_removed_are_detected() -> None:
    plan = plan_detection(outlines_of(1, rows=(1,)), ALL, "then", "now", row_mask(0, 1))
    np.testing.assert_array_equal(plan.detect, [0, 2, 3])
    np.testing.assert_array_equal(plan.given, row_mask(1))


def test_edited_rows_win_over_detected_ones() -> None:
    detected, by_hand = outlines_of(1), edited(outlines_of(2, rows=(1,), legs=(0, 2)))
    merged = merge_edited(detected, by_hand)
    assert merged.row_keys() == detected.row_keys()
    assert_same(merged.choose(is_edited(merged)), by_hand)
    others = merged.choose(~is_edited(merged))
    assert len(others) == len(detected) - len(by_hand)


def test_edited_rows_are_kept_where_nothing_was_detected() -> None:
    by_hand = edited(outlines_of(2))
    assert_same(merge_edited(outlines_of(1, rows=(0,), legs=(1,)), by_hand), by_hand)
    assert_same(merge_edited(no_outlines(), by_hand), by_hand)


def test_detected_rows_of_the_table_do_not_return() -> None:
    detected = outlines_of(1, rows=(0,))
    assert_same(merge_edited(detected, outlines_of(2)), detected)


# The files.


def hexapod_outlines(rows: tuple[int, ...] = (0, 1, 2, 3), seed: int = 1) -> Outlines:
    """Rejected outlines of the hexapod's first legs: the tables need no more of them."""
    outlines = outlines_of(seed, rows=rows, rejected=1.0)
    nothing = np.full(len(outlines), np.nan)
    return replace(
        outlines,
        part=tuple(hexapod().legs[leg].cylinders[0].link for leg in outlines.leg),
        h=np.repeat(nothing[:, None], 3, axis=1),
        ends=np.broadcast_to(nothing[:, None, None], (len(nothing), 2, 2)).copy(),
        covariance=np.broadcast_to(nothing[:, None, None], (len(nothing), 2, 2)).copy(),
    )


def test_stored_outlines_are_found_again(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    current = fingerprint(dataset, SETTINGS)
    assert plan_dataset(dataset, current).detect.tolist() == [0, 1, 2, 3]
    outlines = hexapod_outlines()
    assert store_outlines(dataset, outlines, current, NONE) is None
    again = load_dataset(folder.path)
    plan = plan_dataset(again, fingerprint(again, SETTINGS))
    assert len(plan.detect) == 0
    assert_same(plan.keep, outlines)
    assert sorted(p.name for p in folder.path.iterdir() if p.name[0] in "o.") == [
        CACHE_NAME,
        OBSERVATIONS_NAME,
    ]


def change_image(folder: Folder) -> None:
    path = str(folder.path / "images" / "c1_1.png")
    image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    assert image is not None
    image[5, 5] ^= 1
    cv2.imwrite(path, image)


def change_reading(folder: Folder) -> None:
    folder.rows[0][JOINTS[0]] += 1e-7


def change_camera(folder: Folder) -> None:
    folder.camera["camera_matrix"]["data"][2] += 0.01


def change_gamma(folder: Folder) -> None:
    folder.entry["views"]["c1"]["gamma"] = 2.2


def change_pose(folder: Folder) -> None:
    folder.entry["views"]["c1"]["T_base_camera"]["xyz"][0] += 0.01


def change_legs(folder: Folder) -> None:
    folder.entry["views"]["c2"]["legs"] = ["leg1"]


def change_sigma(folder: Folder) -> None:
    folder.entry["encoder_sigma"] = 3e-6


@pytest.mark.parametrize(
    "change",
    [
        change_image,
        change_reading,
        change_camera,
        change_gamma,
        change_pose,
        change_legs,
        change_sigma,
    ],
)
def test_every_change_of_the_dataset_changes_the_fingerprint(
    folder: Folder, change: Callable[[Folder], None]
) -> None:
    before = fingerprint(load_dataset(folder.path), SETTINGS)
    change(folder)
    folder.write()
    assert fingerprint(load_dataset(folder.path), SETTINGS) != before


def add_board(folder: Folder) -> dict[str, Any]:
    """Fix a board to the base, and return its block."""
    pose = {"xyz": [0.1, 0.0, 0.0], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    board = {"kind": "chessboard", "squares_x": 6, "squares_y": 9, "square": 0.03}
    folder.entry["board"] = board | {"T_base_board": pose}
    folder.write()
    found: dict[str, Any] = folder.entry["board"]
    return found


def correct_square(board: dict[str, Any]) -> None:
    board["square"] = 0.031


def correct_pose_of_board(board: dict[str, Any]) -> None:
    board["T_base_board"]["xyz"][2] += 1e-4


def remove_pose_of_board(board: dict[str, Any]) -> None:
    del board["T_base_board"]


@pytest.mark.parametrize("change", [correct_square, correct_pose_of_board, remove_pose_of_board])
def test_corrected_board_or_pose_of_it_detects_again(
    folder: Folder, change: Callable[[dict[str, Any]], None]
) -> None:
    board = add_board(folder)
    dataset = load_dataset(folder.path)
    store_outlines(dataset, hexapod_outlines(), fingerprint(dataset, SETTINGS), NONE)
    same = load_dataset(folder.path)
    assert len(plan_dataset(same, fingerprint(same, SETTINGS)).detect) == 0
    change(board)
    folder.write()
    other = load_dataset(folder.path)
    plan = plan_dataset(other, fingerprint(other, SETTINGS))
    assert plan.detect.tolist() == [0, 1, 2, 3]
    assert len(plan.keep) == 0


def test_settings_model_and_version_change_the_fingerprint(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    dataset = load_dataset(folder.path)
    before = fingerprint(dataset, SETTINGS)
    assert fingerprint(dataset, {**SETTINGS, "blur": 0.5}) != before
    assert fingerprint(dataset, dict(reversed(SETTINGS.items()))) == before
    urdf = tmp_path / "other.urdf"
    urdf.write_bytes(dataset.machine.urdf_path.read_bytes() + b"\n")
    other = replace(dataset, machine=replace(dataset.machine, urdf_path=urdf))
    assert fingerprint(other, SETTINGS) != before
    monkeypatch.setattr("legcal.data.cache.__version__", "0.0.0")
    assert fingerprint(dataset, SETTINGS) != before


def test_another_version_of_the_detector_searches_again(monkeypatch: pytest.MonkeyPatch) -> None:
    before = detection_settings()
    monkeypatch.setattr("legcal.perception.photographs.DETECTOR_VERSION", 0)
    assert detection_settings() != before


def test_order_of_rows_and_views_does_not_change_the_fingerprint(folder: Folder) -> None:
    before = fingerprint(load_dataset(folder.path), SETTINGS)
    folder.rows.reverse()
    folder.columns.reverse()
    folder.entry["views"] = dict(reversed(folder.entry["views"].items()))
    folder.write()
    assert fingerprint(load_dataset(folder.path), SETTINGS) == before


def test_changed_image_is_detected_again_and_stale_rows_do_not_matter(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    store_outlines(dataset, hexapod_outlines(), fingerprint(dataset, SETTINGS), NONE)
    del folder.rows[0]
    folder.write()
    again = load_dataset(folder.path)
    plan = plan_dataset(again, fingerprint(again, SETTINGS))
    assert plan.detect.tolist() == [0, 1, 2]
    assert len(plan.keep) == 0


def test_given_rows_are_remembered_by_their_image(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    names = dataset.machine.leg_names
    path = folder.path / OBSERVATIONS_NAME
    write_observations(path, hexapod_outlines(rows=(0, 2)), dataset.measurements, names)
    dataset = load_dataset(folder.path)
    current = fingerprint(dataset, SETTINGS)
    plan = plan_dataset(dataset, current)
    assert plan.detect.tolist() == [1, 3]
    table = join_outlines([plan.keep, hexapod_outlines(rows=(1, 3))])
    assert store_outlines(dataset, table, current, plan.given) is None
    change_sigma(folder)
    folder.rows.reverse()
    folder.write()
    again = load_dataset(folder.path)
    plan = plan_dataset(again, fingerprint(again, SETTINGS))
    assert plan.detect.tolist() == [0, 2]
    assert set(plan.keep.row.tolist()) == {1, 3}


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff", b'{"format": 1}', b"null"])
def test_fingerprint_that_cannot_be_read_matches_nothing(folder: Folder, content: bytes) -> None:
    dataset = load_dataset(folder.path)
    current = fingerprint(dataset, SETTINGS)
    store_outlines(dataset, hexapod_outlines(), current, NONE)
    (folder.path / CACHE_NAME).write_bytes(content)
    plan = plan_dataset(load_dataset(folder.path), current)
    assert plan.detect.tolist() == [0, 1, 2, 3]


def test_fingerprint_file_is_as_documented(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    store_outlines(dataset, hexapod_outlines(), "abc", row_mask(0), ["view c1: a note."])
    assert json.loads((folder.path / CACHE_NAME).read_text()) == {
        "format": 1,
        "fingerprint": "abc",
        "given": [["c1", "images/c1_1.png"]],
        "notes": ["view c1: a note."],
    }
    assert plan_dataset(load_dataset(folder.path), "abc").notes == ("view c1: a note.",)
    assert plan_dataset(load_dataset(folder.path), "abcd").notes == ()


def test_folder_that_cannot_be_written_to_is_a_note(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = load_dataset(folder.path)

    def refuse(*_: Any, **__: Any) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    note = store_outlines(dataset, hexapod_outlines(), "abc", NONE)
    assert note is not None
    assert "found 'Permission denied', needed a folder that can be written to" in note


def test_row_with_outlines_needs_no_image(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    path = folder.path / OBSERVATIONS_NAME
    write_observations(
        path, hexapod_outlines(rows=(0, 2)), dataset.measurements, dataset.machine.leg_names
    )
    (folder.path / "images" / "c1_1.png").unlink()
    assert load_dataset(folder.path).measurements.n_rows == 4
    (folder.path / "images" / "c1_2.png").unlink()
    with pytest.raises(DatasetError, match=r"row 2: image .*c1_2\.png could not be read"):
        load_dataset(folder.path)


def test_dataset_of_outlines_alone_is_read(folder: Folder) -> None:
    dataset: Dataset = load_dataset(folder.path)
    for row in folder.rows:
        row["image"] = ""
    folder.write()
    blank = load_dataset(folder.path, check_images=False)
    path = folder.path / OBSERVATIONS_NAME
    write_observations(path, hexapod_outlines(), blank.measurements, dataset.machine.leg_names)
    again = load_dataset(folder.path)
    plan = plan_dataset(again, fingerprint(again, SETTINGS))
    assert len(plan.detect) == 0
    assert_same(plan.keep, hexapod_outlines())
