"""``legcal identify``: counts and ranks against equations written out, information, reports."""

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_line import run
from fit_sessions import machine_session
from hexapod_example import HEXAPOD
from hypothesis import given, settings
from hypothesis import strategies as st
from machines import delta_with_round_arms
from random_legs import closed_leg
from rich.console import Console
from uncertainty import compared

import legcal
from legcal import Dataset, Machine, identifiability, load_dataset
from legcal.calibration.identify.identifiability import (
    Analysis,
    check_identifiable,
    identifiability_of_dataset,
    is_scale_open,
)
from legcal.calibration.identify.report import Identifiability
from legcal.calibration.identify.session import Session, planned_session, recorded_session
from legcal.calibration.joint_fit.determinacy import covariance_as_stated
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.predicted import WHITE
from legcal.data.corners import found_corners
from legcal.data.image_choice import dataset_at
from legcal.descriptions.new_model import create_model
from legcal.errors import NotIdentifiable
from legcal.estimation.problem import Frames
from legcal.machine.equations import pose_sensitivity
from legcal.machine.leg import LegKind
from legcal.machine.parameters import parametrization_of, parametrize
from legcal.paper.conditions import count_conditions, three_legs_at_once, two_directions
from legcal.paper.four_steps import run_steps
from legcal.report.machine import identify_table
from legcal.vision.board import Board, FixedBoard

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
def report(
    name: str, views: Sequence[Sequence[int]], images: int = 15, **choices: Any
) -> Identifiability:
    legs = model(name).leg_names
    shown = [[legs[j] for j in view] for view in views]
    return identifiability(model(name), shown, images, **choices)


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
    session = machine_session("hexapod", n_poses=3)
    axes, m = session.axes, session.measurements
    view = m.view[axes.row]
    assert two_directions(view, axes.leg, axes.u, 6).ok
    u = np.where((axes.leg == 3)[:, None], axes.u[axes.leg == 3][0], axes.u)
    condition = two_directions(view, axes.leg, u, 6)
    assert (condition.ok, condition.legs) == (False, (3,))


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
    rng, R, t = np.random.default_rng(1), np.eye(3), np.array([0.0, 0.0, 2.0])
    legs = [
        closed_leg(joints, R, t, rng, LegKind.PASSIVE if j in passive else LegKind.ACTUATED)
        for j, joints in enumerate(types.split())
    ]
    condition = three_legs_at_once(views, legs, spatial=not types.startswith("RR"))
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
    machine = create_model(delta_with_round_arms(), tmp_path).machine
    with_arms, without = (
        Analysis(planned_session(m, [range(6)] * 2, 15)) for m in (machine, model("delta"))
    )
    sigma, other = (a.platform_sigma for a in (with_arms, without))
    assert sigma is not None
    assert other is not None
    assert 0.5 * other.dX_m < sigma.dX_m < 0.9 * other.dX_m
    assert is_scale_open(with_arms)
    radii = {f"leg{j}.radius.arm{a}_link": Prior(0.008, 1e-5) for j, a in ((1, 1), (3, 2), (5, 3))}
    assert not is_scale_open(replace(with_arms, choices=Choices(priors=radii)))


@pytest.mark.parametrize(
    ("name", "rtol"),
    [("planar", 0.02), ("board", 0.06), pytest.param("revolute", 0.02, marks=pytest.mark.system)],
)
def test_identify_and_plan_predict_what_calibrate_states(name: str, rtol: float) -> None:
    """At the same poses, cameras and used outlines, with the noise of the result."""
    _, (stated, *predicted) = compared(Path(__file__).parent / "data/recorded" / name)
    np.testing.assert_allclose(predicted, stated, rtol=rtol)


def test_a_prediction_holds_weak_directions_that_do_not_move_the_platform() -> None:
    """As a fit does that knows them: with a strong prior along the direction."""
    found, rng = planned_session(model("3-upu"), [range(3)] * 3, 8), np.random.default_rng(1)
    legs, length = found.fitted, found.mean_length
    unit = np.where(np.equal(legs.parametrization.units, "m"), 1.0, 1.0 / length)
    moves = pose_sensitivity(legs.nominal, legs.parametrization, legs.frame_legs, found.R, found.t)
    still = np.linalg.svd((moves * unit).reshape(-1, len(unit)))[2][-1]
    root = 1e-4 * rng.normal(size=(len(unit), 40))
    S = unit[:, None] * (root @ root.T + np.outer(still, still) * length**2) * unit
    moved = unit[:, None] * 1e-4 * rng.normal(size=(len(unit), 3))
    poses = Frames(found.R, found.t).motions
    stated = covariance_as_stated(S, moved, legs, poses, length)
    information = np.linalg.inv(S)
    known = np.linalg.inv(information + 1e14 * np.outer(still / unit, still / unit))
    moved = known @ information @ moved
    np.testing.assert_allclose(stated, known + moved @ moved.T, rtol=1e-3, atol=1e-12)
    assert np.trace(stated) < 0.01 * np.trace(S)


