"""What a diagnosis says of the likely mistake of a session, and the mistake that a fit shows.

:mod:`.mistake_search` finds what images say of the others. Outlines that were given under the names
of other legs, as exchanged in one view, need no search: where the legs and a camera are known,
nearly, it is seen which leg each outline belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import DiagnosisBlock
from legcal.data.measurements import Measurements, few_views
from legcal.data.outlines import Outlines, along_legs
from legcal.files.schema import few
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import Leg

MIN_SHARE = 0.5  # of the images, that agree with a mistake corrected
NONE_EXPLAINS = (
    "Tried without success, each alone and the likeliest beside others: wrong columns, rows, "
    "units, directions and zeros of readings, joints of the model in another order or mirrored, "
    "diameters as radii, focal lengths, mirrored or turned photographs. More may be wrong, or "
    "photographs show too little: click some joints in a photograph of each view (legcal detect "
    "DATASET -o OUT --edit), see in its overlays which legs stand elsewhere, mend that, and "
    "calibrate again."
)
_NEARER = 0.2  # of the distance from the leg that they name: to the one that they belong to
_MIN_OUTLINES = 4  # of each leg


class Diagnosis(DiagnosisBlock):
    """The likely mistake of a session, with what its sentence says besides."""

    mended: str = Field(exclude=True)  # the correction, as a clause: "with the columns swapped"
    images: int = Field(exclude=True)  # that were judged
    # tests that distinguish it from the mistakes of ``same_as``
    tests: tuple[str, ...] = Field(default=(), exclude=True)
    # of ``same_as`` in the sentence: one of each kind stands before more of these kinds
    n_kinds: int = Field(default=0, exclude=True)

    @property
    def finding(self) -> str:
        """The mistake and the number of images that agree, as a clause."""
        more = len(self.same_as) - self.n_kinds
        others = "".join(f", or {other}" for other in self.same_as[: self.n_kinds])
        others += f", or {more} similar mistake{'s' * (more > 1)}" * (more > 0)
        n, rest = self.images_after, " (the other images may have a further problem)"
        return (
            f"{self.what}{others}: {self.mended}, {n} of {self.images} images agree"
            f"{rest * (n < MIN_SHARE * self.images)}, against {self.images_before} now"
        )

    @property
    def remedies(self) -> str:
        """What to do, and the tests that distinguish it from similar mistakes."""
        tell = f". To distinguish them, {', or '.join(self.tests)}" if self.tests else ""
        return f"{self.remedy}{tell}"

    @property
    def sentence(self) -> str:
        """The diagnosis as a message."""
        return f"{self.finding[0].upper()}{self.finding[1:]}; {self.remedies}."


def notes_beside(diagnosis: Sequence[Diagnosis], notes: Sequence[str], job: str) -> list[str]:
    """Return notes on images; only their number beside a diagnosis, from which most follow.

    They would blame the wrong images. *job* is the command to run again: ``legcal doctor``.
    """
    if not (diagnosis and notes):
        return list(notes)
    return [
        f"{len(notes)} further problem{'s' * (len(notes) != 1)} may have the same cause: correct "
        f"the problem above first, then run {job} again."
    ]


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
