"""Cameras that do not stand still between the images of a view: their moves, by the background."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as tried
from hypothesis import strategies as st
from simulated import settings, small_camera, standing

from legcal import calibrate, detect, load_dataset, simulate
from legcal.calibration.diagnosis import NONE_EXPLAINS
from legcal.calibration.ordered_dataset import order_dataset
from legcal.data.measurements import Measurements, View
from legcal.data.photograph_notes import notes_on_moves
from legcal.errors import NotVisible
from legcal.geometry.types import Array
from legcal.perception.alignment import camera_moves, is_moved
from legcal.progress import no_progress
from legcal.simulation.settings import Level
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey, Move
from legcal.workers import in_turn

WIDTH, HEIGHT, N = 640, 480, 7
K = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])
CORNERS = np.array([[x, y, 1.0] for x in (-320.0, 320.0) for y in (-240.0, 240.0)])
S = TypeVar("S")
T = TypeVar("T")
SIZES = np.array([1.0, 1.0, 1e-3, 1e-3, 2e-6, 2e-6])


def move(x: float, y: float = 0.0, zoom: float = 0.0) -> Move:
    return Move(x, y, zoom, 0.0, 0.0, 0.0)


def at_corners(move: Move) -> Array:
    """Return how a move shifts the corners of an image, (4, 2) [px]."""
    there = CORNERS @ move.homography.T
    return np.asarray(there[:, :2] / there[:, 2:] - CORNERS[:, :2])


def texture(seed: int) -> Grey:
    """Return a background with structure of a few pixels."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, WIDTH))
    fine, coarse = (cv2.GaussianBlur(noise, (0, 0), size) for size in (2, 12))
    both = fine / fine.std() + coarse / coarse.std()
    return np.asarray(110.0 + 18.0 * both, dtype=np.float32)


