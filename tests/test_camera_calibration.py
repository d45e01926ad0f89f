"""Cameras from corners of a board: recovered with honest sigmas, or refused with the figures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from camera_sessions import CAMERAS, NOISE_PX, SIZE, seen_corners

from legcal.calibration.camera_calibration.adjustment import BoardCorners, RobustFit, robust_fit
from legcal.calibration.camera_calibration.diagnostics import refuse_undetermined, warnings
from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.vision.camera import DistortionModel, intrinsic_values

MODELS: tuple[DistortionModel, ...] = ("plumb_bob", "rational_polynomial", "equidistant")


def fitted(seen: BoardCorners, model: DistortionModel = "plumb_bob") -> RobustFit:
    found = robust_fit(seen, SIZE, model)
    assert found is not None
    return found


def sigmas(found: RobustFit) -> Array:
    return np.sqrt(np.diag(found.adjusted.covariance) * found.scale)


@pytest.mark.parametrize("model", MODELS)
def test_every_number_of_the_camera_is_recovered_within_its_sigma(model: DistortionModel) -> None:
    truth = CAMERAS[model]
    found = fitted(seen_corners(truth, 12, 3), model)
    pulls = (intrinsic_values(found.adjusted.camera) - intrinsic_values(truth)) / sigmas(found)
    assert np.abs(pulls).max() < 3.0
    assert sigmas(found)[:4].max() < 0.3
    assert 0.8 < found.scale < 1.25
    assert found.left_out == {}
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    again = found.adjusted.camera.project(np.column_stack([truth.undistort(corners), np.ones(4)]))
    assert np.abs(again - corners).max() < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_sigmas_are_the_spread_of_many_calibrations(model: DistortionModel) -> None:
    truth = intrinsic_values(CAMERAS[model])
    found = [fitted(seen_corners(CAMERAS[model], 12, seed), model) for seed in range(30)]
    pulls = np.array([(intrinsic_values(f.adjusted.camera) - truth) / sigmas(f) for f in found])
    of_lens = pulls[:, :4]  # coefficients of a ratio may cancel: they are held by a prior
    assert np.all(np.sqrt(np.mean(of_lens**2, axis=0)) < 1.4)
    assert np.all(np.sqrt(np.mean(of_lens**2, axis=0)) > 0.65)
    assert np.all(np.sqrt(np.mean(pulls**2, axis=0)) < 1.5)


def test_sigmas_are_those_of_opencv() -> None:
    seen = seen_corners(CAMERAS["plumb_bob"], 12, 5)
    found = fitted(seen)
    pieces = [seen.image == k for k in range(12)]
    _, K, distortion, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
        [seen.points[p].astype(np.float32) for p in pieces],
        [seen.px[p].astype(np.float32) for p in pieces],
        (SIZE.width, SIZE.height),
        np.eye(3),
        np.zeros(5),
    )
    theirs = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(distortion)])
    ours = intrinsic_values(found.adjusted.camera)
    np.testing.assert_allclose(sigmas(found), np.ravel(sigma)[:9], rtol=0.1)
    assert np.abs((ours - theirs) / sigmas(found)).max() < 0.5  # other weights, the same data


def test_single_corners_and_images_that_disagree_are_left_out() -> None:
    seen = seen_corners(CAMERAS["plumb_bob"], 12, 7)
    px = seen.px.copy()
    rng = np.random.default_rng(1)
    single = np.flatnonzero(seen.image < 11)[::40]
    px[single] += rng.choice([-2.0, 2.0], (len(single), 2))
    px[seen.image == 11] += rng.normal(0.0, 2.0, (np.count_nonzero(seen.image == 11), 2))
    found = fitted(replace(seen, px=px))
    assert list(found.left_out) == [11]
    assert "disagree" in found.left_out[11] or "px off" in found.left_out[11]
    assert found.n_left_out == len(single)
    pulls = (
        intrinsic_values(found.adjusted.camera) - intrinsic_values(CAMERAS["plumb_bob"])
    ) / sigmas(found)
    assert np.abs(pulls).max() < 3.5


def test_noise_that_corners_do_not_claim_is_seen() -> None:
    seen = seen_corners(CAMERAS["plumb_bob"], 12, 9, noise=0.2)
    found = fitted(replace(seen, sigma_px=np.full(len(seen.px), NOISE_PX)))
    assert found.extra_px == pytest.approx(0.2, rel=0.2)
    pulls = (
        intrinsic_values(found.adjusted.camera) - intrinsic_values(CAMERAS["plumb_bob"])
    ) / sigmas(found)
    assert np.abs(pulls).max() < 3.0


def test_boards_parallel_to_the_image_plane_leave_the_focal_length_open() -> None:
    found = fitted(seen_corners(CAMERAS["plumb_bob"], 6, 2, tilt=0.002, noise=0.3))
    with pytest.raises(NotIdentifiable, match=r"leave the focal length open .* tilt the board"):
        refuse_undetermined(found, ["a"] * 6)


def test_weak_views_are_told_with_figures() -> None:
    flat = fitted(seen_corners(CAMERAS["plumb_bob"], 6, 2, tilt=0.08))
    told = " ".join(warnings(flat))
    assert "6 images are few" in told
    assert "The focal length is weakly determined" in told
    assert "out of the image plane" in told
    good = fitted(seen_corners(CAMERAS["plumb_bob"], 14, 2))
    assert warnings(good) == []


def test_corners_in_the_middle_are_told_with_their_share() -> None:
    seen = seen_corners(CAMERAS["plumb_bob"], 14, 4)
    middle = np.all(np.abs(seen.px - [320.0, 240.0]) < [150.0, 110.0], axis=1)
    counts = np.bincount(seen.image[middle], minlength=14)
    keep = middle & (counts[seen.image] >= 12)
    _, image = np.unique(seen.image[keep], return_inverse=True)
    part = BoardCorners(image, seen.points[keep], seen.px[keep], seen.sigma_px[keep])
    told = " ".join(warnings(fitted(part)))
    share = int(told.split("Corners cover ")[1].split(" %")[0])
    assert 15 <= share <= 23


def test_a_model_that_gains_nothing_is_told() -> None:
    plain = fitted(seen_corners(CAMERAS["plumb_bob"], 12, 1), "rational_polynomial")
    assert any("overfits" in sentence for sentence in warnings(plain))


def test_fewer_than_three_images_are_refused() -> None:
    found = fitted(seen_corners(CAMERAS["plumb_bob"], 3, 1))
    refuse_undetermined(found, ["a", "b", "c"])
    with pytest.raises(NotIdentifiable, match=r"found 2 images with the board \(a, b\), needed 3"):
        refuse_undetermined(replace(found, images=(0, 1)), ["a", "b"])
    left_out = ["c: 20 of its 40 corners disagree"]
    words = (
        r"found 2 images with the board that agree \(a, b\), and 1 more that had to be left out "
        r"\(c: 20 of its 40 corners disagree\), needed 3 at least and better 10; see that the board"
    )
    with pytest.raises(NotIdentifiable, match=words):
        refuse_undetermined(replace(found, images=(0, 1)), ["a", "b"], left_out)
