"""Equations of legs, their parameters, and how errors of these move the platform."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import changed, closed_leg, leg_and_pose
from scipy.spatial.transform import Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.equations import leg_equations, pose_equations, pose_sensitivity
from legcal.machine.leg import JointType, Leg, LegColumns, LegKind
from legcal.machine.parameters import Parametrization, parametrize, vector_of

FAST = settings(deadline=None, max_examples=6)
SEEDS = st.integers(0, 2**32 - 1)
TYPES = [f"{base}{platform}" for base, platform in product("RUS", ["R", "U", "S", ""])]
FREEDOMS = {"R": 1, "U": 2, "S": 3, "": 0}
ACTUATED, PASSIVE, CONSTANT = LegKind.ACTUATED, LegKind.PASSIVE, LegKind.CONSTANT
STEP = 1e-6


# --- the equations of one leg -------------------------------------------------------------------


@pytest.mark.parametrize("joints", TYPES)
@FAST
@given(seed=SEEDS)
def test_equations_of_a_leg_are_met_where_it_closes_and_have_their_derivatives(
    joints: str, seed: int
) -> None:
    leg, R, t = leg_and_pose(joints, seed)
    found = leg_equations(leg, R[None], t[None])
    np.testing.assert_allclose(found.values[0, 1:], 0.0, atol=1e-12)
    assert found.values[0, 0] == pytest.approx(np.linalg.norm(R @ leg.B + t - leg.A) - leg.q0)
    free = FREEDOMS[joints[0]] + 1 + FREEDOMS[joints[1:]] - (joints == "SS")  # but the idle spin
    assert len(found.kinds) - 1 == 6 - free

    steps = STEP * np.concatenate([np.eye(6), -np.eye(6)])
    turned = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ R
    ends = leg_equations(leg, turned, t + steps[:, 3:], by_local=False).values
    difference = (ends[:6] - ends[6:]).T / (2.0 * STEP)
    np.testing.assert_allclose(found.by_pose[0], difference, atol=1e-6, rtol=1e-5)
    if joints[1:] == "":
        return  # the axis at the platform carries the reference of the twist along, see below
    for column, step in enumerate(STEP * np.eye(LegColumns.COUNT)[: LegColumns.OWN]):
        one, other = (
            leg_equations(changed(leg, s * step), R[None], t[None]).values[0] for s in (1.0, -1.0)
        )
        difference = (one - other) / (2.0 * STEP)
        np.testing.assert_allclose(found.by_local[0, :, column], difference, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("joints", [j for j in TYPES if j[1:] == ""])
@FAST
@given(seed=SEEDS)
def test_a_turn_of_the_direction_in_the_platform_is_a_turn_of_the_platform(
    joints: str, seed: int
) -> None:
    leg, R, t = leg_and_pose(joints, seed)
    found = leg_equations(leg, R[None], t[None])
    assert leg.platform_axis is not None
    for column, e in zip((9, 10), normal_basis(leg.platform_axis), strict=True):
        rows = found.by_pose[0, 1:, :3] @ (R @ e)
        arm = np.cross(e, leg.B)  # the platform's turn moves B as well
        tied = found.by_local[0, 1:, column] + found.by_local[0, 1:, 3:6] @ arm
        np.testing.assert_allclose(rows, tied, atol=1e-9)


@FAST
@given(seed=SEEDS)
def test_equations_of_a_leg_do_not_depend_on_the_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    leg, R, t = leg_and_pose("UU", seed)
    Q, s = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    assert leg.base_axis is not None
    elsewhere = replace(leg, A=Q @ leg.A + s, base_axis=Q @ leg.base_axis)
    flipped = replace(leg, base_axis=-leg.base_axis)
    here = leg_equations(leg, R[None], t[None]).values
    there = leg_equations(elsewhere, (Q @ R)[None], (Q @ t + s)[None]).values
    np.testing.assert_allclose(there, here, atol=1e-12)
    same = leg_equations(flipped, R[None], t[None]).values
    np.testing.assert_allclose(same[0, 1:], here[0, 1:], atol=1e-12)


# --- parameters ---------------------------------------------------------------------------------


def legs_of(
    types: Sequence[str], seed: int, kinds: Sequence[LegKind] | None = None
) -> tuple[list[Leg], Array, Array]:
    """Return legs that close at one pose, in frames that are not those on the joints."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    kinds = kinds or [ACTUATED] * len(types)
    return [closed_leg(j, R, t, rng, k) for j, k in zip(types, kinds, strict=True)], R, t