def moved(picture: Grey, move: Move) -> Grey:
    """Return what a camera takes of a picture that has moved, by other code than undoes it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    middle = 0.5 * np.array([WIDTH - 1, HEIGHT - 1])
    p = np.stack([u.ravel() - middle[0], v.ravel() - middle[1], np.ones(u.size)])
    from_there = np.linalg.solve(move.homography, p)
    u, v = (
        (from_there[k] / from_there[2] + middle[k]).reshape(u.shape).astype(np.float32)
        for k in range(2)
    )
    return np.asarray(cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))


def taken(background: Grey, moves: list[Move], seed: int = 0) -> list[Grey]:
    """Return noisy images of a background, with a leg elsewhere and another exposure in each."""
    images, rng = [], np.random.default_rng(seed)
    for k, one in enumerate(moves):
        scene = background.copy()
        scene[40:440, 60 + 70 * k : 140 + 70 * k] = 200.0 - 0.3 * np.arange(80)
        noise = 2.0 * rng.normal(size=scene.shape).astype(np.float32)
        images.append((1.0 - 0.06 * (k % 4)) * moved(scene, one) + noise)
    return images


def measured(n: int, width: int, height: int) -> Measurements:
    return Measurements(
        views=(View("c1", Camera(K, width, height)),),
        view=np.zeros(n, dtype=np.intp),
        pose=np.arange(n),
        image=tuple(f"{k}.png" for k in range(n)),
        q=np.zeros((n, 1)),
        sigma_q=np.full(1, 1e-5),
    )


def found_in(images: list[Grey]) -> dict[int, Move]:
    n, (height, width) = len(images), images[0].shape
    rows = measured(n, width, height)
    return camera_moves(images.__getitem__, rows, range(n), in_turn, no_progress)


@given(seed=st.integers(0, 99), size=st.floats(0.3, 1.5))
@tried(max_examples=6, deadline=None)
def test_moves_are_found_whatever_the_legs_do(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    true = [Move(*(size * SIZES * rng.normal(size=6)).tolist()) for _ in range(N)]
    found = found_in(taken(texture(seed), true, seed))
    assert sorted(found) == list(range(N))
    off = np.array([at_corners(found[k]) - at_corners(one) for k, one in enumerate(true)])
    assert np.sqrt(np.mean((off - np.median(off, axis=0)) ** 2)) < 0.05


def test_many_images_are_compared_with_the_background_of_some(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("legcal.perception.alignment.MOST_IMAGES", 5)
    true = [move(0.6 * (k % 3), -0.4 * (k % 2)) for k in range(N)]
    found = found_in(taken(texture(5), true))
    off = np.array([at_corners(found[k]) - at_corners(one) for k, one in enumerate(true)])
    assert np.sqrt(np.mean((off - np.median(off, axis=0)) ** 2)) < 0.05


def test_what_stood_still_shows_little_or_another_scene_is_left_alone() -> None:
    still, shaken = [move(0.0)] * N, [move(0.7 * k) for k in range(N)]
    background = texture(1)
    assert found_in(taken(background, still)) == {}
    assert found_in(taken(np.full_like(background, 110.0), shaken)) == {}
    assert found_in(taken(background, shaken)[:4]) == {}
    images = taken(background, shaken)
    images[2] = taken(texture(2), shaken)[2]
    assert sorted(found_in(images)) == [0, 1, 3, 4, 5, 6]


def test_a_camera_in_the_hand_is_told_from_one_on_a_tripod() -> None:
    rows, still = range(N), [move(0.0)] * N
    in_hand = [taken(texture(seed), still)[seed] for seed in rows]
    assert is_moved(in_hand.__getitem__, rows)
    assert not is_moved(in_hand.__getitem__, rows[:4])
    shaken = taken(texture(1), [move(0.7 * k) for k in rows])
    assert not is_moved(shaken.__getitem__, rows)
    bumped = [*taken(texture(1), still)[:4], *taken(texture(2), still)[4:]]
    assert not is_moved(bumped.__getitem__, rows)
    plain = taken(np.full_like(texture(0), 110.0), still)
    assert not is_moved(plain.__getitem__, rows)
    machine = [image.copy() for image in plain]  # that moves before a background without texture
    for image, other in zip(machine, in_hand, strict=True):
        image[:240, :320] = other[:240, :320]
    assert not is_moved(machine.__getitem__, rows)
    few = [*in_hand[:3], *plain[3:]]
    assert not is_moved(few.__getitem__, rows)
    strips = [image[:20] for image in in_hand]
    assert not is_moved(strips.__getitem__, rows)


@pytest.mark.system
def test_photographs_without_a_common_background_are_refused_as_taken_in_the_hand(
    tmp_path: Path,
) -> None:
    views = standing("hexapod", 1, small_camera(tmp_path, WIDTH, HEIGHT))
    shot = settings(level=Level.PHOTOGRAPHS, views=views, poses=6)
    folder = simulate("hexapod", tmp_path / "s", shot).folder
    for k, file in enumerate(sorted((folder / "images").iterdir())):
        cv2.imwrite(str(file), np.rint(texture(k)).astype(np.uint8))
    with pytest.raises(NotVisible) as refused:
        calibrate(folder)
    assert "in the hand" in str(refused.value)
    assert "hand_held: true" in str(refused.value)
    assert NONE_EXPLAINS not in refused.value.notes


def test_processes_decode_all_photographs(tmp_path: Path) -> None:
    """Decoding colours starts threads of OpenCV: a process that has them is not forked."""
    views = standing("hexapod", 1, small_camera(tmp_path, WIDTH, HEIGHT))
    shot = settings(level=Level.PHOTOGRAPHS, views=views, poses=5)
    dataset, decoded = load_dataset(simulate("hexapod", tmp_path / "s", shot).folder), list[Any]()

    def pool(task: Callable[[S], T], rows: Iterable[S], /) -> Iterable[T]:
        asked = list(rows)
        decoded.extend(asked)
        return map(task, asked)

    order_dataset(dataset, pool, no_progress)
    assert decoded == list(range(5))


def test_the_note_on_moves_counts_the_corners() -> None:
    """An autofocus moves these alone."""
    images = [f"{k}.png" for k in range(2)]
    (note,) = notes_on_moves(measured(2, WIDTH, HEIGHT), {images[1]: move(0.0, zoom=0.01)})
    assert "moves by up to 4.0 px" in note


def test_moves_are_found_in_tall_images() -> None:
    tall = cv2.resize(texture(6), (360, 1440))
    noise = np.random.default_rng(0).normal(size=(N, *tall.shape)).astype(np.float32)
    found = found_in([np.roll(tall, k, axis=0) + noise[k] for k in range(N)])
    down = [found[k].y for k in range(N)]
    np.testing.assert_allclose(np.diff(down), 1.0, atol=0.02)


def test_a_background_along_one_line_leaves_moves_open() -> None:
    """As a shelf across the middle of the image, where a slant moves nothing."""
    band = np.full((HEIGHT, WIDTH), 110.0, dtype=np.float32)
    band[230:250] = texture(4)[230:250]
    images = taken(band, [move(0.5 * k, 0.3 * k) for k in range(N)])
    assert found_in([image[60:420] for image in images]) == {}


@pytest.mark.system
def test_legs_are_found_as_if_the_camera_had_stood_still(tmp_path: Path) -> None:
    """Photographs before a wallpaper, as they are, and by a camera that was touched."""
    views = standing("hexapod", 1, small_camera(tmp_path, WIDTH, HEIGHT))
    shot = settings(level=Level.PHOTOGRAPHS, views=views, poses=6)
    still = simulate("hexapod", tmp_path / "still", shot).folder
    paper = texture(3)
    paper[70:, 130:-130] = np.nan
    for file in sorted((still / "images").iterdir()):
        picture = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
        before_it = np.where(np.isnan(paper), picture, np.rint(np.nan_to_num(paper)))
        cv2.imwrite(str(file), before_it.astype(np.uint8))
    shaken = shutil.copytree(still, tmp_path / "shaken")
    for k, file in enumerate(sorted((shaken / "images").iterdir())):
        picture = np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)).astype(np.float32)
        there = moved(picture, move(0.9 * k, -0.4 * k, 1e-3 * k))
        cv2.imwrite(str(file), np.clip(np.rint(there), 0, 255).astype(np.uint8))
    seen, as_still = (detect(load_dataset(folder)) for folder in (shaken, still))
    (note,) = set(seen.notes) - set(as_still.notes)
    assert "The camera of view c1 did not stand still" in note
    both = seen.outlines.used & as_still.outlines.used
    assert np.count_nonzero(both) > 0.8 * np.count_nonzero(as_still.outlines.used)
    middle = 0.5 * np.array([WIDTH - 1, HEIGHT - 1])
    common = middle + 1.0025 * (as_still.outlines.ends[both] - middle) + (2.25, -1.0)
    lens = seen.dataset.measurements.views[0].camera
    off = lens.line_offset(seen.outlines.h[both][:, None], lens.undistort(common))
    assert np.median(np.abs(off)) < 0.2  # of images up to 5 px away
    given = replace(load_dataset(shaken), observations=seen.outlines.choose(seen.outlines.row < 3))
    assert detect(given).dataset.moves == seen.dataset.moves
