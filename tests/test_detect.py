"""``legcal detect``: the folder that people look at, what is drawn, and that nothing is lost."""

import base64
import gzip
import http.client
import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command_line import run
from csv_rows import read_rows, write_rows
from hexapod_example import Spoiled, spoiled
from lxml import html
from scipy.spatial.transform import RigidTransform

from legcal import detect, doctor
from legcal.calibration.detection import Detection, Examination
from legcal.data.outlines import Outlines, found_outlines, join_outlines
from legcal.data.reasons import USED, Reason, Rejection
from legcal.errors import UsageError
from legcal.geometry.types import Array
from legcal.machine.leg import Cylinder
from legcal.perception.overlays import marks_of_image
from legcal.viewer.click_server import ClickServer
from legcal.viewer.server import TOKEN_HEADER
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.visibility import PredictedLeg, predict_legs

pytestmark = pytest.mark.usefixtures("without_remedies")

BLANK = "images/blank.png"


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Spoiled:
    """Three photographs of the example, one that shows nothing, and another view of nothing."""
    made = spoiled(tmp_path_factory.mktemp("detect") / "hexapod", 3, ("c1",))
    made.entry["views"]["c2"] = dict(made.entry["views"]["c1"])
    for view, name in (("c1", BLANK), ("c2", "images/aside.png")):
        made.rows.append({**made.rows[0], "view": view, "image": name})
        cv2.imwrite(str(made.path / name), np.full((384, 512), 90, dtype=np.uint8))
    made.write()
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out") / "found"


@pytest.fixture(scope="module")
def examined(session: Spoiled, folder: Path) -> Examination:
    before = sorted(session.path.rglob("*"))
    with pytest.MonkeyPatch.context() as patch:  # trying mistakes would take most of the time
        patch.setattr("legcal.calibration.doctor.diagnose", lambda *_: ())
        found = doctor(session.path, output=folder)
    assert sorted(session.path.rglob("*")) == before
    return found


@pytest.fixture(scope="module")
def found(examined: Examination) -> Detection:
    assert examined.detection is not None
    return examined.detection


