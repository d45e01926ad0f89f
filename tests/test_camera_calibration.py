"""``legcal camera``: cameras from corners and photographs of a board, and all that it refuses."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from camera_sessions import (
    CAMERAS,
    NOISE_PX,
    PINHOLE,
    SIZE,
    drawings,
    photographs,
    seen_corners,
    together,
)
from command_line import run
from lens_choice import WIDE_SIZE, corners_at_the_edge, projection_errors, wide_camera
from thinned import thinned

from legcal import calibrate_camera
from legcal.calibration.camera_calibration.consensus import RobustFit, robust_fit
from legcal.calibration.camera_calibration.diagnostics import (
    noise_correlation,
    refuse_divided,
    refuse_undetermined,
    repeat_noise,
    warnings,
)
from legcal.calibration.camera_calibration.document import CameraCalibration, write_picture
from legcal.calibration.camera_calibration.lens import chosen_lens, given_lens
from legcal.calibration.camera_calibration.projection import compare_cameras, projection_sigma
from legcal.errors import LegcalError, NotIdentifiable, NotVisible, UsageError
from legcal.geometry.types import Array, BoolArray
from legcal.perception.board_adjustment import BoardImages
from legcal.perception.board_corners import certain_corners, search_board
from legcal.vision.board import board_of
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values, with_intrinsics
from legcal.vision.camera_file import read_camera
from legcal.vision.distortion import DistortionModel

MODELS: tuple[DistortionModel, ...] = ("plumb_bob", "rational_polynomial", "equidistant")
SPEC = "chessboard:9x6:30mm"


N_IMAGES = 3


def fitted(seen: BoardImages, model: DistortionModel = "plumb_bob") -> RobustFit:
    found = robust_fit(seen, SIZE, model)
    assert found is not None
    return found


@cache
def fit_of(model: DistortionModel) -> RobustFit:
    """Return the fit of twelve images of a camera with a lens of a model."""
    return fitted(seen_corners(CAMERAS[model], 12, 3), model)


def sigmas(found: RobustFit) -> Array:
    return np.sqrt(np.diag(found.covariance))


def pulls(found: RobustFit, model: DistortionModel = "plumb_bob") -> Array:
    error = intrinsic_values(found.adjusted.camera) - intrinsic_values(CAMERAS[model])
    return np.asarray(error / sigmas(found))


# From corners


@pytest.mark.parametrize("model", MODELS)
def test_every_number_of_the_camera_is_recovered_within_its_sigma(model: DistortionModel) -> None:
    truth = CAMERAS[model]
    found = fit_of(model)
    assert np.abs(pulls(found, model)).max() < 3.0
    assert sigmas(found)[:4].max() < 0.3
    assert 0.8 < found.ratio < 1.7
    assert found.left_out == {}
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [0.0, 479.0], [639.0, 479.0]])
    again = found.adjusted.camera.project(np.column_stack([truth.undistort(corners), np.ones(4)]))
    assert np.abs(again - corners).max() < 3.0


def test_boards_that_all_lean_alike_give_the_camera_within_its_sigma() -> None:
    # From a guess of the focal length by homographies alone both end at 2 to 10 times its value.
    seen = seen_corners(CAMERAS["plumb_bob"], 5, 31, tilt=0.03, lean=0.4, roll=0.03)
    found = fitted(seen)
    assert np.abs(pulls(found)).max() < 4.0
    assert 0.5 < sigmas(found)[0] < 30.0


def test_sigmas_are_those_of_opencv_and_a_little_for_what_the_sheet_may_be() -> None:
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
    wider = sigmas(found) / np.ravel(sigma)[:9]
    assert np.all((wider > 0.95) & (wider < 1.25))
    assert np.abs((ours - theirs) / sigmas(found)).max() < 0.5  # other weights, the same data


SHEET = np.array([9e-4, -6e-4, 4e-4, 3e-3])  # bent by about a millimetre, printed 0.3 % too wide


def test_a_board_that_is_bent_and_printed_too_wide_gives_the_same_camera() -> None:
    found = fitted(seen_corners(CAMERAS["plumb_bob"], 14, 2, sheet=SHEET))
    assert np.abs(pulls(found)).max() < 3.0
    off = found.sheet - SHEET
    covariance = found.all_covariance[-4:, -4:]
    assert off @ np.linalg.solve(covariance, off) < 4.0 * 4
    assert np.all(np.abs(SHEET) > 10.0 * np.sqrt(np.diag(covariance)))
    assert found.adjusted.residual.std() < 1.05 * NOISE_PX


@pytest.mark.system
def test_errors_that_corners_of_an_image_share_are_in_the_sigmas() -> None:
    squares = []
    for seed in range(4):
        found = fitted(seen_corners(CAMERAS["plumb_bob"], 10, seed, smooth=0.06, sheet=SHEET))
        off = intrinsic_values(found.adjusted.camera) - intrinsic_values(CAMERAS["plumb_bob"])
        squares.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        assert np.median(found.corners.sigma_px) < 0.1
        # They share errors of 0.06 px over about 60 px, and have 0.03 px each.
        length, effective = noise_correlation(found.corners, found.adjusted.residual)
        assert 10.0 < length < 150.0
        assert effective < 0.5
        plain = fitted(seen_corners(CAMERAS["plumb_bob"], 10, seed))
        assert noise_correlation(plain.corners, plain.adjusted.residual)[0] == 0.0
    assert 0.4 < np.mean(squares) < 1.8


def test_an_image_that_a_splined_lens_leaves_out_is_named() -> None:
    seen = seen_corners(CAMERAS["equidistant"], 12, 7)
    moved = np.where(seen.image[:, None] == 11, [30.0, 12.0], 0.0)
    found = fitted(replace(seen, px=seen.px + moved), "splined_radial")
    assert list(found.left_out) == [11]
    assert "as with stabilisation or another crop" in found.left_out[11]


def still(camera: Camera, n: int, shared: float, noise: float, length: float) -> BoardImages:
    """Return pairs of images of a board that stands still.

    Each corner has noise that is correlated over a length [px], and an error that comes back.
    """
    rng = np.random.default_rng(5)
    parts = []
    for seed in range(n):
        one = seen_corners(camera, 1, seed, noise=1e-9)
        same = shared * rng.standard_normal(one.px.shape)
        for _ in range(2):
            apart = np.linalg.norm(one.px[:, None] - one.px, axis=-1)
            root = np.linalg.cholesky(np.exp(-apart / length))
            error = noise * root @ rng.standard_normal(one.px.shape)
            px = one.px + same + error
            parts.append(replace(one, px=px, sigma_px=np.full(len(px), NOISE_PX)))
    return together(*parts)


@pytest.mark.parametrize("shared", [0.0, 0.06])
def test_images_of_a_board_that_stands_still_tell_the_noise_of_corners(shared: float) -> None:
    """What print and lens do to a corner comes back and does not count."""
    camera, n = CAMERAS["plumb_bob"], 12
    fit = fitted(together(*(seen_corners(camera, 1, seed) for seed in range(n))))
    found = repeat_noise(fit, still(camera, n, shared, NOISE_PX, 1.0), range(n))
    assert found is not None
    assert found.pairs == n
    assert found.noise_px == pytest.approx(NOISE_PX, rel=0.06)
    assert found.length_px == 0.0
    smooth = repeat_noise(fit, still(camera, n, shared, NOISE_PX, 80.0), range(n))
    assert smooth is not None
    assert 20.0 < smooth.length_px < 80.0  # what spans the board moves its pose instead
    copies = still(camera, n, shared, 1e-6, 30.0)
    assert repeat_noise(fit, copies, range(n)) is None


def test_single_corners_and_images_that_disagree_are_left_out() -> None:
    seen = seen_corners(CAMERAS["plumb_bob"], 12, 7)
    px = seen.px.copy()
    rng = np.random.default_rng(1)
    single = np.flatnonzero(seen.image < 11)[::40]
    px[single] += rng.choice([-2.0, 2.0], (len(single), 2))
    px[seen.image == 11] += rng.normal(0.0, 2.0, (np.count_nonzero(seen.image == 11), 2))
    found = fitted(replace(seen, px=px))
    assert list(found.left_out) == [11]
    assert found.left_out[11]
    assert found.n_left_out == len(single)
    assert np.abs(pulls(found)).max() < 3.5


TRUTH = CAMERAS["plumb_bob"]
CENTRE = np.array([[0.0, 0.0, 312.4], [0.0, 0.0, 244.9], [0.0, 0.0, 0.0]])
ZOOMED, FAR_ZOOMED = (
    replace(TRUTH, K=np.diag([1.0 + by, 1.0 + by, 1.0]) @ TRUTH.K - by * CENTRE)
    for by in (0.04, 0.5)
)


def shifted(seen: BoardImages) -> BoardImages:
    """Return corners of photographs that stabilisation has put aside."""
    return replace(seen, px=seen.px + np.array([12.0, 5.0]))


def mirrored(seen: BoardImages) -> BoardImages:
    """Return corners of photographs that were mirrored, numbered as those of a board are."""
    px = np.where([True, False], SIZE.width - 1.0 - seen.px, seen.px)
    return replace(seen, px=px, points=seen.points * [-1.0, 1.0, 1.0] + [0.21, 0.0, 0.0])


def corrected(seen: BoardImages) -> BoardImages:
    """Return corners of photographs whose distortion a program has taken out."""
    xy = np.column_stack([TRUTH.undistort(seen.px), np.ones(len(seen.px))])
    return replace(seen, px=(xy @ TRUTH.K.T)[:, :2])


OTHERS: dict[str, Callable[[], BoardImages]] = {
    "focal length about 4 % longer": lambda: five(ZOOMED),
    "px off (rms) before the camera of the others": lambda: mirrored(five()),
    "another distortion of the lens": lambda: corrected(five()),
    "beside that of the others": lambda: shifted(five()),
}


def five(camera: Camera = TRUTH) -> BoardImages:
    return seen_corners(camera, 5, 8, sheet=SHEET)


@pytest.mark.parametrize("why", thinned(OTHERS, ["beside that of the others"]))
def test_a_third_of_the_images_wrong_alike_is_named_and_moves_nothing(why: str) -> None:
    others = OTHERS[why]()
    found = fitted(together(others, seen_corners(TRUTH, 10, 2, sheet=SHEET)))
    assert set(found.left_out) == set(range(5))
    assert sum(why in reason for reason in found.left_out.values()) >= 3
    assert np.abs(pulls(found)).max() < 3.0
    refuse_divided(found, [str(k) for k in range(15)])


def test_two_groups_of_one_size_are_refused_and_named() -> None:
    found = fitted(together(seen_corners(ZOOMED, 5, 8), seen_corners(TRUTH, 5, 2)))
    with pytest.raises(NotIdentifiable) as refused:
        refuse_divided(found, [f"{k}.jpg" for k in range(10)])
    for word in ("two groups", "0.jpg, 1.jpg", "5.jpg, 6.jpg", "focal length about"):
        assert word in str(refused.value)
    uneven = fitted(together(five(FAR_ZOOMED), seen_corners(TRUTH, 6, 2, sheet=SHEET)))
    assert set(uneven.left_out) == set(range(5))  # though the first fit follows the fewer
    few = replace(found, rival=(), images=found.images[:5], left_out=dict.fromkeys(range(7), "?"))
    with pytest.raises(NotIdentifiable, match="only 5 of 12 images agree"):
        refuse_divided(few, [f"{k}.jpg" for k in range(12)])


@pytest.mark.system
@pytest.mark.parametrize(
    ("model", "reason"),
    [
        ("equidistant", ("19 images agree on it", "plumb_bob")),
        ("splined_radial", ("of 19 images that it has not seen better", "rational_polynomial")),
    ],
)
def test_few_images_at_the_edge_of_a_lens_choose_it_and_are_not_accused(
    model: DistortionModel, reason: tuple[str, ...]
) -> None:
    """The many in the middle suit plumb_bob, which leaves the others out."""
    truth = wide_camera(model)
    seen = corners_at_the_edge(truth, 19, 2, np.random.default_rng(3))
    plain = robust_fit(seen, WIDE_SIZE, "plumb_bob")
    assert plain is not None
    assert {17, 18} <= set(plain.left_out)
    assert "part of the image that the others do not" in plain.left_out[18]
    chosen = chosen_lens(seen, WIDE_SIZE)
    assert chosen is not None
    fit = chosen.fit
    assert fit.adjusted.camera.model == model
    assert fit.left_out == {}
    assert all(words in chosen.reason for words in reason)
    assert chosen.validated_px is not None
    residual_px = np.sqrt(np.mean(np.sum(fit.adjusted.residual**2, axis=1)))
    assert residual_px < chosen.validated_px < 1.5 * residual_px
    errors = projection_errors(truth, fit.adjusted.camera, fit.covariance)
    assert errors.max() < 3.0
    assert np.mean(errors > 0.0) > 0.9  # corners of the image may be far from any board
    assert sigmas(fit)[:4].max() < 0.3


@pytest.mark.parametrize(
    ("model", "n_edge", "seeds"),
    [("plumb_bob", 3, [49, 0, 5002]), ("splined_radial", 9, [49, 4, 5108])],
)
def test_no_image_is_accused_for_the_wrong_one_of_the_two_poses_of_a_plane(
    model: DistortionModel, n_edge: int, seeds: list[int]
) -> None:
    """One and two boards near the corners of these sets once started with it, and kept it."""
    seen = corners_at_the_edge(wide_camera(model), 35, n_edge, np.random.default_rng(seeds))
    fit = robust_fit(seen, WIDE_SIZE, model)
    assert fit is not None
    assert fit.left_out == {}


def test_the_simplest_lens_model_stays_where_it_fits_and_a_given_one_is_warned_of() -> None:
    seen = seen_corners(TRUTH, 8, 1)
    chosen = chosen_lens(seen, SIZE)
    assert chosen is not None
    assert chosen.fit.adjusted.camera.model == "plumb_bob"
    bulge = seen.px - [320.0, 240.0]
    far = np.sum((bulge / 400.0) ** 2, axis=1, keepdims=True)
    ripple = replace(seen, px=seen.px + 0.02 * bulge * np.cos(18.0 * far) * far)
    given = given_lens(ripple, SIZE, "plumb_bob")
    assert given is not None
    assert "as given" in given.reason
    assert "leave out --model" in " ".join(given.warnings)


def test_cameras_of_one_covariance_differ_as_it_says_of_the_projection() -> None:
    fit = fit_of("plumb_bob")
    camera = replace(fit.adjusted.camera, covariance=fit.covariance)
    values, names = intrinsic_values(camera), intrinsic_names(camera)
    rng = np.random.default_rng(0)
    off = []
    for drawn in rng.multivariate_normal(values, fit.covariance, 80):
        other = with_intrinsics(camera, dict(zip(names, drawn.tolist(), strict=True)))
        comparison = compare_cameras(camera, other)
        assert comparison.sigma_px is not None
        off.append(comparison.off_px)
    spread = np.einsum("dni,dnj->nij", off, off) / len(off)
    sigma = projection_sigma(camera, fit.covariance)
    ratio = np.sqrt(np.linalg.eigvalsh(spread)[:, -1]) / sigma
    assert 0.8 < ratio.min() < ratio.max() < 1.25
    # A shift of the principal point is a turn, but for distortion and perspective.
    shifted_camera = with_intrinsics(camera, {"cx": values[2] + 1.0})
    turned = compare_cameras(camera, replace(shifted_camera, covariance=None))
    assert turned.sigma_px is None
    assert turned.turn == pytest.approx(1.0 / values[0], rel=0.3)
    assert turned.px.max() < 1.0
    with pytest.raises(UsageError, match="one size"):
        compare_cameras(camera, PINHOLE)


def shown_in(seen: BoardImages, part: BoolArray) -> BoardImages:
    """Return the corners in a part of the image, of images that have twelve there."""
    enough = np.bincount(seen.image[part], minlength=seen.image.max() + 1) >= 12
    keep = part & enough[seen.image]
    _, image = np.unique(seen.image[keep], return_inverse=True)
    return BoardImages(image, seen.points[keep], seen.px[keep], seen.sigma_px[keep])


def test_what_images_hardly_determine_is_warned_of_with_figures() -> None:
    flat = " ".join(warnings(fitted(seen_corners(CAMERAS["plumb_bob"], 6, 2, tilt=0.08))))
    for words in (
        "6 images are few",
        "focal length is weakly determined",
        "out of the image plane",
    ):
        assert words in flat
    good = seen_corners(CAMERAS["plumb_bob"], 14, 4)
    assert warnings(fitted(good)) == []
    part = shown_in(good, np.all(np.abs(good.px - [320.0, 240.0]) < [150.0, 110.0], axis=1))
    said = " ".join(warnings(fitted(part)))
    hull = cv2.contourArea(cv2.convexHull(part.px.astype(np.float32))) / (640 * 480)
    assert int(said.split("Corners cover ")[1].split(" %")[0]) == round(100 * hull)


def test_a_board_that_is_not_as_stated_is_named_and_what_to_add() -> None:
    wide = fitted(seen_corners(TRUTH, 12, 2, sheet=np.array([0.0, 0.0, 0.0, 0.025])))
    assert np.abs(pulls(wide)).max() < 4.0
    assert "2.5 % wider than high" in " ".join(warnings(wide))
    bent = fitted(seen_corners(TRUTH, 12, 2, sheet=np.array([9e-3, 0.0, 0.0, 0.0])))
    assert "bent by 9 mm" in " ".join(warnings(bent))
    seen = seen_corners(TRUTH, 12, 4)
    higher = replace(seen, px=seen.px * [1.0, 1.04] - [0.0, 10.0])
    assert "along y" in " ".join(warnings(fitted(higher)))
    part = shown_in(seen, np.all(seen.px < 300.0, axis=1))
    said = " ".join(warnings(fitted(part)))
    missing = said.split("bring the board to ")[1].split(" of the image")[0].split(", ")
    assert {"the right", "the bottom", "the bottom right"} <= set(missing)
    assert "the top left" not in missing


def test_undetermined_cameras_are_refused_with_figures() -> None:
    parallel = fitted(seen_corners(CAMERAS["plumb_bob"], 6, 2, tilt=0.002, noise=0.3))
    few = fitted(seen_corners(CAMERAS["plumb_bob"], 3, 1))
    refuse_undetermined(few, ["a", "b", "c"])
    factor = (0.1 * few.adjusted.camera.K[0, 0] / sigmas(few)[0]) ** 2
    weak = replace(few, all_covariance=factor * few.all_covariance)
    knots = np.array([0.0, 0.0, -0.6, 0.0, 0.0, 0.0])
    bent = replace(few.adjusted.camera, distortion=knots, model="splined_radial")
    folded = replace(few, adjusted=replace(few.adjusted, camera=bent))
    pair, left_out = replace(few, images=(0, 1)), ["c: 20 of its 40 corners disagree"]
    for found, names, others, named in (
        (parallel, ["a"] * 6, [], ("focal length open", "tilt the board")),
        (weak, ["a", "b", "c"], [], ("focal length open",)),
        (folded, ["a", "b", "c"], [], ("splined lens", "stops growing", "leave out --model")),
        (pair, ["a", "b"], [], ("2 images", "(a, b)", "3")),
        (pair, ["a", "b"], left_out, ("2 images", "1 more", left_out[0], "3")),
    ):
        with pytest.raises(NotIdentifiable) as refused:
            refuse_undetermined(found, names, others)
        assert [word for word in named if word not in str(refused.value)] == []


# From photographs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of a chessboard, one twice, one that stands still, one of nothing, and of macOS."""
    path = tmp_path_factory.mktemp("boards")
    drawings(path, PINHOLE, N_IMAGES)
    cv2.imwrite(str(path / "empty.png"), np.full((336, 448), 90, dtype=np.uint8))
    (path / "same.png").write_bytes((path / "b00.png").read_bytes())
    first = cv2.imread(str(path / "b00.png"))
    assert first is not None
    cv2.imwrite(str(path / "still.png"), np.roll(first, 1, axis=1))
    (path / "._b00.png").write_bytes(b"Mac OS X")
    return path


