"""``legcal.plan``: what is asked of a plan, checked, and the plan that answers it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from legcal.errors import UsageError
from legcal.geometry import Array
from legcal.machine import Machine, load_mechanism
from legcal.planning.goals import Goal
from legcal.planning.information import DEFAULT_NOISE, PredictedNoise, Predictor
from legcal.planning.places import USUAL, Setting
from legcal.planning.planner import Plan, plan_session
from legcal.progress import Progress, shown_progress
from legcal.vision import Camera, read_camera

SIGMA_Q = 2e-6  # [m] of a reading, where nobody says
MOST_IMAGES, MOST_VIEWS = 500, 12


def default_camera() -> Camera:
    """Return a camera of 1024 x 768 pixels that sees 43 degrees, as long as none is chosen."""
    K = np.array([[1290.0, 0.0, 511.5], [0.0, 1290.0, 383.5], [0.0, 0.0, 1.0]])
    return Camera(K, 1024, 768)


def plan(
    model: str | Path | Machine,
    *,
    images: int | None = None,
    images_per_view: int | None = None,
    cameras: int = 3,
    criterion: Goal | str = Goal.MEAN,
    parameters: Sequence[str] = (),
    camera: str | Path | Camera | None = None,
    noise: PredictedNoise = DEFAULT_NOISE,
    encoder_sigma: float = SIGMA_Q,
    bounds: Array | None = None,
    setting: Setting = USUAL,
    seed: int = 0,
    progress: Progress = False,
    stop: Callable[[], bool] = lambda: False,
) -> Plan:
    """Choose poses and camera places of a session that determine a machine best.

    Parameters
    ----------
    model : str, Path or Machine
        The nominal model, as :func:`legcal.load_mechanism` takes it.
    images, images_per_view : int, optional
        Photographs of the whole session, 45 by default; or of each view.
    cameras : int
        Camera places.
    criterion : Goal or str
        What is made small: ``mean`` or ``worst`` error of the platform over the workspace, ``d``
        (determinant of the covariance of all parameters), or sigma of ``parameters``.
    parameters : sequence of str
        Names of parameters, for that criterion.
    camera : path or Camera, optional
        The camera, or its file; 1024 x 768 pixels and 43 degrees wide by default.
    noise : PredictedNoise
        Errors of outlines.
    encoder_sigma : float
        One standard deviation of a reading [m].
    bounds : (3, 2) array, optional
        Lowest and highest x, y, z of cameras in the base link [m].
    setting : Setting
        How well tripods are set, and what is known of the machine before.
    seed : int
        Of everything that is drawn: the same gives the same plan.
    progress : bool or callable
        True shows bars on stderr; a function is called as ``progress(stage, done, total)``.
    stop : callable
        Asked between steps: once it is true, the best so far is the plan.

    Returns
    -------
    Plan

    Raises
    ------
    UsageError
        If an option cannot be used.
    DidNotConverge, NotVisible, NotIdentifiable
        If there are no poses, no places that show legs, or too few images.
    """
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    n_views = _whole("--cameras", cameras, 1, MOST_VIEWS)
    if images is not None and images_per_view is not None:
        raise UsageError(
            f"The plan could not be made: found {images} images and {images_per_view} images per "
            "view, needed one of the two; leave out --images-per-view, or --images."
        )
    n_images = 15 * n_views
    if images is not None:
        n_images = _whole("--images", images, 1, MOST_IMAGES)
    elif images_per_view is not None:
        n_images = n_views * _whole("--images-per-view", images_per_view, 1, MOST_IMAGES // n_views)
    if n_images < n_views:
        raise UsageError(
            f"The plan could not be made: found {n_images} images for {n_views} cameras, needed "
            "one for each at least; give more --images or fewer --cameras."
        )
    if criterion not in list(Goal):
        raise UsageError(
            f"The plan could not be made: found the criterion '{criterion}', needed "
            f"{', '.join(Goal)}; choose one."
        )
    chosen = default_camera() if camera is None else camera
    lens = chosen if isinstance(chosen, Camera) else read_camera(Path(chosen))
    predictor = Predictor(machine, lens, noise, encoder_sigma)
    with shown_progress(progress) as report:
        return plan_session(
            predictor,
            n_images,
            n_views,
            Goal(criterion),
            named=parameters,
            setting=setting,
            bounds=bounds,
            seed=seed,
            progress=report,
            stop=stop,
        )


def _whole(name: str, found: int, least: int, most: int) -> int:
    """Return a number of an option between limits."""
    if not least <= found <= most:
        raise UsageError(
            f"The plan could not be made: found {name} {found}, needed {least} to {most}; correct "
            "it."
        )
    return found
