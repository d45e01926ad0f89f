"""``legcal camera``: from photographs to a camera file, and all that it refuses."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from camera_sessions import CAMERAS, PINHOLE, drawings, photographs
from numpy.typing import NDArray

from legcal import calibrate_camera, cli
from legcal.calibration import CameraCalibration
from legcal.calibration.joint_fit.choices import Prior, known_parameters, resolve
from legcal.data.measurements import View
from legcal.data.overrides import overrides_of_call
from legcal.errors import DatasetError, NotIdentifiable, NotVisible, UsageError
from legcal.geometry.types import Array, IntArray
from legcal.machine import load_mechanism
from legcal.perception import find_corners
from legcal.vision import Board, board_of
from legcal.vision.camera import DistortionModel, intrinsic_values
from legcal.vision.camera_file import read_camera

SPEC = "chessboard:9x6:30mm"
CHARUCO = Board("charuco", 7, 5, 0.04, marker=0.029, dictionary="DICT_4X4_50")
N_IMAGES = 4
SEARCHED: dict[object, tuple[IntArray, Array, Array]] = {}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures of a chessboard, and one that shows nothing."""
    path = tmp_path_factory.mktemp("boards")
    drawings(path, PINHOLE, N_IMAGES)
    cv2.imwrite(str(path / "empty.png"), np.full((336, 448), 90, dtype=np.uint8))
    return path


@pytest.fixture(scope="module")
def found(folder: Path) -> CameraCalibration:
    return calibrate_camera(folder, SPEC, output=folder / "camera.yaml")


