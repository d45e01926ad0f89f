"""A camera of which nothing is known but what its photographs say: a focal length, roughly."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.vision.camera import Camera, intrinsic_names
from legcal.vision.camera_file import CALIBRATED, camera_info
from legcal.vision.image_facts import ImageFacts

FILM_DIAGONAL = np.hypot(36.0, 24.0)  # [mm]: fields of view are compared along diagonals
# Standard deviations, in parts of the focal length: whole millimetres, cropping, focus; and of fx
# against fy, whose pixels are square
FOCAL_SIGMA, ASPECT_SIGMA = 0.04, 0.002
CENTRE_SIGMA = 0.02  # of the principal point from the middle, in parts of the longer side
DISTORTION_SIGMA = {"k1": 0.1, "k2": 0.1}  # of lenses without it, or where programs remove it


def camera_of_photographs(facts: Sequence[ImageFacts], width: int, height: int) -> Camera | None:
    """Return the camera of photographs of one size by their focal length on 35 mm film.

    Its covariance says how roughly that is known. None where they state none, or not one.
    """
    stated = {(one.device, one.focal_length_35mm) for one in facts}
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
    """Return the text of the camera file of such a camera, with its covariance."""
    names = intrinsic_names(camera)
    C = np.zeros((len(names), len(names))) if camera.covariance is None else camera.covariance
    known = [i for i in range(len(names)) if C[i, i] > 0.0]
    stated = {
        "version": 1,
        "sigma": {names[i]: float(np.sqrt(C[i, i])) for i in known},
        "names": [names[i] for i in known],
        "covariance": C[np.ix_(known, known)].tolist(),
    }
    return camera_info(camera, name, {CALIBRATED: stated})
