"""``legcal init``: a dataset from photographs and a table as their owner has them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Outcome, run
from csv_rows import read_rows
from hexapod_example import HEXAPOD
from photograph_files import exif, jpeg
from simulated import files_of, small_camera

import legcal
from legcal import load_dataset
from legcal.vision.board import board_document, board_of
from legcal.vision.image_file import camera_of_photographs, read_facts

PICTURE = np.zeros((48, 64), np.uint8)
LEGS = [f"leg{j}" for j in range(1, 7)]


def own_folder(
    tmp_path: Path, photographs: Sequence[str], taken: Mapping[str, str] | None = None
) -> Path:
    """Write photographs and the file of their camera."""
    for k, name in enumerate(photographs):
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        said = {"taken": taken[name]} if taken else {}
        path.write_bytes(jpeg(PICTURE + np.uint8(k), block=exif(**said)))
    small_camera(tmp_path, 64, 48).rename(tmp_path / "camera_info.yaml")
    return tmp_path


def readings(k: int) -> list[float]:
    """Return readings of row k inside the travel of the shipped hexapod [mm]."""
    return [10.0 + 7.0 * k + j for j in range(6)]


def by_leg(k: int) -> dict[str, float]:
    return dict(zip(LEGS, readings(k), strict=True))


def table(
    folder: Path,
    columns: Mapping[str, Sequence[str]] | None = None,
    n: int = 3,
    *,
    names: Sequence[str] = LEGS,
    factor: float = 1.0,
    add: float = 0.0,
    separator: str = ",",
) -> None:
    """Write a table of readings: some columns, and one for each leg."""
    columns = columns or {}
    lines = [[*columns, *names]]
    for k in range(n):
        numbers = [f"{factor * (q + add):.12g}" for q in readings(k)]
        lines.append([*(cells[k] for cells in columns.values()), *numbers])
    text = "\n".join(separator.join(line) for line in lines) + "\n"
    if separator != ",":
        text = text.replace(".", ",")
    (folder / "own.csv").write_text(text)


def init(folder: Path, *words: str, output: str = "dataset") -> Outcome:
    return run(
        "init", folder / "photos", "--readings", folder / "own.csv",
        "--model", "hexapod", "-o", folder / output, *words,
    )  # fmt: skip


def pairs(folder: Path) -> list[tuple[str, str, int]]:
    """Return view, image and number of the readings of each row that was written."""
    rows = read_rows(folder / "dataset" / "measurements.csv")
    number = {readings(k)[0]: k for k in range(20)}
    return [
        (row["view"], row["image"], number[round(1e3 * float(row["leg1_prismatic"]), 6)])
        for row in rows
    ]


FLAT = ("IMG_2.JPG", "IMG_10.JPG", "IMG_11.JPG")
TWO = ("a/IMG_2.jpg", "a/IMG_10.jpg", "a/IMG_11.jpg", "b/IMG_3.jpg", "b/IMG_4.jpg", "b/IMG_12.jpg")
BACK = ("a/IMG_10.jpg", "a/IMG_11.jpg", "b/IMG_8.jpg", "b/IMG_9.jpg")
SAME = ("a/1.png", "a/2.png", "a/3.png", "b/1.png", "b/2.png", "b/3.png")
TIMES = ("2026:11:23 10:00:05", "2026:11:23 10:01:05", "2026:11:23 10:02:06")
Columns = dict[str, Sequence[str]]
MATCHED: list[tuple[Sequence[str], Columns, int, list[tuple[str, int]]]] = [
    # photographs, columns, number of rows, and the photograph of each row
    (FLAT, {}, 3, list(zip(FLAT, range(3), strict=True))),
    (FLAT, {"Image": ("img_11.png", "IMG_2", "x/img_10.jpg")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    (FLAT, {"photo": ("10", "11", "2")}, 3,
     [("IMG_10.JPG", 0), ("IMG_11.JPG", 1), ("IMG_2.JPG", 2)]),
    (TWO, {}, 3, [*zip(TWO[:3], range(3), strict=True), *zip(TWO[3:], range(3), strict=True)]),
    (TWO, {}, 6, list(zip(TWO, range(6), strict=True))),
    # one camera counted the photographs of all folders
    (BACK, {}, 4, list(zip([*BACK[2:], *BACK[:2]], range(4), strict=True))),
    (TWO, {"view": ("b", "b", "b", "a", "a", "a")}, 6,
     [*zip(TWO[3:], range(3), strict=True), *zip(TWO[:3], range(3, 6), strict=True)]),
    (SAME, {"file": ("3.jpg", "1.jpg", "2.jpg")}, 3,
     [(f"{v}/{i}.png", k) for v in "ab" for k, i in enumerate((3, 1, 2))]),
    (SAME, {"camera": "abba", "name": "1122"}, 4,
     [("a/1.png", 0), ("a/2.png", 3), ("b/1.png", 1), ("b/2.png", 2)]),
    (TWO[:2] + TWO[3:5], {"Ansicht": "bbaa", "Bild Nr.": ("1", "02", "1", "02")}, 4,
     [(TWO[3], 0), (TWO[4], 1), (TWO[0], 2), (TWO[1], 3)]),
    (FLAT, {"time": ("10:02:00", "10:00", "10:01")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    # clocks an hour apart
    (FLAT, {"Time": tuple(f"2026-11-23T11:0{i}:03" for i in (1, 0, 2))}, 3,
     [("IMG_10.JPG", 0), ("IMG_2.JPG", 1), ("IMG_11.JPG", 2)]),
    (FLAT, {"Zeit": tuple(f"3.11.2026 11:0{i}" for i in (1, 0, 2))}, 3,
     [("IMG_10.JPG", 0), ("IMG_2.JPG", 1), ("IMG_11.JPG", 2)]),
    (FLAT, {"time": ("1795428126000", "1795428005000", "1795428065000")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    (FLAT, {"Elapsed time [s]": ("121.5", "0", "60")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    # milliseconds, which are no date of the year 1796
    (FLAT, {"time": ("1796011333345", "1796011212345", "1796011272345")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    (FLAT, {"time": ("1000", "800", "900")}, 3,  # seconds, and no times of a day
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    (FLAT, {"time": ("1002", "1000", "1001")}, 3,
     [("IMG_11.JPG", 0), ("IMG_2.JPG", 1), ("IMG_10.JPG", 2)]),
    (("001.002.003.jpg", "1'234.jpg"), {"image": ("1'234.jpg", "001.002.003.jpg")}, 2,
     [("1'234.jpg", 0), ("001.002.003.jpg", 1)]),
    (FLAT, {"time": ("10:02:00", "10:00")}, 2, [("IMG_11.JPG", 0), ("IMG_2.JPG", 1)]),
]  # fmt: skip


@pytest.mark.parametrize(("photographs", "columns", "n", "expected"), MATCHED)
def test_photographs_are_matched_by_name_order_or_time(
    photographs: Sequence[str],
    columns: Columns,
    n: int,
    expected: list[tuple[str, int]],
    tmp_path: Path,
) -> None:
    taken = dict(zip(FLAT, TIMES, strict=True)) if photographs is FLAT else None
    table(own_folder(tmp_path, photographs, taken), columns, n)
    assert init(tmp_path).code == 0
    found = pairs(tmp_path)
    names = [(image.removeprefix("images/"), k) for _, image, k in found]
    assert names == expected
    folders = [Path(name).parent.name or "c1" for name, _ in names]
    assert [view for view, *_ in found] == folders
    load_dataset(tmp_path / "dataset")


AT_THE_END = ("002-left.png", "002-right.png", "010-left.png", "010-right.png")


def test_views_that_are_words_in_the_names_are_taken_and_numbers_proposed(tmp_path: Path) -> None:
    table(own_folder(tmp_path, AT_THE_END), n=4)
    outcome = init(tmp_path)
    assert outcome.code == 0
    taken = "Views left, right are taken from the names of the photographs, '*-{view}'"
    assert taken in outcome.said
    table(tmp_path, {"view": ("a", "a", "b", "b"), "Remark": "abcd"}, n=4)  # or a column says it
    outcome = init(tmp_path, output="other")
    assert outcome.code == 0
    assert "Column 'Remark' of" in outcome.said
    by_names, by_column = (
        {Path(row["image"]).name: row["view"] for row in read_rows(tmp_path / name)}
        for name in ("dataset/measurements.csv", "other/measurements.csv")
    )
    assert by_names == {name: name[4:].removesuffix(".png") for name in AT_THE_END}
    assert by_column == dict(zip(AT_THE_END, "aabb", strict=True))
    numbered = tmp_path / "numbered"
    numbered.mkdir()
    table(own_folder(numbered, ("1_01.png", "1_02.png", "2_01.png", "2_02.png")), n=4)
    outcome = init(numbered)
    assert outcome.code == 0
    assert "look ('{view}_*'), put those of each" in outcome.said
    assert {view for view, *_ in pairs(numbered)} == {"c1"}


def test_views_of_unequal_size_are_words_in_the_names_too_as_a_plan_names_them(
    tmp_path: Path,
) -> None:
    names = [f"c{v}_p{k:02d}.png" for v, *poses in ((1, 1, 2, 3), (2, 4, 5, 6, 7)) for k in poses]
    for form in ("{} {:03d}.png", "{} ({}).png", "{}{:03d}.png", "{1} {0}.png"):
        folder = tmp_path / form
        folder.mkdir()
        table(own_folder(folder, [form.format("ab"[k > 3], k) for k in range(1, 8)]), n=7)
        assert init(folder).code == 0
        assert [view for view, *_ in pairs(folder)] == ["a"] * 3 + ["b"] * 4
    table(own_folder(tmp_path, names), n=7)
    assert init(tmp_path).code == 0
    assert [view for view, *_ in pairs(tmp_path)] == ["c1"] * 3 + ["c2"] * 4
    for few in tmp_path.glob("photos/c1_p0[12].png"):  # one is no view
        few.unlink()
    table(tmp_path, n=5)
    assert init(tmp_path, output="other").code == 0
    assert {row["view"] for row in read_rows(tmp_path / "other/measurements.csv")} == {"c1"}


@pytest.mark.parametrize("names", ["Turm {}", "Stepper {} (mm)", "tower-{};Drive {}", "Axis {}"])
def test_motors_are_named_by_what_follows_the_word_for_a_motor(names: str, tmp_path: Path) -> None:
    printer = "M665 L288 R141 B130 H402 ; RepRapFirmware\nM666 X0 Y0 Z0\n"
    (tmp_path / "config.g").write_text(printer)
    legcal.new(tmp_path / "config.g", tmp_path)
    own_folder(tmp_path, FLAT)
    travelled = [[500.0, 450.0, 400.0], [450.0, 400.0, 500.0], [400.0, 500.0, 450.0]]
    beside = ";0" * names.count(";")  # of a heading that would do alone
    lines = [";".join(names.format(x, x) for x in "ZXY")]
    lines += [";".join(f"{q}{beside}" for q in (z, x, y)) for x, y, z in travelled]
    (tmp_path / "own.csv").write_text("\n".join(lines))
    made = legcal.init(
        tmp_path / "photos", tmp_path / "own.csv", tmp_path, tmp_path / "dataset"
    ).measurements
    np.testing.assert_allclose(1e3 * made.q[:, ::2], travelled)


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16"])
def test_tables_are_read_as_spreadsheets_write_them(encoding: str, tmp_path: Path) -> None:
    names = [f"Länge {j} (mm)" for j in range(1, 7)]
    table(own_folder(tmp_path, FLAT), names=names, add=345.0, separator=";")
    path = tmp_path / "own.csv"
    headings, *rows = path.read_text().splitlines()
    lines = ["sep=;", "My hexapod;;;;;", ";;;;;", headings, ";".join(["(mm)"] * 6), *rows]
    path.write_bytes("\r\n".join(lines).encode(encoding))
    assert init(tmp_path, "--lengths").code == 0
    assert [k for *_, k in pairs(tmp_path)] == [0, 1, 2]


@pytest.mark.parametrize(
    ("names", "factor", "add", "words"),
    [
        (LEGS, 1.0, 0.0, ()),  # mm, found from the travel
        ([f"Leg {j} (um)" for j in range(1, 7)], 1e3, 0.0, ()),
        ([str(j) for j in range(6)], 0.1, 0.0, ("--unit", "cm")),
        ([f"L{j} [in]" for j in range(1, 7)], 1.0 / 25.4, 0.0, ()),
        ([f"Bein {j} (Zoll)" for j in range(1, 7)], 1.0 / 25.4, 0.0, ()),
        ([f"leg{j}_Inches" for j in range(1, 7)], 1.0 / 25.4, 0.0, ()),
        ([f"L{j} [80 counts/mm]" for j in range(1, 7)], 80.0, 0.0, ()),
        (LEGS, 1e-3, 345.0, ("--lengths",)),
        ([f"Zylinder {j} (Länge) [mm]" for j in range(1, 7)], 1.0, 345.0, ()),
        ([f"Vérin {j}" for j in range(1, 7)], 1.0, 345.0, ()),
    ],
)
def test_units_and_columns_are_found(
    names: Sequence[str], factor: float, add: float, words: Sequence[str], tmp_path: Path
) -> None:
    table(own_folder(tmp_path, FLAT), names=names, factor=factor, add=add, separator=";")
    assert init(tmp_path, *words).code == 0
    assert [k for *_, k in pairs(tmp_path)] == [0, 1, 2]


REFUSED: list[tuple[Sequence[str], dict[str, Any], Sequence[str], Sequence[str]]] = [
    # photographs, table, words of the command, what must be named
    (FLAT, {"n": 2}, (), ("3 photographs for 2 rows", "column image")),
    (TWO, {"n": 7}, (), ("all folders together", "6 photographs for 7 rows")),
    (TWO, {"n": 4}, (), ("folder a", "3 photographs for 4 rows")),
    (FLAT[:2], {"columns": {"image": ("IMG_2", "IMG_10", "IMG_12")}}, (),
     ("'IMG_12'", "add the file, or remove the row")),
    (FLAT, {"columns": {"Foto": ("IMG_2", "IMG_10", "IMG_12")}}, (),
     ("row 3 (line 4), column Foto", "'IMG_12'", "'IMG_11.JPG'")),
    (FLAT, {"columns": {"Foto": ("a", "b", "c")}}, (),
     ("'a'", "'IMG_2.JPG'", "correct the column Foto", "in order")),
    (FLAT, {"columns": {"image": ("IMG_2", "img_2.jpg", "IMG_10")}}, (), ("row 2", "row 1")),
    (("1.jpg", "1.png", "2.png"), {"columns": {"image": "112"}}, (), ("row 1", "1.jpg, 1.png")),
    (SAME, {"n": 6, "columns": {"image": "123123"}}, (), ("a/1.png", "column view")),
    (FLAT, {"names": LEGS[:5]}, (), ("leg6", "'leg5'")),
    (FLAT, {"names": ["1.5"] * 6}, (), ("numbers in the first line", "leg1")),
    (FLAT, {"names": ["a", "b", "c", "d", "e", "f"]}, (), ("'a'", "L1, q1, 1")),
    (FLAT, {"names": ["X [mm]", "Y [mm]", "Z [mm]", "A", "B", "C"]}, (), ("where the tool",)),
    (FLAT, {"names": [*LEGS[:5], "leg5 mm"]}, (), ("'leg5'", "'leg5 mm'")),
    (FLAT, {"add": 345.0}, ("--unit", "m"), ("lengths of legs in mm", "add --lengths")),
    (FLAT, {}, ("--lengths",), ("readings in mm", "leave out --lengths")),
    (FLAT, {}, ("--unit", "m"), ("readings in mm", "state the unit mm")),
    (FLAT, {"add": 322.0}, ("--lengths", "--unit", "mm"),
     ("lengths are outside", "correct the lengths")),
    (FLAT, {"add": 5000.0}, (), ("travel of the model", "-4 to 144 mm")),
    (FLAT, {"names": [f"{leg} [mm]" for leg in LEGS]}, ("--unit", "m"), ("m and mm", "headings")),
    (FLAT, {}, ("--unit", "inch"), ("'inch'", "um")),
    (FLAT, {"names": [f"{leg}_feet" for leg in LEGS]}, (), ("'feet'", "mm, um, nm, cm, m, in, ft")),
    (FLAT, {}, ("--camera", "c7=x.yaml"), ("c7=x.yaml", "c1")),
    (FLAT, {}, ("--camera", "missing.yaml"), ("missing.yaml",)),
    (FLAT, {}, ("--camera", "c1=a.yaml", "--camera", "c1=b.yaml"), ("c1=a.yaml", "c1=b.yaml")),
    (FLAT, {}, ("--camera", str(HEXAPOD / "camera_info.yaml")), ("IMG_2.JPG", "64 x 48", "1024")),
    (FLAT, {"columns": {"time": ("10:00", "x", "10:02")}}, (), ("EXIF",)),
    (FLAT, {}, ("--encoder-sigma", "50mm"), ("50 mm", "20% of the travel", "--encoder-sigma")),
    (FLAT, {}, ("--board", "circles:9x7:30mm:15mm"), ("--board", "circles", "charuco")),
    (("IMG_1.HEIC", "IMG_2.HEIC"), {}, (), ("2 of another format", "IMG_1.HEIC", "JPEG")),
    ((), {}, (), ("no such folder",)),
]  # fmt: skip


@pytest.mark.parametrize(("photographs", "content", "words", "named"), REFUSED)
def test_what_cannot_become_a_dataset_is_refused_and_nothing_written(
    photographs: Sequence[str],
    content: dict[str, Any],
    words: Sequence[str],
    named: Sequence[str],
    tmp_path: Path,
) -> None:
    table(own_folder(tmp_path, photographs), **content)
    outcome = init(tmp_path, *words)
    assert outcome.code == 2
    said = outcome.err
    assert said.count("legcal: ") == 1
    assert all(word in said for word in named), said
    assert not (tmp_path / "dataset").exists()


def test_readings_that_nobody_knows_stay_empty(tmp_path: Path) -> None:
    """Some motors or all; a reading that is missing among others is refused."""
    folder = own_folder(tmp_path, names := ["a.jpg", "b.jpg", "c.jpg"])
    for unknown in ({"leg2"}, set(LEGS)):
        rows = [
            [name, *("" if leg in unknown else f"{q}" for leg, q in by_leg(k).items())]
            for k, name in enumerate(names)
        ]
        text = "\n".join(",".join(row) for row in [["image", *LEGS], *rows])
        (folder / "own.csv").write_text(text)
        made = init(folder, "--force", "--encoder-sigma", "2um", "--unit", "mm")
        assert made.code == 0
        assert "are not known (empty cells)" in made.said
        assert ("--encoder-sigma and --unit had no effect" in made.said) == (len(unknown) == 6)
        machine = load_dataset(folder / "dataset").machine
        assert len(machine.motors) == 6 - len(unknown)
    rows[0][1] = "10"
    (folder / "own.csv").write_text("\n".join(",".join(row) for row in [["image", *LEGS], *rows]))
    refused = init(folder, output="other")
    assert refused.code == 2
    assert "row 2 (line 3), column leg1: the reading could not be used" in refused.said
    assert not (folder / "other").exists()


def test_a_camera_in_the_hand_and_its_board_are_written(tmp_path: Path) -> None:
    table(own_folder(tmp_path, FLAT))
    assert "--hand-held" in init(tmp_path).said
    spec = "charuco:7x5:40mm:30mm:DICT_4X4_50"
    outcome = init(tmp_path, "--force", "--hand-held", "--board", spec)
    assert outcome.code == 0
    assert "--hand-held" not in outcome.said
    dataset = load_dataset(tmp_path / "dataset")
    assert len(dataset.measurements.views) == dataset.measurements.n_rows == len(FLAT)
    (board,) = dataset.boards
    assert (board.link, board_document(board.board)) == ("base", board_document(board_of(spec)))


def test_without_a_camera_file_photographs_that_state_a_focal_length_give_a_rough_camera(
    tmp_path: Path,
) -> None:
    table(own_folder(tmp_path, TWO[:3]))
    (tmp_path / "camera_info.yaml").unlink()
    outcome = init(tmp_path)
    assert outcome.code == 2  # nothing says what the lens is
    assert "not one focal length in their EXIF data" in outcome.said
    photographs = sorted((tmp_path / "photos" / "a").iterdir())
    for path in photographs:
        path.write_bytes(jpeg(PICTURE, block=exif(make="Acme", model="One", focal35=26)))
    outcome = init(tmp_path)
    assert outcome.code == 0
    assert "only known by the focal length" in outcome.said
    camera = load_dataset(tmp_path / "dataset").measurements.views[0].camera
    f = 26.0 * 80.0 / np.hypot(36.0, 24.0)  # of 64 x 48 px
    np.testing.assert_allclose(camera.K, [[f, 0, 31.5], [0, f, 23.5], [0, 0, 1]])
    assert camera.covariance is not None
    sigma = np.sqrt(np.diagonal(camera.covariance))
    assert sigma[0] == pytest.approx(np.hypot(0.04, 0.5 / np.sqrt(3.0) / 26.0) * f, rel=0.01)
    assert np.sqrt(camera.covariance[0, 0] - camera.covariance[0, 1]) < 0.01 * f  # square pixels
    assert np.count_nonzero(sigma) >= 5  # the principal point and distortion
    photographs[0].write_bytes(jpeg(PICTURE, block=exif(make="Acme", model="One", focal35=52)))
    assert init(tmp_path, "--force").code == 2  # a zoom


SIZES: dict[str, tuple[tuple[int, int], dict[str, Any], tuple[float, float]]] = {
    # size of the image [px], what EXIF says, least and largest focal length by it [px]
    "16:9 of a 4:3 sensor": ((1600, 900), {}, (1103.2, 1201.8)),
    "square of a 4:3 sensor": ((900, 900), {}, (764.8, 901.4)),
    "zoom 2": ((1600, 1200), {"zoom": 2.0}, (1201.8, 2403.6)),
    "cut by a program": ((1200, 800), {"width": 1600, "height": 1200}, (866.6, 1201.8)),
    "long lens that is near": ((1600, 1200), {"focal": 50.0, "focus": 0.5}, (1092.5, 1322.0)),
    "short lens": ((1600, 1200), {"focal": 4.25}, (1194.0, 1209.6)),
}


@pytest.mark.parametrize("name", SIZES)
def test_a_focal_length_by_exif_is_as_uncertain_as_its_zoom_format_and_focus_leave_it(
    name: str,
) -> None:
    (width, height), said, (least, most) = SIZES[name]
    photograph = read_facts(exif(make="Acme", model="One", focal35=26, **said))
    camera = camera_of_photographs([photograph] * 3, width, height)
    assert camera is not None
    assert camera.covariance is not None
    assert camera.K[0, 0] == pytest.approx(np.sqrt(least * most), rel=0.01)
    sigma = np.sqrt(camera.covariance[0, 0]) / camera.K[0, 0]
    open_ = np.sqrt(most / least) - 1.0  # to either end, at least
    assert sigma == pytest.approx(np.linalg.norm([open_, 0.04, 0.0111]), rel=0.02)
    margin = said.get("width", width) - width
    centre = np.hypot(0.02 * width, margin / np.sqrt(12.0))
    assert np.sqrt(camera.covariance[2, 2]) == pytest.approx(centre)


def test_a_focal_length_by_exif_that_no_sensor_has_is_not_taken() -> None:
    assert camera_of_photographs([read_facts(exif(focal=3.99, focal35=177))], 640, 480) is None
    zoomed = read_facts(exif(focal=3.99, focal35=177, zoom=6.0))
    assert camera_of_photographs([zoomed], 640, 480) is not None


def test_nothing_is_overwritten_without_force_and_nothing_is_written_into_the_photographs(
    tmp_path: Path,
) -> None:
    table(own_folder(tmp_path, FLAT))
    outcome = init(tmp_path, output="photos/dataset")
    assert outcome.code == 2
    assert "folder of the photographs, which is not changed" in outcome.err
    # beside the photographs: they are named where they are
    (tmp_path / "camera_info.yaml").rename(tmp_path / "lens.yaml")
    words = ("--camera", str(tmp_path / "lens.yaml"), "--json")
    outcome = init(tmp_path, *words, output=".")
    assert outcome.code == 0
    assert [image["image"] for image in outcome.document["images"]] == [f"photos/{x}" for x in FLAT]
    assert not (tmp_path / "images").exists()
    assert load_dataset(tmp_path).measurements.n_rows == 3
    before = files_of(tmp_path)
    table(tmp_path, add=1.0)
    outcome = init(tmp_path, *words, output=".")
    assert outcome.code == 2
    assert "dataset.yaml, measurements.csv, camera_info.yaml already" in outcome.out
    changed = {path for path, x in files_of(tmp_path).items() if x != before.get(path)}
    assert changed == {"own.csv"}
    assert init(tmp_path, *words, "--force", output=".").code == 0
    assert load_dataset(tmp_path).measurements.q[0, 0] == pytest.approx(0.011)