# Joints at A that actuators move


@cache
def session(name: str) -> Session:
    """Return what three views of all legs of a shipped machine show."""
    return planned_session(model(name), [range(model(name).n_legs)] * 3, 8)


def test_steps_of_machines_whose_joints_at_A_move_are_left_out() -> None:
    delta = machine_session("delta")
    with pytest.raises(NotIdentifiable, match="joints at the base that motors move, needed joints"):
        run_steps(delta.nominal, delta.axes, delta.measurements)


def test_counts_by_analogy_are_those_written_out() -> None:
    """The base of a Delta whose one view shows two arms: 4 joints, 4 circles, 2 axes."""
    on = [((0, 1), True), ((2, 3), True), ((4, 5), True)]
    counts = count_conditions([(0, 1, 2, 3)], 6, actuators=on)
    points, axes = 4 + 4, 2
    products = points * (points - 1) // 2 + axes * (points - 1) + 1 - 4
    assert (counts[0].equations, counts[0].unknowns) == (products, 3 + 9 + 3 * 4)
    assert [c.by_analogy for c in counts] == [True, True, True, False]
    carriages = [((0, 1), False), ((2, 3), False), ((4, 5), False)]
    (eq12, *_) = count_conditions([(0, 1, 2, 3)], 6, actuators=carriages)
    assert (eq12.equations, eq12.unknowns) == (6 + 2 * 3 + 1, 3 + 9 + 3 * 2)


@pytest.mark.parametrize(("name", "rank"), [("hexaglide", 42), ("delta", 42)])
def test_ranks_are_the_published_ones_and_lengths_carry_the_scale_of_arms(
    name: str, rank: int
) -> None:
    analysis = Analysis(session(name))
    assert (analysis.full.rank, analysis.full.of) == (rank, rank)
    assert is_scale_open(analysis) == (name == "delta")
    if name == "delta":
        for sigma, is_open in ((5e-5, False), (0.02, True)):  # else radii would set the scale
            known = Choices(priors={"leg1.length": Prior(0.4, sigma)})
            assert is_scale_open(Analysis(session(name), known)) == is_open
        (rod,) = model(name).legs[0].cylinders
        radius = Choices(priors={f"leg1.radius.{rod.link}": Prior(rod.radius, 1e-5)})
        assert not is_scale_open(Analysis(session(name), radius))


def test_a_free_gain_of_every_carriage_loses_the_scale_too() -> None:
    found = session("hexaglide")
    with_gains = parametrize(
        found.machine.leg_names, found.legs, found.machine.frame_legs, twists=True
    )
    found = replace(found, parametrization=with_gains)
    gains = frozenset(x for x in with_gains.names if x.endswith(".gain"))
    assert len(gains) == 6
    assert not is_scale_open(Analysis(found))
    assert is_scale_open(Analysis(found, Choices(free=gains)))
    assert not is_scale_open(Analysis(found, Choices(free=gains - {"rail1.gain"})))


def test_an_unknown_scale_is_refused_with_what_would_fix_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = "legcal.calibration.identify.identifiability.recorded_session"
    monkeypatch.setattr(name, lambda dataset, twists: session("servo-hexapod"))
    known = SimpleNamespace(
        readings_carry_length=False,
        length_option="--length leg1.base:leg1.platform=MEASURED±SIGMAmm",
    )
    dataset: Any = SimpleNamespace(folder="servo", machine=known)
    wanted = "=MEASURED.*--set.*board on base or platform"
    with pytest.raises(NotIdentifiable, match=wanted):
        check_identifiable(dataset)


# The report, a board, choices, datasets


@cache
def example() -> Dataset:
    return load_dataset(HEXAPOD, check_images=False)


