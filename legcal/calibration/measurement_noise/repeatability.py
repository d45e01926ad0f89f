"""What repeated images of one pose say of the precision of outlines and leg axes (section 4.2).

Repeats of a leg's orientation (one pose in one view) give pairs of outlines, axes by (4) and (5),
and numbers of these: Euler angles and M_LS as in Table 1, and the errors in the image and towards
the camera. Their standard deviations are pooled over orientations, beside what is claimed of them.
Repeats agree on what the images share: an edge that light, blur or the model of the outline moves
is moved in all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from legcal.data.axes import LegAxes, axes_from_outlines
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, along_legs
from legcal.errors import NotVisible
from legcal.files.schema import Document
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import Leg
from legcal.perception.diagnostics import is_out_of_sight
from legcal.vision.camera import Camera
from legcal.vision.cylinder import angles_of_direction

ANGLES = ("psi", "theta", "angle", "tilt")
QUANTITIES = ("psi", "theta", "x", "z", "angle", "across", "tilt", "depth")  # of an axis
OUTLINE = "outline"  # the spread of outlines, beside these
OF_M_LS = ("x", "z")
CONFIDENCE = 0.95  # of the range of a ratio
SURELY = 3.0  # standard deviations by which an axis must be inclined to the plane of M_LS
_STEP = 1e-6  # of derivatives [rad, m]
_M_LS_ROWS = [QUANTITIES.index(name) for name in OF_M_LS]


@dataclass(frozen=True, eq=False)
class Repeats:
    """Images of one pose from one camera position."""

    view: int
    pose: int
    rows: IntArray


def group_rows(measurements: Measurements, rows: IntArray) -> list[Repeats]:
    """Return rows by view and pose, also those that nothing repeats."""
    places = np.stack([measurements.view[rows], measurements.pose[rows]], axis=1)
    distinct, which = np.unique(places, axis=0, return_inverse=True)
    return [
        Repeats(int(view), int(pose), rows[which.ravel() == k])
        for k, (view, pose) in enumerate(distinct)
    ]


@dataclass(frozen=True, eq=False)
class Sample:
    """What the repeats of one orientation say about one quantity."""

    covariance: Array  # (d, d) of the repeats
    claimed: Array  # (d, d) mean of the covariances that the method claims
    dof: int  # repeats less one

    @property
    def sd(self) -> float:
        """Standard deviation, the root mean square over the components."""
        return float(np.sqrt(np.trace(self.covariance) / len(self.covariance)))

    @property
    def ratio(self) -> float:
        """Standard deviation in the claimed one."""
        return float(np.sqrt(np.trace(self.covariance) / np.trace(self.claimed)))


class PooledSpread(Document):
    """A standard deviation pooled over orientations."""

    sd: float
    claimed: float
    ratio: float  # of both
    ratio_low: float  # the ends of its 95 % range
    ratio_high: float
    median: float  # of the standard deviations of single orientations
    largest: float
    dof: float
    samples: int  # orientations, and each outline in each of them


def sample_of(deviations: Array, claimed: Array) -> Sample:
    """Return the sample of repeats (n, d) against any common origin, with covariances (n, d, d)."""
    dof = len(deviations) - 1
    centred = deviations - deviations.mean(axis=0)
    return Sample(np.asarray(centred.T @ centred / dof), np.asarray(claimed.mean(axis=0)), dof)


def pool(samples: Sequence[Sample]) -> PooledSpread | None:
    """Return the pooled standard deviation of samples of one dimension; None without any."""
    if not samples:
        return None
    size = len(samples[0].covariance)
    dof = np.array([s.dof for s in samples], dtype=np.float64)
    found, claimed = (
        float(np.sqrt(float(dof @ [np.trace(c) for c in covariances]) / (size * dof.sum())))
        for covariances in ([s.covariance for s in samples], [s.claimed for s in samples])
    )
    traces = np.array([np.trace(s.claimed) for s in samples])
    squares = np.array([np.sum(s.claimed**2) for s in samples])  # tr C^2 of a symmetric C
    effective = float(dof @ traces) ** 2 / float(dof @ squares)
    tail = 0.5 * (1.0 - CONFIDENCE)
    low, high = (
        found / claimed * float(np.sqrt(effective / (2.0 * gammaincinv(effective / 2.0, p))))
        for p in (1.0 - tail, tail)
    )
    each = [s.sd for s in samples]
    return PooledSpread(
        sd=found,
        claimed=claimed,
        ratio=found / claimed,
        ratio_low=low,
        ratio_high=high,
        median=float(np.median(each)),
        largest=max(each),
        dof=effective,
        samples=len(samples),
    )


@dataclass(frozen=True, eq=False)
class AxisValues:
    """Repeated axes of one leg as numbers."""

    values: Array  # (n, 8) QUANTITIES, as differences to the first axis [rad, m]
    claimed: Array  # (n, 8, 8)
    inclination: Array  # (n,) angle between the image of the axis and the image x axis [rad]
    has_M_LS: bool  # whether it is seen in one place up to the width of the leg, for all axes


def axis_values(axes: LegAxes, chosen: BoolArray, radius: float) -> AxisValues:
    """Return what chosen axes are in numbers: the repeats of one leg in one view and pose."""
    u, M = axes.u[chosen], axes.M[chosen]
    basis, covariance = axes.basis[chosen], axes.covariance[chosen]
    values = _values(u, M, u[0], M[0])
    derivative = np.empty((len(u), len(QUANTITIES), 4))
    for k in range(4):
        step = _STEP * basis[:, k % 2]
        du, dM = (step, np.zeros_like(M)) if k < 2 else (np.zeros_like(u), step)
        up, down = (_values(u + s * du, M + s * dM, u[0], M[0]) for s in (1.0, -1.0))
        derivative[..., k] = (up - down) / (2.0 * _STEP)
    claimed = derivative @ covariance @ derivative.swapaxes(1, 2)
    normal = cross(u, M)
    inclination = np.arctan2(np.abs(normal[:, 0]), np.abs(normal[:, 1]))
    e_y = basis[:, :, 1]
    sigma_u_y = np.sqrt(np.einsum("ni,nij,nj->n", e_y, covariance[:, :2, :2], e_y))
    has_M_LS = _has_M_LS(u, M, sigma_u_y, claimed, radius)
    return AxisValues(values, claimed, inclination, has_M_LS)


def _has_M_LS(u: Array, M: Array, sigma_u_y: Array, claimed: Array, radius: float) -> bool:
    """Say whether M_LS is expected to be seen at the same place up to the width of the leg.

    It is not where an axis is parallel to the plane y = 0 within SURELY standard deviations.
    """
    if np.any(np.abs(u[:, 1]) <= np.maximum(SURELY * sigma_u_y, 10.0 * _STEP)):
        return False
    x, z = _M_LS(u, M)
    gradient = np.column_stack([1.0 / z, -x / z**2])  # of x / z, where M_LS is seen
    variance = np.einsum(
        "ni,nij,nj->n", gradient, claimed[:, _M_LS_ROWS][:, :, _M_LS_ROWS], gradient
    )
    return bool(np.all(np.sqrt(variance) < 2.0 * radius / np.linalg.norm(M, axis=1)))


def _values(u: Array, M: Array, u_0: Array, M_0: Array) -> Array:
    """Return the quantities of axes (n, 8) as differences to those of a reference axis."""
    n = cross(u_0, M_0)
    n /= np.linalg.norm(n)
    w = cross(n, u_0)  # the part of M_0 normal to u_0: away from the camera
    psi, theta = angles_of_direction(u)
    psi_0, theta_0 = angles_of_direction(u_0)
    x, z = _M_LS(u, M)
    x_0, z_0 = _M_LS(u_0[None], M_0[None])
    at_M = M - M_0 - u * (((M - M_0) @ u_0) / (u @ u_0))[:, None]  # where M_0 was along the leg
    columns = [
        psi - psi_0,
        np.remainder(theta - theta_0 + np.pi, 2.0 * np.pi) - np.pi,
        x - x_0,
        z - z_0,
        u @ n,
        at_M @ n,
        u @ w,
        at_M @ w,
    ]
    return np.column_stack(columns)


def _M_LS(u: Array, M: Array) -> tuple[Array, Array]:
    """Return x and z of the axis at y = 0; of any size where it is nearly parallel to it."""
    flat = np.abs(u[:, 1]) < 1e-12
    along = np.where(flat, 0.0, M[:, 1] / np.where(flat, 1.0, u[:, 1]))
    return M[:, 0] - along * u[:, 0], M[:, 2] - along * u[:, 2]


@dataclass(frozen=True, eq=False)
class LegOrientation:
    """One leg in repeated images of one pose in one view."""

    leg: int
    view: int
    pose: int
    images: int  # that show the leg by the model
    axes: int  # found in them
    quantities: Mapping[str, Sample]  # of two axes or more; without x and z if there is no M_LS
    inclination: float | None  # smallest to the image x axis [rad], where M_LS does not exist
    lines: tuple[Sample, ...]  # of each outline found twice: its offsets at both ends [px]
    outlines: int  # that the images show by the model
    outlines_found: int

    def samples(self, quantity: str) -> list[Sample]:
        """Return what repeats say of one of the ``QUANTITIES``, or of each outline."""
        if quantity == OUTLINE:
            return list(self.lines)
        return [self.quantities[quantity]] if quantity in self.quantities else []


def leg_orientations(
    outlines: Outlines,
    measurements: Measurements,
    legs: Sequence[Leg],
    repeats: Sequence[Repeats],
) -> list[LegOrientation]:
    """Return what the outlines in all repeated images say of every leg that they show."""
    radii = {part: r for leg in legs for part, r in leg.radius_along.items()}
    outlines = along_legs(outlines, legs)
    try:
        axes = axes_from_outlines(outlines, measurements, radii)
    except NotVisible:
        axes = None
    shown = ~is_out_of_sight(outlines)
    found = []
    for group in repeats:
        camera = measurements.views[group.view].camera
        for j, leg in enumerate(legs):
            here = shown & (outlines.leg == j) & np.isin(outlines.row, group.rows)
            if not here.any():
                continue
            quantities: dict[str, Sample] = {}
            inclination, n_axes = None, 0
            if axes is not None:
                chosen = (axes.leg == j) & np.isin(axes.row, group.rows)
                n_axes = int(np.count_nonzero(chosen))
                if n_axes > 1:
                    radius = max(leg.radius_along.values())
                    quantities, inclination = _axis_samples(axes, chosen, radius)
            found.append(
                LegOrientation(
                    leg=j,
                    view=group.view,
                    pose=group.pose,
                    images=len(np.unique(outlines.row[here])),
                    axes=n_axes,
                    quantities=quantities,
                    inclination=inclination,
                    lines=_line_samples(outlines, here & outlines.used, camera),
                    outlines=int(np.count_nonzero(here)),
                    outlines_found=int(np.count_nonzero(here & outlines.used)),
                )
            )
    return found


def _axis_samples(
    axes: LegAxes, chosen: BoolArray, radius: float
) -> tuple[dict[str, Sample], float | None]:
    """Return the samples of an axis, and its inclination if it has no M_LS."""
    found = axis_values(axes, chosen, radius)
    samples = {
        name: sample_of(found.values[:, [i]], found.claimed[:, [i]][:, :, [i]])
        for i, name in enumerate(QUANTITIES)
        if found.has_M_LS or name not in OF_M_LS
    }
    return samples, None if found.has_M_LS else float(found.inclination.min())


def _line_samples(outlines: Outlines, chosen: BoolArray, camera: Camera) -> tuple[Sample, ...]:
    """Return a sample of every outline (part and edge) that was found at least twice."""
    found: dict[tuple[str, int], list[int]] = {}
    for i in np.flatnonzero(chosen).tolist():
        found.setdefault((outlines.part[i], int(outlines.edge[i])), []).append(i)
    return tuple(
        _line_sample(camera, outlines.h[i], outlines.ends[i], outlines.covariance[i])
        for _, i in sorted(found.items())
        if len(i) > 1
    )


def _line_sample(camera: Camera, h: Array, ends: Array, covariance: Array) -> Sample:
    """Return how repeats of one outline (n, 3) lie, as offsets at two common ends [px].

    The common ends are the means of the ends (n, 2, 2) of their used pieces [px]; covariances
    (n, 2, 2) of the offsets at their own ends are carried there along the line.
    """
    own = camera.undistort(ends)
    common = own.mean(axis=0)
    offsets = camera.line_offset(
        np.broadcast_to(h[:, None], (len(h), 2, 3)), np.broadcast_to(common, own.shape)
    )
    along = common[1] - common[0]
    place = (own - common[0]) @ along / (along @ along)
    carry = np.linalg.inv(np.stack([1.0 - place, place], axis=-1))
    return sample_of(offsets, carry @ covariance @ carry.swapaxes(1, 2))
