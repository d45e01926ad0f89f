"""HEIC photographs: read where a package is, named with what to do where it is not."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from photograph_files import exif
from test_init import init, own_folder, table

from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError
from legcal.vision.camera import Camera
from legcal.vision.image_file import decode_image, image_suffixes, inspect_image

BOX = b"\0\0\0\x18ftypheic\0\0\0\0"
GREY = np.add.outer(2 * np.arange(48), np.arange(64)).astype(np.uint8)
CAMERA = Camera(np.array([[80.0, 0.0, 32.0], [0.0, 80.0, 24.0], [0.0, 0.0, 1.0]]), 64, 48)


def _opened(content: bytes, **_: Any) -> Any:
    """Stand in for the package: behind the box is a PNG."""
    pixels = cv2.imdecode(np.frombuffer(content[len(BOX) :], np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("no picture")
    block = b"Exif\0\0" + exif(model="Phone", orientation=6)
    return SimpleNamespace(
        size=pixels.shape[1::-1],
        info={"exif": block},
        __array_interface__=pixels.__array_interface__,
        pixels=pixels,
    )


def _heic(grey: np.ndarray[Any, Any] = GREY) -> bytes:
    colours = np.repeat(grey[:, :, None], 4, axis=2)  # transparent too
    return BOX + cv2.imencode(".png", colours)[1].tobytes()


def test_without_the_package_heic_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    assert ".heic" not in image_suffixes()
    path = tmp_path / "a.heic"
    path.write_bytes(_heic())
    with pytest.raises(DatasetError, match=r"HEIC file.*legcal\[heic\].*magick"):
        decode_image(path, CAMERA)
    table(own_folder(tmp_path, ("IMG_1.HEIC",)), n=1)
    outcome = init(tmp_path)
    assert outcome.code == 2
    assert "pip install 'legcal[heic]'" in outcome.said


def test_with_the_package_heic_is_a_photograph_like_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pi_heif", SimpleNamespace(open_heif=_opened))
    table(own_folder(tmp_path, ("IMG_1.HEIC", "IMG_2.HEIC")), n=2)
    for k in (1, 2):
        (tmp_path / f"photos/IMG_{k}.HEIC").write_bytes(_heic(GREY + np.uint8(k)))
    assert init(tmp_path).code == 0
    dataset = load_dataset(tmp_path / "dataset")
    for k in range(2):
        path = dataset.image_path(k)
        assert path is not None
        np.testing.assert_allclose(decode_image(path, CAMERA), GREY + np.uint8(k + 1), atol=1e-3)
        facts, problem = inspect_image(path, CAMERA)
        assert (facts.device, problem) == ("Phone", None)
        assert facts.orientation is None  # pixels come turned
    for content, found in ((BOX + b"x", "no picture"), (_heic(GREY[:24]), "64 x 24")):
        (tmp_path / "bad.heic").write_bytes(content)
        with pytest.raises(DatasetError, match=found):
            decode_image(tmp_path / "bad.heic", CAMERA)
