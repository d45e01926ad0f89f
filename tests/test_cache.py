"""Stored outlines: which images are searched again, which rows are kept, what makes them stale."""

import json
import os
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dataset_folder import JOINTS, Folder, folder, hexapod
from outline_tables import assert_same, outlines_of

from legcal.data.cache import (
    DetectionPlan,
    fingerprint,
    note_on_missing_photographs,
    plan_dataset,
    plan_detection,
    store_outlines,
)
from legcal.data.dataset import CACHE_NAME, OBSERVATIONS_NAME, Dataset, load_dataset
from legcal.data.outlines import Outlines, join_outlines, write_observations
from legcal.errors import DatasetError
from legcal.geometry.types import BoolArray
from legcal.perception.photographs import detection_settings
from legcal.vision.image_file import Move

__all__ = ["folder"]

ALL = (0, 1, 2, 3)
SETTINGS = {"blur": 0.4, "parts": ["rod"]}


def _mask(rows: Collection[int]) -> BoolArray:
    return np.isin(np.arange(4), list(rows))


def _hexapod_outlines(rows: tuple[int, ...] = ALL) -> Outlines:
    """Rejected outlines of the hexapod's first legs: the tables need no more of them."""
    outlines = outlines_of(1, rows=rows, rejected=1.0)
    nothing = np.full(len(outlines), np.nan)
    return replace(
        outlines,
        part=tuple(hexapod().legs[leg].cylinders[0].link for leg in outlines.leg),
        h=np.repeat(nothing[:, None], 3, axis=1),
        ends=np.broadcast_to(nothing[:, None, None], (len(nothing), 2, 2)).copy(),
        covariance=np.broadcast_to(nothing[:, None, None], (len(nothing), 2, 2)).copy(),
    )


def _plan(folder: Folder) -> DetectionPlan:
    dataset = load_dataset(folder.path)
    return plan_dataset(dataset, fingerprint(dataset, SETTINGS))


def _store(folder: Folder) -> Dataset:
    dataset = load_dataset(folder.path)
    current = fingerprint(dataset, SETTINGS)
    assert store_outlines(dataset, _hexapod_outlines(), current, _mask(())) is None
    return dataset


def _give(folder: Folder, rows: tuple[int, ...]) -> None:
    """Write a table of outlines as a user does."""
    dataset = load_dataset(folder.path, check_images=False)
    path, names = folder.path / OBSERVATIONS_NAME, dataset.machine.leg_names
    write_observations(path, _hexapod_outlines(rows), dataset.measurements, names)


@pytest.mark.parametrize(
    ("detected", "edited", "images", "recorded", "given", "searched", "kept", "still_given"),
    [
        (None, (), (0, 2, 3), None, (), (0, 2, 3), (), ()),  # there is no table
        (ALL, (), ALL, None, (), (), ALL, ALL),  # given by the user
        ((0,), (), (0, 2, 3), None, (), (2, 3), (0,), (0,)),  # given for some of the images
        ((0, 1), (2, 3), ALL, None, (), (2, 3), ALL, (0, 1)),  # given, others edited in part
        ((0, 1), (2,), ALL, "now", (0,), (), (0, 1, 2), (0,)),  # stored and current
        ((1, 3), (0, 2), ALL, "then", (), ALL, (0, 2), ()),  # stale: edited rows stay
        (ALL, (), (0, 2, 3), "then", (), (0, 2, 3), (1,), ()),  # stale, an image is gone
        (ALL, (), ALL, "then", (0, 1), (2, 3), (0, 1), (0, 1)),  # stale: given rows stay
        ((1,), (), ALL, "then", (0, 1), (0, 2, 3), (1,), (1,)),  # a given row was removed
    ],
)
def test_what_is_searched_and_what_is_kept(
    detected: tuple[int, ...] | None,
    edited: tuple[int, ...],
    images: tuple[int, ...],
    recorded: str | None,
    given: tuple[int, ...],
    searched: tuple[int, ...],
    kept: tuple[int, ...],
    still_given: tuple[int, ...],
) -> None:
    table = None
    if detected is not None:
        parts = [outlines_of(1, rows=detected)]
        if edited:
            by_hand = outlines_of(2, rows=edited)
            parts.append(replace(by_hand, source=("edited",) * len(by_hand)))
        table = join_outlines(parts)
    plan = plan_detection(table, _mask(images), recorded, "now", _mask(given))
    assert tuple(plan.detect) == searched
    assert tuple(np.flatnonzero(plan.given)) == still_given
    if table is None:
        assert len(plan.keep) == 0
    else:
        assert_same(plan.keep, table.choose(np.isin(table.row, kept)))


