"""A rough camera from nothing but the focal length in the metadata of its photographs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.vision.camera import Camera, intrinsic_names
from legcal.vision.camera_file import CALIBRATED, camera_info
from legcal.vision.image_facts import ImageFacts

FILM_DIAGONAL = np.hypot(36.0, 24.0)  # [mm]: fields of view are compared along diagonals
# Standard deviations, relative to the focal length: of f (whole millimetres, cropping, focus), and
# of the difference between fx and fy (pixels are square)
FOCAL_SIGMA, ASPECT_SIGMA = 0.04, 0.002
CENTRE_SIGMA = 0.02  # standard deviation of the principal point, in units of the longer side
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1}  # standard deviations of the distortion of usual lenses


def camera_of_photographs(facts: Sequence[ImageFacts], width: int, height: int) -> Camera | None:
    """Return the camera of photographs of one size by their focal length on 35 mm film.

    Its covariance states the uncertainty. None if they state no focal length, or several.
    """
    stated = {(photograph.device, photograph.focal_length_35mm) for photograph in facts}
    focal = next(iter(stated))[1] if len(stated) == 1 else None
    if focal is None:
        return None
    f = focal * float(np.hypot(width, height)) / float(FILM_DIAGONAL)
    K = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    camera = Camera(K, width, height)
    names = intrinsic_names(camera)
    centre = CENTRE_SIGMA * max(width, height)
    sigma = {"cx": centre, "cy": centre, **DISTORTION_SIGMA}
    C = np.diag([sigma.get(name, 0.0) ** 2 for name in names])
    focals = [names.index("fx"), names.index("fy")]
    C[np.ix_(focals, focals)] = (FOCAL_SIGMA * f) ** 2 + np.diag([(ASPECT_SIGMA * f) ** 2] * 2)
    return Camera(K, width, height, covariance=C)


def rough_camera_info(camera: Camera, name: str) -> str:
    """Return the text of the camera file of a rough camera, with its covariance."""
    names = intrinsic_names(camera)
    C = np.zeros((len(names), len(names))) if camera.covariance is None else camera.covariance
    inexact = [i for i in range(len(names)) if C[i, i] > 0.0]
    stated = {
        "version": 1,
        "sigma": {names[i]: float(np.sqrt(C[i, i])) for i in inexact},
        "names": [names[i] for i in inexact],
        "covariance": C[np.ix_(inexact, inexact)].tolist(),
    }
    return camera_info(camera, name, {CALIBRATED: stated})
