"""Pixels beside outlines: where they are read, and how far they are from the outlines."""

import numpy as np
import pytest

from legcal.perception.light import Samples
from legcal.perception.profiles import Edge, Profiles, read_profiles
from legcal.vision.camera import Camera
from legcal.vision.visibility import Band

CAMERA = Camera(
    np.array([[500.0, 0.0, 200.0], [0.0, 500.0, 150.0], [0.0, 0.0, 1.0]]),
    400,
    300,
    np.array([-0.2, 0.05, 0.001, -0.001, 0.0]),
)
V = np.array([1.5, -2.0])
DEEP = 3.5


def edge(angle: float, epsilon: float = 1.0, length: float = 200.0) -> Edge:
    """Return an outline through the middle of the image, at an angle to its rows."""
    along = np.array([np.cos(angle), np.sin(angle)])
    normal = np.array([-along[1], along[0]])
    band = Band(-0.5 * length / 500.0 * along, along, normal, 500.0, length)
    return Edge(band, V, epsilon, 20.0, np.zeros(10, dtype=np.bool_))


def numbered(axis: int) -> Samples:
    """Return an image that holds the column (0) or the row (1) of every pixel."""
    return np.asarray(np.indices((300, 400))[1 - axis], dtype=np.float32)


def read(
    edges: list[Edge], axis: int = 0, inner: float = DEEP, most: int | None = None
) -> Profiles:
    depths = DEEP, np.full(len(edges), inner)
    return read_profiles(numbered(axis), CAMERA, edges, [e.v for e in edges], depths, 8, most)


@pytest.mark.parametrize("angle", [0.1, 0.7, 1.5, 2.4, 3.5, 5.0])
@pytest.mark.parametrize("epsilon", [1.0, -1.0])
def test_distances_are_those_of_the_pixels_that_are_read(angle: float, epsilon: float) -> None:
    one = edge(angle, epsilon)
    columns, rows = read([one], 0), read([one], 1)
    xy = CAMERA.undistort(np.stack([columns.grey, rows.grey], axis=-1).astype(np.float64))
    h = one.band.line(*V)
    distance = epsilon * CAMERA.line_offset(np.broadcast_to(h, (*xy.shape[:-1], 3)), xy)
    seen = columns.inside
    assert np.count_nonzero(seen) > 500
    np.testing.assert_allclose(columns.d[seen], distance[seen], atol=0.02)
    assert distance[seen].min() < -DEEP + 0.3
    assert distance[seen].max() > DEEP - 0.3
    t, _ = one.band.coordinates(xy)
    np.testing.assert_allclose(columns.position, t.mean(axis=1) / one.band.length, atol=0.02)


def test_gain_is_how_far_an_outline_moves_in_the_image() -> None:
    one = edge(0.8)
    h = np.stack([one.band.line(*(V + move)) for move in (0.0, 1.0)])
    found = read([one])
    on_line = one.band.points(found.position * one.band.length, V[0] + np.diff(V) * found.position)
    moved = [CAMERA.line_offset(np.broadcast_to(line, (len(on_line), 3)), on_line) for line in h]
    np.testing.assert_allclose(found.gain, moved[0] - moved[1], atol=5e-3)


def test_outlines_are_read_together_as_they_are_alone() -> None:
    edges = [edge(0.3), edge(1.2, -1.0, 120.0), edge(2.0)]
    together = read(edges)
    for k, one in enumerate(edges):
        alone, own = read([one]), slice(together.bounds[k], together.bounds[k + 1])
        seen, of_one = together.inside[own], alone.inside
        np.testing.assert_allclose(together.position[own], alone.position, atol=1e-3)
        np.testing.assert_array_equal(seen.sum(axis=1), of_one.sum(axis=1))
        np.testing.assert_allclose(together.d[own][seen], alone.d[of_one], atol=5e-3)
        np.testing.assert_array_equal(together.grey[own][seen], alone.grey[of_one])


def test_hidden_stretches_and_other_blocks_are_left_out() -> None:
    one = edge(1.3)
    one.hidden[2:5] = True
    every, found = read([edge(1.3)]), read([one])
    assert not np.any((found.position > 0.2) & (found.position < 0.5))
    assert len(found.position) == np.count_nonzero(
        (every.position <= 0.2) | (every.position >= 0.5)
    )
    n = len(every.position) // 2
    np.testing.assert_array_equal(read([edge(1.3)], most=n).position, every.position[::2])


def test_no_pixels_are_read_deeper_inside_than_asked() -> None:
    found = read([edge(0.4)], inner=1.0)
    assert found.d[found.inside].max() <= 1.0
    assert found.d[found.inside].min() < -3.0
