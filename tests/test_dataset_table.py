"""measurements.csv: what it gives, and every way in which it is refused."""

from typing import Any

import numpy as np
import pytest
from dataset_folder import JOINTS, Folder, folder, readings

from legcal.data.dataset import load_dataset
from legcal.data.measurements import Measurements
from legcal.errors import DatasetError

__all__ = ["folder"]


def read(folder: Folder) -> Measurements:
    folder.write()
    return load_dataset(folder.path).measurements


def refused(folder: Folder, *, write: bool = True) -> str:
    if write:
        folder.write()
    with pytest.raises(DatasetError) as refusal:
        load_dataset(folder.path)
    return str(refusal.value)


def test_readings_are_found_by_the_names_of_their_columns(folder: Folder) -> None:
    folder.columns = [JOINTS[3], "image", *JOINTS[:3], "view", *JOINTS[4:]]
    measurements = read(folder)
    np.testing.assert_array_equal(measurements.q, [readings(seed) for seed in range(4)])
    assert measurements.image[2] == "images/c2_1.png"
    np.testing.assert_array_equal(measurements.view, [0, 0, 1, 1])


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_byte_order_mark_line_ends_and_blank_lines_do_not_matter(
    folder: Folder, mark: bytes, end: bytes
) -> None:
    path = folder.path / "measurements.csv"
    path.write_bytes(mark + path.read_bytes().replace(b"\n", end) + end + b" , ,,,,,," + end)
    measurements = load_dataset(folder.path).measurements
    np.testing.assert_array_equal(measurements.q, [readings(seed) for seed in range(4)])


def test_without_labels_each_row_is_its_own_pose(folder: Folder) -> None:
    measurements = read(folder)
    np.testing.assert_array_equal(measurements.pose, [0, 1, 2, 3])
    assert measurements.pose_labels == ()


def test_rows_of_one_label_share_a_pose_and_the_mean_reading(folder: Folder) -> None:
    folder.columns.append("pose")
    for row, label in zip(folder.rows, ["b", "", "b", ""], strict=True):
        row["pose"] = label
    folder.rows[2].update(dict(zip(JOINTS, readings(0), strict=True)))
    folder.rows[2][JOINTS[1]] += 4e-6
    measurements = read(folder)
    np.testing.assert_array_equal(measurements.pose, [0, 1, 0, 2])
    assert measurements.pose_labels == ("b", "", "")
    np.testing.assert_array_equal(measurements.q[0], measurements.q[2])
    assert measurements.q[0, 1] == pytest.approx(readings(0)[1] + 2e-6, abs=1e-12)
    np.testing.assert_allclose(measurements.q[0, 2:], readings(0)[2:], rtol=1e-15)


def test_rows_of_one_label_with_other_readings_are_refused(folder: Folder) -> None:
    folder.columns.append("pose")
    folder.rows[0]["pose"] = folder.rows[1]["pose"] = "p"
    folder.rows[1].update(dict(zip(JOINTS, readings(0), strict=True)))
    folder.rows[1][JOINTS[2]] += 1e-4
    message = refused(folder)
    assert "row 1 (line 2), column leg3_prismatic: the pose p could not be used" in message
    assert "differ by 0.0001 m, needed one reading within 10 sigma (2e-05 m)" in message


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["view", "image", *JOINTS, "leg7_prismatic"], "found the unknown column 'leg7_prismatic'"),
        (
            ["view", "image", *JOINTS, "Pose"],
            "found the unknown column 'Pose', needed those of a table of measurements; did you",
        ),
        (
            ["view", "image", *JOINTS[:5]],
            "found no column 'leg6_prismatic', needed it (reading, in",
        ),
        (["image", *JOINTS], "found no column 'view', needed it; add the column"),
        (["view", "image", *JOINTS, JOINTS[0]], "found the column 'leg1_prismatic' 2 times"),
        (["view", "image", *JOINTS, ""], "found the unknown column ''"),
    ],
)
def test_wrong_columns_are_refused(folder: Folder, columns: list[str], message: str) -> None:
    folder.columns = columns
    assert message in refused(folder)


def test_every_wrong_column_is_listed_at_once(folder: Folder) -> None:
    folder.columns = ["view", "view", "picture", *JOINTS[1:]]
    assert len(refused(folder).splitlines()) == 4


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_are_refused(folder: Folder, separator: str) -> None:
    path = folder.path / "measurements.csv"
    path.write_text(path.read_text().replace(",", separator))
    assert "between columns, needed ','" in refused(folder, write=False)


@pytest.mark.parametrize("keep", [0, 1])
def test_empty_table_is_refused(folder: Folder, keep: int) -> None:
    folder.write_table([["view", "image", *JOINTS]][:keep])
    found = "found a header and no row" if keep else "found no header and no row"
    assert found in refused(folder, write=False)


