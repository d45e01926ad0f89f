"""The linearised observations, against second routes."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_legs import changed, closed_leg
from scipy.spatial.transform import Rotation

from legcal.calibration.identify.information import (
    SIGMA_EXACT,
    by_cameras,
    compress,
    demands_of,
    eliminate,
    image_rows,
    of_parameters,
)
from legcal.calibration.identify.judge import identifiability
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.session import (
    SIGMA_PX,
    Session,
    at_base_joints,
    at_platform_joints,
)
from legcal.geometry.types import Array
from legcal.machine import LegKind, linearize, load_mechanism, parametrize

FAST = settings(deadline=None, max_examples=10)
SEEDS = st.integers(0, 2**32 - 1)
TYPES = [f"{base}{platform}" for base, platform in product("RUS", "RUS")]
STEP = 1e-6


def random_session(seed: int, n_legs: int = 4, n_views: int = 2) -> Session:
    """Return a session of one pose with random legs of random types."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    kinds = rng.choice(list(LegKind), n_legs)
    joints = rng.choice(TYPES, n_legs)
    legs = tuple(closed_leg(j, R, t, rng, LegKind(k)) for j, k in zip(joints, kinds, strict=True))
    names = tuple(f"leg{j + 1}" for j in range(n_legs))
    return Session(
        leg_names=names,
        legs=legs,
        frame_legs=(0, 1, 2),
        parametrization=parametrize(names, legs, (0, 1, 2)),
        radius=rng.uniform(0.01, 0.05, n_legs),
        R=R[None],
        t=t[None],
        R_reached=R[None],
        t_reached=t[None],
        view=np.arange(n_views),
        pose=np.zeros(n_views, dtype=np.intp),
        seen=rng.random((n_views, n_legs)) < 0.7,
        camera=rng.normal(size=(n_views, 3)) * 5.0,
        focal=rng.uniform(800.0, 2000.0, n_views),
        sigma_q=2e-6,
        board=np.zeros(n_views, dtype=np.bool_),
    )


def offsets_of_axes(session: Session, step: Array, x: Array, camera: Array, v: int) -> Array:
    """Return how far each leg's axis has moved at its old ends, in a moved camera, (n, 2, 3).

    The axis is drawn in the camera's frame and cut with the planes across the old axis.
    """
    R = Rotation.from_rotvec(x[:3]).as_matrix() @ session.R[0]
    t = session.t[0] + x[3:]
    turn = Rotation.from_rotvec(camera[:3])
    padded = np.append(step, 0.0)
    moved = []
    for j, leg in enumerate(session.legs):
        new = changed(leg, padded[session.parametrization.place[j]])
        ends = [leg.A, session.R[0] @ leg.B + session.t[0]]
        A, B = (turn.inv().apply(P - camera[3:]) for P in (new.A, R @ new.B + t))
        u0 = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        cut = [A + (B - A) * ((P - A) @ u0) / ((B - A) @ u0) - P for P in ends]
        moved.append(cut)
    return np.array(moved)


def finite_differences(session: Session, v: int) -> Array:
    """Return the derivative of what an image shows by pose, camera and parameters."""
    A, B = at_base_joints(session), at_platform_joints(session)
    gradient = np.stack([A.gradient[v], B.gradient[v]], axis=1)  # leg, end, lateral or depth
    n_p = len(session.unit)
    scale = np.repeat([1.0 / session.mean_length, 1.0], 3)
    columns = []
    for column in np.eye(12 + n_p):
        sides = []
        for h in (STEP, -STEP):
            x, camera, step = np.split(h * column, [6, 12])
            cut = offsets_of_axes(session, step * session.unit, x * scale, camera * scale, v)
            sides.append(np.einsum("nekc,nec->nek", gradient, cut).reshape(len(cut), 4))
        columns.append((sides[0] - sides[1]) / (2.0 * STEP))
    return np.stack(columns, axis=-1)


@FAST
@given(seed=SEEDS)
def test_image_rows_equal_finite_differences_of_axes_cut_in_the_camera(seed: int) -> None:
    session = random_session(seed)
    exact = image_rows(session)
    for v in range(session.n_views):
        difference = finite_differences(session, v)
        size = np.abs(difference).max(initial=1.0)
        np.testing.assert_allclose(exact[v] / size, difference / size, atol=1e-5)


@FAST
@given(seed=SEEDS)
def test_demands_equal_finite_differences(seed: int) -> None:
    session = random_session(seed)
    found = demands_of(session)
    n_p = len(session.unit)
    scale = np.repeat([1.0 / session.mean_length, 1.0], 3)
    columns = []
    for column in np.eye(6 + n_p):
        sides = [_demand_values(session, h * column, scale) for h in (STEP, -STEP)]
        columns.append((sides[0] - sides[1]) / (2.0 * STEP))
    difference = np.stack(columns, axis=-1)
    exact = np.concatenate([found.by_pose[0], found.by_parameters[0]], axis=1)
    size = np.abs(difference).max(axis=1, keepdims=True)
    np.testing.assert_allclose(exact / size, difference / size, atol=1e-5)
    assert exact.shape[0] == len(found.leg) == len(found.demand)