@pytest.fixture(autouse=True)
def search_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Search no picture twice for the same board."""

    def search(board: Board, image: NDArray[np.generic]) -> tuple[IntArray, Array, Array]:
        key = (board.kind, board.grid, hash(image.tobytes()))
        if key not in SEARCHED:
            SEARCHED[key] = find_corners(board, image)
        return SEARCHED[key]

    monkeypatch.setattr("legcal.calibration.camera_calibration.calibration.find_corners", search)


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    command = ["legcal", "camera", *map(str, words), "--workers", "1"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_pictures_give_the_camera_that_took_them(found: CameraCalibration) -> None:
    truth = intrinsic_values(PINHOLE)
    assert np.abs((found.values - truth) / found.sigma).max() < 3.0
    assert found.sigma[0] < 1.0
    assert found.rms_px < 0.03


def test_the_file_is_read_with_its_sigmas_and_is_a_camera_info(
    found: CameraCalibration, folder: Path
) -> None:
    camera = read_camera(folder / "camera.yaml")
    np.testing.assert_array_equal(intrinsic_values(camera), found.values)
    sigma = [camera.sigma[name] for name in found.names]
    np.testing.assert_allclose(sigma, found.sigma, rtol=1e-5)
    document = yaml.safe_load((folder / "camera.yaml").read_text())
    assert list(document)[:6] == [
        "image_width",
        "image_height",
        "camera_name",
        "camera_matrix",
        "distortion_model",
        "distortion_coefficients",
    ]
    assert [i["image"] for i in document["legcal_camera"]["images"]] == [
        f"b{k:02d}.png" for k in range(N_IMAGES)
    ]


def test_its_sigmas_are_the_priors_of_intrinsics_that_are_freed(
    found: CameraCalibration, folder: Path
) -> None:
    view = View("c1", read_camera(folder / "camera.yaml"))
    known = known_parameters(load_mechanism("hexapod"), [view])
    choices = resolve(overrides_of_call(free=["c1.f?", "c1.cx"], priors=["c1.cx=310+-2"]), known)
    assert choices.free == frozenset()
    assert set(choices.priors) == {"c1.fx", "c1.fy", "c1.cx"}
    assert choices.priors["c1.fx"].mean == found.values[0]
    assert choices.priors["c1.fx"].sigma == pytest.approx(found.sigma[0], rel=1e-5)
    assert choices.priors["c1.cx"] == Prior(310.0, 2.0)
    unknown = replace(view, camera=replace(view.camera, sigma={}))
    known = known_parameters(load_mechanism("hexapod"), [unknown])
    assert resolve(overrides_of_call(free=["c1.fx"]), known).free == {"c1.fx"}


def test_sigmas_of_other_names_are_refused(folder: Path, tmp_path: Path) -> None:
    text = (folder / "camera.yaml").read_text()
    path = tmp_path / "camera.yaml"
    path.write_text(text.replace("sigma: {fx:", "sigma: {f:"))
    with pytest.raises(DatasetError, match=r"legcal_camera.sigma could not be used: found f, "):
        read_camera(path)
    path.write_text(text.replace("sigma: {fx: ", "sigma: {fx: -"))
    with pytest.raises(DatasetError, match=r"legcal_camera.sigma.fx"):
        read_camera(path)


def test_images_without_the_board_are_named_and_few_are_told(found: CameraCalibration) -> None:
    told = " ".join(found.warnings)
    assert "empty.png left out: the board was not found." in told
    assert f"{N_IMAGES} images are few" in told


def test_people_read_images_numbers_and_warnings(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    three = [folder / f"b{k:02d}.png" for k in range(3)]
    assert run(monkeypatch, *three, "--board", SPEC, "-o", tmp_path / "c.yaml") == 0
    printed = capsys.readouterr()
    assert "b00.png" in printed.out
    assert "40/40" in printed.out
    assert "fx" in printed.out
    assert "warning: 3 images are few" in printed.out
    assert "Searching the board: 3/3" in printed.err


@pytest.mark.slow
def test_json_names_another_board_that_is_there(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    words = ("--board", "chessboard:8x6", "-o", tmp_path / "c.yaml", "--json")
    assert run(monkeypatch, folder / "b00*.png", *words) == 1
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["kind"] == "NotVisible"
    assert "found a chessboard of" in error["message"]
    assert not (tmp_path / "c.yaml").exists()


def test_images_that_show_no_board_are_refused(folder: Path) -> None:
    with pytest.raises(NotVisible, match=r"found nothing like the board in its 1 image, needed a"):
        calibrate_camera(folder / "empty.png", "charuco:7x5:40mm:29mm:DICT_4X4_50")


def test_too_few_images_are_refused(folder: Path) -> None:
    two = [folder / "b00.png", folder / "b01.png"]
    with pytest.raises(NotIdentifiable, match=r"found 2 images with the board \(b00.png, b01.png"):
        calibrate_camera(two, SPEC)


def test_images_of_another_size_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "turned.png"), np.zeros((448, 336), dtype=np.uint8))
    with pytest.raises(
        DatasetError, match=r"448 x 336 px in b00.png, .*; 336 x 448 px in turned.png"
    ):
        calibrate_camera([folder, tmp_path / "turned.png"], SPEC)


def test_damaged_and_missing_images_are_refused_by_name(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "cut.png").write_bytes((folder / "b00.png").read_bytes()[:2000])
    with pytest.raises(DatasetError, match=r"cut.png: .* found a PNG cut off after 2000 bytes"):
        calibrate_camera([folder, tmp_path / "cut.png"], SPEC)
    assert run(monkeypatch, tmp_path / "no*.png", "--board", SPEC, "-o", tmp_path / "c.yaml") == 2
    assert "found no such file, folder with images or pattern" in capsys.readouterr().err


def test_only_cameras_of_this_command_are_replaced(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "camera_info.yaml"
    other.write_text("image_width: 640\n")
    with pytest.raises(UsageError, match=r"found another file of that name"):
        calibrate_camera(folder, SPEC, output=other)
    assert other.read_text() == "image_width: 640\n"
    with pytest.raises(UsageError, match=r"found no folder"):
        calibrate_camera(folder, SPEC, output=tmp_path / "no" / "camera.yaml")
    with pytest.raises(UsageError, match=r"found a folder"):
        calibrate_camera(folder, SPEC, output=tmp_path)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("chessbord:9x6", "needed a YAML file or one of: chessboard:9x6:25mm"),
        ("chessboard:9", "needed chessboard:9x6:25mm"),
        ("chessboard:3x6", "found 3 x 6 squares, needed 4 to 100 squares"),
        ("chessboard:9x6:25", "needed a number and its unit"),
        ("chessboard:9x6:25m", "found squares of 25000 mm"),
        ("charuco:7x5:40mm:29mm", "needed charuco:7x5:40mm:29mm:DICT_4X4_50"),
        ("charuco:7x5:40mm:29mm:DICT_4X4_51", "needed a dictionary of OpenCV; did you mean"),
        ("charuco:7x5:29mm:40mm:DICT_4X4_50", "exchange marker and square"),
        ("charuco:7x5:40mm:29mm:DICT_4X4_50:old", "needed legacy, or nothing"),
        ("aprilgrid:6x6:88mm:wide", "needed the gap as a number"),
        ("aprilgrid:6x6:88mm:9", "needed 0.05 to 2"),
    ],
)
def test_boards_that_cannot_be_meant_are_refused(spec: str, message: str) -> None:
    with pytest.raises(UsageError) as refused:
        board_of(spec)
    assert message in str(refused.value)
    assert len(refused.value.problems) == 1


def test_boards_are_described_in_a_word_or_a_file(tmp_path: Path) -> None:
    board = board_of("charuco:7x5:40mm:29mm:DICT_4X4_50:legacy")
    assert (board.columns, board.rows, board.side, board.legacy) == (7, 5, 0.04, True)
    board = board_of("aprilgrid:6x5:88mm:0.3")
    assert (board.kind, board.columns, board.rows, board.spacing) == ("aprilgrid", 6, 5, 0.3)
    assert board_of("chessboard:9x7").grid == (8, 6)  # looks the same after half a turn
    path = tmp_path / "dataset.yaml"
    path.write_text("board: {kind: chessboard, squares_x: 9, squares_y: 6, square: 0.03}\n")
    assert board_of(path).side == 0.03


@pytest.mark.slow
@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_photographs_of_other_lenses_and_boards_give_their_cameras(
    model: DistortionModel, tmp_path: Path
) -> None:
    paths = photographs(tmp_path, CAMERAS[model], 10, board=CHARUCO)
    found = calibrate_camera(paths, CHARUCO, model=model)
    pulls = (found.values - intrinsic_values(CAMERAS[model])) / found.sigma
    assert np.abs(pulls[:2]).max() < 3.0
    assert np.abs(pulls).max() < 4.0