@pytest.mark.parametrize(("n", "remedy"), [(7, "complete or remove"), (9, "remove what is too")])
def test_short_and_long_rows_are_refused(folder: Folder, n: int, remedy: str) -> None:
    row = ["c1", "images/c1_1.png", *["0.01"] * 7][:n]
    folder.write_table([["view", "image", *JOINTS], row])
    message = refused(folder, write=False)
    assert f"row 1 (line 2): the row could not be used: found {n} cells, needed 8" in message
    assert remedy in message


@pytest.mark.parametrize(
    ("cell", "found"),
    [
        ("nan", "'nan'"),
        ("inf", "'inf'"),
        ("", "an empty cell"),
        ("0,01", "found 9 cells"),
        ("ten", "'ten'"),
        ("1e999", "'1e999'"),
        ("1_0", "'1_0'"),
        ("0x1p3", "'0x1p3'"),
    ],
)
def test_readings_that_are_no_numbers_are_refused(folder: Folder, cell: str, found: str) -> None:
    folder.rows[2][JOINTS[4]] = cell
    message = refused(folder)
    assert found in message
    assert "row 3 (line 4)" in message
    assert cell == "0,01" or "column leg5_prismatic: the reading could not be used" in message


def test_reading_a_little_outside_the_travel_is_noted(folder: Folder) -> None:
    folder.rows[1][JOINTS[0]] = 0.144 + 0.04 * 0.148
    folder.write()
    (note,) = load_dataset(folder.path).notes
    assert "leg1_prismatic" in note
    assert "0.14992 m in row 2 (line 3)" in note


def test_reading_far_outside_the_travel_is_refused(folder: Folder) -> None:
    folder.rows[1][JOINTS[0]] = 0.144 + 0.06 * 0.148
    message = refused(folder)
    assert "column leg1_prismatic: readings are outside the travel: found 0.15288 m in" in message
    assert "row 2 (line 3), needed -0.004 to 0.144 m" in message
    assert "margin of 5%; correct the readings or the limits" in message


def test_millimetres_are_recognised(folder: Folder) -> None:
    for row in folder.rows:
        row.update({joint: 1000.0 * row[joint] for joint in JOINTS})
    message = refused(folder)
    assert len(message.splitlines()) == 6
    assert "and 1 more" in message
    assert message.count("these look like millimetres: divide the column by 1000") == 6


def test_one_reading_far_outside_does_not_make_its_column_millimetres(folder: Folder) -> None:
    folder.rows[1]["leg1_prismatic"] = 0.5
    message = refused(folder)
    assert "found 0.5 m in row 2 (line 3)" in message
    assert "correct the readings or the limits" in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"view": "c3"}, "column view: the row could not be used: found the unknown view 'c3'"),
        ({"view": ""}, "found the unknown view ''"),
        ({"image": "images/c1_1.png"}, "images/c1_1.png could not be used: found it also in row 1"),
        ({"image": "images/../images/c1_1.png"}, "found it also in row 1 (line 2)"),
        ({"image": "../set/images/c1_1.png"}, "found it also in"),
        ({"image": "../other.png"}, "found a path that leads out of the dataset folder"),
        ({"image": "/tmp/other.png"}, "found an absolute path"),
        ({"image": "C:\\other.png"}, "found an absolute path"),
        ({"image": "images/none.png"}, "none.png could not be read: found no such file"),
        ({"image": "images"}, "found something that is not a file"),
        ({"image": "images/a\0b.png"}, "found a path that cannot be followed"),
        ({"image": ""}, "found neither an image nor outlines of it in observations.csv"),
    ],
)
def test_wrong_rows_are_refused(folder: Folder, change: dict[str, Any], message: str) -> None:
    folder.rows[2].update(change)
    found = refused(folder)
    assert message in found
    assert "measurements.csv, row 3" in found


def test_image_behind_a_link_out_of_the_folder_is_refused(folder: Folder) -> None:
    (folder.path.parent / "other").mkdir()
    (folder.path / "linked").symlink_to(folder.path.parent / "other")
    folder.rows[0]["image"] = "linked/a.png"
    assert "found a path that leads out of the dataset folder" in refused(folder)


def test_link_inside_the_folder_is_followed(folder: Folder) -> None:
    (folder.path / "linked").symlink_to(folder.path / "images")
    folder.rows[0]["image"] = "linked/c1_1.png"
    assert read(folder).n_rows == 4


def test_every_problem_of_the_rows_is_listed_at_once(folder: Folder) -> None:
    folder.rows[0]["view"] = "c7"
    folder.rows[1][JOINTS[0]] = "nan"
    folder.rows[1][JOINTS[3]] = 9.0
    folder.rows[2]["image"] = "/a.png"
    folder.rows[3][JOINTS[1]] = "x"
    assert len(refused(folder).splitlines()) == 5


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"view,image\n\xff\xfe", "found the byte 0xff at place 11, .* comma-separated .* UTF-8"),
        (b'view,image\n"c1,x', "needed comma-separated text in UTF-8"),
        (b"view,image\na\0b,c", "found the unknown|needed comma-separated text|found no column"),
    ],
)
def test_bytes_that_are_no_table_are_refused(folder: Folder, content: bytes, message: str) -> None:
    (folder.path / "measurements.csv").write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        load_dataset(folder.path)
