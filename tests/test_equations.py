"""The closed forms of what legs demand, against finite differences and each other."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import changed, leg_and_pose, twist_of
from scipy.spatial.transform import Rotation

from legcal.geometry.lines import normal_basis
from legcal.machine import EquationKind, leg_equations

FAST = settings(deadline=None, max_examples=20)
SEEDS = st.integers(0, 2**32 - 1)
TYPES = [f"{base}{platform}" for base, platform in product("RUS", ["R", "U", "S", ""])]
STEP = 1e-6


@pytest.mark.parametrize("joints", TYPES)
@FAST
@given(seed=SEEDS)
def test_all_demands_but_the_length_are_met_where_a_leg_closes(joints: str, seed: int) -> None:
    leg, R, t = leg_and_pose(joints, seed)
    found = leg_equations(leg, R[None], t[None])
    np.testing.assert_allclose(found.values[0, 1:], 0.0, atol=1e-12)
    assert found.values[0, 0] == pytest.approx(np.linalg.norm(R @ leg.B + t - leg.A) - leg.q0)
    freedoms = {"R": 1, "U": 2, "S": 3, "": 0}
    idle = joints == "SS"
    free = freedoms[joints[0]] + 1 + freedoms[joints[1:]] - idle
    assert len(leg.equations) - 1 == 6 - free


@pytest.mark.parametrize("joints", TYPES)
@FAST
@given(seed=SEEDS)
def test_derivatives_by_pose_equal_finite_differences(joints: str, seed: int) -> None:
    leg, R, t = leg_and_pose(joints, seed)
    exact = leg_equations(leg, R[None], t[None]).by_pose[0]
    for column, step in enumerate(STEP * np.eye(6)):
        ends = []
        for sign in (1.0, -1.0):
            turn = Rotation.from_rotvec(sign * step[:3]).as_matrix() @ R
            ends.append(leg_equations(leg, turn[None], (t + sign * step[3:])[None]).values[0])
        difference = (ends[0] - ends[1]) / (2.0 * STEP)
        np.testing.assert_allclose(exact[:, column], difference, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("joints", [j for j in TYPES if j[1:] != ""])
@FAST
@given(seed=SEEDS)
def test_derivatives_by_parameters_equal_finite_differences(joints: str, seed: int) -> None:
    leg, R, t = leg_and_pose(joints, seed)
    exact = leg_equations(leg, R[None], t[None]).by_local[0]
    for column, step in enumerate(STEP * np.eye(12)):
        ends = [
            leg_equations(changed(leg, sign * step), R[None], t[None]).values[0]
            for sign in (1.0, -1.0)
        ]
        difference = (ends[0] - ends[1]) / (2.0 * STEP)
        np.testing.assert_allclose(exact[:, column], difference, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("joints", [j for j in TYPES if j[1:] == ""])
@FAST
@given(seed=SEEDS)
def test_a_turn_of_the_direction_in_the_platform_is_a_turn_of_the_platform(
    joints: str, seed: int
) -> None:
    """Turning everything tied to the platform together is the same as turning the platform."""
    leg, R, t = leg_and_pose(joints, seed)
    found = leg_equations(leg, R[None], t[None])
    assert leg.platform_axis is not None
    for column, e in zip((9, 10), normal_basis(leg.platform_axis), strict=True):
        rows = found.by_pose[0, 1:, :3] @ (R @ e)
        arm = np.cross(e, leg.B)  # the platform's turn moves B as well
        np.testing.assert_allclose(
            rows, found.by_local[0, 1:, column] + found.by_local[0, 1:, 3:6] @ arm, atol=1e-9
        )


@FAST
@given(seed=SEEDS)
def test_the_demands_of_a_leg_do_not_depend_on_the_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    leg, R, t = leg_and_pose("UU", seed)
    Q = Rotation.random(rng=rng).as_matrix()
    s = rng.normal(size=3)
    assert leg.base_axis is not None
    elsewhere = replace(leg, A=Q @ leg.A + s, base_axis=Q @ leg.base_axis)
    here = leg_equations(leg, R[None], t[None]).values
    there = leg_equations(elsewhere, (Q @ R)[None], (Q @ t + s)[None]).values
    np.testing.assert_allclose(there, here, atol=1e-12)
    flipped = replace(leg, base_axis=-leg.base_axis)
    np.testing.assert_allclose(
        leg_equations(flipped, R[None], t[None]).values[0, 1:], here[0, 1:], atol=1e-12
    )


def test_the_twist_is_that_of_a_line() -> None:
    for seed in range(30):
        leg, R, t = leg_and_pose("UR", seed)
        assert leg.twist is not None
        assert -0.5 * np.pi < leg.twist <= 0.5 * np.pi
        again = twist_of(replace(leg, twist=None if seed % 2 else 1.0), R, t)
        assert again == pytest.approx(leg.twist, abs=1e-12)


def test_a_leg_without_an_s_joint_says_what_it_demands() -> None:
    assert leg_and_pose("UU", 0)[0].equations == (EquationKind.LENGTH, EquationKind.TWIST)
    assert leg_and_pose("RS", 0)[0].equations == (EquationKind.LENGTH, EquationKind.BASE_AXIS)
