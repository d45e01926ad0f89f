"""Outlines that were given under the names of other legs, as exchanged in one view.

Where the legs and a camera are known, nearly, it is seen which leg each outline belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.diagnosis.mistakes import Diagnosis
from legcal.data.measurements import Measurements, few_views
from legcal.data.outlines import Outlines, along_legs
from legcal.files.schema import few
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import Leg

_NEARER = 0.2  # of the distance from the leg that they name: to the one that they belong to
_MIN_OUTLINES = 4  # of each leg


def exchanged_legs(
    outlines: Outlines,  # that were given, whatever a fit rejected
    measurements: Measurements,
    legs: Sequence[Leg],
    # (n_rows, n_legs, 3): joints A and B in each image, in the base; NaN where they are not known
    ends: tuple[Array, Array],
    cameras: Sequence[RigidTransform | None],  # T_base_camera of each view, where it is known
    *,
    of_all: bool = True,  # also all legs of a view: a camera at a symmetric place sees the same
) -> tuple[Diagnosis, ...]:
    """Return legs whose outlines lie at each other's place in views."""
    o = along_legs(outlines, legs)
    o = o.choose(np.asarray(np.isfinite(o.h).all(axis=1)))
    radius = np.array(
        [legs[j].radius_along[part] for j, part in zip(o.leg.tolist(), o.part, strict=True)]
    )
    off, at = np.full((len(o), len(legs)), np.nan), measurements.view[o.row]
    for v, T_base_camera in enumerate(cameras):
        of_view = np.flatnonzero(at == v)
        if T_base_camera is not None and len(of_view):
            camera, T = measurements.views[v].camera, T_base_camera.inv()
            xy = camera.undistort(o.ends[of_view].reshape(-1, 2))
            rays = np.column_stack([xy, np.ones(len(xy))]).reshape(-1, 2, 3)
            A, B = (T.apply(x[o.row[of_view]].reshape(-1, 3)).reshape(-1, len(legs), 3)
                    for x in ends)  # fmt: skip
            off[of_view] = _distances(rays, A, B, radius[of_view])
    found = dict[tuple[tuple[int, int], ...], list[int]]()
    for v in range(len(cameras)):
        for names in _permuted(off[at == v], o.leg[at == v], of_all=of_all):
            found.setdefault(names, []).append(v)
    return tuple(_diagnosis(measurements, legs, o, off, *one) for one in found.items())


def _distances(rays: Array, A: Array, B: Array, radius: Array) -> Array:
    """Return how far outlines are from where those of each leg would be, (n, n_legs) [m].

    By rays (n, 2, 3) through their ends and joints (n, n_legs, 3) in the camera: an outline touches
    the cylinder, so that its rays pass the axis at the radius.
    """
    along, toward = (B - A)[:, None], rays[:, :, None]
    # Distance of two lines: the axis, and the ray through the camera centre
    across = np.linalg.norm(cross(toward, along), axis=-1)
    passes = np.abs(np.sum(toward * cross(A[:, None], along), axis=-1)) / across
    return np.asarray(np.abs(passes - radius[:, None, None]).max(axis=1))


def _permuted(
    off: Array, leg: IntArray, *, of_all: bool = True
) -> Iterator[tuple[tuple[int, int], ...]]:
    """Yield legs of a view with those whose place their outlines take, a cycle at a time.

    Most of the other legs lie where they should: with wrong readings or another camera none does,
    and some are near each other's place by chance.
    """
    median = dict[int, Array]()
    for j in np.unique(leg).tolist():
        of_leg = off[leg == j]
        if len(of_leg) >= _MIN_OUTLINES and np.isfinite(of_leg).all():
            median[j] = np.median(of_leg, axis=0)
    nearest = {j: int(np.argmin(away)) for j, away in median.items()}
    belongs = {j: k for j, k in nearest.items() if median[j][k] < _NEARER * median[j][j]}
    others, cycles = [j for j in median if j not in belongs], list[list[int]]()
    while belongs:
        first, cycle = next(iter(belongs)), list[int]()
        j = first
        while j in belongs and j not in cycle:
            cycle.append(j)
            j = belongs[j]
        if j == first:
            cycles.append(cycle)
        for done in cycle if j == first else [first]:
            del belongs[done]
    renamed = {j for cycle in cycles for j in cycle}
    away = [float(median[j][j]) for j in others or median.keys() - renamed]
    apart = float(np.median(away)) if away else 0.0 if of_all else np.inf
    for cycle in cycles:
        if apart < _NEARER * min(median[j][j] for j in cycle):
            yield tuple((j, nearest[j]) for j in cycle)


def _diagnosis(
    m: Measurements,
    legs: Sequence[Leg],
    o: Outlines,
    off: Array,
    names: tuple[tuple[int, int], ...],
    views: Sequence[int],
) -> Diagnosis:
    """Return the diagnosis of outlines that name other legs in some views."""
    renamed = dict(names)
    of = np.flatnonzero(np.isin(m.view[o.row], views) & np.isin(o.leg, list(renamed)))
    own = off[of, o.leg[of]]
    other = off[of, [renamed[j] for j in o.leg[of].tolist()]]
    rows, image = np.unique(o.row[of], return_inverse=True)
    nearer = np.bincount(image, np.where(other < own, 1.0, -1.0))
    named = [legs[j].name for j in renamed]
    where = few_views([m.views[v].name for v in views])
    if len(named) == 2:
        what, remedy = f"{' and '.join(named)} appear to be exchanged", "exchange these names"
    else:
        pairs = [f"{legs[j].name} those of {legs[k].name}" for j, k in names]
        what, remedy = f"{few(named)} name other legs ({few(pairs)})", "correct these names"
    return Diagnosis(
        kind="legs exchanged",
        what=f"the outlines of {what} in {where}",
        same_as=(),
        mended="with the names corrected",
        images=len(rows),
        images_before=int(np.sum(nearer <= 0.0)),
        images_after=int(np.sum(nearer > 0.0)),
        score=float(np.mean(other < own)),
        remedy=f"{remedy} there (columns leg and part of observations.csv)",
    )