def parametrized(
    legs: Sequence[Leg], *, twists: bool = False, frame: Sequence[int] = (0, 1, 2)
) -> Parametrization:
    names = [f"leg{j + 1}" for j in range(len(legs))]
    return parametrize(names, legs, frame, twists=twists)


TRICEPT = ["SS", "SS", "SS", "U"], [*[ACTUATED] * 3, PASSIVE]
ROD = ["SS"] * 6, [*[ACTUATED] * 5, CONSTANT]


@pytest.mark.parametrize(
    ("types", "kinds", "count"),
    [
        (["US"] * 6, None, 30),
        (*ROD, 30),
        (["US"] * 6 + ["SS"], [*[ACTUATED] * 6, PASSIVE], 36),
        (["UU"] * 3, None, 21),
        (["RS"] * 3, None, 15),
        (["SR"] * 3, None, 15),
        (*TRICEPT, 18),
    ],
    ids=["6-UPS", "one rod", "strut", "3-UPU", "3-RPS", "3-SPR", "Tricept"],
)
def test_the_parameters_of_each_class_are_counted(
    types: list[str], kinds: list[LegKind] | None, count: int
) -> None:
    found = parametrized(legs_of(types, 1, kinds)[0])
    assert len(found) == len(set(found.names)) == len(found.units) == count
    assert sorted(found.place[found.place >= 0]) == list(range(count))


def test_a_planar_machine_has_neither_heights_nor_axes() -> None:
    R = JointType("R")
    planar = [replace(leg, base_joint=R, platform_joint=R) for leg in legs_of(["SS"] * 3, 1)[0]]
    found = parametrized(planar, frame=(0, 1))
    assert found.names == (
        "leg2.base.x", "leg3.base.x", "leg3.base.y",
        "leg2.platform.x", "leg3.platform.x", "leg3.platform.y",
        "leg1.offset", "leg2.offset", "leg3.offset",
    )  # fmt: skip


def test_names_and_units_say_what_each_number_of_a_leg_is() -> None:
    legs, _, _ = legs_of(["UU", "RS", "SS", "U"], 2, [ACTUATED, ACTUATED, CONSTANT, PASSIVE])
    found = parametrized(legs, twists=True)
    unit = dict(zip(found.names, found.units, strict=True))
    points = [f"{end}.{x}" for end in ("base", "platform") for x in "xyz"]
    axes = [f"{end}_axis.{k}" for end in ("base", "platform") for k in (1, 2)]
    for j, row in enumerate(found.place):
        numbers = [*points, "length" if legs[j].kind is CONSTANT else "offset", *axes, "twist"]
        for column, i in enumerate(row):
            if i >= 0:
                assert found.names[i] == f"leg{j + 1}.{numbers[column]}"
                assert found.units[i] == ("m" if column <= 6 else "rad")
    assert {"leg3.length", "leg1.twist", "leg2.base_axis.2", "leg4.platform_axis.1"} < set(unit)
    assert not {"leg4.offset", "leg2.platform_axis.1"} & set(unit)
    assert sum(name.startswith("leg4.platform.") for name in unit) == 2  # not along its axis


