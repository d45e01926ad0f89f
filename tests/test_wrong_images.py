"""Photographs, views, hints and radii that cannot be right: each is named, and the rest is used."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fit_sessions import PINHOLE
from hexapod_example import Picture, Spoiled, spoiled
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation
from simulated import simulated

from legcal import calibrate, detect, load_dataset
from legcal.calibration.board import rough_placement
from legcal.calibration.detection import Detection
from legcal.calibration.estimate import outlier_images
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.data.reasons import Reason, Rejection
from legcal.geometry.types import Array, BoolArray
from legcal.perception.diagnostics import (
    ImageExplanation,
    OutlineCount,
    hint_notes,
    image_verdict,
)
from legcal.perception.image_quality import measure_exposure
from legcal.perception.photographs import MeasuredImages, place_and_measure
from legcal.progress import no_progress
from legcal.workers import in_turn

pytestmark = pytest.mark.usefixtures("without_steps")

WITHOUT_GAMMA = "The gamma of "  # a note on the cameras of the example
N = 8  # images of a view: with fewer good ones its rough pose gives way to a long search


def _mirror(picture: Picture) -> Picture:
    return picture[:, ::-1]


def _zoomed(picture: Picture) -> Any:
    height, width = picture.shape
    M = cv2.getRotationMatrix2D((0.5 * (width - 1), 0.5 * (height - 1)), 0.0, 1.08)
    return cv2.warpAffine(picture, M, (width, height), flags=cv2.INTER_CUBIC)


def _elsewhere(picture: Picture) -> Any:
    rng = np.random.default_rng(2)
    other = np.full(picture.shape, 90, dtype=np.uint8)
    for _ in range(25):
        x, y, width, height = rng.integers(5, 400, 4).tolist()
        cv2.rectangle(other, (x, y), (x + width, y + height), int(rng.integers(20, 230)), -1)
    return cv2.GaussianBlur(other, (0, 0), 0.6)


RNG, BLURRED = np.random.default_rng(1), r"is blurred by \d\.\d.* px, the others of its view by \d"
CHANGED: dict[tuple[str, int], tuple[Callable[[Picture], Any], str]] = {
    ("c1", 1): (lambda picture: 0 * picture, "the image is black, at most 0 of 255"),
    ("c1", 2): (lambda picture: 0 * picture + 255, "the image is overexposed, at least 255"),
    ("c1", 4): (_mirror, "the image is mirrored; replace it"),
    ("c1", 5): (_zoomed, r"it shows the legs about 1\.0[6-9] times as large as the others"),
    ("c2", 1): (
        lambda picture: cv2.GaussianBlur(picture, (0, 0), 3.0),
        r"the image is blurred by \d\.\d.* px, the others of its view by \d",
    ),
    ("c2", 2): (
        lambda picture: cv2.blur(picture, (13, 1)),
        r"the image is blurred by \d\.\d.* px, the others of its view by \d",
    ),
    ("c2", 4): (lambda picture: picture[::-1, ::-1], "the image is upside down"),
    ("c3", 1): (
        lambda picture: 110.0 + 1.5 * RNG.standard_normal(picture.shape),
        "the image shows nothing, all of it within",
    ),
    ("c3", 2): (
        _elsewhere,
        "0 of 1[02] predicted outlines were found, and no other explanation",
    ),
}
SWAPPED = [(("c1", 3), ("c2", 5)), (("c3", 3), ("c3", 4))]


@pytest.fixture(scope="module")
def bad(tmp_path_factory: pytest.TempPathFactory) -> Spoiled:
    """Nearly every way in which an image can be wrong."""
    made = spoiled(tmp_path_factory.mktemp("bad") / "hexapod", N)
    for (view, k), (change, _) in CHANGED.items():
        made.change(view, k, change)
    for one, other in SWAPPED:
        made.swap(one, other)
    made.entry["views"]["c3"]["legs"] = [f"leg{j}" for j in (1, 3, 4, 5, 6)]
    made.write()
    return made


@pytest.fixture(scope="module")
def detected(bad: Spoiled) -> Detection:
    return detect(bad.path)


def _note(notes: tuple[str, ...], image: str) -> str:
    found = [note for note in notes if re.search(rf"image {image}: |\([^)]*{image}[,)]", note)]
    assert len(found) == 1, notes
    return found[0]


@pytest.mark.parametrize("where", CHANGED, ids=lambda where: f"{where[0]}_{where[1]}")
def test_an_image_that_is_no_good_is_named_and_left_out(
    bad: Spoiled, detected: Detection, where: tuple[str, int]
) -> None:
    row = bad.row(*where)
    note = _note(detected.notes, row["image"])
    start = f"view {where[0]}, image {row['image']}: was left out: "
    assert note.startswith(start) or "2 images of view c2" in note
    assert "left out" in note
    assert re.search(CHANGED[where][1], note), note
    of_row = detected.outlines.row == bad.rows.index(row)
    assert of_row.any()
    assert not detected.outlines.used[of_row].any()


def test_files_that_were_exchanged_are_told_from_each_other(
    bad: Spoiled, detected: Detection
) -> None:
    (one, other), (near, far) = SWAPPED
    for here, from_view, with_image in ((one, other, other), (other, one, one)):
        image, given = bad.row(*here)["image"], bad.row(*with_image)["image"]
        words = f"by the camera of view {from_view[0]} at the reading given for image {given};"
        assert words in _note(detected.notes, image)
    for here, of in ((near, far), (far, near)):
        image, given = bad.row(*here)["image"], bad.row(*of)["image"]
        assert f"shows the reading given for image {given};" in _note(detected.notes, image)


@pytest.mark.system
def test_a_wrong_digit_is_no_exchange_with_an_image_that_shows_its_own_reading(
    tmp_path: Path,
) -> None:
    made = spoiled(tmp_path / "digit", N, ("c1", "c2"))
    row = made.row("c1", 4)
    assert row["leg2_prismatic"] == "0.0075626"
    row["leg2_prismatic"] = "0.0705626"
    found = detect(made.write())
    note = _note(found.notes, row["image"])
    assert "shows the reading given for" not in note
    assert "check its reading of leg2, 70.56 mm against 7.91 mm," in note


def test_nothing_else_is_said_and_the_other_images_are_used(
    bad: Spoiled, detected: Detection
) -> None:
    notes = [note for note in detected.notes if not note.startswith(WITHOUT_GAMMA)]
    assert len(notes) == len(CHANGED) - 1 + 2 * len(SWAPPED)  # both blurred ones are one
    assert detected.unplaced == {}
    named = "".join(detected.notes)
    for k, row in enumerate(bad.rows):
        if row["image"] not in named:
            own = detected.outlines.row == k
            assert detected.outlines.used[own].mean() > 0.5


def _observed(made: Spoiled) -> MeasuredImages:
    session = order_dataset(load_dataset(made.write()), in_turn, no_progress)
    scene, _ = rough_placement(session)
    return place_and_measure(session.photographs, scene, no_progress)


def test_images_that_show_nothing_are_named_although_their_view_is_not_placed(
    tmp_path: Path,
) -> None:
    made = spoiled(tmp_path / "views", 4, ("c1", "c2"))
    black = [made.change("c1", k, lambda picture: 0 * picture) for k in range(3)]
    made.change("c1", 3, _elsewhere)
    for k in range(4):
        made.change("c2", k, lambda picture: 0 * picture)
    found = _observed(made).placement
    assert list(found.unplaced) == ["c1", "c2"]
    assert list(found.notes) == [
        f"3 images of view c1 ({', '.join(black)}) were left out: the image is "
        "black, at most 0 of 255 grey levels; take it again."
    ]
    assert "none of its 4 images" in str(found.unplaced["c2"])  # once for all of them


@pytest.mark.system
def test_a_mirrored_view_and_exchanged_hints_are_named(tmp_path: Path) -> None:
    made = spoiled(tmp_path / "views", 3)
    for k in range(3):
        made.change("c1", k, _mirror)
    views = made.entry["views"]
    for name in ("c2", "c3"):
        views[name], views[name]["T_base_camera"] = dict(views[name]), None
    views["c2"]["T_base_camera"], views["c3"]["T_base_camera"] = (
        {"xyz": [-0.7234, 0.5958, 0.288], "quat_xyzw": [-0.32591, 0.67154, -0.59867, 0.29053]},
        {"xyz": [0.9335, 0.2578, 0.1912], "quat_xyzw": [0.41111, 0.57416, -0.55209, -0.44331]},
    )
    found = detect(made.write())
    assert list(found.unplaced) == ["c1"]
    assert "images show the legs only if left and right are swapped" in str(found.unplaced["c1"])
    assert len([note for note in found.notes if not note.startswith(WITHOUT_GAMMA)]) == 2
    assert re.match(r"view c2: its T_base_camera is wrong: .*it fits view c3", found.notes[0])
    assert re.match(r"view c3: its T_base_camera is wrong: .*it fits view c2", found.notes[1])


X_FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # x is z, y is -x


@pytest.mark.parametrize(
    ("written", "words"),
    [
        (lambda T: T.inv(), "if it is T_camera_base, the inverse:"),
        (
            lambda T: _pose(T.translation, Rotation.from_quat(np.roll(T.rotation.as_quat(), 1))),
            "if its quaternion is in the order w, x, y, z:",
        ),
        (
            lambda T: T * _pose(np.zeros(3), Rotation.from_euler("x", 180, degrees=True)),
            "if its camera axes are y up and z backward:",
        ),
        (
            lambda T: T * _pose(np.zeros(3), Rotation.from_matrix(X_FORWARD)),
            "if its camera axes are x forward and z up:",
        ),
        (
            lambda T: T * _pose(np.zeros(3), Rotation.from_euler("y", 40, degrees=True)),
            "; correct it in dataset.yaml",
        ),
    ],
)
def test_a_rough_pose_in_another_convention_is_called_so(
    written: Callable[[RigidTransform], RigidTransform], words: str
) -> None:
    near = _pose(np.array([0.01, -0.01, 0.0]), Rotation.from_rotvec([1.0, -1.0, 0.5], degrees=True))
    T = _pose(np.array([0.3, -0.9, 0.5]), Rotation.from_quat([0.68, 0.17, -0.2, 0.68]))
    views = [View(name, PINHOLE, written(T * near)) for name in ("c1", "c2")]
    (note,) = hint_notes(views[:1], [T])
    assert words in note
    notes = hint_notes(views, [T] * 2)
    assert len(notes) == 1 + words.startswith(";")  # one cause, one note
    assert ("views c1, c2:" in notes[0]) == (len(notes) == 1)


def _pose(xyz: NDArray[np.float64], rotation: Rotation) -> RigidTransform:
    return RigidTransform.from_components(xyz, rotation)


@pytest.mark.parametrize(
    ("factor", "leg", "words"),
    [
        pytest.param(
            1.2, "leg", r"All legs appear 1[2-9] % thinner than in the model; the radii",
            marks=pytest.mark.system,
        ),
        pytest.param(0.8, "leg2", r"leg2 may be 2[2-8] % thicker than in the model: its radius is"),
    ],
)  # fmt: skip
def test_radii_that_are_wrong_by_a_fifth_are_found(
    tmp_path: Path, factor: float, leg: str, words: str
) -> None:
    made = spoiled(tmp_path / "radii", 3, ("c1", "c2"))
    made.scale_radii(factor, leg)
    observed = _observed(made)
    found = observed.placement
    assert found.unplaced == {}
    assert len(found.notes) == 1
    assert re.match(words, found.notes[0]), found.notes
    radii = [c.radius for of_leg in observed.photographs.cylinders for c in of_leg]
    assert np.allclose(radii, 0.01, rtol=0.06)


def test_blur_is_measured_whatever_the_light() -> None:
    rng = np.random.default_rng(0)
    picture = np.zeros((300, 400), np.float32)
    for _ in range(40):
        x, y, width, height = rng.integers(0, 250, 4).tolist()
        cv2.rectangle(picture, (x, y), (x + width, y + height), float(rng.uniform(20, 200)), -1)
    for blur in (1.0, 2.0, 4.0):
        smooth = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur))
        for light in (0.3, 1.0):
            noisy = (light * smooth + rng.standard_normal(picture.shape)).astype(np.float32)
            assert measure_exposure(noisy).blur == pytest.approx(blur, rel=0.35, abs=0.3)


def test_what_is_flat_has_no_edges() -> None:
    picture = np.full((600, 800), 20.0, np.float32)
    assert measure_exposure(picture).blur == 0.0
    cv2.rectangle(picture, (200, 150), (420, 400), 180.0, -1)
    for blur in (1.0, 2.0):
        smooth = np.rint(cv2.GaussianBlur(picture, (0, 0), blur))
        assert measure_exposure(smooth).blur == pytest.approx(blur, rel=0.2)
    stripes = np.tile((40.0 + 150.0 * (np.arange(4000) // 9 % 2)).astype(np.float32), (3000, 1))
    assert measure_exposure(stripes).blur < 0.6  # all slopes are the greatest


def _with_rejected(outlines: Outlines, rejected: BoolArray) -> Outlines:
    out = rejected & outlines.used
    reasons = zip(out.tolist(), outlines.reason, strict=True)
    reason = tuple(
        Rejection(Reason.DISAGREES, "5.0 px") if is_out else why for is_out, why in reasons
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)


def test_images_most_of_whose_outlines_disagree_are_named(tmp_path: Path) -> None:
    o = calibrate(simulated(tmp_path / "set", "hexapod", poses=6).folder).solution.outlines
    (notes,) = outlier_images(_with_rejected(o, o.row == 1)).items()
    assert notes[0] == 1
    assert re.match(r"\d+ of its \d+ outlines disagree with the fit and were left", str(notes[1]))
    assert "check its readings" in str(notes[1])
    (in_hand,) = outlier_images(_with_rejected(o, o.row == 1), [1]).values()
    assert "no board places its camera" in str(in_hand)
    for legs, edges in (((0,), ()), ((0, 1), ()), ((0,), (1,))):
        wrong = (o.row == 1) & (np.isin(o.leg, legs) | np.isin(o.edge, edges))
        assert outlier_images(_with_rejected(o, wrong)) == {}


def test_readings_of_another_image_are_named_where_there_are_readings() -> None:
    copied = np.array([[0.1, np.nan], [0.2, np.nan], [0.1, np.nan], [0.1, np.nan]])
    views, of_view = (View("c1", PINHOLE), View("c2", PINHOLE)), np.array([0, 0, 0, 1])
    m = Measurements(views, ("a", "b", "c", "d"), of_view, np.arange(4), copied, np.full(2, 1e-6))
    nothing, usual, counts = ImageExplanation(0.0), dict.fromkeys((0, 1), 1.0), OutlineCount(1, 12)

    def said(readings: Array, row: int) -> str:
        of = replace(m, q=readings)
        return str(image_verdict(of, row, nothing, usual, {row: counts})[1])

    assert "its readings are those of image a; correct its row" in said(copied, 2)
    for readings, row in ((copied, 1), (copied, 3), (np.full((4, 2), np.nan), 2)):
        assert "no other explanation" in said(readings, row)
