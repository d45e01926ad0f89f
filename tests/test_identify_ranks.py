"""Counts, ranks and information: equations written out, and what counts get wrong."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import with_round_arms
from random_legs import closed_leg
from staged_sessions import exact_session
from uncertainty import compared

import legcal
from legcal import identifiability
from legcal.calibration.identify.identifiability import Analysis, is_scale_open
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.identify.session import planned_session
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.descriptions.new_model import create_model
from legcal.geometry.motions import motion_of
from legcal.machine.leg import Leg, LegKind
from legcal.machine.model import Machine
from legcal.paper.conditions import count_conditions, three_legs_at_once, two_directions

WEAK_JOINT = ((0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (4, 5))
HALVES = ((0, 1), (2, 3, 4, 5))
VIEWS = [
    ((0, 1, 2, 3), (2, 3, 4, 5), (0, 1, 4, 5)),
    WEAK_JOINT,
    ((0, 1, 2), (3, 4, 5), (0, 1, 2)),
    ((0, 1), (2, 3), (4, 5)),
    ((0, 1, 2, 3), (3, 4, 5)),
    ((0, 1, 2, 3, 4, 5),),
]


@cache
def model(name: str) -> Machine:
    return legcal.load_mechanism(name)


@cache
def report(name: str, views: Sequence[Sequence[int]], images: int = 15) -> Identifiability:
    legs = model(name).leg_names
    return identifiability(model(name), [[legs[j] for j in view] for view in views], images)


# Counts


def products_written_out(legs: set[int], revolute: set[int]) -> set[frozenset[object]]:
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


def unknowns_written_out(n: int, revolute: set[int], *, spatial: bool) -> int:
    """Return the number of coordinates that the choice of R_b leaves, written out."""
    if not spatial:  # two coordinates a joint, less those of a frame; (10) adds the normal's angle
        free = {(j, c) for j in range(n) for c in "xy"} - {(0, "x"), (0, "y"), (1, "y")}
        return len(free) + 1
    zero = {(0, "x"), (0, "y"), (0, "z"), (1, "y"), (1, "z"), (2, "z")}
    free = {(j, c) for j in range(n) for c in "xyz"} - zero
    return len(free) + len([(j, angle) for j in revolute for angle in (1, 2)])


@settings(deadline=None, max_examples=100)
@given(data=st.data(), spatial=st.booleans())
def test_counts_equal_the_equations_written_out(data: st.DataObject, spatial: bool) -> None:
    n = data.draw(st.integers(3 if spatial else 2, 8))
    some = st.sets(st.integers(0, n - 1))
    revolute, passive = data.draw(some), data.draw(some)
    views = data.draw(st.lists(st.sets(st.integers(0, n - 1), min_size=1), max_size=5))
    eq12, eq15, eq17, seen = count_conditions(
        views, n, spatial=spatial, revolute=revolute, passive=passive
    )
    assert [c.name for c in (eq12, eq15, eq17, seen)] == ["eq12", "eq15", "eq17", "every_leg_seen"]
    assert eq12.equations == sum(len(products_written_out(view, revolute)) for view in views)
    assert eq12.unknowns == unknowns_written_out(n, revolute, spatial=spatial)
    distances = sum(len(list(combinations(view - passive, 2))) for view in views)
    assert eq15.equations == eq17.equations == distances
    assert eq15.unknowns == len(set(range(n)) - passive)
    gauge = 0 if spatial else 1  # without the normal's angle
    assert eq17.unknowns == unknowns_written_out(n, set(), spatial=spatial) - gauge
    assert seen.ok == all(any(j in view for view in views) for j in range(n))
    for c in (eq12, eq15, eq17):
        assert c.equations is not None
        assert c.unknowns is not None
        assert c.ok == (c.equations >= c.unknowns)


def test_two_directions_fail_for_a_leg_that_never_turns() -> None:
    session = exact_session(n_poses=3)
    axes, m = session.axes, session.measurements
    view = m.view[axes.row]
    assert two_directions(view, axes.leg, axes.u, 6).ok
    u = np.where((axes.leg == 3)[:, None], axes.u[axes.leg == 3][0], axes.u)
    condition = two_directions(view, axes.leg, u, 6)
    assert (condition.ok, condition.legs) == (False, (3,))


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
        ("RR RR RR", (), [{0, 1}, {1, 2}], ()),  # planar
    ],
)
def test_three_legs_at_once_where_18_and_19_need_them(
    types: str, passive: tuple[int, ...], views: list[set[int]], failing: tuple[int, ...]
) -> None:
    planar = types.startswith("RR")
    condition = three_legs_at_once(views, legs_of(types, passive), spatial=not planar)
    assert (condition.ok, condition.legs) == (not failing, failing)


# What counts get wrong


@pytest.mark.parametrize(
    ("name", "views", "holds", "full"),
    [
        ("hexapod", VIEWS[0], True, 30),
        ("hexapod", VIEWS[2], False, 30),
        ("hexapod", VIEWS[3], False, 30),
        ("hexapod", ((0, 1, 2, 3), (1, 2, 3, 4), (0, 2, 3, 4)), False, 30),  # no leg 6
        ("3-upu-tilted", ((0, 1, 2),) * 3, True, 21),
    ],
)
def test_the_joint_fit_determines_all_where_counts_fail(
    name: str, views: Sequence[Sequence[int]], holds: bool, full: int
) -> None:
    found = report(name, views, 6)
    assert (found.paper.ok, found.full.rank) == (holds, full)
    assert found.identifiable
    assert not found.remedies
    sigma = found.platform_sigma
    assert sigma is not None
    assert 1e-5 < sigma.dX_m < 2e-2


@pytest.mark.usefixtures("without_remedies")
@pytest.mark.parametrize(
    ("name", "views", "weak", "kinds"),
    [
        ("3-upu", ((0, 1, 2),) * 3, 6, {"base_axis", "platform_axis"}),  # only differences
        ("hexapod-strut", ((0, 1, 2, 3, 4, 5),) * 2, 6, None),  # an unseen strut
    ],
)
def test_what_does_not_move_the_platform_is_harmless(
    name: str, views: Sequence[Sequence[int]], weak: int, kinds: set[str] | None
) -> None:
    found = report(name, views, 6)
    assert (len(found.full.weak), found.full.rank) == (weak, found.full.of - weak)
    assert all(d.harmless for d in found.full.weak)
    assert all(d.dX_m == pytest.approx(0.0, abs=1e-9) for d in found.full.weak if kinds is None)
    assert kinds in (None, {p.split(".")[1] for d in found.full.weak for p in d.parameters})
    assert found.identifiable
    one = report("hexapod", ((0, 1, 2, 3, 4, 5),), 1)  # one pose, and yet judged at many
    assert not one.identifiable
    assert not any(direction.harmless for direction in one.full.weak)


@pytest.mark.parametrize("name", ["hexapod", "3-upu"])
def test_every_shipped_model_is_identifiable_from_three_places(name: str) -> None:
    found = identifiability(model(name))
    assert found.views == (model(name).leg_names,) * 3
    assert found.paper.ok
    assert found.identifiable
    harmless = 6 if name == "3-upu" else 0
    assert found.full.rank == found.full.of - harmless
    assert found.platform_sigma is not None
    if name == "hexapod":
        boards = identifiability(model(name), platform_board=True)
        assert boards.platform_sigma is not None
        assert boards.platform_sigma.dX_m < 0.95 * found.platform_sigma.dX_m


def test_remedies_were_tried_and_are_true() -> None:
    found = report("hexapod", HALVES, 2)
    assert found.images == (2, 2)
    assert found.full.rank < 30
    text = [r.remedy for r in found.remedies]
    assert all(r.enough and r.full_rank == 30 for r in found.remedies)
    assert "take 15 images a view instead of 2" in text
    assert report("hexapod", HALVES).full.rank == 30
    assert "add a camera position (legs 2, 3 and 4)" in text
    assert report("hexapod", (*HALVES, (1, 2, 3)), 2).full.rank == 30


# Information


def test_arms_tell_of_motors_but_not_of_the_scale(tmp_path: Path) -> None:
    machine = create_model(with_round_arms("delta"), tmp_path).machine
    with_arms, without = (
        Analysis(planned_session(m, [range(6)] * 2, 15)) for m in (machine, model("delta"))
    )
    sigma, other = (a.motion.sigma(a.information) for a in (with_arms, without))
    assert sigma is not None
    assert other is not None
    assert 0.5 * other.dX_m < sigma.dX_m < 0.9 * other.dX_m
    assert is_scale_open(with_arms)
    radii = {f"leg{j}.radius.arm{a}_link": Prior(0.008, 1e-5) for j, a in ((1, 1), (3, 2), (5, 3))}
    assert not is_scale_open(replace(with_arms, choices=Choices(priors=radii)))


def larger(leg: Leg, size: float) -> Leg:
    cylinders = tuple(
        replace(c, radius=size * c.radius, start=size * c.start, end=size * c.end)
        for c in leg.cylinders
    )
    return replace(leg, A=size * leg.A, B=size * leg.B, q0=size * leg.q0, cylinders=cylinders)


def test_what_is_determined_does_not_depend_on_the_size_of_the_machine() -> None:
    """A thousand times as large and as far, before the same cameras: relative figures stay."""
    session, size = planned_session(model("3-rps"), [range(3)] * 3, 3), 1e3
    assert session.home is not None
    other = replace(
        session,
        legs=tuple(larger(leg, size) for leg in session.legs),
        home=motion_of(session.home.rotation.as_matrix(), size * session.home.translation),
        t=size * session.t,
        t_reached=size * session.t_reached,
        cameras=tuple(
            replace(view, T_base_camera=motion_of(T.rotation.as_matrix(), size * T.translation))
            for view, T in zip(session.cameras, session.places, strict=True)
        ),
        sigma_q=size * session.sigma_q,
    )
    found = [Analysis(each) for each in (session, other)]
    singular = [np.linalg.svd(each.information, compute_uv=False) for each in found]
    np.testing.assert_allclose(size * singular[1], singular[0], rtol=1e-3)


@pytest.mark.parametrize("name", ["planar", pytest.param("revolute", marks=pytest.mark.system)])
def test_identify_and_plan_predict_what_calibrate_states(name: str) -> None:
    """At the same poses, cameras and used outlines, with the noise of the result."""
    _, (stated, *predicted) = compared(Path(__file__).parent / "data/recorded" / name)
    np.testing.assert_allclose(predicted, stated, rtol=0.02)
