"""observations.csv: written, read back exactly, corrected by hand, and refused.

Refusals of single cells are in tests/refusal_table.py; here are those that need more
than one cell of a table that a simulation wrote.
"""

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from csv_rows import read_rows
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from outline_tables import LEG_NAMES, LEGS, assert_same, outlines_of, recorded

from legcal.data.measurements import row_names
from legcal.data.outlines import (
    MEASURED,
    Outlines,
    axes_of_table,
    join_axes,
    no_outlines,
    read_observations,
    write_observations,
)
from legcal.data.reasons import Reason, Rejection, read_rejection

FAST = settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
MEASUREMENTS = recorded(labels=["", "", "a", "b"])
OPTIONAL = MEASURED


def written(folder: Path, table: Outlines) -> Path:
    write_observations(folder / "observations.csv", table, MEASUREMENTS, LEG_NAMES)
    return folder / "observations.csv"


def read(path: Path, *, skip_stale: bool = False) -> Outlines:
    return read_observations(path, LEGS, MEASUREMENTS, skip_stale=skip_stale)


def rewritten(path: Path, change: Callable[[list[list[str]]], list[list[str]]]) -> Path:
    """Change the cells of a table, the header among them."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = change(list(csv.reader(file)))
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        csv.writer(file, lineterminator="\r\n").writerows(lines)
    return path


def edited(path: Path, row: int, **cells: str) -> Path:
    """Change cells of a row, counted from 1."""

    def change(lines: list[list[str]]) -> list[list[str]]:
        for name, cell in cells.items():
            lines[row][lines[0].index(name)] = cell
        return lines

    return rewritten(path, change)


# --- written and read


@FAST
@given(st.integers(0, 2**32 - 1))
def test_outlines_are_read_exactly_as_they_were_written(tmp_path: Path, seed: int) -> None:
    outlines = outlines_of(seed)
    path = written(tmp_path, outlines)
    content = path.read_bytes()
    found = read(path)
    assert_same(found, outlines)
    assert b"nan" not in content  # numbers not found are empty cells
    assert written(tmp_path, found).read_bytes() == content
    turned = replace(  # the end nearer to the base joint comes first again
        outlines, ends=outlines.ends[:, ::-1], covariance=outlines.covariance[:, ::-1, ::-1]
    )
    assert_same(read(written(tmp_path, turned)), outlines)


def test_the_header_is_that_of_the_contract(tmp_path: Path) -> None:
    path = written(tmp_path, no_outlines())
    assert path.read_text().splitlines()[0] == (
        "view,image,leg,part,edge,a,b,c,u0,v0,u1,v1,s00,s01,s11,verdict,reason,source,"
        "contrast,length,residual,gamma,by_gamma,polish,detail"
    )
    assert len(read(path)) == 0
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_tables_without_optional_columns_and_rows_without_the_other_edge_are_read(
    tmp_path: Path,
) -> None:
    outlines = outlines_of(3)
    path = written(tmp_path, outlines)
    rewritten(path, lambda lines: [cells[: -len(OPTIONAL) - 1] for cells in lines])
    unknown = np.full(len(outlines), np.nan)
    codes = tuple(Rejection(why.reason) for why in outlines.reason)
    plain = replace(outlines, reason=codes, **dict.fromkeys(OPTIONAL, unknown))  # type: ignore[arg-type]
    assert_same(read(path), plain)
    rewritten(path, lambda lines: lines[:2] + lines[3:])
    assert len(read(path)) == len(outlines) - 1


def test_rows_without_image_are_named_by_label_or_else_by_number(tmp_path: Path) -> None:
    assert row_names(MEASUREMENTS) == ("i/2.png", "i/1.png", "a", "b")
    assert row_names(recorded()) == ("i/2.png", "i/1.png", "3", "4")
    twice = recorded(["", "", "", ""], ["x", "y", "x", "z"])
    assert row_names(twice) == ("1", "y", "3", "z")
    shared = replace(recorded(["", "", "", ""], ["x", "y"]), pose=np.array([0, 0, 1, 1]))
    assert row_names(shared) == ("x", "x", "y", "y")
    clash = recorded(["x", "", "", ""], ["", "y", "x", "z"])
    assert row_names(clash) == ("x", "y", "3", "z")
    rows = read_rows(written(tmp_path, outlines_of(0)))
    assert {row["image"] for row in rows} == {"i/2.png", "i/1.png", "a", "b"}
    assert "leg, C" in {row["leg"] for row in rows}


def test_joined_axes_do_not_depend_on_the_points_that_state_them() -> None:
    rng = np.random.default_rng(2)
    values, none = np.array([[0.7, -0.5, 0.1, 0.9]] * 2), np.zeros(2, dtype=np.intp)
    exact = axes_of_table(none, none, values, np.full((2, 4), 1e-3))  # one line, seen twice
    root = rng.normal(size=(2, 4, 4)) * 1e-3
    spread = np.einsum("ni,nia->na", rng.normal(size=(2, 2)) * 1e-3, exact.basis)
    two = replace(exact, M=exact.M + spread, covariance=root @ np.swapaxes(root, 1, 2))
    along = 0.4  # from one point of the second axis to another: beta grows by that times alpha
    lever = np.kron([[1.0, 0.0], [along, 1.0]], np.eye(2))
    moved = replace(
        two,
        M=two.M + [[0.0], [along]] * two.u,
        covariance=np.stack([two.covariance[0], lever @ two.covariance[1] @ lever.T]),
    )
    one, other = (join_axes(axes, axes.row) for axes in (two, moved))
    assert len(one) == 1
    for name in ("u", "M", "covariance"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-7, atol=1e-12)
    assert np.abs(one.M - two.M[0]).max() > 1e-5


# --- corrected by hand


def test_a_rounded_direction_is_made_unit(tmp_path: Path) -> None:
    outlines = outlines_of(7, rejected=0.0)
    cells = {name: f"{x:.4f}" for name, x in zip("abc", outlines.h[0], strict=True)}
    found = read(edited(written(tmp_path, outlines), 1, **cells))
    assert np.linalg.norm(found.h[0]) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(found.h[0], outlines.h[0], atol=1e-4)


@pytest.mark.parametrize(
    ("text", "code", "detail", "words"),
    [
        ("hidden by leg3", Reason.HIDDEN, "leg3", ""),
        ("width inconsistent with the radius, 12.1 px for 14.0 px", Reason.WIDTH,
         "12.1 px for 14.0 px", ""),
        ("its other outline: edge hardly visible, found on 12 % of it", Reason.PARTNER, "faint",
         "its other outline: edge barely visible"),
        ("edge hardly visible, found on 12 % of it", Reason.FAINT, "12",
         "edge barely visible, detected on 12 % of it"),
        ("not used before", Reason.NOT_BEFORE, "", "not used in the previous measurement"),
        ("disagrees with the fit by 5.4 px, lies on edge 1 of leg2.rod", Reason.DISAGREES,
         "5.4 px, lies on edge 1 of leg2.rod", ""),
        ("disagrees with the other legs of its view", Reason.VIEW_DISAGREES, "", ""),
        ("a cable", Reason.OTHER, "a cable", ""),
    ],
)  # fmt: skip
def test_sentences_of_earlier_versions_are_read_as_reasons(
    tmp_path: Path, text: str, code: Reason, detail: str, words: str
) -> None:
    path = edited(written(tmp_path, outlines_of(14)), 1, verdict="rejected", reason=text, detail="")
    found = read(path).reason[0]
    assert found == Rejection(code, detail)
    assert str(found) == (words or text)
    assert read_rejection(found.reason, str(found.detail)) == found
