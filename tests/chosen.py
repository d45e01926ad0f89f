"""Parameters of machines seen by three views of two cameras, and choices of them."""

from collections.abc import Mapping, Sequence

import numpy as np

from legcal import load_mechanism
from legcal.calibration.joint_fit.parameter_choices import (
    Choices,
    KnownParameters,
    known_parameters,
    resolve,
)
from legcal.data.dataset_file import overrides_of_call
from legcal.data.measurements import View
from legcal.vision.camera import Camera

K = np.array([[1290.0, 0.0, 511.0], [0.0, 1285.0, 380.0], [0.0, 0.0, 1.0]])
OTHER_K = np.array([[1800.0, 0.0, 511.0], [0.0, 1800.0, 380.0], [0.0, 0.0, 1.0]])
VIEWS = (
    View("c2", Camera(K, 1024, 768)),
    View("c1", Camera(K.copy(), 1024, 768)),
    View("tele", Camera(OTHER_K, 1024, 768)),
)
Priors = Mapping[str, object] | Sequence[str]


def known(model: str = "hexapod", *, axes_given: bool = False) -> KnownParameters:
    return known_parameters(load_mechanism(model), VIEWS, axes_given=axes_given)


HEXAPOD = known()


def choose(
    priors: Priors = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    parameters: KnownParameters = HEXAPOD,
) -> Choices:
    return resolve(overrides_of_call(priors, fixed, free), parameters)
