"""What the covariance of a camera file is worth: errors over what the fit states of them.

    OMP_NUM_THREADS=1 python benchmarks/intrinsics.py [--runs 100] [--machine 6-spu-noncoplanar]
        [--images 12] [--noise 0.05] [--focal PART] [--outlines 0.1]

A board of 9 x 6 squares before the true camera, in so many images, with so much noise of its
corners [px], gives the covariance of a calibration. In every run the camera file is drawn from it,
for all views or for each of them, and the joint fit of an outline session gets the true camera,
the drawn one as if it were exact, and the drawn one with the covariance. A line each: the squared
error of all kinematic parameters by the whole covariance that the fit states, over their number
(``nse``, which is that of the platform); displacement of the platform, rms over runs, true and
predicted; error of the focal length over what is stated of it, mean and rms, where it is estimated;
how often a camera was said to disagree; time of a fit.

With --focal the covariance is that of a focal length known to that part of it, as by EXIF, and of
nothing else; --outlines is the noise of edge points of outlines [px].
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from bound import ERRORS
from camera_sessions import seen_corners
from fit_sessions import with_camera
from outline_sessions import (
    MACHINES,
    SHIPPED,
    Design,
    Noise,
    OutlineSession,
    design_of,
    draw_session,
    one_fit,
    platform_errors,
)

from legcal.calibration.camera_calibration.consensus import robust_fit
from legcal.calibration.joint_fit.solution import Solution
from legcal.data.measurements import View
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.equations import pose_sensitivity
from legcal.machine.parameters import vector_of
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values, with_intrinsics
from legcal.vision.image_file import ImageSize

KINDS = ("true camera", "drawn, exact", "drawn, covariance")


def calibrated(camera: Camera, n_images: int, noise_px: float) -> Array:
    """Return the covariance that a calibration with a board states of the intrinsics."""
    seen = seen_corners(camera, n_images, 0, noise=noise_px)
    found = robust_fit(seen, ImageSize(camera.width, camera.height), camera.model)
    assert found is not None
    return found.covariance


def focal_alone(camera: Camera, part: float) -> Array:
    """Return the covariance where the focal length is known to a part of it, all else exactly."""
    values = np.where(
        np.isin(intrinsic_names(camera), ("fx", "fy")), part * intrinsic_values(camera), 0.0
    )
    return np.outer(values, values) + np.diag(np.full(len(values), 1e-12))


def focal_error(found: Solution, camera: Camera) -> float:
    """Return the error of the first focal length over what the fit states; NaN if it is fixed."""
    estimates = found.estimates
    names = [name for name in estimates.names if name.endswith(".fx")]
    sigma = estimates.sigma[estimates.names.index(names[0])] if names else 0.0
    return float((found.cameras[0].K[0, 0] - camera.K[0, 0]) / sigma) if sigma > 0.0 else np.nan


def drawn(camera: Camera, covariance: Array, rng: np.random.Generator) -> Camera:
    """Return a camera whose errors have this covariance."""
    names, values = intrinsic_names(camera), intrinsic_values(camera)
    values = rng.multivariate_normal(values, covariance)
    return with_intrinsics(camera, dict(zip(names, values.tolist(), strict=True)))


def sessions(
    session: OutlineSession, covariance: Array, rng: np.random.Generator, *, one_camera: bool
) -> Iterator[OutlineSession]:
    """Yield a session with its true camera, with a drawn one, and with the drawn covariance."""
    yield session
    m, o = session.measurements, session.outlines
    views, h, wrong = list[View](), o.h.copy(), drawn(m.views[0].camera, covariance, rng)
    for v, view in enumerate(m.views):
        if v and not one_camera:
            wrong = drawn(view.camera, covariance, rng)
        h[m.view[o.row] == v] = with_camera(m, o, wrong)[1].h[m.view[o.row] == v]
        views.append(replace(view, camera=wrong))
    outlines = replace(o, h=h)
    yield replace(session, measurements=replace(m, views=tuple(views)), outlines=outlines)
    views = [replace(v, camera=replace(v.camera, covariance=covariance)) for v in views]
    yield replace(session, measurements=replace(m, views=tuple(views)), outlines=outlines)


def errors(design: Design, session: OutlineSession, found: Solution) -> tuple[float, float, float]:
    """Return e' C^-1 e of the kinematic parameters, and mean squares of the platform [m^2]."""
    covariance = found.kinematic.value_covariance
    truth = vector_of(found.kinematic.parametrization, design.legs.nominal, session.legs.nominal)
    away = found.estimates.vector(found.kinematic.parametrization.names) - truth
    free = np.flatnonzero(np.diagonal(covariance) > 0.0)
    sigma = np.sqrt(np.diagonal(covariance)[free])
    correlation = covariance[np.ix_(free, free)] / np.outer(sigma, sigma)
    z = away[free] / sigma
    R, t = components(design.poses)
    J = pose_sensitivity(found.legs, found.kinematic.parametrization, design.legs.frame_legs, R, t)[
        :, 3:
    ]
    predicted = np.einsum("kia,ab,kib->k", J, found.kinematic.covariance, J, optimize=True)
    displacement, _ = platform_errors(design, found.legs)
    squared = float(np.mean(displacement**2)), float(np.mean(predicted))
    return float(z @ np.linalg.solve(correlation, z)) / len(free), *squared


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--machine", choices=(*MACHINES, *SHIPPED), default=MACHINES[0])
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--noise", type=float, default=0.05)
    parser.add_argument("--focal", type=float, help="part of it, all that is not known")
    parser.add_argument("--outlines", type=float, default=Noise().sigma_px)
    chosen = parser.parse_args()
    noise = Noise(sigma_px=chosen.outlines)
    design = design_of(chosen.machine, 3, 15, noise.sigma_px)
    if chosen.focal is None:
        covariance = calibrated(design.camera, chosen.images, chosen.noise)
    else:
        covariance = focal_alone(design.camera, chosen.focal)
    sigma = zip(intrinsic_names(design.camera), np.sqrt(np.diagonal(covariance)), strict=True)
    print(", ".join(f"{name} {s:.2g}" for name, s in sigma))
    print(
        "cameras  fit                  nse  platform um  predicted um  focal length  disagree  ms"
    )
    for one_camera in (True, False):
        found: list[list[tuple[float, ...]]] = [[] for _ in KINDS]
        for seed in range(chosen.runs):
            rng = np.random.default_rng([2002, seed])
            session = draw_session(design, noise, ERRORS, rng)
            several = sessions(session, covariance, rng, one_camera=one_camera)
            for k, given in enumerate(several):
                begin = time.perf_counter()
                solution = one_fit(given, noise.radius_sigma)
                took = time.perf_counter() - begin
                doubted = bool(solution.camera_doubts)
                focal = focal_error(solution, design.camera)
                found[k].append((*errors(design, given, solution), focal, doubted, took))
        for kind, rows in zip(KINDS, found, strict=True):
            nse, error, predicted, focal, doubted, took = np.mean(rows, axis=0)
            size = np.sqrt(np.mean(np.array(rows)[:, 3] ** 2))
            print(
                f"{'one' if one_camera else 'three':7s}  {kind:18s} {nse:5.2f} "
                f"{1e6 * np.sqrt(error):12.1f} {1e6 * np.sqrt(predicted):13.1f} "
                f"{focal:+7.2f}, {size:4.2f} {100.0 * doubted:7.0f} % {1e3 * took:4.0f}"
            )


if __name__ == "__main__":
    main()
