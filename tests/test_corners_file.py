"""The table ``corners.csv``."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from boards import CHARUCO, LENS
from hypothesis import given, settings
from hypothesis import strategies as st

from legcal.data.corners import (
    COLUMNS,
    Corners,
    format_corners,
    found_corners,
    join_corners,
    read_corners,
    write_corners,
)
from legcal.data.measurements import Measurements, View
from legcal.data.rows import canonical_order
from legcal.errors import DatasetError

HEAD = ",".join(COLUMNS)
MEASUREMENTS = Measurements(
    views=(View("c2", LENS), View("c1", LENS)),
    image=("a.png", "b.png", "c.png"),
    view=np.array([0, 0, 1]),
    pose=np.arange(3),
    q=np.zeros((3, 1)),
    sigma_q=1e-6,
)
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
    reason = tuple("" if u else 'far, "off"' for u in used)
    source = tuple(draw(st.lists(st.sampled_from(["detected", "edited"]), min_size=n, max_size=n)))
    return Corners(row, corner, px, sigma, used, reason, source)


def _same(one: Corners, other: Corners) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in vars(one))


@settings(max_examples=40)
@given(tables())
def test_corners_are_read_as_they_were_written(corners: Corners) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "corners.csv"
        write_corners(path, corners, MEASUREMENTS)
        assert _same(read_corners(path, CHARUCO, MEASUREMENTS), corners)


@settings(max_examples=40)
@given(tables())
def test_order_of_work_and_back_is_the_order_of_rows_and_numbers(corners: Corners) -> None:
    order = canonical_order(MEASUREMENTS, ["leg1"])
    back = order.restore(order.reorder(corners))
    assert _same(back, corners.choose(np.lexsort([corners.corner, corners.row])))


def test_corners_of_some_rows_are_theirs() -> None:
    corners = found_corners(
        np.array([0, 1, 2]), np.array([3, 4, 5]), np.ones((3, 2)), np.full(3, 0.1)
    )
    some = join_corners([corners]).at(np.array([2, 0]))
    assert some.row.tolist() == [1, 0]
    assert some.corner.tolist() == [3, 5]


def _read(tmp_path: Path, *lines: str) -> Corners:
    (tmp_path / "corners.csv").write_text("\n".join([HEAD, *lines]) + "\n")
    return read_corners(tmp_path / "corners.csv", CHARUCO, MEASUREMENTS)


def test_an_edited_corner_wins_over_the_detected_one(tmp_path: Path) -> None:
    corners = _read(
        tmp_path,
        "c2,a.png,3,10.0,20.0,0.1,used,,detected",
        "c2,a.png,4,11.0,20.0,0.1,used,,detected",
        "c2,a.png,3,10.5,20.5,0.2,used,,edited",
    )
    assert dict(zip(corners.corner.tolist(), corners.px[:, 0].tolist(), strict=True)) == {
        3: 10.5,
        4: 11.0,
    }


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("c9,a.png,3,1,2,0.1,used,,detected", "column view: .* unknown view 'c9'"),
        ("c2,c.png,3,1,2,0.1,used,,detected", "column image: .* found 'c.png', needed an image of"),
        ("c2,a.png,15,1,2,0.1,used,,detected", "column corner: .* found '15', needed .* 0 to 14"),
        ("c2,a.png,-1,1,2,0.1,used,,detected", "column corner: .* found '-1'"),
        ("c2,a.png,1.0,1,2,0.1,used,,detected", "column corner: .* found '1.0'"),
        ("c2,a.png,3,x,2,0.1,used,,detected", "column u: .* found 'x', needed a finite number"),
        ("c2,a.png,3,1,,0.1,used,,detected", "column v: .* found an empty cell"),
        ("c2,a.png,3,1,nan,0.1,used,,detected", "column v: .* found 'nan'"),
        ("c2,a.png,3,470,2,0.1,used,,detected", "column u: .* found 470 px, .* inside the image"),
        ("c2,a.png,3,1,2,0,used,,detected", "column sigma: .* found '0', needed a standard dev"),
        ("c2,a.png,3,1,2,-0.1,used,,detected", "column sigma: .* found '-0.1'"),
        ("c2,a.png,3,1,2,0.1,good,,detected", "column verdict: .* needed used or rejected"),
        ("c2,a.png,3,1,2,0.1,used,,me", "column source: .* needed detected or edited"),
        ("c2,a.png,3,1,2,0.1,used", "found 7 cells, needed 9"),
    ],
)
def test_a_wrong_cell_is_named(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        _read(tmp_path, "c1,c.png,0,5.0,5.0,0.1,used,,detected", line)
    assert len(caught.value.problems) == 1
    assert "row 2 (line 3)" in str(caught.value)


def test_a_rejected_corner_needs_no_place(tmp_path: Path) -> None:
    corners = _read(tmp_path, "c2,a.png,3,,,,rejected,hidden,edited")
    assert not corners.used.any()
    assert "c2,a.png,3,,,,rejected,hidden,edited" in format_corners(corners, MEASUREMENTS)


def test_twice_the_same_corner_and_none_at_all_are_refused(tmp_path: Path) -> None:
    line = "c2,a.png,3,1,2,0.1,used,,detected"
    with pytest.raises(DatasetError, match=r"row 2 .* the same image and corner in row 1"):
        _read(tmp_path, line, line)
    with pytest.raises(
        DatasetError, match="found a header and no row, needed the corners of the board"
    ):
        _read(tmp_path)
