"""Oriented lines: their moments, feet and distances, eq (1)."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from legcal.geometry.lines import distance_to_line, moment, nearest_point_to_origin, normal_basis
from legcal.geometry.types import Array

FAST = settings(deadline=None, max_examples=50)


def vectors(low: float = -2.0, high: float = 2.0) -> st.SearchStrategy[Array]:
    return st.tuples(*[st.floats(low, high, width=32)] * 3).map(lambda v: np.array(v))


def directions() -> st.SearchStrategy[Array]:
    return (
        vectors(-1.0, 1.0)
        .filter(lambda v: bool(np.linalg.norm(v) > 0.1))
        .map(lambda v: np.asarray(v / np.linalg.norm(v)))
    )


@FAST
@given(directions(), vectors(), st.floats(-3.0, 3.0))
def test_eq01_moment_is_the_same_for_every_point_of_the_line(u: Array, M: Array, s: float) -> None:
    np.testing.assert_allclose(moment(u, M + s * u), moment(u, M), atol=1e-12)


@FAST
@given(directions(), vectors())
def test_eq01_moment_turns_with_the_direction(u: Array, M: Array) -> None:
    np.testing.assert_array_equal(moment(-u, M), -moment(u, M))


@FAST
@given(directions(), vectors())
def test_eq01_norm_of_the_moment_is_the_distance_to_the_origin(u: Array, M: Array) -> None:
    foot = nearest_point_to_origin(u, M)
    assert np.linalg.norm(moment(u, M)) == pytest.approx(np.linalg.norm(foot), abs=1e-12)
    assert foot @ u == pytest.approx(0.0, abs=1e-12)
    assert distance_to_line(foot, u, M) == pytest.approx(0.0, abs=1e-12)


@FAST
@given(vectors(), directions(), vectors(), st.floats(-3.0, 3.0))
def test_eq06_no_point_of_the_line_is_nearer_than_the_distance(
    P: Array, u: Array, M: Array, s: float
) -> None:
    assert np.linalg.norm(M + s * u - P) >= distance_to_line(P, u, M) - 1e-12


@FAST
@given(directions())
def test_normal_basis_is_right_handed_and_orthonormal(u: Array) -> None:
    e1, e2 = normal_basis(u)
    np.testing.assert_allclose(
        np.stack([e1, e2, u]) @ np.stack([e1, e2, u]).T, np.eye(3), atol=1e-12
    )
    np.testing.assert_allclose(np.cross(e1, e2), u, atol=1e-12)


def test_normal_basis_of_many_directions_is_that_of_each() -> None:
    rng: Any = np.random.default_rng(1)
    u = rng.normal(size=(4, 5, 3))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    assert normal_basis(u).shape == (4, 5, 2, 3)
    np.testing.assert_array_equal(normal_basis(u)[2, 3], normal_basis(u[2, 3]))
