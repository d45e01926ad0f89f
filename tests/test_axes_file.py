"""axes.csv: written, read back, and refused."""

import csv
from pathlib import Path

import numpy as np
import pytest
from outline_tables import LEG_NAMES, recorded

from legcal.data.axes import COLUMNS, LegAxes, axes_of_table, read_axes, write_axes
from legcal.errors import DatasetError

MEASUREMENTS = recorded(labels=["", "", "a", "b"])


def _axes(seed: int = 0) -> LegAxes:
    rng = np.random.default_rng(seed)
    row, leg = np.divmod(np.arange(12, dtype=np.intp), 3)
    values = rng.uniform([-1.2, -1.2, -0.3, 0.6], [1.2, 1.2, 0.3, 1.2], (12, 4))
    return axes_of_table(row, leg, values, rng.uniform(1e-4, 1e-3, (12, 4)))


def _written(tmp_path: Path) -> Path:
    path = tmp_path / "axes.csv"
    write_axes(path, _axes(), MEASUREMENTS, LEG_NAMES)
    return path


def _edited(path: Path, row: int, **cells: str) -> Path:
    """Change cells of a row, counted from 1."""
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    for name, cell in cells.items():
        lines[row][[column.name for column in COLUMNS].index(name)] = cell
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(lines)
    return path


def _read(path: Path) -> LegAxes:
    return read_axes(path, LEG_NAMES, MEASUREMENTS)


def _refusal(path: Path) -> str:
    with pytest.raises(DatasetError) as refusal:
        _read(path)
    return str(refusal.value)


def test_axes_are_read_as_they_were_written(tmp_path: Path) -> None:
    found, expected = _read(_written(tmp_path)), _axes()
    assert np.array_equal(found.row, expected.row)
    assert np.array_equal(found.leg, expected.leg)
    assert np.allclose(found.u, expected.u, atol=1e-15)
    assert np.allclose(found.M, expected.M, atol=1e-15)
    turn = found.basis @ np.swapaxes(expected.basis, -1, -2)
    assert np.allclose(turn, np.eye(2), atol=1e-14)
    scale = np.abs(expected.covariance).max(axis=(1, 2), keepdims=True)
    assert np.allclose(found.covariance / scale, expected.covariance / scale, atol=1e-9)


def test_the_header_is_that_of_the_contract(tmp_path: Path) -> None:
    header = _written(tmp_path).read_text().splitlines()[0]
    assert header == "view,image,leg,psi,theta,x,z,sigma_psi,sigma_theta,sigma_x,sigma_z"


def test_rows_without_image_are_named_by_their_pose(tmp_path: Path) -> None:
    with _written(tmp_path).open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["image"] for row in rows[::3]] == ["i/2.png", "i/1.png", "a", "b"]
    assert rows[2]["leg"] == "leg, C"


def test_column_order_and_line_ends_do_not_matter(tmp_path: Path) -> None:
    path = _written(tmp_path)
    expected = _read(path)
    with path.open(newline="") as file:
        lines = [cells[::-1] for cells in csv.reader(file)]
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        csv.writer(file, lineterminator="\r\n").writerows(lines)
    assert np.array_equal(_read(path).u, expected.u)


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        ({"view": "rihgt"}, "column view: the axis could not be used: found the unknown view"),
        ({"image": "i/3.png"}, "column image: the axis could not be used"),
        ({"leg": "legZ"}, "column leg: the axis could not be used: found the unknown leg 'legZ'"),
        ({"psi": ""}, "column psi: the axis could not be used: found an empty cell, needed a fin"),
        ({"z": "nan"}, "column z: the axis could not be used: found 'nan', needed a finite number"),
        ({"x": "1_0"}, "column x: the axis could not be used: found '1_0', needed a finite number"),
        ({"theta": "-12"}, "found '-12', needed an angle from -3.1416 to 3.1416 rad; write"),
        ({"x": "1e9"}, "column x: the axis could not be used: found '1e9', needed a coordinate"),
        ({"z": "-1e300"}, "found '-1e300', needed a coordinate from -1000 to 1000 m; correct it"),
        ({"psi": "1.7"}, "found '1.7', needed an angle from -1.5708 to 1.5708 rad; write"),
        ({"sigma_psi": "0"}, "column sigma_psi: the axis could not be used: found '0', needed a "),
        ({"sigma_x": "-1e-3"}, "found '-1e-3', needed a standard deviation from 1e-09 to 1 m; "),
        ({"sigma_z": "50"}, "needed a standard deviation from 1e-09 to 1 m; give it in m"),
        ({"sigma_theta": "3"}, "needed a standard deviation from 1e-09 to 1 rad; give it in rad"),
        ({"theta": "1.5707963"}, "columns psi, theta: the axis could not be used: found an axis p"),
        ({"psi": "1.5707963"}, "the point (x, 0, z) does not exist"),
    ],
)
def test_a_wrong_cell_is_refused_by_row_and_column(
    tmp_path: Path, cells: dict[str, str], words: str
) -> None:
    message = _refusal(_edited(_written(tmp_path), 5, **cells))
    assert "axes.csv, row 5 (line 6)" in message
    assert words in message


def test_all_problems_are_listed_at_once(tmp_path: Path) -> None:
    path = _edited(_edited(_written(tmp_path), 2, psi="x", sigma_x="0"), 4, leg="leg9")
    with pytest.raises(DatasetError) as refusal:
        _read(path)
    assert len(refusal.value.problems) == 3


@pytest.mark.parametrize("cell", ["inf", "-inf", "nan", "x"])
@pytest.mark.parametrize("name", ["psi", "theta", "x", "sigma_psi"])
def test_a_cell_that_is_no_number_is_one_problem(tmp_path: Path, name: str, cell: str) -> None:
    with pytest.raises(DatasetError, match="needed a finite number") as refusal:
        _read(_edited(_written(tmp_path), 3, **{name: cell}))
    assert len(refusal.value.problems) == 1


def test_a_table_in_degrees_is_said_shortly(tmp_path: Path) -> None:
    path = _written(tmp_path)
    for row in range(1, 13):
        _edited(path, row, theta=str(-90 - row))
    with pytest.raises(DatasetError) as refusal:
        _read(path)
    lines = str(refusal.value).splitlines()
    assert len(refusal.value.problems) == 12
    assert len(lines) == 6
    assert lines[-1] == "... and 7 more like these."


def test_the_same_leg_twice_in_an_image_is_refused(tmp_path: Path) -> None:
    message = _refusal(_edited(_written(tmp_path), 2, leg=LEG_NAMES[0]))
    assert "row 2 (line 3): the axis could not be used: found the same image and leg" in message
    assert "row 1 (line 2), needed it once" in message


def test_another_header_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path)
    path.write_text(path.read_text().replace("sigma_z", "sigma_y"))
    assert "found no column 'sigma_z', needed it; add the column" in _refusal(path)


def test_an_incomplete_row_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path)
    path.write_text(path.read_text() + "right,i/2.png\n")
    assert "found 2 cells, needed 11 as in the header; complete or remove the row" in _refusal(path)


def test_a_table_without_rows_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path)
    path.write_text(path.read_text().splitlines()[0] + "\n")
    assert "found a header and no row, needed the axes of the legs in every image" in _refusal(path)
