"""How the experiments of the studies of outlines are made, in words."""

from __future__ import annotations

import numpy as np

from legcal.studies.outline_session import Noise, StartErrors

IN_WORDS = (
    "Machines: the shipped hexapod (coplanar), the same with joints 2, 4 and 6 moved 30 mm out "
    "of the planes of 1, 3 and 5 (non-coplanar), the shipped 3-upu-tilted and 3-rpr."
)
SHIPPED_IN_WORDS = "Machines: the shipped models are the true ones."


def readings(noise: Noise, errors: StartErrors, n_views: int, n_poses: int) -> tuple[str, ...]:
    """Return how an experiment is made, one sentence each."""
    return (
        f"{n_views} cameras of 1024 x 768 px see {n_poses} extreme poses each, no two the same; of "
        "a machine with six legs or more each is said to see the four legs that it sees best. "
        "Machine, poses and cameras are drawn once: the bound is one matrix, at the truth.",
        f"Every pixel along an outline is an edge point with {noise.sigma_px:g} px of white noise "
        "(1 sigma): the covariance of a fitted line is known. Readings have "
        f"{1e6 * noise.sigma_q:g} um.",
        f"Nominal radii are Gaussian, {100.0 * noise.radius_sigma:g} % (1 sigma), and so is what "
        "the fit takes them for.",
        _start(errors),
        "The fit sees outlines, readings, the nominal model and the rough camera poses. It "
        "estimates the noise and guards against wrong outlines as in any calibration. Twists of "
        "legs without an S joint are known (`legcal calibrate` has a prior on them).",
    )


def _start(errors: StartErrors) -> str:
    """Return how wrong what the fit starts from is."""
    length, angle = f"{1e3 * errors.length:g} mm", f"{np.rad2deg(errors.angle):g} deg"
    shift = f"{1e3 * errors.camera_shift:g} mm"
    turn = f"{np.rad2deg(errors.camera_turn):g} deg"
    if errors.full:
        return (
            f"In every run the nominal model is wrong by {length}, up or down, in every coordinate "
            f"of a joint and every offset, and by {angle} in every axis, in any direction; every "
            f"camera pose by {shift} and {turn}, in any direction and about any axis."
        )
    return (
        f"In every run the nominal model is wrong by up to {length} in every coordinate of a joint "
        f"and every offset, and by up to {angle} in both angles of every axis (uniform); every "
        f"camera pose by up to {shift} and {turn}."
    )