@cache
def two_images() -> Dataset:
    return dataset_at(example(), np.array([0, 15]))


@pytest.mark.usefixtures("without_remedies")
@pytest.mark.parametrize(("images", "ranks"), [(6, (30, 30)), (1, (26, 30))])
def test_a_board_raises_the_rank_and_takes_the_place_of_a_condition(
    images: int, ranks: tuple[int, int]
) -> None:
    without, given = (report("hexapod", WEAK_JOINT, images, board=b) for b in (False, True))
    assert (without.full.rank, given.full.rank) == ranks
    assert (without.board, given.board) == (False, True)
    assert [c.needed for c in (without.conditions[0], given.conditions[0])] == [None, False]
    assert not given.conditions[0].fails


@pytest.mark.usefixtures("without_remedies")
def test_only_a_board_lets_a_camera_in_the_hand_meet_the_conditions() -> None:
    found = report("hexapod", VIEWS[0], board=True, hand_held=True)
    assert (len(found.views), set(found.images)) == (45, {1})
    assert found.full.rank == 30
    assert found.paper.ok
    assert found.board
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(identify_table(found))
    said = " ".join(console.export_text().split())
    assert "views 1 to 15: legs 1, 2, 3, 4 in 1 image each" in said


@pytest.mark.usefixtures("without_remedies")
def test_the_document_is_that_of_the_report() -> None:
    found = report("hexapod", VIEWS[2], board=True)
    words = [word for view in found.views for word in ("--view", ",".join(view))]
    outcome = run("identify", "hexapod", *words, "--board", "--json")
    assert outcome.code == 0
    document = outcome.document
    assert document == json.loads(json.dumps(found.document()))
    sizes = {"spatial": True, "n": 6, "n_d": 3, "r": 0, "n_ac": 6}
    assert {k: document[k] for k in sizes} == sizes
    assert document["conditions"][0] == {
        "name": "eq12", "equations": 9, "unknowns": 12, "ok": False, "needed": False,
    }  # fmt: skip
    assert "needed" not in document["conditions"][1]
    assert document["paper"] == {"ok": found.paper.ok}
    assert document["board"] is True
    assert document["views"] == [list(view) for view in found.views]


@pytest.mark.usefixtures("without_remedies")
def test_a_dataset_with_a_board_is_judged_with_it() -> None:
    """Everywhere until somebody has looked for it, then in the views that show it."""
    board = Board("chessboard", 9, 6, 0.03)
    with_board = replace(example(), boards=(FixedBoard(board, "base"),))
    assert not recorded_session(example()).board.any()
    assert recorded_session(with_board).board.all()
    row = np.flatnonzero(example().measurements.view == 1)[:1]
    one = found_corners(row, np.array([0]), np.array([[10.0, 20.0]]), np.array([0.05]))
    shown = recorded_session(replace(with_board, corners=one)).board
    np.testing.assert_array_equal(shown, [False, True, False])
    found = identifiability_of_dataset(with_board)
    assert found.board
    assert found.conditions[0].needed is False


@pytest.mark.usefixtures("without_remedies")
def test_choices_determine_what_they_say_and_no_more() -> None:
    names = parametrization_of(two_images().machine).names
    with pytest.raises(NotIdentifiable, match="or state known values with --set"):
        check_identifiable(two_images())
    known, vague = (
        Choices(priors={name: Prior(0.3, sigma) for name in names}) for sigma in (1e-4, 100.0)
    )
    assert check_identifiable(two_images(), known) == ()

    def rank(choices: Choices) -> int:
        return Analysis(recorded_session(two_images()), choices, WHITE).full.rank

    alone = rank(Choices())
    assert rank(Choices(fixed=frozenset(names))) == 30
    assert rank(Choices(fixed=frozenset({"leg5.platform.x"}))) == alone + 1
    assert rank(vague) == alone


@pytest.mark.usefixtures("without_remedies")
@pytest.mark.parametrize(("name", "images", "noted"), [("3-rps", 3, True), ("hexapod", 4, False)])
def test_directions_that_a_fit_would_refuse_are_noted(name: str, images: int, noted: bool) -> None:
    machine = model(name)
    found = identifiability(machine, [machine.leg_names], images)
    assert found.identifiable
    assert found.platform_sigma is not None
    assert (found.platform_sigma.dX_m > 0.02) == noted
    assert any("a tenth of a leg" in note for note in found.notes) == noted
