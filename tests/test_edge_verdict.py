"""Which of two measured edges of a leg are its outlines."""

from dataclasses import replace

import numpy as np
import pytest

from legcal.geometry.types import Array
from legcal.perception.blocks import Line
from legcal.perception.outline import NARROW_BIAS, WRONG_WIDTH, PartVerdict, verdict
from legcal.perception.part_edges import EdgePair
from legcal.perception.subpixel_edges import MeasuredEdge

WIDTH = np.array([20.0, 18.0])  # by the radius [px]
LENGTH = 200.0
N = 20


def _edge(v: Array, *, sigma: float = 0.1, kept: float = 1.0, is_step: bool = True) -> MeasuredEdge:
    on_line = np.arange(N) < kept * N
    position = (np.flatnonzero(on_line) + 0.5) / N
    n = len(position)
    line = Line(np.zeros(2), on_line, 1.0, position, np.zeros(n), np.full(n, 0.01))
    return MeasuredEdge(v, line, 50.0, is_step, 1.0, sigma**2 * np.eye(2))


def _judged(
    off: float,
    one: MeasuredEdge | None,
    two: MeasuredEdge | None,
    *,
    alone: bool = False,
    window: float | None = None,
) -> PartVerdict:
    """Judge edges whose pair was found at a distance that is off [px]."""
    v = np.stack([np.zeros(2), WIDTH + off])
    pair = EdgePair(v, np.ones(2, dtype=np.bool_), np.full(2, alone))
    return verdict(pair, np.stack([np.zeros(2), WIDTH]), LENGTH, (one, two), window)


def test_an_outline_before_a_saturated_background_needs_some_of_its_step() -> None:
    whole, most = _edge(np.zeros(2)), replace(_edge(WIDTH), clipped=0.2)
    assert _judged(0.0, whole, most).reasons == ("", "")
    found = _judged(0.0, whole, replace(most, clipped=0.5))
    assert found.reasons[1] == "the background is overexposed, 1.0 px of the step are left"


def test_two_edges_at_the_distance_of_the_radius_are_used() -> None:
    found = _judged(0.0, _edge(np.zeros(2)), _edge(WIDTH + 0.5))
    assert found.reasons == ("", "")
    assert found.bias == 0.0


@pytest.mark.parametrize(
    ("off", "used"),
    [((1.0, 0.0), (False, True)), ((0.0, -1.0), (True, False)), ((0.6, -0.6), (False, False))],
)
def test_after_a_fit_an_edge_away_from_its_prediction_is_not_the_outline(
    off: tuple[float, float], used: tuple[bool, bool]
) -> None:
    """A pixel of width passes while the radius is hardly known, and not near a fit."""
    predicted = np.stack([np.zeros(2), WIDTH])
    edges = _edge(predicted[0] + off[0]), _edge(predicted[1] + off[1])
    pair = EdgePair(predicted, np.ones(2, dtype=np.bool_), np.zeros(2, dtype=np.bool_))
    assert verdict(pair, predicted, LENGTH, edges).reasons == ("", "")
    found = verdict(pair, predicted, LENGTH, edges, near_fit=True)
    for reason, is_used in zip(found.reasons, used, strict=True):
        assert reason == "" if is_used else reason.startswith(WRONG_WIDTH)


@pytest.mark.parametrize("surer", [0, 1])
def test_of_two_edges_too_near_to_each_other_the_surer_is_the_outline(surer: int) -> None:
    sigma = [0.3, 0.3]
    sigma[surer] = 0.1
    one, two = _edge(np.zeros(2), sigma=sigma[0]), _edge(WIDTH - 3.0, sigma=sigma[1])
    found = _judged(-3.0, one, two)
    assert found.reasons[surer] == ""
    assert found.reasons[1 - surer].startswith(WRONG_WIDTH)
    assert found.bias == pytest.approx(3.0 * NARROW_BIAS)


@pytest.mark.parametrize(
    ("off", "sigma", "is_step"),
    [(3.0, 0.1, True), (-3.0, 0.28, True), (-3.0, 0.1, False)],
    ids=["too far from each other", "about as sure", "no step"],
)
def test_otherwise_edges_at_another_distance_are_not_used(
    off: float, sigma: float, is_step: bool
) -> None:
    one = _edge(np.zeros(2), sigma=sigma, is_step=is_step)
    found = _judged(off, one, _edge(WIDTH + off, sigma=0.3))
    assert all(reason.startswith(WRONG_WIDTH) for reason in found.reasons)


@pytest.mark.parametrize(
    ("off", "alone", "kept", "used"),
    [(0.5, False, 1.0, True), (4.0, False, 1.0, False), (4.0, True, 1.0, True),
     (0.5, False, 0.4, False)],
    ids=["found at its distance", "found elsewhere", "convincing alone", "half of it seen"],
)  # fmt: skip
def test_an_edge_whose_partner_was_found_but_not_measured(
    off: float, alone: bool, kept: float, used: bool
) -> None:
    found = _judged(off, _edge(np.zeros(2), kept=kept), None, alone=alone)
    expected = "" if used else "its other outline: edge hardly visible"
    assert found.reasons == (expected, "edge hardly visible")


@pytest.mark.parametrize(("beside", "used"), [(0.5, True), (3.0, False)])
def test_an_edge_where_other_legs_foretell_it_needs_no_partner(beside: float, used: bool) -> None:
    found = _judged(6.0, _edge(np.full(2, beside)), _edge(WIDTH + 6.0), window=5.0)
    assert (found.reasons[0] == "") is used
    assert found.reasons[1].startswith(WRONG_WIDTH)
    lone = _judged(6.0, _edge(np.full(2, beside)), None, alone=True, window=5.0)
    assert (lone.reasons[0] == "") is used
