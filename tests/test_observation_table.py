"""observations.csv: written, read back exactly, corrected by hand, and refused."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from outline_tables import LEG_NAMES, LEGS, assert_same, outlines_of, recorded

from legcal.data.measurements import View, row_names
from legcal.data.outlines import (
    ENCODING,
    QUALITY,
    Outlines,
    no_outlines,
    read_observations,
    reject_unused_legs,
    write_observations,
)
from legcal.errors import DatasetError

FAST = settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
MEASUREMENTS = recorded(labels=["", "", "a", "b"])
WHERE = (0, 1, 2, 3, 4)  # the columns that name an outline


def written(tmp_path: Path, outlines: Outlines) -> Path:
    path = tmp_path / "observations.csv"
    write_observations(path, outlines, MEASUREMENTS, LEG_NAMES)
    return path


def read(path: Path, *, skip_stale: bool = False) -> Outlines:
    return read_observations(path, LEGS, MEASUREMENTS, skip_stale=skip_stale)


def edit(path: Path, row: int, **cells: str) -> Path:
    """Change cells of a row, counted from 1."""
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    for name, cell in cells.items():
        lines[row][lines[0].index(name)] = cell
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    return path


@FAST
@given(st.integers(0, 2**32 - 1))
def test_outlines_are_read_exactly_as_they_were_written(tmp_path: Path, seed: int) -> None:
    outlines = outlines_of(seed)
    assert_same(read(written(tmp_path, outlines)), outlines)


def test_header_is_that_of_the_contract(tmp_path: Path) -> None:
    header = written(tmp_path, no_outlines()).read_text().strip()
    assert header == (
        "view,image,leg,part,edge,a,b,c,u0,v0,u1,v1,s00,s01,s11,verdict,reason,source,"
        "contrast,length,residual,gamma,by_gamma"
    )


def test_table_without_quality_is_read(tmp_path: Path) -> None:
    outlines = outlines_of(3)
    path = written(tmp_path, outlines)
    with path.open(newline="") as file:
        lines = [cells[: -len(QUALITY) - len(ENCODING)] for cells in csv.reader(file)]
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    found = read(path)
    for name in (*QUALITY, *ENCODING):
        assert np.isnan(getattr(found, name)).all()
    no = np.full(len(outlines), np.nan)
    bare = replace(outlines, contrast=no, length=no, residual=no, gamma=no, by_gamma=no)
    assert_same(found, bare)


def test_edited_row_has_no_quality(tmp_path: Path) -> None:
    found = read(edit(written(tmp_path, outlines_of(6, rejected=0.0)), 3, source="edited"))
    assert np.isnan(found.contrast[2])
    assert np.isfinite(found.contrast[[0, 1, 3]]).all()


@pytest.mark.parametrize("cell", ["-1", "inf", "good"])
def test_quality_that_is_no_number_is_refused(tmp_path: Path, cell: str) -> None:
    path = edit(written(tmp_path, outlines_of(3, rejected=0.0)), 2, residual=cell)
    with pytest.raises(DatasetError, match=f"row 2 .*, column residual: .*found '{cell}', needed"):
        read(path)


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"gamma": "0"}, "column gamma: .*found '0', needed a number above 0"),
        ({"by_gamma": "nan"}, "column by_gamma: .*found 'nan', needed a finite number"),
        (
            {"by_gamma": ""},
            "column by_gamma: .*found an empty cell, needed a finite number beside gamma",
        ),
    ],
)
def test_gamma_that_cannot_be_is_refused(tmp_path: Path, cells: dict[str, str], words: str) -> None:
    path = edit(written(tmp_path, outlines_of(3, rejected=0.0)), 2, **cells)
    with pytest.raises(DatasetError, match=f"row 2 .*, {words}") as refused:
        read(path)
    assert len(refused.value.problems) == 1


def test_edited_row_does_not_move_with_gamma(tmp_path: Path) -> None:
    found = read(edit(written(tmp_path, outlines_of(6, rejected=0.0)), 3, source="edited"))
    for name in ENCODING:
        assert np.isnan(getattr(found, name)[2])
        assert np.isfinite(getattr(found, name)[[0, 1, 3]]).all()


def test_empty_table_is_read_as_empty(tmp_path: Path) -> None:
    assert len(read(written(tmp_path, no_outlines()))) == 0


def test_writing_what_was_read_gives_the_same_bytes(tmp_path: Path) -> None:
    path = written(tmp_path, outlines_of(3))
    content = path.read_bytes()
    write_observations(path, read(path), MEASUREMENTS, LEG_NAMES)
    assert path.read_bytes() == content
    assert [p.name for p in tmp_path.iterdir()] == ["observations.csv"]


def test_line_ends_byte_order_mark_and_column_order_do_not_matter(tmp_path: Path) -> None:
    outlines = outlines_of(4)
    path = written(tmp_path, outlines)
    with path.open(newline="") as file:
        lines = [cells[::-1] for cells in csv.reader(file)]
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        csv.writer(file, lineterminator="\r\n").writerows(lines)
    assert_same(read(path), outlines)


def test_numbers_not_found_are_empty_cells(tmp_path: Path) -> None:
    outlines = outlines_of(5, rejected=0.9)
    assert np.isnan(outlines.h).any()
    assert "nan" not in written(tmp_path, outlines).read_text()


def test_edited_row_is_read_as_edited(tmp_path: Path) -> None:
    outlines = outlines_of(6, rejected=0.0)
    path = edit(written(tmp_path, outlines), 3, source="edited", verdict="rejected", reason="mine")
    found = read(path)
    assert found.source[2] == "edited"
    assert not found.used[2]
    assert found.reason[2] == "mine"
    np.testing.assert_array_equal(found.h, outlines.h)


def test_rounded_direction_is_made_unit(tmp_path: Path) -> None:
    outlines = outlines_of(7, rejected=0.0)
    cells = {name: f"{x:.4f}" for name, x in zip("abc", outlines.h[0], strict=True)}
    found = read(edit(written(tmp_path, outlines), 1, **cells))
    assert np.linalg.norm(found.h[0]) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(found.h[0], outlines.h[0], atol=1e-4)


def test_ends_in_either_order_are_read_base_first(tmp_path: Path) -> None:
    outlines = outlines_of(8)
    turned = replace(
        outlines, ends=outlines.ends[:, ::-1], covariance=outlines.covariance[:, ::-1, ::-1]
    )
    assert_same(read(written(tmp_path, turned)), outlines)


def test_one_edge_without_the_other_is_allowed(tmp_path: Path) -> None:
    path = written(tmp_path, outlines_of(9))
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2] + lines[3:]))
    assert len(read(path)) == len(lines) - 2


def test_rows_without_image_are_named_by_label_or_else_by_number() -> None:
    assert row_names(MEASUREMENTS) == ("i/2.png", "i/1.png", "a", "b")
    assert row_names(recorded()) == ("i/2.png", "i/1.png", "3", "4")
    twice = recorded(["", "", "", ""], ["x", "y", "x", "z"])
    assert row_names(twice) == ("1", "y", "3", "z")
    shared = replace(recorded(["", "", "", ""], ["x", "y"]), pose=np.array([0, 0, 1, 1]))
    assert row_names(shared) == ("x", "x", "y", "y")
    clash = recorded(["x", "", "", ""], ["", "y", "x", "z"])
    assert row_names(clash) == ("x", "y", "3", "z")


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ({"view": "up"}, "column view: .* found the unknown view 'up', needed a view with"),
        ({"image": "i/1.png"}, "column image: .* found 'i/1.png', needed an image of view right"),
        ({"leg": "leg9"}, "column leg: .* found the unknown leg 'leg9', needed a leg of the mech"),
        (
            {"part": "legA_rod"},
            "column part: .* found the unknown part 'legA_rod', .* of legB; did",
        ),
        ({"edge": "3"}, "column edge: .* found '3', needed 1 or 2"),
        ({"verdict": "yes"}, "column verdict: .* found 'yes', needed used or rejected"),
        ({"source": "me"}, "column source: .* found 'me', needed detected or edited"),
        ({"a": "0.1x"}, "column a: .* found '0.1x', needed a finite number"),
        ({"u0": ""}, "column u0: .* found an empty cell, needed a finite number"),
        ({"v1": "nan"}, "column v1: .* found 'nan', needed a finite number"),
        ({"s00": "inf"}, "column s00: .* found 'inf', needed a finite number"),
        ({"a": "5"}, "columns a, b, c: .* found a vector of norm .*, needed a unit vector"),
        ({"a": "0", "b": "0", "c": "0"}, "found a vector of norm 0, needed a unit vector"),
        (
            {"u0": "5", "u1": "5", "v0": "7", "v1": "7"},
            "columns u0, v0, u1, v1: .* found both ends at the same pixel",
        ),
        ({"s00": "-1"}, "columns s00, s01, s11: .* not positive definite"),
        ({"s00": "1", "s01": "2", "s11": "1"}, r"not positive definite \(1, 2, 1\)"),
        ({"u0": "-400", "v0": "-300"}, r"found ends \S+ px from the line \(a, b, c\), needed at"),
        ({"edge": "2"}, r"row 2 \(line 3\).* found the same image, leg, part and edge in row 1"),
    ],
)
def test_wrong_cells_are_refused(tmp_path: Path, cells: dict[str, str], message: str) -> None:
    path = edit(written(tmp_path, outlines_of(10, rejected=0.0)), 1, **cells)
    with pytest.raises(DatasetError, match=message) as refusal:
        read(path)
    assert str(path) in str(refusal.value)


def test_rejected_row_with_a_text_for_a_number_is_refused(tmp_path: Path) -> None:
    path = edit(written(tmp_path, outlines_of(10)), 1, verdict="rejected", a="left")
    with pytest.raises(DatasetError, match=r"column a: .* found 'left'"):
        read(path)


def test_every_problem_is_listed_at_once(tmp_path: Path) -> None:
    path = written(tmp_path, outlines_of(10, rejected=0.0))
    edit(path, 1, view="up", leg="none", edge="0")
    edit(path, 4, a="x", b="y")
    edit(path, 6, a="9", s00="-1")
    with pytest.raises(DatasetError) as refusal:
        read(path)
    assert len(refusal.value.problems) == 7


@pytest.mark.parametrize("content", ["", "view,image\n", "a,b\n1,2\n"])
def test_other_columns_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "observations.csv"
    path.write_text(content)
    with pytest.raises(DatasetError, match="header: the columns could not be used"):
        read(path)


def test_rows_of_another_length_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, outlines_of(11))
    path.write_text(path.read_text() + "right,i/2.png\n")
    with pytest.raises(
        DatasetError, match="found 2 cells, needed 23 as in the header; complete or remove"
    ):
        read(path)


def test_stale_rows_are_left_out_only_where_legcal_detected_them(tmp_path: Path) -> None:
    outlines = outlines_of(12, rejected=0.0)
    path = edit(written(tmp_path, outlines), 2, image="gone.png")
    assert len(read(path, skip_stale=True)) == len(outlines) - 1
    edit(path, 2, source="edited")
    with pytest.raises(DatasetError, match=r"found 'gone\.png', needed an image"):
        read(path, skip_stale=True)


def test_legs_that_a_view_leaves_out_are_rejected() -> None:
    outlines = outlines_of(13, rejected=0.0)
    views = (MEASUREMENTS.views[0], View("left", MEASUREMENTS.views[1].camera, legs=("legA",)))
    found = reject_unused_legs(outlines, replace(MEASUREMENTS, views=views), LEG_NAMES)
    left_out = (MEASUREMENTS.view[outlines.row] == 1) & (outlines.leg != 1)
    np.testing.assert_array_equal(found.used, ~left_out)
    assert {found.reason[i] for i in np.flatnonzero(left_out)} == {
        "view left does not use this leg"
    }
