"""The paper's counts, as printed, against the equations written out one by one."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import closed_leg
from staged_hexapods import exact_session

from legcal.machine import Leg, LegKind
from legcal.paper.conditions import count_conditions, three_legs_at_once, two_directions
from legcal.simulation.hexapod import PAPER_VIEWS

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


def enumerated_products(legs: set[int], revolute: set[int]) -> set[frozenset[object]]:
    """Return the scalar products that (9) counts for one view, each written out.

    Distances between joints stand for the products of vectors between joints; axes are
    multiplied with each other and with the n - 1 vectors from the first joint.
    """
    distances = {frozenset({("A", j), ("A", g)}) for j, g in combinations(sorted(legs), 2)}
    axes = sorted(legs & revolute)
    crossed = {frozenset({("v", j), ("v", g)}) for j, g in combinations(axes, 2)}
    star = sorted(legs)[1:]
    mixed = {frozenset({("v", j), ("vector to", g)}) for j in axes for g in star}
    return distances | crossed | mixed


def enumerated_unknowns(n: int, revolute: set[int], *, spatial: bool) -> int:
    """Return the number of coordinates that the choice of R_b leaves, written out."""
    if not spatial:  # two coordinates a joint, less those of a frame; (10) adds the normal's angle
        free = {(j, c) for j in range(n) for c in "xy"} - {(0, "x"), (0, "y"), (1, "y")}
        return len(free) + 1
    zero = {(0, "x"), (0, "y"), (0, "z"), (1, "y"), (1, "z"), (2, "z")}
    free = {(j, c) for j in range(n) for c in "xyz"} - zero
    return len(free) + len([(j, angle) for j in revolute for angle in (1, 2)])


@settings(deadline=None, max_examples=200)
@given(data=st.data(), spatial=st.booleans())
def test_counts_equal_the_equations_written_out(data: st.DataObject, spatial: bool) -> None:
    n = data.draw(st.integers(3 if spatial else 2, 8))
    some = st.sets(st.integers(0, n - 1))
    revolute, passive = data.draw(some), data.draw(some)
    views = data.draw(st.lists(st.sets(st.integers(0, n - 1), min_size=1), max_size=5))
    eq12, eq15, eq17, seen = count_conditions(
        views, n, spatial=spatial, revolute=revolute, passive=passive
    )
    assert eq12.equations == sum(len(enumerated_products(view, revolute)) for view in views)
    assert eq12.unknowns == enumerated_unknowns(n, revolute, spatial=spatial)
    distances = sum(len(list(combinations(view - passive, 2))) for view in views)
    assert eq15.equations == eq17.equations == distances
    assert eq15.unknowns == len(set(range(n)) - passive)
    gauge = 0 if spatial else 1  # without the normal's angle
    assert eq17.unknowns == enumerated_unknowns(n, set(), spatial=spatial) - gauge
    assert seen.ok == all(any(j in view for view in views) for j in range(n))
    for c in (eq12, eq15, eq17):
        assert c.equations is not None
        assert c.unknowns is not None
        assert c.ok == (c.equations >= c.unknowns)


def legs_of(types: str, passive: tuple[int, ...] = ()) -> list[Leg]:
    """Return legs of types such as ``SS UU RS U``, some of them passive."""
    rng = np.random.default_rng(1)
    kinds = [LegKind.PASSIVE if j in passive else LegKind.ACTUATED for j in range(9)]
    R, t = np.eye(3), np.array([0.0, 0.0, 2.0])
    return [
        closed_leg(joints, R, t, rng, kind)
        for joints, kind in zip(types.split(), kinds, strict=False)
    ]


@pytest.mark.parametrize(
    ("types", "passive", "views", "failing"),
    [
        ("SS SS SS SS", (), [{0}, {1}, {2}, {3}], ()),  # nothing needs it
        ("SR SR SR", (), [{0, 1}, {1, 2}], (0, 1, 2)),  # (18)
        ("SR SS SS SS", (), [{0, 1}, {1, 2, 3}], (0,)),
        ("SR SS SS SS", (), [{0, 1}, {0, 2, 3}], ()),
        ("UU UU UU", (), [{0, 1, 2}], ()),
        ("UU UU UU", (), [{0, 1}, {1, 2}, {0, 2}], (0, 1, 2)),
        ("US US US", (), [{0, 1}, {1, 2}], ()),  # a U in a leg with an S has no axis to find
        ("RS RS RS", (), [{0, 1}, {1, 2}], ()),  # the axes of (7) need no pose of the platform
        ("SS SS SS U", (3,), [{0, 1, 2}, {0, 1, 3}], (3,)),  # (19)
        ("SS SS SS U", (3,), [{0, 1, 2, 3}], ()),
        ("SS SS SS SS SS", (3, 4), [{0, 1, 3, 4}, {0, 1, 2, 4}], (3,)),
    ],
)
def test_three_legs_at_once_where_18_and_19_need_them(
    types: str, passive: tuple[int, ...], views: list[set[int]], failing: tuple[int, ...]
) -> None:
    condition = three_legs_at_once(views, legs_of(types, passive))
    assert (condition.ok, condition.legs) == (not failing, failing)


def test_revolute_axes_of_a_planar_mechanism_need_no_three_legs() -> None:
    assert three_legs_at_once([{0, 1}, {1, 2}], legs_of("RR RR RR"), spatial=False).ok