@pytest.fixture(scope="module")
def found(folder: Path) -> CameraCalibration:
    picture = folder.parent / f"{folder.name}-field.png"
    return calibrate_camera(folder, SPEC, output=folder / "camera.yaml", picture=picture)


def test_pictures_give_the_camera_that_took_them(found: CameraCalibration) -> None:
    assert np.abs((found.values - intrinsic_values(PINHOLE)) / found.sigma).max() < 3.0
    assert found.sigma[0] < 1.0
    assert found.rms_px < 0.03
    said = " ".join(found.warnings)
    assert "empty.png left out: the board was not found." in said
    assert "same.png left out: the same photograph as b00.png." in said
    assert "still.png left out: the board stands as in b00.png." in said
    assert f"{N_IMAGES} images are few" in said
    document = found.document()
    tilts = [image["tilt_rad"] for image in document["images"]]
    assert tilts[:N_IMAGES] == pytest.approx([0.5] * N_IMAGES, abs=0.05)  # as they were drawn
    assert tilts[N_IMAGES] is None
    assert [i["sigma"] for i in document["intrinsics"]] == found.sigma.tolist()


@pytest.mark.parametrize("spec", ["asymmetric_circles:4x11:20mm:14mm", "circles:7x5:32mm:20mm"])
def test_grids_of_circles_give_the_camera_that_took_them(spec: str, tmp_path: Path) -> None:
    images = drawings(tmp_path, PINHOLE, 4, board_of(spec), 0.46)
    found = calibrate_camera(images, spec, model="plumb_bob")
    assert np.abs((found.values - intrinsic_values(PINHOLE)) / found.sigma).max() < 3.0
    assert all(image.used for image in found.images)
    assert found.rms_px < 0.1
    with pytest.raises(UsageError, match="gaps"):
        calibrate_camera(images, spec.rsplit(":", 1)[0] + ":35mm")


