"""Which parameters a mechanism has, and how their errors move the platform."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import changed, closed_leg
from scipy.spatial.transform import Rotation

from legcal import load_mechanism
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine import (
    JointType,
    Leg,
    LegKind,
    Parametrization,
    geometries,
    leg_equations,
    parametrization_of,
    parametrize,
    pose_equations,
    pose_sensitivity,
    to_vector,
    vector_of,
)

FAST = settings(deadline=None, max_examples=15)
SEEDS = st.integers(0, 2**32 - 1)
ACTUATED, PASSIVE, CONSTANT = LegKind.ACTUATED, LegKind.PASSIVE, LegKind.CONSTANT


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


@pytest.mark.parametrize(
    ("types", "kinds", "count"),
    [
        (["US"] * 6, None, 30),
        (["SS"] * 6, [*[ACTUATED] * 5, CONSTANT], 30),
        (["US"] * 6 + ["SS"], [*[ACTUATED] * 6, PASSIVE], 36),
        (["UU"] * 3, None, 21),
        (["RS"] * 3, None, 15),
        (["SR"] * 3, None, 15),
        (["SS", "SS", "SS", "U"], [*[ACTUATED] * 3, PASSIVE], 18),
    ],
    ids=["6-UPS", "one rod", "strut", "3-UPU", "3-RPS", "3-SPR", "Tricept"],
)
def test_the_parameters_of_each_class_are_counted(
    types: list[str], kinds: list[LegKind] | None, count: int
) -> None:
    legs, _, _ = legs_of(types, 1, kinds)
    found = parametrized(legs)
    assert len(found) == len(set(found.names)) == len(found.units) == count
    assert sorted(found.place[found.place >= 0]) == list(range(count))


def test_a_planar_mechanism_has_neither_heights_nor_axes() -> None:
    legs, _, _ = legs_of(["SS"] * 3, 1)
    planar = [
        replace(leg, base_joint=JointType("R"), platform_joint=JointType("R")) for leg in legs
    ]
    found = parametrized(planar, frame=(0, 1))
    assert found.names == (
        "leg2.base.x", "leg3.base.x", "leg3.base.y",
        "leg2.platform.x", "leg3.platform.x", "leg3.platform.y",
        "leg1.offset", "leg2.offset", "leg3.offset",
    )  # fmt: skip


def test_names_say_what_each_parameter_is() -> None:
    legs, _, _ = legs_of(["UU", "RS", "SS", "U"], 2, [ACTUATED, ACTUATED, CONSTANT, PASSIVE])
    found = parametrized(legs, twists=True)
    unit = dict(zip(found.names, found.units, strict=True))
    assert unit["leg3.length"] == "m"
    assert unit["leg1.twist"] == unit["leg2.base_axis.2"] == unit["leg4.platform_axis.1"] == "rad"
    assert "leg4.offset" not in unit
    assert "leg2.platform_axis.1" not in unit
    assert sum(name.startswith("leg4.platform.") for name in unit) == 2  # not along its axis


def test_a_hexapod_has_the_parameters_that_the_fit_has() -> None:
    machine = load_mechanism("hexapod")
    found, legs = parametrization_of(machine), geometries(machine)
    assert found.names[::24] == ("leg2.base.x", "leg1.offset")
    np.testing.assert_array_equal(
        vector_of(found, legs, legs), to_vector(machine.parameters, machine.frame_legs)
    )


@FAST
@given(seed=SEEDS)
def test_a_vector_says_how_far_each_axis_is_turned(seed: int) -> None:
    legs, _, _ = legs_of(["UU", "RS", "SU", "UR"], seed)
    rng = np.random.default_rng(seed)
    found = parametrized(legs, twists=True)
    start = vector_of(found, legs, legs)
    steps = 0.1 * rng.normal(size=(4, 12))
    steps[found.place < 0] = 0.0
    moved = [changed(leg, step) for leg, step in zip(legs, steps, strict=True)]
    expected = np.zeros(len(found))
    expected[found.place[found.place >= 0]] = steps[found.place >= 0]
    np.testing.assert_allclose(vector_of(found, moved, legs) - start, expected, atol=1e-12)
    flipped = [
        leg if leg.base_axis is None else replace(leg, base_axis=-leg.base_axis) for leg in moved
    ]
    np.testing.assert_allclose(vector_of(found, flipped, legs) - start, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("types", "kinds"),
    [
        (["US"] * 6, None),
        (["UU"] * 3, None),
        (["RS"] * 3, None),
        (["UR", "RU", "SR", "SS"], [ACTUATED, PASSIVE, ACTUATED, ACTUATED]),
        (["SS", "SS", "SS", "U"], [*[ACTUATED] * 3, PASSIVE]),
        (["SS"] * 6, [*[ACTUATED] * 5, CONSTANT]),
    ],
    ids=["6-UPS", "3-UPU", "3-RPS", "mixed", "Tricept", "one rod"],
)
@pytest.mark.parametrize("seed", range(3))
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
    lengths = [leg.q0 for leg in legs]
    readings = [float(np.linalg.norm(R @ leg.B + t - leg.A)) - leg.q0 for leg in legs]
    assert all(np.isfinite(lengths))
    T, p = R, t
    for _ in range(5):
        equations = pose_equations(moved, T[None], p[None])
        residual = _residual(moved, readings, T, p)
        change = -np.linalg.pinv(equations.by_pose[0]) @ residual
        T = Rotation.from_rotvec(change[:3]).as_matrix() @ T
        p = p + change[3:]
    turn = Rotation.from_matrix(T @ R.T).as_rotvec()
    size = float(np.abs(predicted).max())
    np.testing.assert_allclose(np.concatenate([turn, p - t]), predicted, atol=1e-3 * size)


def _residual(legs: Sequence[Leg], readings: Sequence[float], R: Array, t: Array) -> Array:
    """Return how far a pose is from readings and demands, rows as in ``pose_equations``."""
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
