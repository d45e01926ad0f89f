"""The table of measured tool poses: read strictly, every problem in one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from located import Located, located, shipped, write_poses, write_rows

from legcal.calibration.location.table import read_tool_poses
from legcal.errors import DatasetError

Rows = list[dict[str, str]]


@pytest.fixture(scope="module")
def made() -> Located:
    return located("hexapod", 4)


def change(**cells: str) -> Callable[[Rows], None]:
    def spoil(rows: Rows) -> None:
        rows[1].update(cells)

    return spoil


def everywhere(**cells: str) -> Callable[[Rows], None]:
    def spoil(rows: Rows) -> None:
        for row in rows:
            row.update(cells)

    return spoil


def without(name: str) -> Callable[[Rows], None]:
    def spoil(rows: Rows) -> None:
        for row in rows:
            del row[name]

    return spoil


def twice(rows: Rows) -> None:
    rows.append({name: f"{text}00" if "e" not in text else text for name, text in rows[0].items()})


def test_what_was_written_is_read(made: Located, tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.csv", made)
    found = read_tool_poses(tmp_path / "poses.csv", made.machine)
    np.testing.assert_array_equal(found.q, made.poses.q)
    np.testing.assert_array_equal(found.position, made.poses.position)
    np.testing.assert_allclose(found.rotation, made.poses.rotation, atol=1e-15)
    assert found.oriented.all()
    assert found.notes == ()
    assert found.position_sigma is None


def test_orientations_may_be_missing_in_some_rows_or_all(made: Located, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = write_poses(path, made)
    rows[2].update(qx="", qy="", qz="", qw="")
    write_rows(path, [row | {"angle_sigma": "0.001" * (row is not rows[2])} for row in rows])
    found = read_tool_poses(path, made.machine)
    assert found.oriented.tolist() == [True, True, False, True]
    write_poses(path, made, quaternions=False)
    assert not read_tool_poses(path, made.machine).oriented.any()


def test_columns_may_stand_in_any_order_with_names_and_sigmas(
    made: Located, tmp_path: Path
) -> None:
    path = tmp_path / "poses.csv"
    rows = write_poses(path, made)
    more = {"position_sigma": "2e-5", "angle_sigma": "1e-4", "name": "first"}
    write_rows(path, [dict(reversed(list((more | row).items()))) for row in rows])
    found = read_tool_poses(path, made.machine)
    np.testing.assert_array_equal(found.position, made.poses.position)
    assert found.position_sigma is not None
    assert found.position_sigma.tolist() == [2e-5] * 4


def test_rounded_quaternions_are_made_unit_and_told(made: Located, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    rows = write_poses(path, made)
    short = [
        {name: f"{float(text):.4f}" if name[0] == "q" else text for name, text in row.items()}
        for row in rows
    ]
    write_rows(path, short)
    found = read_tool_poses(path, made.machine)
    np.testing.assert_allclose(
        found.rotation @ np.swapaxes(found.rotation, 1, 2),
        np.tile(np.eye(3), (4, 1, 1)),
        atol=1e-15,
    )
    assert len(found.notes) == 1
    assert "quaternions were made unit" in found.notes[0]


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (without("y"), "header: the columns could not be used: found no column 'y', needed it"),
        (without("leg3_prismatic"), r"no column 'leg3_prismatic', needed it \(reading, in met"),
        (without("qw"), "no column 'qw'"),
        (everywhere(rx="90"), "found 'rx', which looks like an angle, needed orientations as quat"),
        (everywhere(quality="2"), "found the unknown column 'quality'"),
        (change(x="nan"), r"row 2 \(line 3\), column x: the position could not .* found 'nan'"),
        (change(z=""), "column z: the position could not be used: found an empty cell"),
        (change(z="2e9"), "the position could not be used: found '2e9', needed less"),
        (change(leg1_prismatic="none"), "column leg1_prismatic: the reading could not be used"),
        (change(leg1_prismatic="0.4"), "readings are outside the travel"),
        (change(qx=""), "column qx: the quaternion could not be used: found an empty cell"),
        (change(qx="2.0"), r"found a quaternion of norm 2\.\d+, needed 1 within 0.001"),
        (change(qx="90", qy="0", qz="0", qw="0"), "norm 90, .*; these look like angles in degrees"),
        (everywhere(angle_sigma="0.5"), "found '0.5', needed one from .*radians, not degrees"),
        (everywhere(position_sigma="0"), "column position_sigma: the standard deviation could not"),
        (everywhere(position_sigma=""), "column position_sigma: .* found an empty cell"),
        (twice, r"row 5 \(line 6\): the row could not be used: found the same readings and the"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_table_is_told_by_row_and_column(
    made: Located, tmp_path: Path, spoil: Callable[[Rows], None], match: str
) -> None:
    path = tmp_path / "poses.csv"
    rows = write_poses(path, made)
    spoil(rows)
    write_rows(path, rows)
    with pytest.raises(DatasetError, match=match):
        read_tool_poses(path, made.machine)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "found no header and no row"),
        ("x,y,z\n", "found a header and no row"),
        ("x;y;z\n1;2;3\n", "between columns, needed ','"),
        ("x,x,y,z\n1,2,3,4\n", "found the column 'x' 2 times"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(DatasetError, match=match):
        read_tool_poses(path, shipped("hexapod"))


def test_a_short_row_is_refused(made: Located, tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    write_poses(path, made)
    path.write_text(path.read_text() + "1,2\n")
    with pytest.raises(DatasetError, match=r"row 5 .*found 2 cells, needed 13 as in the header"):
        read_tool_poses(path, made.machine)
    with pytest.raises(DatasetError, match="found no such file"):
        read_tool_poses(tmp_path / "none.csv", made.machine)
