"""The paper's counts, as printed."""

import numpy as np
import pytest
from staged_hexapods import exact_session

from legcal.identify.conditions import count_conditions, two_directions
from legcal.simulation.cameras import PAPER_VIEWS

EVERY = ((0, 1, 2),)


@pytest.mark.parametrize(
    ("views", "n_legs", "spatial", "revolute", "expected"),
    [
        (PAPER_VIEWS, 6, True, (), [(18, 12), (18, 6), (18, 12)]),  # 6-SPU, 1234/3456/1256
        (EVERY, 3, False, (0, 1, 2), [(12, 4), (3, 3), (3, 3)]),  # 3-RPR
        (EVERY, 3, True, (), [(3, 3), (3, 3), (3, 3)]),  # 3-UPU
        (EVERY, 3, True, (0, 1, 2), [(12, 9), (3, 3), (3, 3)]),  # 3-RPS
    ],
)
def test_eq12_eq15_eq17_count_as_printed(
    views: tuple[tuple[int, ...], ...],
    n_legs: int,
    spatial: bool,
    revolute: tuple[int, ...],
    expected: list[tuple[int, int]],
) -> None:
    conditions = count_conditions(views, n_legs, spatial=spatial, revolute=revolute)
    assert [c.name for c in conditions] == ["eq12", "eq15", "eq17", "every_leg_seen"]
    assert [(c.equations, c.unknowns) for c in conditions[:3]] == expected
    assert all(c.ok for c in conditions)


def test_the_paper_needs_four_legs_at_once_from_three_camera_positions() -> None:
    three = ((0, 1, 2), (2, 3, 4), (0, 4, 5))
    eq12, _, _, seen = count_conditions(three, 6)
    assert (eq12.equations, eq12.unknowns, eq12.ok) == (9, 12, False)
    assert seen.ok


def test_a_leg_that_is_never_seen_and_passive_legs_are_counted() -> None:
    eq12, eq15, _, seen = count_conditions(((0, 1, 2, 3), (0, 1, 2, 4)), 6, passive=(0,))
    assert not seen.ok
    assert (eq12.equations, eq15.equations, eq15.unknowns) == (12, 6, 5)


def test_two_directions_fail_for_a_leg_that_never_turns() -> None:
    session = exact_session(n_poses=3)
    axes, m = session.axes, session.measurements
    view = m.view[axes.row]
    assert two_directions(view, axes.leg, axes.u, 6).ok
    u = np.where((axes.leg == 3)[:, None], axes.u[axes.leg == 3][0], axes.u)
    condition = two_directions(view, axes.leg, u, 6)
    assert (condition.ok, condition.legs) == (False, (3,))