def _demand_values(session: Session, step: Array, scale: Array) -> Array:
    """Return what all legs demand, in standard deviations, after a step of pose and parameters."""
    x, parameters = step[:6] * scale, np.append(step[6:] * session.unit, 0.0)
    R = Rotation.from_rotvec(x[:3]).as_matrix() @ session.R[0]
    values = []
    for j, leg in enumerate(session.legs):
        new = changed(leg, parameters[session.parametrization.place[j]])
        found = linearize(new, R[None], (session.t[0] + x[3:])[None]).values[0]
        length = session.length[0, j]
        if leg.kind is not LegKind.PASSIVE:
            sigma = session.sigma_q if leg.kind is LegKind.ACTUATED else SIGMA_EXACT
            values.append(found[0] / sigma)
        values += (found[1:] * length / SIGMA_EXACT).tolist()
    return np.array(values)


def test_a_tenth_of_a_pixel_across_is_one_standard_deviation() -> None:
    session = random_session(3)
    across = at_platform_joints(session)
    for v, j in np.argwhere(session.seen):
        P, camera = across.point[v, j], session.camera[v]
        z = (P - camera) / np.linalg.norm(P - camera)  # a camera that looks at P
        lateral, depth = across.gradient[v, j]
        ends = [P, P + lateral / (lateral @ lateral)]  # moved by one standard deviation
        pixels = [session.focal[v] * (Q - camera) / ((Q - camera) @ z) for Q in ends]
        assert np.linalg.norm(pixels[1] - pixels[0]) == pytest.approx(SIGMA_PX, rel=1e-3)
        ratio = np.linalg.norm(lateral) / np.linalg.norm(depth)
        assert ratio == pytest.approx(np.linalg.norm(P - camera) / session.radius[j])


@FAST
@given(seed=SEEDS, rank=st.integers(0, 4), rows=st.integers(1, 12))
def test_elimination_keeps_what_is_said_whatever_the_own_unknowns_do(
    seed: int, rank: int, rows: int
) -> None:
    """Against projection on what the own unknowns cannot explain."""
    rng = np.random.default_rng(seed)
    left = np.linalg.qr(rng.normal(size=(3, rows, min(rows, rank))))[0]
    right = np.linalg.qr(rng.normal(size=(3, 4, min(rows, rank))))[0]
    own = left * rng.uniform(0.5, 2.0, left.shape[2]) @ np.swapaxes(right, 1, 2)
    shared = rng.normal(size=(3, rows, 5))
    found = eliminate(np.concatenate([own, shared], axis=2), 4)
    expected = np.zeros((5, 5))
    for N, J in zip(own, shared, strict=True):
        rest = J - N @ np.linalg.pinv(N, rcond=1e-10) @ J
        expected += rest.T @ rest
    np.testing.assert_allclose(found.T @ found, expected, atol=1e-9)
    upper = compress(found)
    np.testing.assert_allclose(upper.T @ upper, expected, atol=1e-9)


@FAST
@given(seed=SEEDS, shown=st.lists(st.booleans(), min_size=3, max_size=3))
def test_views_with_a_board_have_one_camera_in_common(seed: int, shown: list[bool]) -> None:
    """Against the normal equations of all unknowns, one camera for all views with a board."""
    session = replace(random_session(seed, n_views=3), board=np.array(shown))
    n_p, images, demands = len(session.unit), image_rows(session), demands_of(session)
    cameras = ["board" if board else v for v, board in enumerate(shown)]
    places = list(dict.fromkeys(cameras))
    rows = np.zeros((3, session.n_legs * 4, 6 + 6 * len(places) + n_p))
    for v, camera in enumerate(cameras):
        seen, at = images[v].reshape(-1, 12 + n_p), 6 + 6 * places.index(camera)
        rows[v, :, :6], rows[v, :, at : at + 6] = seen[:, :6], seen[:, 6:12]
        rows[v, :, 6 + 6 * len(places) :] = seen[:, 12:]
    other = np.zeros((demands.by_pose.shape[1], rows.shape[2]))
    other[:, :6], other[:, 6 + 6 * len(places) :] = demands.by_pose[0], demands.by_parameters[0]
    every = np.concatenate([other, *rows])
    own, shared = np.split(every, [every.shape[1] - n_p], axis=1)
    basis, singular, _ = np.linalg.svd(own, full_matrices=False)
    kept = basis[:, singular > 1e-3]
    rest = shared - kept @ (kept.T @ shared)
    found = of_parameters(session, by_cameras(session, images, demands))
    scale = max(1.0, float(np.abs(rest).max()) ** 2)
    np.testing.assert_allclose(found.T @ found / scale, rest.T @ rest / scale, atol=1e-6)


@FAST
@given(seed=SEEDS)
def test_a_further_image_of_a_known_pose_takes_nothing_away(seed: int) -> None:
    session = random_session(seed)
    both = _information(session)
    first = np.flatnonzero(session.view == 0)
    one = _information(_with(session, view=session.view[first], pose=session.pose[first]))
    gain = both.T @ both - one.T @ one
    scale = max(1.0, float(np.linalg.norm(both.T @ both)))  # 1/m^2: less says nothing
    assert np.linalg.eigvalsh(gain)[0] > -1e-6 * scale


def _information(session: Session) -> Array:
    return Analysis(session).information


def _with(session: Session, **changes: Any) -> Session:
    return replace(session, seen=session.seen[:1], camera=session.camera[:1], **changes)


@pytest.mark.parametrize(("seen", "most"), [(1, 0), (3, 6), (4, 10)])
def test_one_image_tells_no_more_than_it_measures(seen: int, most: int) -> None:
    machine = load_mechanism("hexapod")  # 4 numbers a leg, 6 readings; 6 for pose and for camera
    full = identifiability(machine, [machine.leg_names[:seen]], images=1).full
    assert full.rank == most
    assert full.rank + len(full.weak) == full.of
