"""The two outlines of every part of every leg in one image: found, measured, judged (3.1).

Reading order: where the parts should be and what hides them; the pair of edges; the limb model
fitted to all outlines of the image together; the verdict on each part, with the reason.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, BoolArray
from legcal.vision.band import Band, band_of_leg
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON
from legcal.vision.fit import BlockFit, estimate_blur, fit_blocks
from legcal.vision.limb import Samples
from legcal.vision.pairs import block_positions, find_pair
from legcal.vision.picture import Grey
from legcal.vision.pieces import Piece
from legcal.vision.prediction import PredictedLeg, hidden_by
from legcal.vision.profiles import Profiles, read_profiles
from legcal.vision.straight import StraightFit, fit_straight

DEPTH = 6.0  # distance from an outline up to which pixels are used [px]
REACH = 9  # pixels read to each side: DEPTH over the cosine of 45 degrees
INNERMOST = 0.8  # largest used depth, in half-widths
SATURATED = 250.0  # grey level from which a pixel says no more than "bright"
ROUNDS = 3
MARGIN = 4.0  # beside a leg in front [px]
LEAST_LENGTH = (30.0, 1.0)  # of an outline: [px] and in widths of the leg
NARROWEST = 5.0  # [px]
LEAST_CONTRAST = 4.0  # [grey levels]
LEAST_KEPT = 0.5  # share of the unhidden blocks that must lie on the line
LARGEST_SCATTER = 0.6  # [px]
LARGEST_SIGMA = 0.5  # [px]
WIDTH_TOLERANCE = (0.7, 0.06)  # [px] and share of the predicted width


@dataclass(frozen=True, eq=False)
class PartOutlines:
    """Both outlines of a part in an image.

    Attributes
    ----------
    leg : int
        The leg.
    part : str
        The URDF link of the cylinder.
    h : (2, 3) array
        Unit normals h1, h2 of eq (3); NaN where nothing was found.
    ends : (2, 2, 2) array
        Both ends of both used pieces [px], the first nearer to the base joint.
    covariance : (2, 2, 2) array
        Of the normal offsets at these ends [px^2].
    reason : str
        Why the part was rejected, "" if it is to be used.
    """

    leg: int
    part: str
    h: Array
    ends: Array
    covariance: Array
    reason: str


@dataclass(frozen=True, eq=False)
class _Part:
    """A part on its way: where it is predicted, and where its edges were found."""

    leg: PredictedLeg
    piece: Piece
    band: Band
    predicted: Array  # (2, 2) offsets of edge 1 and 2 at both ends of the band
    hidden: BoolArray  # of the block positions
    v: Array  # (2, 2) found offsets

    @property
    def half_width(self) -> float:
        return float(0.5 * np.mean(self.v[1] - self.v[0]))


def outline_parts(
    grey: Grey,
    camera: Camera,
    legs: Sequence[PredictedLeg],
    names: Sequence[str],
    wanted: BoolArray,
    window: Array,
) -> list[PartOutlines]:
    """Find and measure the outlines of all parts in one image.

    Parameters
    ----------
    grey : Grey
        The image.
    camera : Camera
        Its camera.
    legs : sequence of PredictedLeg
        All legs that the image should show; also the unwanted ones hide others.
    names : sequence of str, length n_legs
        Names of the legs, for reasons.
    wanted : (n_legs,) array of bool
        The legs to look for, by their index.
    window : (n_legs,) array
        Largest distance of an outline from its prediction [px].

    Returns
    -------
    list of PartOutlines
        One for every part of every wanted leg, found or not, from base to platform.
    """
    results: list[PartOutlines] = []
    parts: list[_Part] = []
    for leg in legs:
        if not wanted[leg.leg]:
            continue
        for piece, h in zip(leg.pieces, leg.outlines, strict=True):
            found = _find(grey, camera, legs, names, leg, piece, h, float(window[leg.leg]))
            if isinstance(found, str):
                results.append(_rejected(leg, piece, found))
            else:
                parts.append(found)
    if parts:
        results.extend(_measure(grey, camera, parts))
    return sorted(results, key=lambda result: result.leg)


def _find(
    grey: Grey,
    camera: Camera,
    legs: Sequence[PredictedLeg],
    names: Sequence[str],
    leg: PredictedLeg,
    piece: Piece,
    h: Array,
    window: float,
) -> _Part | str:
    """Find the pair of edges of a part, or say why not."""
    band = band_of_leg(camera, leg.A_camera, leg.B_camera, piece.start, piece.end)
    if band is None:
        return "outside the image"
    predicted = band.offsets(h[:, None, :], np.array([0.0, band.length]))
    width = float(np.mean(predicted[1] - predicted[0]))
    least = max(LEAST_LENGTH[0], LEAST_LENGTH[1] * width)
    if width < NARROWEST:
        return f"too narrow, {width:.1f} px wide"
    if band.length < least:
        return f"too short, {band.length:.0f} px in the image"
    t = block_positions(band)
    front = _in_front(legs, leg, h, band, t)
    free = np.all(front < 0, axis=0)
    if np.mean(free) * band.length < least:
        values, counts = np.unique(front[front >= 0], return_counts=True)
        return f"hidden by {names[values[np.argmax(counts)]]}"
    pair = find_pair(grey, camera, band, predicted, ~free, window)
    if pair is None:
        return "no convincing pair of edges"
    return _Part(leg, piece, band, predicted, ~free, pair.v)


def _in_front(
    legs: Sequence[PredictedLeg], leg: PredictedLeg, h: Array, band: Band, t: Array
) -> Array:
    """Return which leg hides each outline (2, n_t) at t [px] of a band, -1 where it is free."""
    s = leg.distance_along(band, t)
    axis = leg.A_camera + s[:, None] * leg.u
    front = []
    for normal, epsilon in zip(h, EPSILON, strict=True):
        radius = epsilon * float(normal @ leg.A_camera)
        line = axis - epsilon * radius * normal
        front.append(hidden_by(leg, legs, line, MARGIN / band.scale))
    return np.stack(front)


def _measure(grey: Grey, camera: Camera, parts: Sequence[_Part]) -> list[PartOutlines]:
    """Measure the outlines of parts whose edges are known to a pixel."""
    profiles: list[Profiles] = []
    for part in parts:
        depth = min(DEPTH, INNERMOST * part.half_width)
        for v, epsilon in zip(part.v, EPSILON, strict=True):
            read = read_profiles(grey, camera, part.band, v, epsilon, (-DEPTH, depth), REACH)
            block = np.searchsorted(block_positions(part.band), read.t)
            profiles.append(read.take(~part.hidden[np.minimum(block, len(part.hidden) - 1)]))
    counts = [len(p.t) for p in profiles]
    if sum(counts) == 0:
        return [_rejected(part.leg, part.piece, "too short") for part in parts]
    half_width = np.repeat([p.half_width for p in parts for _ in EPSILON], counts)
    lines, fit = _fit_all(profiles, half_width.astype(np.float32)[:, None], parts)
    splits = np.cumsum(counts)[:-1]
    contrast = [
        float(np.median(np.abs(c))) if len(c) else 0.0 for c in np.split(fit.contrast, splits)
    ]
    return [
        _judge(camera, part, lines[2 * i : 2 * i + 2], contrast[2 * i : 2 * i + 2])
        for i, part in enumerate(parts)
    ]


def _fit_all(
    profiles: Sequence[Profiles], half_width: Samples, parts: Sequence[_Part]
) -> tuple[list[StraightFit | None], BlockFit]:
    """Fit the limb model and the lines in turn; the lines hold the whole shift from the start."""
    d = np.concatenate([p.d for p in profiles])
    grey = np.concatenate([p.grey for p in profiles])
    inside = np.concatenate([p.inside for p in profiles])
    bounds = np.cumsum([0, *(len(p.t) for p in profiles)])
    moved = np.zeros(len(d))
    blur = 1.0
    for turn in range(ROUNDS + 1):
        at = d - moved[:, None].astype(np.float32)
        if turn == 1:
            blur = estimate_blur(at, grey, inside, half_width)
        fit = fit_blocks(at, grey, inside, half_width, blur)
        lines: list[StraightFit | None] = []
        for i, p in enumerate(profiles):
            block = slice(bounds[i], bounds[i + 1])
            position = p.t / parts[i // 2].band.length
            shift = (moved[block] + fit.shift[block]) / p.gain
            line = fit_straight(position, shift, fit.variance[block] / p.gain**2)
            lines.append(line)
            if line is not None:
                along = line.ends[0] + (line.ends[1] - line.ends[0]) * position
                moved[block] = along * p.gain
    return lines, fit


def _judge(
    camera: Camera, part: _Part, lines: Sequence[StraightFit | None], contrast: Sequence[float]
) -> PartOutlines:
    """Turn the fitted lines of a part into outlines with a verdict."""
    if lines[0] is None or lines[1] is None:
        return _rejected(part.leg, part.piece, "no straight edge")
    fits = [lines[0], lines[1]]
    v = np.stack([v + e * f.ends for v, e, f in zip(part.v, EPSILON, fits, strict=True)])
    h = np.stack([part.band.line(*edge) for edge in v])
    ends = np.empty((2, 2, 2))
    for i, f in enumerate(fits):
        place = np.array([f.first, f.last])
        offset = v[i, 0] + (v[i, 1] - v[i, 0]) * place
        ends[i] = camera.distort(part.band.points(place * part.band.length, offset))
    covariance = np.stack([f.covariance for f in fits])
    reason = _reason(part, v, fits, contrast)
    return PartOutlines(part.leg.leg, part.piece.link, h, ends, covariance, reason)


def _reason(part: _Part, v: Array, fits: Sequence[StraightFit], contrast: Sequence[float]) -> str:
    """Return why a part cannot be trusted, "" if it can."""
    width, expected = v[1] - v[0], part.predicted[1] - part.predicted[0]
    mismatch = np.abs(width - expected) / (WIDTH_TOLERANCE[0] + WIDTH_TOLERANCE[1] * expected)
    if mismatch.max() > 1.0:
        i = int(np.argmax(mismatch))
        return f"width inconsistent with the radius, {width[i]:.1f} px for {expected[i]:.1f} px"
    least = max(LEAST_LENGTH[0], LEAST_LENGTH[1] * float(width.mean()))
    length = min((f.last - f.first) * part.band.length for f in fits)
    if length < least:
        return f"too short, {length:.0f} px visible"
    kept = min(float(np.mean(f.kept)) for f in fits)
    if kept < LEAST_KEPT:
        return f"edge not straight, {100 * kept:.0f} % of it on one line"
    if min(contrast) < LEAST_CONTRAST:
        return f"low contrast, {min(contrast):.1f} grey levels"
    scatter = max(f.scatter for f in fits)
    if scatter > LARGEST_SCATTER:
        return f"edge too rough, scatter {scatter:.2f} px"
    sigma = max(float(np.sqrt(np.diag(f.covariance).max())) for f in fits)
    if sigma > LARGEST_SIGMA:
        return f"edge too uncertain, sigma {sigma:.2f} px"
    return ""


def _rejected(leg: PredictedLeg, piece: Piece, reason: str) -> PartOutlines:
    """Return a part of which nothing was found."""
    nothing = np.full((2, 3), np.nan)
    square = np.full((2, 2, 2), np.nan)
    return PartOutlines(leg.leg, piece.link, nothing, square, square.copy(), reason)