def _change_image(folder: Folder) -> None:
    path = str(folder.path / "images" / "c1_1.png")
    image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
    assert image is not None
    image[5, 5] ^= 1
    cv2.imwrite(path, image)


def _set(*keys: str | int, by: Any) -> Callable[[Folder], None]:
    """Change a value of the dataset by a summand, or to what is no number."""

    def change(folder: Folder) -> None:
        block: Any = {"rows": folder.rows, "camera": folder.camera, "entry": folder.entry}
        for key in keys[:-1]:
            block = block[key]
        block[keys[-1]] = block[keys[-1]] + by if isinstance(by, float) else by

    return change


STATED = {"version": 1, "sigma": {}, "names": ["fx"], "covariance": [[4.0]]}


@pytest.mark.parametrize(
    "change",
    [
        _change_image,
        _set("rows", 0, JOINTS[0], by=1e-7),
        _set("camera", "camera_matrix", "data", 2, by=0.01),
        _set("camera", "legcal_camera", by=STATED),
        _set("entry", "views", "c1", "gamma", by=0.2),
        _set("entry", "views", "c1", "T_base_camera", "xyz", 0, by=0.01),
        _set("entry", "views", "c2", "legs", by=["leg1"]),
        _set("entry", "encoder_sigma", by=1e-6),
        _set("entry", "board", "square", by=1e-3),
        _set("entry", "board", "T_base_board", "xyz", 2, by=1e-4),
        _set("entry", "board", "T_base_board", by=None),
    ],
)
def test_every_change_of_the_dataset_makes_stored_outlines_stale(
    folder: Folder, change: Callable[[Folder], None]
) -> None:
    pose = {"xyz": [0.1, 0.0, 0.0], "quat_xyzw": [0.0, 0.0, 0.0, 1.0]}
    board = {"kind": "chessboard", "squares_x": 6, "squares_y": 9, "square": 0.03}
    folder.entry["board"] = board | {"T_base_board": pose}
    folder.entry["views"]["c1"]["gamma"] = 2.0
    folder.write()
    _store(folder)
    assert_same(_plan(folder).keep, _hexapod_outlines())
    folder.rows.reverse()  # order does not count
    folder.columns.reverse()
    folder.entry["views"] = dict(reversed(folder.entry["views"].items()))
    folder.write()
    assert len(_plan(folder).detect) == 0
    folder.rows.reverse()
    change(folder)
    folder.write()
    plan = _plan(folder)
    assert plan.detect.tolist() == list(ALL)
    assert len(plan.keep) == 0