def test_an_image_with_one_row_of_corners_is_left_out_by_name(tmp_path: Path) -> None:
    board = board_of("charuco:9x6:30mm:22mm:DICT_5X5_100")
    paths = photographs(tmp_path, PINHOLE, 4, board=board)
    image = np.asarray(cv2.imread(str(paths[3]), cv2.IMREAD_GRAYSCALE))
    number, px, _ = certain_corners(board, search_board(board, image))
    rows = [px[number // board.grid[0] == k] for k in range(2)]
    below = [np.polyfit(row[:, 0], row[:, 1], 1) for row in rows]
    u, v = np.meshgrid(np.arange(PINHOLE.width), np.arange(PINHOLE.height))
    hidden = v > 0.1 * np.polyval(below[0], u) + 0.9 * np.polyval(below[1], u)
    cv2.imwrite(str(paths[3]), np.where(hidden, 120, image).astype(np.uint8))
    found = calibrate_camera(tmp_path, board)
    assert found.images[3].reason == "only corners on one line of the board were found"
    assert [image.used > 0 for image in found.images] == [True] * 3 + [False]


def test_ten_copies_shifted_by_some_pixels_are_one_image(tmp_path: Path) -> None:
    (path,) = drawings(tmp_path, PINHOLE, 1)
    image = np.asarray(cv2.imread(str(path)))
    for k in range(1, 10):
        cv2.imwrite(str(tmp_path / f"s{k}.png"), np.roll(image, (k, -k), (0, 1)))
    with pytest.raises(NotIdentifiable, match=r"found 1 image.*only shifted in the picture"):
        calibrate_camera(tmp_path, SPEC)


def test_the_file_is_a_camera_info_with_the_whole_covariance(
    found: CameraCalibration, folder: Path
) -> None:
    camera = read_camera(folder / "camera.yaml")
    np.testing.assert_array_equal(intrinsic_values(camera), found.values)
    assert camera.covariance is not None
    scale = np.outer(found.sigma, found.sigma)
    np.testing.assert_allclose(camera.covariance / scale, found.covariance / scale, atol=1e-12)
    assert np.linalg.eigvalsh(camera.covariance / scale)[0] > 0.0
    document = yaml.safe_load((folder / "camera.yaml").read_text())
    assert list(document)[:6] == [
        "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model",
        "distortion_coefficients",
    ]  # fmt: skip
    names = [i["image"] for i in document["legcal_camera"]["images"]]
    assert names == [f"b{k:02d}.png" for k in range(N_IMAGES)]
    sigma = document["legcal_camera"]["sigma"]
    np.testing.assert_allclose([sigma[n] for n in found.names], found.sigma, rtol=1e-5)


@pytest.mark.usefixtures("found")
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("{}/camera.yaml {}/camera.yaml --compare --json", 0, '"largest_px": '),
        ("{}/camera.yaml {}/camera.yaml --compare", 0, "bottom right"),
        ("{}/camera.yaml {}/camera.yaml --compare", 0, "100 % of the image compared."),
        ("{}/camera.yaml --compare", 2, "needed legcal camera A B --compare"),
        ("{}/camera.yaml --to opencv -o {}/opencv.yml", 0, "files of opencv do not hold it"),
        ("{}/camera.yaml --to ros -o {}/ros.yaml", 0, "written: "),
        ("{}/camera.yaml --to ros -o {}/c.yml --model plumb_bob", 2, "--model, --picture"),
        ("{}/camera.yaml --to ros -o {}/c.yml --picture {}/c.png", 2, "--model, --picture"),
        ("{}/camera.yaml --to opencv", 2, "found no --output"),
        ("{}/camera.yaml {}/camera.yaml --to opencv -o {}/c.yml", 2, "a single camera file"),
        ("{}/b00.png -o {}/c.yml", 2, "found no --board"),
    ],
)
def test_camera_files_are_compared_and_converted_by_the_command(
    folder: Path, arguments: str, code: int, said: str
) -> None:
    outcome = run("camera", *arguments.replace("{}", str(folder)).split())
    assert outcome.code == code
    assert said in outcome.said


