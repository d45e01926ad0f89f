"""Which outlines move with a gamma that nobody told, and how far."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from legcal.geometry.types import Array
from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.vision.intrinsics import shared_cameras

_ALIKE = 1e-6  # gammas that differ by less, relatively, are one


def cameras_of(measurements: Measurements) -> tuple[str, ...]:
    """Return the name of the view that stands for the camera of each view.

    A view whose gamma is told stands for itself: nothing is to be found of its camera's.
    """
    views = measurements.views
    unknown = [view for view in views if not view.camera.gamma_is_told]
    shared = shared_cameras([view.name for view in unknown], [view.camera for view in unknown])
    stands_for = dict(zip((view.name for view in unknown), shared, strict=True))
    return tuple(stands_for.get(view.name, view.name) for view in views)


def movements_by_gamma(outlines: Outlines, measurements: Measurements) -> Array:
    """Return how far outlines move towards the inside with ln gamma, zero where that is told [px].

    (n,)
    """
    told = np.array([view.camera.gamma_is_told for view in measurements.views], dtype=np.bool_)
    unknown = ~told[measurements.view[outlines.row]] & np.isfinite(outlines.by_gamma)
    return np.where(unknown, outlines.by_gamma, 0.0)


def mixed_gammas(moved: Array, gamma: Array, camera: Sequence[str]) -> list[str]:
    """Return one sentence for each camera whose outlines were measured with several gammas.

    Parameters
    ----------
    moved : (n,) array
        :func:`movements_by_gamma` of outlines.
    gamma : (n,) array
        With which they were measured.
    camera : sequence of str
        The name of the camera of each.
    """
    found: dict[str, set[float]] = {}
    for by_gamma, one, name in zip(moved.tolist(), gamma.tolist(), camera, strict=True):
        if by_gamma != 0.0:
            found.setdefault(name, set()).add(one)
    return [
        f"The outlines of the camera of view {name} could not be used: found that they were "
        f"measured with the gammas {min(values):g} and {max(values):g}, needed one; search the "
        "images again, or write gamma of the view in dataset.yaml."
        for name, values in sorted(found.items())
        if max(values) / min(values) > 1.0 + _ALIKE
    ]


def known_gammas(outlines: Outlines, measurements: Measurements) -> dict[str, float]:
    """Return with which gamma used outlines of cameras were measured that nobody told, by view."""
    moved = outlines.used & (movements_by_gamma(outlines, measurements) != 0.0)
    cameras = cameras_of(measurements)
    view = measurements.view[outlines.row[moved]].tolist()
    known = {
        cameras[v]: gamma for v, gamma in zip(view, outlines.gamma[moved].tolist(), strict=True)
    }
    names = [view.name for view in measurements.views]
    return {n: known[c] for n, c in zip(names, cameras, strict=True) if c in known}
