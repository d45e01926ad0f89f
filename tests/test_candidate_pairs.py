"""Straight edges of pictures, and the pairs of them that may be the outlines of a leg."""

import numpy as np
import pytest
from rendering import Bar, Light, render

from legcal.geometry.types import Array
from legcal.perception.candidate_pairs import (
    EdgeSegments,
    segments_of_reduced,
    still_picture,
)
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis
from legcal.vision.image_file import Grey

F = 500.0


def _camera(distortion: Array | None = None) -> Camera:
    K = np.array([[F, 0.0, 160.2], [0.0, F, 119.1], [0.0, 0.0, 1.0]])
    return Camera(K, 320, 240, np.zeros(0) if distortion is None else distortion)


BARS = [
    Bar(np.array([-0.12, 0.14, 0.8]), np.array([-0.05, -0.14, 0.85]), 0.013, 170.0),
    Bar(np.array([0.06, -0.15, 0.8]), np.array([0.1, 0.13, 0.9]), 0.016, 150.0),
]
SHADELESS = Light(ambient=1.0, diffuse=0.0)


def _picture(camera: Camera, bars: list[Bar]) -> Grey:
    image = render(camera, bars, 40.0, SHADELESS, blur=0.6, noise=1.5, supersample=3)
    return np.clip(np.rint(image), 0, 255).astype(np.float32)


def _lines(bar: Bar) -> Array:
    u = (bar.B - bar.A) / np.linalg.norm(bar.B - bar.A)
    return outlines_of_axis(u, bar.A, bar.radius)


def _nearest(found: EdgeSegments, line: Array) -> int:
    """Return the edge whose ends are nearest to a line of the sensor plane."""
    offset = found.ends @ line[:2] + line[2]
    return int(np.argmin(np.abs(offset).max(axis=1)))


@pytest.mark.parametrize("lens", [None, np.array([-0.3, 0.1, 0.001, -0.002, 0.0])])
def test_outlines_are_found_on_the_sensor_plane_with_the_brighter_side(lens: Array | None) -> None:
    camera = _camera(lens)
    found = segments_of_reduced(_picture(camera, BARS), camera, 1)
    assert found.pixel == pytest.approx(1.0 / F)
    for bar in BARS:
        axis = (bar.A + bar.B) / (bar.A + bar.B)[2]
        for line in _lines(bar):
            i = _nearest(found, line)
            start, end = found.ends[i]
            offset = (found.ends[i] @ line[:2] + line[2]) / np.linalg.norm(line[:2])
            assert np.abs(offset).max() < 1.2 * found.pixel
            seen = abs(bar.B[1] / bar.B[2] - bar.A[1] / bar.A[2])
            assert np.linalg.norm(end - start) > 0.7 * min(seen, 0.47)
            left = np.array([end[1] - start[1], start[0] - end[0]])
            assert left @ (axis[:2] - start) > 0.0  # the bar is brighter


def test_what_stands_still_in_the_pictures_of_a_view_is_no_edge_of_a_leg() -> None:
    camera, still = _camera(), BARS[0]

    def moving(x: float) -> list[Bar]:
        ends = np.array([[0.0, -0.15, 0.8], [0.01, 0.13, 0.82]])
        aside = [np.array([x + k, 0.0, 0.0]) for k in (0.0, 0.055, 0.11, 0.165)]
        return [Bar(ends[0] + step, ends[1] + step, 0.008, 150.0) for step in aside]

    moved = [moving(x) for x in (-0.02, -0.008, 0.005, 0.017, 0.03)]
    pictures = [_picture(camera, [still, *bars]) for bars in moved]
    background = still_picture(pictures, 1)
    assert background is not None

    def offsets(found: EdgeSegments, bar: Bar) -> list[float]:
        lines = [line / np.linalg.norm(line[:2]) for line in _lines(bar)]
        nearest = [found.ends[_nearest(found, line)] @ line[:2] + line[2] for line in lines]
        return [float(np.abs(offset).max() * F) for offset in nearest]

    for picture, bars in zip(pictures, moved, strict=True):
        every, found = (segments_of_reduced(picture, camera, 1, b) for b in (None, background))
        assert max(offsets(every, still)) < 1.5
        for bar in bars:
            assert max(*offsets(every, bar), *offsets(found, bar)) < 1.5
        assert min(offsets(found, still)) > 10.0
    assert still_picture(pictures[:3], 1) is None  # of which legs stand still in most
