"""Radii that pictures contradict: how wide edge pairs are against the model (section 3.1).

Lines place a camera, widths hardly do; so a leg that is seen wider or thinner at its place has
another radius than the model says. Pairs of wrong edges agree on nothing: those of most views must.
Where light and shade meet on a leg they may agree all the same, so that only parts are enough whose
outlines were not found.
"""

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.machine.leg import Cylinder
from legcal.perception.pair_matching import (
    CameraPoses,
    PairMatches,
    Picture,
    Pictures,
    gauss_newton_step,
    match_pairs,
)
from legcal.perception.tuning import SEARCHING
from legcal.vision.visibility import look_alike

FACTORS = (1.0, 0.93, 1.075, 0.86, 1.16, 0.8, 1.25, 0.72, 1.38)  # of radii that are tried
TOLERANCES = (*2 * (SEARCHING[3],), *2 * (SEARCHING[4],))  # of an axis from its pair
MIN_MATCH_SCORE = 0.25  # score of a segment with its pair that counts
PREFERRED = 1.15  # ratio by which a farther factor must be better than a nearer one
MIN_CHANGE = 0.08  # from the model, as a logarithm: less does no harm
CONVERGED = 0.02  # the same once corrected
MIN_SIGMAS = 4.0  # standard errors
MIN_PAIRS = 3  # pairs of a part in a view
MAX_SPREAD = 0.025  # robust standard deviation of their logarithms: else some are of other edges
NOISE = 0.01  # of a factor by one view
CONSISTENT = 0.09  # logarithms from views of one part, or of parts that are wrong alike
MIN_SHARE_ALIKE = 0.75  # of the parts that must be wrong alike, to be all
MAX_ITERATIONS = 4  # of correcting radii and placing cameras by them

LegRadius = tuple[int, float]  # leg, and radius in the model [m]


@dataclass(frozen=True, eq=False)
class RadiusFactors:
    """Factors of radii that pictures show, by leg and radius in the model."""

    factor: dict[LegRadius, float]  # by how much they differ from the model; others are left out
    common: float = 0.0  # the factor of all parts, if they differ alike; 0 otherwise

    def corrected(self, leg: int, cylinder: Cylinder) -> float:
        """Return the radius that was found of a cylinder of a leg [m]."""
        return cylinder.radius * self.of(leg, cylinder.radius)

    def of(self, leg: int, radius: float) -> float:
        """Return the factor of a part."""
        for (other, r), factor in self.factor.items():
            if other == leg and look_alike(r, radius):
                return factor
        return self.common or 1.0

    def only(self, suspects: Collection[LegRadius]) -> "RadiusFactors":
        """Return the factors of some parts; of all only where most of them are among these.

        Where all differ alike and few of them are suspect, light and optics make the edges of all
        thinner, and it is no reason why these few were not found.
        """
        mine = {
            part: factor
            for part, factor in self.factor.items()
            if any(part[0] == leg and look_alike(part[1], radius) for leg, radius in suspects)
        }
        if self.common:
            return self if len(mine) >= MIN_SHARE_ALIKE * len(self.factor) else NO_RADIUS_FACTORS
        return RadiusFactors(mine)

    def beyond(self, different: float) -> "RadiusFactors":
        """Return the factors that differ from the model by more than a logarithm."""
        more = {part: f for part, f in self.factor.items() if abs(np.log(f)) > different}
        return RadiusFactors(more, self.common) if more else NO_RADIUS_FACTORS

    def of_the_same(self, step: "RadiusFactors") -> "RadiusFactors":
        """Return the factors of a further step for the parts that this one has corrected."""
        if self.common:
            return step if step.common else NO_RADIUS_FACTORS
        mine = {(leg, r * factor) for (leg, r), factor in self.factor.items()}
        return RadiusFactors({part: f for part, f in step.factor.items() if part in mine})

    def then(self, step: "RadiusFactors") -> "RadiusFactors":
        """Return both corrections, the second one of radii that the first had corrected."""
        if not self.factor:
            return step
        factor = {
            (leg, r): f * step.of(leg, r * self.of(leg, r)) for (leg, r), f in self.factor.items()
        }
        return RadiusFactors(factor, self.common * (step.common or 1.0))


NO_RADIUS_FACTORS = RadiusFactors({})


