"""``legcal detect``: the folder that people look at, what is drawn, and that nothing is lost."""

import base64
import gzip
import http.client
import json
import re
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run
from csv_rows import read_rows, write_rows
from lxml import html
from outline_tables import assert_same
from rendering import SIZE, RepeatedImages, repeated_images
from scipy.spatial.transform import RigidTransform

from legcal import detect, doctor, load_dataset
from legcal.calibration.detection import Detection
from legcal.calibration.detection_folder import _caption
from legcal.calibration.examination import Examination
from legcal.calibration.examination_page import examination_page
from legcal.data.corners import found_corners
from legcal.data.image_tables import canonical_order
from legcal.data.outlines import QUALITY, Outlines, read_observations, unmeasured
from legcal.data.reasons import USED, Reason, Rejection
from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.machine.leg import Cylinder
from legcal.perception.overlays import (
    COLOURS,
    LabelPlaces,
    Mark,
    PartMarks,
    draw,
    marks_of_corners,
    marks_of_image,
    marks_of_pairs,
)
from legcal.perception.photographs import MeasuredImages, Photographs, place_and_measure
from legcal.viewer.click_server import TOKEN_HEADER, ClickServer
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.visibility import PredictedLeg, predict_legs

BLANK, ASIDE = "images/p1_1.png", "images/aside.png"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RepeatedImages:
    """A hexapod in two poses; one picture shows nothing, and another view only shows grey."""
    made = repeated_images(tmp_path_factory.mktemp("detect") / "hexapod", n_images=2)
    made.pictures[BLANK] = np.full_like(made.pictures[BLANK], 90.0)
    made.pictures[ASIDE] = made.pictures[BLANK]
    made.entry["views"]["c2"] = dict(made.entry["views"]["c1"])
    made.rows.append({**made.rows[0], "view": "c2", "image": ASIDE})
    made.write()
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out") / "found"


@pytest.fixture(scope="module")
def examined(rendered: RepeatedImages, folder: Path) -> Examination:
    return doctor(rendered.path, output=folder)


@pytest.fixture(scope="module")
def found(examined: Examination) -> Detection:
    assert examined.detection is not None
    return examined.detection


@pytest.fixture
def one_image(rendered: RepeatedImages, tmp_path: Path) -> RepeatedImages:
    """The same view with two images, to be changed."""
    entry = json.loads(json.dumps(rendered.entry))
    del entry["views"]["c2"]
    rows = [dict(row) for row in rendered.rows[:2]]
    pictures = {row["image"]: rendered.pictures[row["image"]] for row in rows}
    made = RepeatedImages(tmp_path / "set", rendered.machine, entry, rows, pictures)
    made.write()
    return made


