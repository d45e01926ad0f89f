"""Outlines of cylinders by two routes that know nothing of each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legcal.errors import NotVisible
from legcal.simulation.visibility import contact_offsets, silhouette
from legcal.vision.cylinder import outlines_of_axis

PLACES = st.tuples(*[st.floats(-1.0, 1.0)] * 5, st.floats(0.3, 3.0), st.floats(0.001, 0.2))


def _cylinder(numbers: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    u = np.array(numbers[:3]) + np.array([0.0, 1.5, 0.0])
    A = np.array([numbers[3], numbers[4], numbers[5]])
    return u / np.linalg.norm(u), A, np.array(numbers[6])


@given(PLACES)
@settings(max_examples=200, deadline=None)
def test_tangents_to_the_circle_are_the_tangent_planes_of_eq_3(numbers: tuple[float, ...]) -> None:
    u, A, R = _cylinder(numbers)
    if np.linalg.norm(np.cross(u, A)) < 1.01 * R:
        return
    h, _ = silhouette(u, A, R)
    assert np.allclose(h, outlines_of_axis(u, A, R), rtol=0.0, atol=1e-12)


@given(PLACES)
@settings(max_examples=100, deadline=None)
def test_generating_lines_lie_on_the_cylinder_and_in_their_plane(
    numbers: tuple[float, ...],
) -> None:
    u, A, R = _cylinder(numbers)
    if np.linalg.norm(np.cross(u, A)) < 1.01 * R:
        return
    h, offsets = silhouette(u, A, R)
    assert np.allclose(np.linalg.norm(offsets, axis=-1), R, rtol=1e-12)
    assert np.allclose(offsets @ u, 0.0, atol=1e-14)
    points = A + 0.3 * u + offsets
    assert np.allclose(np.sum(h * points, axis=-1), 0.0, atol=1e-12)
    assert np.allclose(np.sum(h * offsets, axis=-1), [-R, R], atol=1e-12)  # epsilon +1, -1


def test_a_camera_inside_a_leg_sees_no_silhouette() -> None:
    with pytest.raises(NotVisible, match=r"5\.0 mm from its axis"):
        contact_offsets(np.array([0.0, 1.0, 0.0]), np.array([0.005, 0.0, 0.0]), np.array(0.01))
