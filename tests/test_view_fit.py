"""The fit of a view to outlines: cameras, what it knows, and legs that do not suit it."""

from dataclasses import replace

import leg_pictures as lp
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array, Image
from legcal.perception.placement import Group, Search, group_views
from legcal.perception.view_fit import (
    ViewFit,
    fit_view,
    min_evidence,
    reversed_pose,
    sideways_sigmas,
)
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

CAMERA = Camera(np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]), 640, 480)
N_LEGS, N_IMAGES = 6, 4
SIGMA = 0.1  # of outlines [px]


def _no_image(row: int) -> Image:
    raise AssertionError(row)


def _session(seed: int) -> tuple[Search, Group, RigidTransform]:
    rng = np.random.default_rng(seed)
    made, T = lp.machine(N_LEGS, rng), lp.camera(rng)
    rows = np.arange(N_IMAGES)
    B = np.array([made.posed(lp.platform(rng)) for _ in rows])
    measurements = Measurements(
        (View("c1", CAMERA),), tuple(f"{row}.png" for row in rows), np.zeros(N_IMAGES, np.intp),
        rows, np.zeros((N_IMAGES, N_LEGS)), 1e-6,
    )  # fmt: skip
    wanted = np.ones((1, N_LEGS), dtype=np.bool_)
    A = np.broadcast_to(made.A, B.shape)
    search = Search(
        _no_image, measurements, A, B, [lp.CYLINDERS] * N_LEGS, wanted, ["leg"] * N_LEGS
    )
    return search, group_views(measurements, rows, [None], None)[0], T


def _outlines(search: Search, T: RigidTransform, A: Array, B: Array, noise: Array) -> Outlines:
    """Return both outlines of all tubes, with normal offsets (rows, legs, edges, ends) [px]."""
    row, leg, edge = (x.ravel() for x in np.indices((N_IMAGES, N_LEGS, 2)))
    ends, n = np.empty((len(row), 2, 2)), len(row)
    for k, (r, j, e) in enumerate(zip(row, leg, edge, strict=True)):
        X = T.inv().apply(np.stack([A[r, j], B[r, j]]))
        u = (X[1] - X[0]) / np.linalg.norm(X[1] - X[0])
        h = outlines_of_axis(u, X[0], lp.TUBE)[e]
        along = X[0] + np.outer([0.03, 0.2], u)
        xy = along[:, :2] / along[:, 2:]
        normal = h[:2] / np.linalg.norm(h[:2])
        off = (xy @ h[:2] + h[2]) / np.linalg.norm(h[:2])
        ends[k] = CAMERA.distort(xy - off[:, None] * normal) + noise[r, j, e][:, None] * normal
    return Outlines(
        row, leg, ("tube",) * n, edge + 1, np.full((n, 3), np.nan), ends,
        np.tile(SIGMA**2 * np.eye(2), (n, 1, 1)), np.ones(n, dtype=np.bool_), ("",) * n,
        ("detected",) * n,
    )  # fmt: skip


Fitted = tuple[ViewFit, Search, Group, RigidTransform]


def _fitted(seed: int, *, joints: float = 0.0, moved: float = 0.0) -> Fitted:
    """Fit a view that starts three degrees off; leg 3 of image 2 is moved aside [px]."""
    search, group, T = _session(seed)
    rng = np.random.default_rng(seed)
    A = search.A_base + joints * rng.normal(size=(N_LEGS, 3))
    B = search.B_base + joints * rng.normal(size=(N_LEGS, 3))
    noise = np.zeros((N_IMAGES, N_LEGS, 2, 2))
    noise[1, 2] = moved
    off = RigidTransform.from_components(
        [0.02, -0.01, 0.02], Rotation.from_rotvec([0.0, 0.05, 0.0])
    )
    outlines = _outlines(search, T, A, B, noise)
    fit = fit_view(search, group, T * off, np.zeros((N_LEGS, 2, 3)), outlines)
    assert fit is not None
    return fit, search, group, T


@pytest.mark.parametrize("seed", range(3))
def test_exact_outlines_give_back_the_camera(seed: int) -> None:
    fit, _, group, T = _fitted(seed)
    away, angle = lp.apart(T, fit.T_base_group)
    assert away < 1e-3
    assert angle < 1e-3
    assert not fit.outliers.any()
    assert fit.evidence == pytest.approx(2.0 * 2 * N_IMAGES * N_LEGS, rel=0.01)
    assert fit.evidence > min_evidence(group)


def test_the_camera_is_as_far_off_as_its_covariance_says() -> None:
    ratios = []
    for seed in range(8):
        fit, _, _, T = _fitted(seed, joints=2e-3)
        ratios.append(lp.apart(T, fit.T_base_group)[1] / fit.turn_sigma)
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 3.0


def test_a_leg_that_is_elsewhere_in_one_image_is_told() -> None:
    fit, _, _, T = _fitted(1, joints=1e-3, moved=25.0)
    wrong = set(zip(fit.row[fit.outliers].tolist(), fit.leg[fit.outliers].tolist(), strict=True))
    assert wrong == {(1, 2)}
    assert lp.apart(T, fit.T_base_group)[1] < np.deg2rad(1.0)


def test_legs_without_outlines_are_known_less_well() -> None:
    search, group, T = _session(2)
    noise = np.zeros((N_IMAGES, N_LEGS, 2, 2))
    outlines = _outlines(search, T, search.A_base, search.B_base, noise)
    some = replace(outlines, used=outlines.leg != 4)
    fit = fit_view(search, group, T, np.zeros((N_LEGS, 2, 3)), some)
    assert fit is not None
    sigma = sideways_sigmas(search, group, fit)
    assert np.isfinite(sigma).all()
    assert sigma[:, 4].min() > 1.5 * np.median(sigma[:, [0, 1, 2, 3, 5]])


def test_without_outlines_there_is_no_fit() -> None:
    search, group, T = _session(0)
    noise = np.zeros((N_IMAGES, N_LEGS, 2, 2))
    outlines = _outlines(search, T, search.A_base, search.B_base, noise)
    none = replace(outlines, used=np.zeros(len(outlines), dtype=np.bool_))
    assert fit_view(search, group, T, np.zeros((N_LEGS, 2, 3)), none) is None


def test_near_and_far_exchanged_twice_is_the_pose_itself() -> None:
    search, group, T = _session(3)
    there = reversed_pose(search, group, T)
    away, angle = lp.apart(T, reversed_pose(search, group, there))
    assert away < 1e-9
    assert angle < 1e-9
    assert lp.apart(T, there)[1] > np.deg2rad(10.0)