@pytest.mark.usefixtures("found")
@pytest.mark.parametrize(("names", "rows"), [(["cx", "fx"], [[4.0, -0.9], [-0.9, 1.0]]), ([], [])])
def test_a_covariance_written_into_a_camera_file_is_taken(
    folder: Path, tmp_path: Path, names: list[str], rows: list[list[float]]
) -> None:
    """What docs/formats.md says: names and covariance alone; all others are exact."""
    document, path = yaml.safe_load((folder / "camera.yaml").read_text()), tmp_path / "camera.yaml"
    document["legcal_camera"] = {"version": 1, "names": names, "covariance": rows}
    path.write_text(yaml.safe_dump(document))
    camera = read_camera(path)
    intrinsics, expected = intrinsic_names(camera), np.zeros((9, 9))
    indices = [intrinsics.index(name) for name in names]
    expected[np.ix_(indices, indices)] = np.array(rows).reshape(len(names), len(names))
    assert camera.covariance is not None
    np.testing.assert_allclose(camera.covariance, expected)


def test_the_picture_shows_where_corners_were_seen_and_replaces_only_itself(
    found: CameraCalibration, folder: Path
) -> None:
    path = folder.parent / f"{folder.name}-field.png"
    shown = cv2.imread(str(path))
    assert shown is not None
    assert shown.shape[1] == 1280
    red = np.all(np.abs(shown.astype(int) - [60, 60, 140]) < 10, axis=-1)
    factor = 1280 / PINHOLE.width
    seen = np.rint((found.corners[:, :2] + 0.5) * factor).astype(int)
    assert not red[seen[:, 1], seen[:, 0]].any()
    assert red[5, 5]
    write_picture(found, path)  # an earlier picture is replaced
    cv2.imwrite(str(path), np.zeros((4, 4), np.uint8))
    with pytest.raises(UsageError, match="another file of that name"):
        write_picture(found, path)
    one = folder.parent / "both"
    with pytest.raises(UsageError, match="found the file of the camera there"):
        calibrate_camera(folder, SPEC, output=one, picture=one)