@FAST
@given(seed=SEEDS)
def test_a_vector_says_how_far_each_axis_is_turned(seed: int) -> None:
    legs, _, _ = legs_of(["UU", "RS", "SU", "UR"], seed)
    rng = np.random.default_rng(seed)
    found = parametrized(legs, twists=True)
    start = vector_of(found, legs, legs)
    steps = 0.1 * rng.normal(size=(4, LegColumns.COUNT))
    steps[found.place < 0] = 0.0
    moved = [changed(leg, step) for leg, step in zip(legs, steps, strict=True)]
    expected = np.zeros(len(found))
    expected[found.place[found.place >= 0]] = steps[found.place >= 0]
    reversed_lines = [  # axes are lines, and so are what twists are counted between
        replace(
            leg,
            base_axis=None if leg.base_axis is None else -leg.base_axis,
            twist=None if leg.twist is None else leg.twist + np.pi,
        )
        for leg in moved
    ]
    for same in (moved, reversed_lines):
        np.testing.assert_allclose(vector_of(found, same, legs) - start, expected, atol=1e-12)


# --- parameters and the pose --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("types", "kinds"),
    [
        (["US"] * 6, None),
        (["UU"] * 3, None),
        (["RS"] * 3, None),
        (["UR", "RU", "SR", "SS"], [ACTUATED, PASSIVE, ACTUATED, ACTUATED]),
        TRICEPT,
        ROD,
    ],
    ids=["6-UPS", "3-UPU", "3-RPS", "mixed", "Tricept", "one rod"],
)
@pytest.mark.parametrize("seed", range(2))
def test_the_platform_goes_where_the_equations_are_met_again(
    types: list[str], kinds: list[LegKind] | None, seed: int
) -> None:
    legs, R, t = legs_of(types, seed, kinds)
    found = parametrized(legs)
    step = 1e-8 * np.random.default_rng(seed).normal(size=len(found))
    if "U" in types:  # the direction of a fixed leg carries its reference for the twist along
        step[[i for i, name in enumerate(found.names) if "leg4.platform_axis" in name]] = 0.0
    moved = [
        changed(leg, np.where(place >= 0, step[place], 0.0))
        for leg, place in zip(legs, found.place, strict=True)
    ]
    predicted = pose_sensitivity(legs, found, (0, 1, 2), R[None], t[None])[0] @ step
    readings = [float(np.linalg.norm(R @ leg.B + t - leg.A)) - leg.q0 for leg in legs]
    T, p = R, t
    for _ in range(5):
        found_there = pose_equations(moved, T[None], p[None])
        weight = np.where(found_there.measured, 1.0, 1e5)  # constraints are met exactly
        weighted = weight[:, None] * found_there.by_pose[0]
        change = -np.linalg.pinv(weighted) @ (weight * _residual(moved, readings, T, p))
        T = Rotation.from_rotvec(change[:3]).as_matrix() @ T
        p = p + change[3:]
    turn = Rotation.from_matrix(T @ R.T).as_rotvec()
    size = float(np.abs(predicted).max())
    np.testing.assert_allclose(np.concatenate([turn, p - t]), predicted, atol=1e-3 * size)


def _residual(legs: Sequence[Leg], readings: Sequence[float], R: Array, t: Array) -> Array:
    """Return how far a pose is from readings and constraints, rows as in ``pose_equations``."""
    rows = []
    for leg, reading in zip(legs, readings, strict=True):
        values = leg_equations(leg, R[None], t[None]).values[0]
        length = values[0] + leg.q0
        if leg.kind is not PASSIVE:
            rows.append(values[0] - (reading if leg.kind is ACTUATED else 0.0))
        rows += (length * values[1:]).tolist()
    return np.array(rows)


def test_too_few_equations_do_not_move_the_platform_anywhere() -> None:
    legs, R, t = legs_of(["US"] * 6, 0, [*[ACTUATED] * 5, PASSIVE])
    with pytest.raises(NotIdentifiable, match="the 5 readings do not determine platform pose 1"):
        pose_sensitivity(legs, parametrized(legs), (0, 1, 2), R[None], t[None])
