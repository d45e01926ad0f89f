"""What is drawn over images: exact under distortion, legible at every size, texts apart."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.machine import Cylinder
from legcal.perception.overlays import (
    COLOURS,
    LabelPlaces,
    Mark,
    PartMarks,
    draw,
    marks_of_image,
    short_reason,
)
from legcal.perception.overview import HIDDEN_LEG, reason_class
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.visibility import PredictedLeg, predict_legs

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
        reason=("", ""),
        source=("detected",) * 2,
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
    normal = np.cross(u, A)
    assert np.abs(cam.line_offset(normal, cam.undistort(drawn["axis"]))).max() < 1e-6
    chord = (
        drawn["axis"][0] + np.linspace(0.0, 1.0, 40)[:, None] * np.diff(drawn["axis"][[0, -1]].T).T
    )
    assert np.abs(chord - drawn["axis"]).max() > 1.0  # the lens bends it


def test_ends_beside_their_line_are_drawn_on_the_line() -> None:
    cam = camera("plumb_bob")
    found = outlines(cam)
    moved = replace(found, ends=found.ends + np.array([0.0, 3.0]))
    drawn = curves(marked(cam, moved))
    offset = cam.line_offset(found.h[0], cam.undistort(drawn["edge 1"]))
    assert np.abs(offset).max() < 1e-6


def test_what_is_not_used_is_drawn_with_its_reason_and_what_is_missing_where_it_should_be() -> None:
    cam = camera("plumb_bob")
    found = outlines(cam)
    one = replace(found, used=np.array([True, False]), reason=("", "low contrast, 2.1 grey levels"))
    part = marked(cam, one)
    assert list(curves(part)) == ["edge 1", "rejected"]
    assert (part.name, part.reason) == ("leg1", "edge 2: low contrast")
    lost = replace(
        found,
        h=np.full((2, 3), np.nan),
        ends=np.full((2, 2, 2), np.nan),
        used=np.zeros(2, dtype=np.bool_),
        reason=("no convincing pair of edges",) * 2,
    )
    part = marked(cam, lost)
    assert [mark.kind for mark in part.marks] == ["predicted", "predicted"]
    assert part.reason == "no convincing pair of edges"
    h = predicted(cam)[0].outlines[0]
    for mark, line in zip(part.marks, h, strict=True):
        assert np.abs(cam.line_offset(line, cam.undistort(mark.points))).max() < 1e-6
    gone = replace(lost, reason=("outside the image",) * 2)
    assert marks_of_image(cam, gone, predicted(cam), NAMES) == []


def test_an_edited_outline_and_a_leg_without_rows_are_named() -> None:
    cam = camera("plumb_bob")
    part = marked(cam, replace(outlines(cam), source=("detected", "edited")))
    assert part.name == "leg1 (edited)"
    found = outlines(cam)
    empty = replace(found, leg=found.leg + 1)
    names = [part.name for part in marks_of_image(cam, empty, predicted(cam), ("leg1", "leg2"))]
    assert names == ["leg2", "leg1"]


@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0])
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


def test_reasons_are_counted_without_their_figures() -> None:
    assert short_reason("width inconsistent with the radius, 12 px for 14 px") == (
        "width inconsistent with the radius"
    )
    assert short_reason("its other outline: edge hardly visible") == "other outline fails"
    assert reason_class("hidden by leg3") == HIDDEN_LEG
    assert reason_class("") == "no reason given"