@pytest.fixture(scope="module")
def of_one_view(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photographs of one view and, in the folder out, what is found in them: to be copied."""
    folder = tmp_path_factory.mktemp("one")
    detect(spoiled(folder / "set", 2, ("c1",)).write(), output=folder / "out")
    return folder


@pytest.fixture
def out(of_one_view: Path, tmp_path: Path) -> Path:
    """A copy of what is found in them, beside a copy of the folder set; to be changed."""
    shutil.copytree(of_one_view, tmp_path, dirs_exist_ok=True)
    return tmp_path / "out"


def test_folder_json_and_summary_tell_the_same(
    examined: Examination, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = folder
    monkeypatch.setattr("legcal.calibration.doctor.doctor", lambda *_, **__: examined)
    outcome = run("detect", "dataset", "-o", out, "--json")
    assert outcome.code == 1  # c2 shows no leg
    document = outcome.document
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
        assert picture.shape[0] > 3 * 384  # enlarged, with a legend
        assert f'href="{file}"' in page
    assert "http:" not in page.replace("http://www.w3.org/2000/svg", "")  # a name, not an address
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
        for i in np.flatnonzero(o.row == 0).tolist()  # at the same readings
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
        table = f"view,image,joint,u,v,sigma\nc1,{BLANK},leg1.base,5,6,\n"
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


def test_an_edited_table_is_never_written_over_and_wins_in_the_dataset(out: Path) -> None:
    dataset = out.parent / "set"
    rows = read_rows(out / "observations.csv")
    rows[3] |= {"verdict": "rejected", "reason": "a cable", "source": "edited"}
    write_rows(out / "observations.csv", rows)
    edited = (out / "observations.csv").read_bytes()
    with pytest.raises(UsageError, match=r"found a table that was changed since .* copy it into"):
        detect(dataset, output=out)
    assert (out / "observations.csv").read_bytes() == edited
    (dataset / "observations.csv").write_bytes(edited)
    found = detect(dataset, output=out)
    assert found.outlines.reason[3] == Rejection(Reason.OTHER, "a cable")
    assert found.outlines.source.count("edited") == 1
    kept = read_rows(out / "observations.csv")[3]
    assert (kept["verdict"], kept["source"], kept["contrast"]) == ("rejected", "edited", "")


def test_an_earlier_detection_is_replaced_and_other_files_are_kept(out: Path) -> None:
    drawn, table = out / "overlays" / "c1", out.parent / "set" / "measurements.csv"
    (out / "overlays" / "mine.txt").write_text("mine")
    first, second = (Path(row["image"]).stem for row in read_rows(table))
    write_rows(table, read_rows(table)[:1])
    detect(table.parent, output=out)
    assert [path.name for path in drawn.iterdir()] == [f"{first}.jpg"]
    assert (out / "overlays" / "mine.txt").read_text() == "mine"
    write_rows(table, [{**row, "image": f"images/{second}.png"} for row in read_rows(table)])
    (drawn / f"{second}.jpg").write_text("of somebody else")
    with pytest.raises(UsageError, match=rf"c1/{second}.jpg, which legcal did not write"):
        detect(table.parent, output=out)
    assert (drawn / f"{first}.jpg").exists()


# What is drawn over images.

A, B, RADIUS = np.array([-0.30, 0.22, 0.8]), np.array([0.25, 0.21, 0.9]), 0.012


def camera(model: str) -> Camera:
    K = np.array([[600.0, 0.0, 321.7], [0.0, 604.0, 238.2], [0.0, 0.0, 1.0]])
    if model == "equidistant":
        return Camera(K, 640, 480, np.array([0.05, -0.01, 0.0, 0.0]), "equidistant")
    return Camera(K, 640, 480, np.array([-0.25, 0.06, 1e-3, -5e-4, 0.0]))


def predicted(cam: Camera) -> list[PredictedLeg]:
    length = float(np.linalg.norm(B - A))
    cylinders = [(Cylinder("leg1_rod", RADIUS, "base", 0.0, length),)]
    return predict_legs(cam, RigidTransform.identity(), A[None], B[None], cylinders)


def outlines(cam: Camera) -> Outlines:
    """Return the exact outlines of a leg, used."""
    u = (B - A) / np.linalg.norm(B - A)
    h = predicted(cam)[0].outlines[0]
    points = np.array([A + 0.1 * u, B - 0.1 * u])
    touching = points - RADIUS * EPSILON[:, None, None] * h[:, None, :]
    two = np.zeros(2, dtype=np.intp)
    covariance = np.tile(1e-4 * np.eye(2), (2, 1, 1))
    ends = cam.project(touching)
    return found_outlines(two, two, ("leg1_rod",) * 2, np.array([1, 2]), h, ends, covariance)


def curves(cam: Camera, found: Outlines) -> dict[str, Array]:
    """Return what is drawn over an image, by kind."""
    (part,) = marks_of_image(cam, found, predicted(cam), ("leg1",))
    return {mark.kind: mark.points for mark in part.marks}


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_curves_are_the_outlines_and_the_axis_of_the_leg_through_the_lens(model: str) -> None:
    cam = camera(model)
    found = outlines(cam)
    drawn = curves(cam, found)
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
    beside = curves(cam, moved)["edge 1"]
    assert np.abs(cam.line_offset(found.h[0], cam.undistort(beside))).max() < 1e-6
    normal = np.cross(u, A)
    assert np.abs(cam.line_offset(normal, cam.undistort(drawn["axis"]))).max() < 1e-6
    chord = (
        drawn["axis"][0] + np.linspace(0.0, 1.0, 40)[:, None] * np.diff(drawn["axis"][[0, -1]].T).T
    )
    assert np.abs(chord - drawn["axis"]).max() > 1.0  # the lens bends it
    weak = Rejection(Reason.CONTRAST, "2.1")
    one = replace(found, used=np.array([True, False]), reason=(USED, weak))
    assert list(curves(cam, one)) == ["edge 1", "rejected"]
    both = join_outlines([found, replace(found, part=("leg1_tube",) * 2)])
    parts = marks_of_image(cam, both, predicted(cam), ("leg1",))
    assert [part.name for part in parts] == ["leg1 rod", "leg1 tube"]
