"""Pairs of edges that may be a cylinder, from edges that are known."""

import leg_pictures as lp
import numpy as np
import pytest

from legcal.geometry.types import Array
from legcal.perception.lines import LEAST_OVERLAP, NARROWEST, WIDEST, find_edge_pairs


def _edges(width: float, length: float, *, turn: float = 0.0, same_way: bool = False) -> Array:
    """Return two parallel edges about the origin, in pixels."""
    x, y = 0.5 * length, 0.5 * width
    lines = np.array([[[x, y], [-x, y]], [[-x, -y], [x, -y]]])
    if same_way:
        lines[1] = lines[1, ::-1]
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(lp.PIXEL * lines @ np.array([[c, s], [-s, c]]))


@pytest.mark.parametrize("seed", range(5))
def test_the_outlines_of_legs_are_bars_with_their_axes_and_widths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    made, T = lp.machine(6, rng), lp.camera(rng)
    targets = lp.pieces(made.A, made.posed(lp.platform(rng)))
    for k in range(len(targets)):
        lines = lp.edges(targets, T)[k]
        bars = find_edge_pairs(lp.segments(lines))
        assert len(bars) == 1
        X = T.inv().apply(targets.ends[k])
        ends = X[:, :2] / X[:, 2:]
        aside = (ends - bars.middle[0]) @ bars.normal[0]
        assert np.abs(aside).max() < 0.2 * lp.PIXEL  # the axis is not quite in the middle
        middle = X.mean(axis=0)
        normal = np.cross(X[0], X[1])
        flat = np.linalg.norm(normal[:2]) / np.linalg.norm(normal)
        width = 2.0 * targets.radius[k] / (middle[2] * flat)
        assert bars.width[0].mean() == pytest.approx(width, rel=0.02)
        assert 2.0 * bars.half_length[0] == pytest.approx(
            np.linalg.norm(ends[1] - ends[0]), rel=0.05
        )


@pytest.mark.parametrize("turn", [0.3, 1.6, 3.0, 5.5])
def test_bars_turn_with_the_picture(turn: float) -> None:
    upright, turned = (
        find_edge_pairs(lp.segments(_edges(12.0, 80.0, turn=t))) for t in (0.0, turn)
    )
    assert abs(float(turned.along[0] @ [np.cos(turn), np.sin(turn)])) == pytest.approx(1.0)
    np.testing.assert_allclose(turned.width, upright.width)
    np.testing.assert_allclose(turned.merit, upright.merit)


def test_edges_that_are_too_near_or_too_far_apart_or_too_short_are_no_bars() -> None:
    for width, length, n in (
        (NARROWEST - 0.5, 60.0, 0),
        (NARROWEST + 0.5, 60.0, 1),
        (WIDEST + 5.0, 400.0, 0),
        (WIDEST - 5.0, 400.0, 1),
        (40.0, 50.0, 0),  # more a square than a bar
    ):
        assert len(find_edge_pairs(lp.segments(_edges(width, length)))) == n


def test_edges_beside_each_other_must_overlap_and_be_nearly_parallel() -> None:
    lines = _edges(12.0, 80.0)
    for part, n in ((0.9 * (1.0 - LEAST_OVERLAP), 1), (1.1 * (1.0 - LEAST_OVERLAP), 0)):
        moved = lines.copy()
        moved[1, :, 0] += part * 80.0 * lp.PIXEL
        assert len(find_edge_pairs(lp.segments(moved))) == n
    skew = lines.copy()
    skew[1, 1, 1] -= 20.0 * lp.PIXEL
    assert len(find_edge_pairs(lp.segments(skew))) == 0


def test_a_pair_at_which_light_changes_the_same_way_twice_counts_less() -> None:
    opposite, same = (
        find_edge_pairs(lp.segments(_edges(12.0, 80.0, same_way=way))) for way in (False, True)
    )
    assert 0.0 < same.merit[0] < opposite.merit[0]


def test_the_best_bars_come_first_and_copies_of_a_bar_are_left_out() -> None:
    short, long = _edges(12.0, 40.0) + 60.0 * lp.PIXEL, _edges(10.0, 90.0, turn=1.2)
    copy = long + 0.5 * lp.PIXEL
    bars = find_edge_pairs(lp.segments(np.concatenate([short, long, copy])))
    assert np.all(np.diff(bars.merit) <= 0.0)
    assert len(bars) == 2
    assert len(bars.take(np.array([1]))) == 1


def test_no_edges_are_no_bars() -> None:
    assert len(find_edge_pairs(lp.segments(np.zeros((0, 2, 2))))) == 0
    assert len(find_edge_pairs(lp.segments(_edges(12.0, 80.0)[:1]))) == 0