def test_folder_json_and_summary_tell_the_same(
    rendered: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sorted(rendered.path.rglob("*"))
    out = tmp_path / "out"
    assert run(monkeypatch, "detect", rendered.path, "-o", out, "--json") == 1  # c2 shows no leg
    document = json.loads(capsys.readouterr().out)
    assert sorted(rendered.path.rglob("*")) == before
    rows = read_rows(out / "observations.csv")
    assert document["outlines"] == len(rows)
    assert document["used"] == sum(row["verdict"] == "used" for row in rows) > 20
    view, aside = document["views"]
    assert (view["view"], aside["view"]) == ("c1", "c2")
    assert (view["images"], view["legs_found"]) == (4, view["legs_visible"] - 6)
    contrast = [float(row["contrast"]) for row in rows if row["verdict"] == "used"]
    assert view["contrast"] == pytest.approx(np.median(contrast))
    assert sum(view["rejected"].values()) == view["outlines"] - view["outlines_used"]
    assert "c2" in aside["problem"]
    assert aside["problem"] in [one["what"] for one in document["findings"]]
    in_c1, in_c2 = document["left_out"]
    assert [image["view"] for image in in_c1["images"]] == ["c1"]
    assert in_c2["why"] == "the camera of its view could not be placed"
    assert [image["view"] for image in in_c2["images"]] == ["c2"]
    files = [entry["file"] for entry in document["overlays"]]
    assert len(files) == len(set(files)) == document["images"] == 5
    page = (out / "index.html").read_text()
    for file in files:
        picture = cv2.imread(str(out / file))
        assert picture is not None
        assert picture.shape[0] > 3 * SIZE[1]  # enlarged, with a legend
        assert f'href="{file}"' in page
    assert "http:" not in page
    assert "https:" not in page
    kept = json.loads((out / "detection.json").read_text())
    assert {key: kept[key] for key in document} == document


def test_the_page_holds_the_table_the_photographs_and_where_lost_outlines_should_be(
    found: Detection, folder: Path
) -> None:
    page: Any = html.fromstring((folder / "index.html").read_text())
    packed = page.xpath("string(//script[@id='editor-table'])")
    table = gzip.decompress(base64.b64decode(packed))
    assert table == (folder / "observations.csv").read_bytes()
    editor = json.loads(page.xpath("string(//script[@id='editor-images'])"))
    for row, image in zip(found.rows.tolist(), editor["images"], strict=True):
        grey = cv2.imread(str(folder / image["photograph"]), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        assert grey.shape == (image["height"], image["width"])
        shown = found.dataset.image_reader([row])(0)
        assert np.abs(grey - np.rint(shown)).mean() < 4.0  # of compression and noise
    assert page.xpath("//figcaption/button/@data-edit") == [str(k) for k in range(5)]
    blank = next(one for one in editor["images"] if one["image"] == BLANK)
    names, o = found.dataset.machine.leg_names, found.outlines
    seen = {
        f"{names[o.leg[i]]}\n{o.part[i]}\n{o.edge[i]}": o.h[i]
        for i in np.flatnonzero(o.row == 2).tolist()  # of the same pose
    }
    cam = found.dataset.measurements.views[0].camera
    lines = [(seen[key], cam.undistort(np.array(px))) for key, px in blank["expected"].items()]
    off = [np.abs(cam.line_offset(h, xy)).max() for h, xy in lines]
    signs = [np.cross([*xy[1], 1.0], [*xy[0], 1.0]) @ h for h, xy in lines]
    assert len(lines) > 10
    assert np.nanmedian(off) < 2.0
    assert np.nanmin(signs) > 0.0  # the first end is nearer to the base


def test_a_served_page_answers_its_own_browser_alone(
    examined: Examination, found: Detection, folder: Path, tmp_path: Path
) -> None:
    shown = replace(found, dataset=replace(found.dataset, folder=tmp_path))
    server = ClickServer(examined, shown, folder)
    threading.Thread(target=server.run, daemon=True).start()

    def ask(method: str, path: str, **said: str) -> tuple[int, bytes]:
        at = http.client.HTTPConnection(server.address.host, server.address.port, timeout=60)
        at.request(method, path, said.pop("body", None), said)
        answer = at.getresponse()
        return answer.status, answer.read()

    try:
        code, page = ask("GET", "/")
        assert code == 200
        assert server.token.encode() in page
        picture = next(iter(found.photograph_files.values()))
        assert ask("GET", f"/{picture}") == (200, (folder / picture).read_bytes())
        for path in ("/detection.json", "/../detect.py", f"/x/../{picture}"):
            assert ask("GET", path)[0] == 404
        assert ask("GET", "/", Host="example.org")[0] == 404  # a name that leads here
        table = "view,image,joint,u,v,sigma\nc1,images/p1_1.png,leg1.base,5,6,\n"
        assert ask("POST", "/save", body=table)[0] == 403  # another page of the browser
        known = {TOKEN_HEADER: server.token}
        code, answer = ask("POST", "/clicks?image=0", body=table, **known)
        assert (code, json.loads(answer)["legs"]) == (200, [])
        assert "1 click" in json.loads(answer)["problems"][0]
        code, answer = ask("POST", "/save", body="joint\nleg1\n", **known)
        assert json.loads(answer)["problems"]
        assert not (tmp_path / "landmarks.csv").exists()
        ask("POST", "/save", body=table, **known)
        (row,) = read_rows(tmp_path / "landmarks.csv")
        assert (row["joint"], float(row["u"]), float(row["v"])) == ("leg1.base", 5.0, 6.0)
    finally:
        server.close()


def test_pages_of_many_images_show_the_worst_and_leave_out_a_table_that_is_too_long(
    examined: Examination, found: Detection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legcal.calibration.examination_page.MAX_ROWS", 2)
    monkeypatch.setattr("legcal.calibration.examination_page.MAX_BYTES", 1000)
    page: Any = html.fromstring(examination_page(examined, found))
    captions = page.xpath("//figure//figcaption/text()")
    assert [text.split(":")[0] for text in captions] == [BLANK, ASIDE]
    assert "The 2 of 5 images with the fewest used outlines are shown." in page.xpath("string()")
    assert "There are more outlines than a page should hold." in page.xpath("string()")
    assert page.xpath("//dialog[@id='editor'] | //button[@data-edit]") == []


def test_views_without_a_camera_pose_are_told_and_drawn_where_they_were_expected(
    found: Detection,
) -> None:
    assert list(found.unplaced) == ["c2"]
    assert {found.view_of(row) for row in found.outlines.row.tolist()} == {"c1"}
    assert len(found.predicted(4)) == 6


def test_captions_say_only_of_a_camera_with_a_hint_where_it_was_expected(
    found: Detection,
) -> None:
    assert _caption(found, 0).startswith("c1  images/p0_0.png  1")
    assert _caption(found, 4).endswith(
        "the camera could not be placed: edge pairs that were found, and legs where it was expected"
    )
    unknown = replace(found, T_base_camera=(found.T_base_camera[0], None))
    assert unknown.predicted(4) == []
    caption = _caption(unknown, 4)
    assert caption.endswith("the camera could not be placed: edge pairs that were found")


def test_pictures_of_a_view_that_is_not_placed_show_the_edge_pairs_that_were_found() -> None:
    cam = Camera(np.array([[500.0, 0.0, 199.5], [0.0, 500.0, 149.5], [0.0, 0.0, 1.0]]), 400, 300)
    image = np.full((300, 400), 200.0, dtype=np.float32)
    image[:, 180:210] = 40.0
    part = marks_of_pairs(cam, image)
    where = sorted(float(mark.points[:, 0].mean()) for mark in part.marks)
    assert where == pytest.approx([179.5, 209.5], abs=1.0)
    drawn = draw(image, [part], "c1 a.png").astype(int)
    near = np.abs(drawn - COLOURS["pair"]).max(axis=2) < 60
    assert near[: 4 * 280].any(axis=1).mean() > 0.9


def test_legs_are_drawn_by_the_radii_that_were_searched_by(
    one_image: RepeatedImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    def thicker(photographs: Photographs, *others: Any) -> MeasuredImages:
        machine = photographs.machine.with_radii(lambda j, c: c.radius * (2.0 + j))
        wrong = replace(photographs, machine=machine)
        return replace(place_and_measure(photographs, *others), photographs=wrong)

    monkeypatch.setattr("legcal.calibration.detection.place_and_measure", thicker)
    found = detect(one_image.path)
    legs = {leg.leg: leg for leg in found.predicted(0)}
    assert len(legs) == 6
    order = canonical_order(found.dataset.measurements, found.dataset.machine.leg_names).legs
    for at, j in enumerate(order.tolist()):
        nominal = {c.link: c.radius for c in found.dataset.machine.legs[j].cylinders}
        for piece in legs[j].segments:
            assert piece.radius == pytest.approx((2.0 + at) * nominal[piece.link])


def test_the_written_table_is_read_as_what_was_found(
    rendered: RepeatedImages, found: Detection, folder: Path
) -> None:
    dataset = load_dataset(rendered.path)
    path, legs = folder / "observations.csv", dataset.machine.legs
    assert_same(read_observations(path, legs, dataset.measurements), found.outlines)
    for name in QUALITY:
        assert np.all(np.isfinite(getattr(found.outlines, name)[found.outlines.used]))


def test_people_read_a_table_of_views(
    one_image: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert run(monkeypatch, "detect", one_image.path, "-o", tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert "outlines can be used" in printed.out
    assert re.search(r"1[12]/12", printed.out)  # of one leg little is seen
    assert f"Look at {tmp_path}/out/index.html" in printed.out.replace("\n", "")
    assert "Drawing overlays: 2/2" in printed.err


def test_an_edited_table_is_never_written_over_and_wins_in_the_dataset(
    one_image: RepeatedImages, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    detect(one_image.path, output=out)
    detect(one_image.path, output=out)  # replaces its own files
    rows = read_rows(out / "observations.csv")
    rows[3] |= {"verdict": "rejected", "reason": "a cable", "source": "edited"}
    write_rows(out / "observations.csv", rows)
    edited = (out / "observations.csv").read_bytes()
    with pytest.raises(UsageError, match=r"found a table that was changed since .* copy it into"):
        detect(one_image.path, output=out)
    assert (out / "observations.csv").read_bytes() == edited
    (one_image.path / "observations.csv").write_bytes(edited)
    found = detect(one_image.path, output=out)
    assert found.outlines.reason[3] == Rejection(Reason.OTHER, "a cable")
    assert found.outlines.source.count("edited") == 1
    kept = read_rows(out / "observations.csv")[3]
    assert (kept["verdict"], kept["source"], kept["contrast"]) == ("rejected", "edited", "")


def test_an_earlier_detection_is_replaced_and_other_files_are_kept(
    one_image: RepeatedImages, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    detect(one_image.path, output=out)
    (out / "overlays" / "mine.txt").write_text("mine")
    del one_image.rows[1]
    one_image.write()
    detect(one_image.path, output=out)
    assert [path.name for path in (out / "overlays" / "c1").iterdir()] == ["p0_0.jpg"]
    assert (out / "overlays" / "mine.txt").read_text() == "mine"
    one_image.rows[0]["image"] = "images/p0_1.png"
    one_image.write()
    (out / "overlays" / "c1" / "p0_1.jpg").write_text("of somebody else")
    with pytest.raises(UsageError, match=r"overlays/c1/p0_1.jpg, which legcal did not write"):
        detect(one_image.path, output=out)
    assert (out / "overlays" / "c1" / "p0_0.jpg").exists()


def test_images_of_the_same_name_have_pictures_of_their_own(found: Detection) -> None:
    measurements = found.dataset.measurements
    views = (replace(measurements.views[0], name="../left cam"), *measurements.views[1:])
    images = ("images/a.png", "more/A.png", "b/c.png", "b/d.png", "images/a.png")
    renamed = replace(measurements, views=views, image=images)
    pictures = replace(found, dataset=replace(found.dataset, measurements=renamed)).overlay_files
    assert list(pictures.values()) == [
        "overlays/_left_cam/images_a.png.jpg",
        "overlays/_left_cam/more_A.png.jpg",
        "overlays/_left_cam/b_c.png.jpg",
        "overlays/_left_cam/b_d.png.jpg",
        "overlays/c2/a.jpg",
    ]


def test_a_folder_with_other_files_is_refused_before_any_work(
    rendered: RepeatedImages, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "detect", rendered.path, "-o", rendered.path, "--json") == 2
    error: dict[str, Any] = json.loads(capsys.readouterr().out)["error"]
    assert "found a folder with other files and no detection.json of legcal" in error["message"]


def test_images_that_cannot_be_read_are_refused_and_nothing_is_written(
    one_image: RepeatedImages,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = one_image.path / one_image.rows[1]["image"]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert run(monkeypatch, "detect", one_image.path, "-o", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "p0_1.png" in said
    assert len(said.strip().splitlines()) <= 2
    assert not (tmp_path / "out").exists()


# What is drawn over images.

A, B, RADIUS = np.array([-0.30, 0.22, 0.8]), np.array([0.25, 0.21, 0.9]), 0.012
NAMES = ("leg1",)


def camera(model: str) -> Camera:
    K = np.array([[600.0, 0.0, 321.7], [0.0, 604.0, 238.2], [0.0, 0.0, 1.0]])
    if model == "equidistant":
        return Camera(K, 640, 480, np.array([0.05, -0.01, 0.0, 0.0]), "equidistant")
    return Camera(K, 640, 480, np.array([-0.25, 0.06, 1e-3, -5e-4, 0.0]))


def predicted(cam: Camera) -> list[PredictedLeg]:
    length = float(np.linalg.norm(B - A))
    cylinders = [(Cylinder("leg1_rod", RADIUS, "base", 0.0, length),)]
    return predict_legs(cam, RigidTransform.identity(), A[None], B[None], cylinders, 0)


def outlines(cam: Camera) -> Outlines:
    """Return the exact outlines of a leg, used."""
    u = (B - A) / np.linalg.norm(B - A)
    h = predicted(cam)[0].outlines[0]
    points = np.array([A + 0.1 * u, B - 0.1 * u])
    touching = points - RADIUS * EPSILON[:, None, None] * h[:, None, :]
    two = np.zeros(2, dtype=np.intp)
    return Outlines(
        row=two,
        leg=two,
        part=("leg1_rod",) * 2,
        edge=np.array([1, 2]),
        h=h,
        ends=cam.project(touching),
        covariance=np.tile(1e-4 * np.eye(2), (2, 1, 1)),
        used=np.ones(2, dtype=np.bool_),
        reason=(USED, USED),
        source=("detected",) * 2,
        **unmeasured(2),
    )


def marked(cam: Camera, found: Outlines) -> PartMarks:
    (part,) = marks_of_image(cam, found, predicted(cam), NAMES)
    return part


def curves(part: PartMarks) -> dict[str, Array]:
    return {mark.kind: mark.points for mark in part.marks}


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_curves_are_the_outlines_and_the_axis_of_the_leg_through_the_lens(model: str) -> None:
    cam = camera(model)
    found = outlines(cam)
    drawn = curves(marked(cam, found))
    assert list(drawn) == ["edge 1", "edge 2", "axis"]
    u = (B - A) / np.linalg.norm(B - A)
    for i, kind in enumerate(("edge 1", "edge 2")):
        offset = cam.line_offset(found.h[i], cam.undistort(drawn[kind]))
        assert np.abs(offset).max() < 1e-6
        np.testing.assert_allclose(drawn[kind][[0, -1]], found.ends[i], atol=0.05)
    on_axis = cam.project(A + np.linspace(0.0, 1.0, 2001)[:, None] * (B - A))
    apart = np.linalg.norm(drawn["axis"][:, None] - on_axis, axis=2).min(axis=1)
    assert apart.max() < 0.2  # of points a third of a pixel apart
    moved = replace(found, ends=found.ends + np.array([0.0, 3.0]))  # beside their lines
    beside = curves(marked(cam, moved))["edge 1"]
    assert np.abs(cam.line_offset(found.h[0], cam.undistort(beside))).max() < 1e-6
    normal = np.cross(u, A)
    assert np.abs(cam.line_offset(normal, cam.undistort(drawn["axis"]))).max() < 1e-6
    chord = (
        drawn["axis"][0] + np.linspace(0.0, 1.0, 40)[:, None] * np.diff(drawn["axis"][[0, -1]].T).T
    )
    assert np.abs(chord - drawn["axis"]).max() > 1.0  # the lens bends it


def test_what_is_not_used_is_drawn_with_its_reason_and_what_is_missing_where_it_should_be() -> None:
    cam = camera("plumb_bob")
    found = outlines(cam)
    one = replace(
        found, used=np.array([True, False]), reason=(USED, Rejection(Reason.CONTRAST, "2.1"))
    )
    part = marked(cam, one)
    assert list(curves(part)) == ["edge 1", "rejected"]
    assert (part.name, part.reason) == ("leg1", "edge 2: low contrast")
    lost = replace(
        found,
        h=np.full((2, 3), np.nan),
        ends=np.full((2, 2, 2), np.nan),
        used=np.zeros(2, dtype=np.bool_),
        reason=(Rejection(Reason.NO_PAIR),) * 2,
    )
    part = marked(cam, lost)
    assert [mark.kind for mark in part.marks] == ["predicted", "predicted"]
    assert part.reason == "no convincing pair of edges"
    h = predicted(cam)[0].outlines[0]
    for mark, line in zip(part.marks, h, strict=True):
        assert np.abs(cam.line_offset(line, cam.undistort(mark.points))).max() < 1e-6
    gone = replace(lost, reason=(Rejection(Reason.OUTSIDE),) * 2)
    assert marks_of_image(cam, gone, predicted(cam), NAMES) == []


def test_an_edited_outline_and_a_leg_without_rows_are_named() -> None:
    cam = camera("plumb_bob")
    part = marked(cam, replace(outlines(cam), source=("detected", "edited")))
    assert part.name == "leg1 (edited)"
    found = outlines(cam)
    empty = replace(found, leg=found.leg + 1)
    names = [part.name for part in marks_of_image(cam, empty, predicted(cam), ("leg1", "leg2"))]
    assert names == ["leg2", "leg1"]


@pytest.mark.parametrize("factor", [0.3, 1.5])
def test_pictures_of_every_size_have_lines_and_letters_of_the_same_share(factor: float) -> None:
    width, height = round(1600 * factor), round(1200 * factor)
    curve = np.column_stack([np.linspace(0.2, 0.8, 30) * width, np.full(30, 0.5 * height)])
    part = PartMarks("leg1", "low contrast", (Mark("edge 1", curve),))
    picture = draw(np.full((height, width), 100.0), [part], "c1 a.png")
    assert picture.shape[1] >= 1600
    image = picture[: round(picture.shape[1] * 0.75)].astype(int)
    column = np.abs(image[:, image.shape[1] // 4] - COLOURS["edge 1"]).max(axis=1)
    thick = np.count_nonzero(column < 60)
    assert 0.0008 < thick / picture.shape[1] < 0.0025
    lit = np.flatnonzero(np.any(image[..., 2] > 200, axis=1))  # the name is red
    assert 0.02 < np.ptp(lit) / picture.shape[1] < 0.06


def test_corners_of_boards_are_crosses_where_they_were_found() -> None:
    px, none = np.array([[300.2, 200.0], [1200.0, 700.5]]), np.zeros(2, dtype=np.intp)
    found = found_corners(none, none, px, np.ones(2))
    found = replace(
        found, used=np.array([True, False]), reason=(USED, Rejection(Reason.OTHER, "far off"))
    )
    grey = np.full((1200, 1600), 100.0)
    picture = draw(grey, [], "c1 a.png", marks_of_corners(found)).astype(int)
    for (x, y), colour in zip(px, (COLOURS["corner"], COLOURS["rejected"]), strict=True):
        is_lit = np.abs(picture[:1200] - np.array(colour)).max(axis=2) < 60
        rows, columns = np.nonzero(is_lit)
        assert abs(rows.mean() - y) < 0.6
        assert abs(columns.mean() - x) < 0.6
    assert np.any(picture[1200:] != draw(grey, [], "c1 a.png")[1200:])  # the legend says so


def test_texts_stand_inside_the_picture_and_apart() -> None:
    curve = np.column_stack([np.full(20, 10.0), np.linspace(10.0, 290.0, 20)])
    places = LabelPlaces(400, 300, curve)
    corners = [places.place(curve, (80, 20), 10.0)[0] for _ in range(5)]
    assert len(set(corners)) == 5
    for x, y in corners:
        assert 0 <= x <= 320
        assert 0 <= y <= 280
    for i, (x, y) in enumerate(corners):
        assert all(abs(x - p) >= 80 or abs(y - q) >= 20 for p, q in corners[:i])


def test_texts_of_rods_in_parallel_pairs_stand_apart() -> None:
    width, height, distance = 1600, 1200, 25.0
    tops = np.array([700.0, 500.0]) + 20.0 * np.array(
        [[0, 0], [1, 1], [4, 2], [5, 2], [8, 1], [9, 0]]
    )
    feet = np.array([[450, 900], [470, 920], [780, 800], [800, 800], [1150, 930], [1170, 910]])
    share = np.linspace(0.0, 1.0, 40)[:, None]
    rods = [a + share * (b - a) for a, b in zip(tops, feet, strict=True)]
    stubs = [np.array([780.0 + x, 820.0]) + share * [20.0, 2.0] for x in (0.0, 25.0, 50.0)]
    curves = [*rods, *stubs]
    places = LabelPlaces(width, height, np.concatenate(curves))
    sizes = [(420, 50), (150, 30), (420, 50), (420, 50), (150, 30), (420, 50), *3 * [(240, 50)]]
    boxes = []
    for curve, size in zip(curves, sizes, strict=True):
        corner, leader = places.place(curve, size, distance)
        boxes.append(np.array([corner, np.add(corner, size)]))
        assert np.linalg.norm(curve - leader[0], axis=1).min() < 1e-9  # on its own rod
        assert np.linalg.norm(np.diff(leader, axis=0)) < 250.0
    for i, box in enumerate(boxes):
        assert np.all(box >= 0)
        assert np.all(box <= [width, height])
        assert all(np.any((box[0] >= o[1]) | (box[1] <= o[0])) for o in boxes[:i])
