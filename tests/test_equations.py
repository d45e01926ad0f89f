"""Equations of legs, their parameters, and how errors of these move the platform."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import changed, leg_and_pose
from scipy.spatial.transform import Rotation

from legcal.machine.equations import leg_equations
from legcal.machine.leg import LegColumns, LegKind
from legcal.machine.parameters import parametrize, vector_of

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


# --- parameters ---------------------------------------------------------------------------------


@FAST
@given(seed=SEEDS)
def test_a_vector_says_how_far_each_axis_is_turned(seed: int) -> None:
    legs = [leg_and_pose(j, seed + k)[0] for k, j in enumerate(("UU", "RS", "SU", "UR"))]
    rng = np.random.default_rng(seed)
    found = parametrize(["leg1", "leg2", "leg3", "leg4"], legs, (0, 1, 2), twists=True)
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
