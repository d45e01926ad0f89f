"""What the legs tell of focal lengths and principal points, against pictures of cylinders."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_example import HEXAPOD
from hypothesis import given
from hypothesis import strategies as st
from test_identify_information import FAST, SEEDS, random_session

from legcal.calibration.identify.intrinsics import NAMES, _changes, _scales, judge_intrinsics
from legcal.calibration.identify.judge import identifiability_of_dataset
from legcal.calibration.identify.planning import looking_at, recorded_session
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.session import at_base_joints
from legcal.data.dataset import load_dataset
from legcal.data.holdout import dataset_at
from legcal.geometry.types import Array
from legcal.report.identify import _intrinsics
from legcal.vision.cylinder import outlines_of_axis


def _edges(K: Array, X: Array, u: Array, radius: float) -> Array:
    """Return places (2,) of both outlines across the leg at the pixel where X is seen [px]."""
    h = outlines_of_axis(u[None], X[None], np.array([radius]))[0]
    pixel = (K @ X)[:2] / X[2]
    end = K @ (X + 1e-3 * u)
    along = end[:2] / end[2] - pixel
    along /= np.linalg.norm(along)
    normal = np.array([-along[1], along[0]])
    lines = h @ np.linalg.inv(K)  # of pixels
    return np.asarray(-(lines[:, :2] @ pixel + lines[:, 2]) / (lines[:, :2] @ normal))


@FAST
@given(seed=SEEDS, number=st.integers(0, 3))
def test_numbers_of_a_camera_move_outlines_as_motions_of_the_leg_do(seed: int, number: int) -> None:
    session = random_session(seed, n_legs=4, n_views=2)
    session = replace(
        session, seen=np.ones_like(session.seen), radius=np.full(4, 1e-3), camera=5e0 * _away(seed)
    )
    R, across = looking_at(session), at_base_joints(session)
    aside, wider = _changes(session, across, R)
    sigma, towards = _scales(session, across)
    f = session.focal[0]
    K = np.array([[f, 0, 512.0], [0, f, 384.0], [0, 0, 1.0]])
    other, step = K.copy(), 0.1
    other[{0: (0, 0), 1: (1, 1), 2: (0, 2), 3: (1, 2)}[number]] += step
    pose = int(session.pose[0])
    for j in range(session.n_legs):
        X = R[0].T @ (session.A[j] - session.camera[0])
        u = R[0].T @ session.u[pose, j]
        lateral, depth = (R[0].T @ across.gradient[0, j, k] for k in (0, 1))
        before, after = _edges(K, X, u, 1e-3), _edges(other, X, u, 1e-3)
        # The same pixel is where the leg was: what moved is the line, seen from there.
        before_at = (K @ X)[:2] / X[2]
        moved = (other @ X)[:2] / X[2] - before_at
        side = lateral / np.linalg.norm(lateral)
        shifted = (K @ (X + 1e-5 * side))[:2] / (X + 1e-5 * side)[2] - before_at
        normal = _normal(K, X, u)
        assert moved @ normal == pytest.approx(
            (shifted @ normal) / 1e-5 * aside[0, j, number] * step, rel=1e-3, abs=1e-9
        )
        width = np.abs(np.diff([before, after], axis=1)).ravel()
        assert np.log(width[1] / width[0]) == pytest.approx(
            wider[0, j, number] * step, rel=1e-2, abs=1e-7
        )
        if abs(u @ X) > 0.9 * np.linalg.norm(X):
            continue  # one that points at the camera gets wider along the image as well
        nearer = X + 1e-4 * depth / np.linalg.norm(depth)
        seen_nearer = np.abs(np.diff(_edges(K, nearer, u, 1e-3)))[0]
        direction = np.sign(np.log(seen_nearer / width[0])) * np.sign(towards[0, j])
        assert direction == 1.0  # a wider leg looks like one that is moved so
        assert sigma[0, j] == pytest.approx(1.0 / np.linalg.norm(lateral))


def _away(seed: int) -> Array:
    """Return where two cameras stand, far from machines of a metre."""
    place = np.random.default_rng(seed).normal(size=(2, 3))
    return np.asarray(place / np.linalg.norm(place, axis=1, keepdims=True) * 3.0)


def _normal(K: Array, X: Array, u: Array) -> Array:
    """Return the unit normal of the imaged axis at X."""
    at, end = (K @ Y / Y[2] for Y in (X, X + 1e-4 * u))
    along = (end - at)[:2] / np.linalg.norm((end - at)[:2])
    return np.array([-along[1], along[0]])


def test_the_example_determines_its_camera() -> None:
    report = identifiability_of_dataset(load_dataset(HEXAPOD, check_images=False))
    (camera,) = report.intrinsics
    assert camera.camera == "c1"  # one for all views
    assert camera.determined
    sigma = [camera.sigma[name] for name in NAMES]
    assert all(value is not None and 0.1 < value < 3.0 for value in sigma)
    assert "determine its intrinsics too (sigma to expect: fx 0." in _intrinsics(camera)
    assert report.document()["intrinsics"][0]["sigma"]["fx"] == pytest.approx(sigma[0])


def test_two_images_leave_the_camera_open() -> None:
    dataset = dataset_at(load_dataset(HEXAPOD, check_images=False), np.array([0, 15]))
    (camera,) = identifiability_of_dataset(dataset).intrinsics
    assert not camera.determined
    assert None in camera.sigma.values()
    assert "calibrate it with legcal camera" in _intrinsics(camera)


def test_cameras_of_their_own_are_known_less_than_one_of_all_views() -> None:
    session = recorded_session(load_dataset(HEXAPOD, check_images=False))
    R = looking_at(session)
    one, three = (
        judge_intrinsics(Analysis(session), R, owners) for owners in (["c1"] * 3, ["a", "b", "c"])
    )
    assert [camera.camera for camera in three] == ["a", "b", "c"]
    for camera in three:
        for name in NAMES:
            known, alone = one[0].sigma[name], camera.sigma[name]
            assert known is not None
            assert alone is None or alone > known