def estimate_radii(
    views: Iterable[tuple[int, Sequence[Picture], CameraPoses]],
    different: float = MIN_CHANGE,
    *,
    alone: bool = False,
) -> RadiusFactors:
    """Return the radii that differ from the model.

    ``views`` are views, their pictures, and T_camera_base. A radius differs from a factor on whose
    logarithm is ``different``; with ``alone`` the parts do not share a factor.
    """
    samples: dict[LegRadius, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for view, pictures, placed in views:
        every = Pictures.of(pictures)
        pose = _by_lines(every, placed)
        found = _whatever_the_width(every, pose, TOLERANCES[-1])
        for picture, score, pair in zip(pictures, found.score, found.pair, strict=True):
            for part, logarithm in _logarithms(picture, pose, score[0], pair[0]):
                samples[part][view].append(logarithm)
    agreed = {part: _agreed(list(of_part.values())) for part, of_part in samples.items()}
    known = {part: found for part, found in agreed.items() if found is not None}
    if not known:
        return NO_RADIUS_FACTORS
    common = float(np.median([value for value, _ in known.values()]))
    alike = np.mean([abs(value - common) < CONSISTENT for value, _ in known.values()])
    of_several = alike >= MIN_SHARE_ALIKE and len({leg for leg, _ in known}) > 1
    if not alone and abs(common) > different and of_several:
        factor = float(np.exp(common))
        return RadiusFactors(dict.fromkeys(samples, factor), factor)
    bias = common if of_several else 0.0  # of pairs, whatever the leg
    differing = {
        part: float(np.exp(value - bias))
        for part, (value, sigma) in known.items()
        if abs(value - bias) > max(different, MIN_SIGMAS * sigma)
    }
    return RadiusFactors(differing)


def _agreed(views: Sequence[Sequence[float]]) -> tuple[float, float] | None:
    """Return the logarithm on which views of a part agree, and its standard error.

    Pairs of a part that something hides, or of wrong edges, do not agree with each other.
    """
    middles: list[float] = []
    enough = [np.array(values) for values in views if len(values) >= MIN_PAIRS]
    for values in enough:
        values = values[np.abs(values - _densest(values)) <= CONSISTENT]
        if len(values) < MIN_PAIRS:
            continue
        middle = float(np.median(values))
        spread = 1.48 * float(np.median(np.abs(values - middle)))
        if spread < MAX_SPREAD:
            middles.append(middle)
    if not middles or 2 * len(middles) < len(enough) or np.ptp(middles) > CONSISTENT:
        return None
    sigma = max(float(np.std(middles)), NOISE) / float(np.sqrt(len(middles)))
    return float(np.mean(middles)), sigma


def _densest(values: Array) -> float:
    """Return the middle of the shortest interval with more than half of the values.

    Few pairs of inner edges, where light and shade meet, do not move it as they move a median.
    """
    ordered = np.sort(values)
    most = len(ordered) // 2 + 1
    first = int(np.argmin(ordered[most - 1 :] - ordered[: len(ordered) - most + 1]))
    return float(np.median(ordered[first : first + most]))


def _by_lines(pictures: Pictures, placed: CameraPoses) -> CameraPoses:
    """Return a pose by where pairs are, which widths hardly move: joints stay as in the model."""
    pose = CameraPoses.rigid(placed.R[:1], placed.t[:1], placed.shift.shape[1])
    for tolerance in TOLERANCES:
        matches = _whatever_the_width(pictures, pose, tolerance)
        pose = gauss_newton_step(pictures, pose, matches, tolerance)
    return pose


def _whatever_the_width(pictures: Pictures, pose: CameraPoses, tolerance: float) -> PairMatches:
    """Return the best pairs of segments with any radius; farther factors must be clearly better."""
    best = match_pairs(pictures, pose, tolerance)
    for factor in FACTORS[1:]:
        scaled = replace(pictures, radius=factor * pictures.radius)
        matches = match_pairs(scaled, pose, tolerance)
        better = matches.score > np.maximum(PREFERRED * best.score, MIN_MATCH_SCORE)
        best = PairMatches(
            np.where(better, matches.score, best.score),
            np.where(better, matches.pair, best.pair),
            best.visible,
        )
    return best


def _logarithms(
    picture: Picture, pose: CameraPoses, score: Array, pair: IntArray
) -> list[tuple[LegRadius, float]]:
    """Return the logarithms of the widths of a picture's pairs against the model's.

    ``score`` and ``pair`` (n_segments,) are those of its segments at a pose.
    """
    targets = picture.targets
    if len(targets) == 0 or len(picture.pairs) == 0:
        return []
    R, t = picture.R @ pose.R[0], picture.R @ pose.t[0] + picture.t
    best = np.where(score >= MIN_MATCH_SCORE, score, 0.0)
    logarithms = []
    for k in np.flatnonzero(best > 0.0).tolist():
        if np.count_nonzero((pair == pair[k]) & (best > 0.0)) > 1:  # whose pair it is, is not known
            continue
        ends = targets.ends[k] @ R.T + t
        expected = _width(ends, float(targets.radius[k]), picture.pairs.middle[pair[k]])
        seen = float(picture.pairs.width[pair[k]].mean())
        part = (int(targets.leg[k]), float(targets.radius[k]))
        logarithms.append((part, float(np.log(seen / expected))))
    return logarithms


def _width(ends: Array, radius: float, middle: Array) -> float:
    """Return the apparent width of a cylinder along ends (2, 3), next to a point."""
    xy = ends[:, :2] / ends[:, 2:]
    run = xy[1] - xy[0]
    share = float((middle - xy[0]) @ run / (run @ run))
    inverse_depth = (1.0 - share) / ends[0, 2] + share / ends[1, 2]
    normal = np.cross(ends[0], ends[1])
    flat = float(np.linalg.norm(normal[:2]) / np.linalg.norm(normal))
    return float(2.0 * radius * max(inverse_depth, 1e-9) / max(flat, 0.1))


def radius_notes(
    factors: RadiusFactors, legs: Sequence[str], seen_in: Mapping[LegRadius, str]
) -> list[str]:
    """Return notes on radii that differ from the model; *seen_in* names the images of each."""
    if not factors.factor:
        return []
    if factors.common:
        way = _away(factors.common)
        return [
            f"All legs appear {way} than in the model; the radii found in the images were used. "
            "Correct the radii of the model, or, if these are right, the unit and scale of the "
            "model and the readings."
        ]
    return [
        f"{legs[leg]} may be {_away(factor)} than in the model: its radius is about "
        f"{1e3 * factor * radius:.1f} mm in {seen_in[leg, radius]}, not {1e3 * radius:.2f} mm; the "
        "measured radius was used; measure the leg, and correct the model if confirmed."
        for (leg, radius), factor in sorted(factors.factor.items())
    ]


def _away(factor: float) -> str:
    way = "thicker" if factor > 1.0 else "thinner"
    return f"{1e2 * abs(factor - 1.0):.0f} % {way}"