def test_moves_of_cameras_are_kept_with_the_outlines(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    moves = {dataset.measurements.image[1]: Move(0.5, -0.25, 1e-4, 0.0, 0.0, 1e-7)}
    current = fingerprint(dataset, SETTINGS)
    store_outlines(replace(dataset, moves=moves), _hexapod_outlines(), current, _mask(()))
    assert _plan(folder).moves == moves


def test_settings_model_and_version_make_them_stale(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = load_dataset(folder.path)
    before = fingerprint(dataset, SETTINGS)
    assert fingerprint(dataset, {**SETTINGS, "blur": 0.5}) != before
    assert fingerprint(dataset, dict(reversed(SETTINGS.items()))) == before
    urdf = folder.path / "other.urdf"
    urdf.write_bytes(dataset.machine.urdf_path.read_bytes() + b"\n")
    other = replace(dataset, machine=replace(dataset.machine, urdf_path=urdf))
    assert fingerprint(other, SETTINGS) != before
    monkeypatch.setattr("legcal.data.cache.__version__", "0.0.0")
    assert fingerprint(dataset, SETTINGS) != before
    settings = detection_settings()
    monkeypatch.setattr("legcal.perception.photographs.DETECTOR_VERSION", 0)
    assert detection_settings() != settings


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff", b'{"format": 1}', b"null"])
def test_a_file_that_cannot_be_read_matches_nothing(folder: Folder, content: bytes) -> None:
    _store(folder)
    (folder.path / CACHE_NAME).write_bytes(content)
    assert _plan(folder).detect.tolist() == list(ALL)


@pytest.mark.parametrize("n_written", [0, 1, 2])
@pytest.mark.parametrize(
    ("before", "searched", "error"),
    [("stale", ALL, OSError("disk")), ("given", (1, 2, 3), KeyboardInterrupt())],
)
def test_writing_that_stops_anywhere_leaves_what_is_searched_again(
    before: str,
    searched: tuple[int, ...],
    n_written: int,
    error: BaseException,
    folder: Folder,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if before == "given":
        _give(folder, (0,))
    elif before == "stale":
        _store(folder)
        _change_image(folder)
    dataset, replacing, written = load_dataset(folder.path), os.replace, list[str]()
    plan, current = _plan(folder), fingerprint(dataset, SETTINGS)
    assert tuple(plan.detect) == searched

    def replace_some(source: Path, target: Path) -> None:
        if len(written) == n_written:
            raise error
        written.append(target.name)
        replacing(source, target)

    with monkeypatch.context() as during, suppress(KeyboardInterrupt):
        during.setattr(os, "replace", replace_some)
        note = store_outlines(dataset, _hexapod_outlines(), current, plan.given)
        assert note is not None
    assert len(written) == n_written
    assert tuple(_plan(folder).detect) == searched
    assert np.array_equal(_plan(folder).given, plan.given)
    store_outlines(dataset, _hexapod_outlines(), current, plan.given)
    assert len(_plan(folder).detect) == 0


def test_the_file_is_as_documented(folder: Folder) -> None:
    dataset = load_dataset(folder.path)
    store_outlines(dataset, _hexapod_outlines(), "abc", _mask([0]), ["view c1: a note."])
    assert json.loads((folder.path / CACHE_NAME).read_text()) == {
        "format": 1,
        "fingerprint": "abc",
        "given": [["c1", "images/c1_1.png"]],
        "notes": ["view c1: a note."],
        "outlines": len(_hexapod_outlines()),
    }
    again = load_dataset(folder.path)
    assert plan_dataset(again, "abc").notes == ("view c1: a note.",)
    assert plan_dataset(again, "abcd").notes == ()


def test_a_photograph_that_is_gone_is_noted_where_its_outlines_are_cached(folder: Folder) -> None:
    _store(folder)
    assert note_on_missing_photographs(load_dataset(folder.path)) == []
    (folder.path / "images" / "c1_1.png").unlink()
    (note,) = note_on_missing_photographs(load_dataset(folder.path))
    assert note.endswith("c1_1.png is missing; its cached outlines are used.")
    (folder.path / CACHE_NAME).unlink()  # outlines of the user
    assert note_on_missing_photographs(load_dataset(folder.path)) == []


def test_rows_with_outlines_need_no_image(folder: Folder) -> None:
    _give(folder, (0, 2))
    (folder.path / "images" / "c1_1.png").unlink()
    assert load_dataset(folder.path).measurements.n_rows == 4
    (folder.path / "images" / "c1_2.png").unlink()
    with pytest.raises(DatasetError, match=r"row 2: image .*c1_2\.png could not be read"):
        load_dataset(folder.path)
    for row in folder.rows:
        row["image"] = ""
    folder.write()
    (folder.path / OBSERVATIONS_NAME).unlink()
    _give(folder, ALL)
    plan = _plan(folder)
    assert len(plan.detect) == 0
    assert_same(plan.keep, _hexapod_outlines())
