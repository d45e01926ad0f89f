"""What lossy compression adds to the errors of outlines is found from the compressed images."""

import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing.reduction import ForkingPickler

import cv2
import numpy as np
import pytest
from six_photographs import six_photographs

from legcal.calibration.compression import compression_effect
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.data.outlines import Outlines
from legcal.perception.photographs import Photographs, measure_photographs
from legcal.perception.placement import Placement
from legcal.progress import no_progress
from legcal.vision.image_facts import ImageFacts
from legcal.vision.image_file import Grey
from legcal.workers import in_turn


@dataclass(frozen=True)
class Stored:
    """Reads photographs as a camera would have stored them."""

    load: Callable[[int], Grey]
    quality: int

    def __call__(self, row: int) -> Grey:
        grey = np.rint(self.load(row)).astype(np.uint8)
        _, file = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        return np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE), dtype=np.float32)


def compressed(photographs: Photographs, quality: int) -> Photographs:
    """Return the photographs as a camera would have stored them, searched as in processes."""
    return replace(
        photographs,
        load=Stored(photographs.load, quality),
        run=lambda task, rows: in_turn(pickle.loads(ForkingPickler.dumps(task)), rows),
    )


def apart(one: Outlines, other: Outlines, photographs: Photographs) -> float:
    """Return how far the ends of outlines lie from others, a standard deviation [px]."""
    m, found = photographs.measurements, []
    for k in np.flatnonzero(one.used & other.used).tolist():
        camera = m.views[m.view[one.row[k]]].camera
        found.append(camera.line_offset(other.h[k], camera.undistort(one.ends[k])))
    return 1.4826 * float(np.median(np.abs(found)))


@pytest.fixture(scope="module")
def measured() -> tuple[Photographs, Placement, Outlines]:
    photographs, _, near = six_photographs()
    return photographs, near, measure_photographs(photographs, near, no_progress)


def test_compressing_once_more_tells_what_compression_did(
    measured: tuple[Photographs, Placement, Outlines],
) -> None:
    (photographs, near, before), quality = measured, 60
    stored = compressed(photographs, quality)
    found = measure_photographs(stored, near, no_progress)
    assert found.row_keys() == before.row_keys()
    facts = {
        image: ImageFacts(form="JPEG", is_lossy=True, jpeg_quality=quality)
        for image in photographs.measurements.image
    }
    effect = compression_effect(stored, near, found, facts, NoiseModel(bias_px=0.5), no_progress)
    assert effect is not None
    true = apart(before, found, photographs)
    assert 0.5 < effect.moved_px / true < 2.0
    assert 1.0 < effect.increase < 1.5
    assert f"{effect.moved_px:.3f} px" in str(effect)
    little = compression_effect(stored, near, found, facts, NoiseModel(0.01), no_progress)
    assert little is not None
    assert math.isinf(little.increase)
    assert "more than 3 times" in str(little)


def test_nothing_is_said_of_photographs_without_loss(
    measured: tuple[Photographs, Placement, Outlines],
) -> None:
    photographs, near, found = measured
    for facts in ({}, {i: ImageFacts(jpeg_quality=98) for i in photographs.measurements.image}):
        none = compression_effect(photographs, near, found, facts, NoiseModel(), no_progress)
        assert none is None