@pytest.mark.parametrize(
    ("images", "board", "kind", "named"),
    [
        (lambda f: [f / "empty.png"], "charuco:7x5:40mm:29mm:DICT_4X4_50", NotVisible,
         ("nothing like the board", "1 image", "ChArUco")),
        (lambda f: [f / "b00.png", f / "b01.png"], SPEC, NotIdentifiable,
         ("2 images", "b00.png", "b01.png")),
        (lambda f: [f / "b00.png", f / "b01.png", f / "same.png", f / "still.png"], SPEC,
         NotIdentifiable, ("2 images", "2 more", "same.png: the same photograph as b00.png",
                           "still.png: the board stands as in b00.png", "tilted to all sides")),
        (lambda f: [f / "b00.png"], "chessboard:8x6", NotVisible, ("found a chessboard of",)),
    ],
)  # fmt: skip
def test_images_that_give_no_camera_are_refused_by_name(
    folder: Path,
    tmp_path: Path,
    images: Callable[[Path], list[Path]],
    board: str,
    kind: type[LegcalError],
    named: tuple[str, ...],
) -> None:
    with pytest.raises(kind) as refused:
        calibrate_camera(images(folder), board, output=tmp_path / "c.yaml")
    assert [word for word in named if word not in str(refused.value)] == []
    assert not (tmp_path / "c.yaml").exists()
