"""Choice of the limbs among parallel edges along a part.

Stripes that a polished rod reflects run along it as its limbs do, often with more contrast, while
the limb shows only where what is behind ends. The limb model tells them apart: inside it may be any
surface, outside is a background, even along short pieces. It is fitted to the same pixels with the
limb at every distance near a line, and the likelihoods of blocks vote; both edges of a part
together, by its width.
"""

from collections.abc import Sequence

import numpy as np

from legcal.geometry.types import Array
from legcal.perception.blocks import MAX_DEPTH, ROWS
from legcal.perception.light import to_light
from legcal.perception.limb import (
    N_AMPLITUDES,
    POLISHED,
    powers,
    profile_functions,
)
from legcal.perception.pixel_sums import PixelBins, applied, medians
from legcal.perception.pooled_fit import COMMON, MIN_SAMPLES
from legcal.perception.profiles import Edge, read_profiles
from legcal.vision.camera import Camera
from legcal.vision.image_file import Grey

SHIFTS = np.arange(-4.0, 4.25, 0.5)  # places of a limb that are tried, inwards [px]
DEPTHS = 7.0, 3.0  # range of pixels outside and inside a line [px]
MOST_BLOCKS = 16  # most blocks of an outline
MIN_NOISE, NOISE_ROUNDS = 0.1, 3  # variance [grey levels^2]
MOST_VOTE = 10.0  # log likelihood by which a block speaks against a place at most
MIN_GAIN, MIN_SHIFT = 8.0, 1.0  # in log likelihood, and [px], for which another edge is taken


def limb_shifts(
    grey: Grey, camera: Camera, edges: Sequence[Edge], blur: float, narrower: Array, sigma: Array
) -> Array:
    """Return the shifts of limbs from lines, positive inwards, (n_edges,) [px].

    Edges are edge 1 and edge 2 of each part; a part is *narrower* (n_parts,) than its edges are
    apart [px], by a standard deviation *sigma*; the blur is known roughly [px].
    """
    evidence = _evidence(grey, camera, edges, blur).reshape(-1, 2, len(SHIFTS))
    width = (SHIFTS[:, None] + SHIFTS - narrower[:, None, None]) / sigma[:, None, None]
    both = evidence[:, 0, :, None] + evidence[:, 1, None] - 0.5 * width**2
    best = np.stack(np.divmod(both.reshape(len(both), -1).argmax(axis=1), len(SHIFTS)), axis=1)
    near = np.where(np.abs(SHIFTS) < MIN_SHIFT, 0.0, -np.inf)
    here = (both + near[:, None] + near).max(axis=(1, 2))
    is_other = both.max(axis=(1, 2)) - here > MIN_GAIN
    return np.asarray(np.where(is_other[:, None], SHIFTS[best], 0.0).ravel())


def _evidence(grey: Grey, camera: Camera, edges: Sequence[Edge], blur: float) -> Array:
    """Return the log likelihoods (n_edges, n_shifts) of places of limbs, up to a constant each."""
    half_width = np.array([edge.half_width for edge in edges])
    outer, inner = DEPTHS[0], np.minimum(DEPTHS[1], MAX_DEPTH * half_width)
    read = read_profiles(
        grey, camera, edges, [edge.v for edge in edges], (outer, inner), ROWS, MOST_BLOCKS
    )
    light, weight = to_light(read.grey, read.window, camera.gamma)
    kept = np.count_nonzero(weight, axis=1) >= MIN_SAMPLES
    edge = np.repeat(np.arange(len(edges)), np.diff(read.bounds))[kept]
    bounds = np.searchsorted(edge, np.arange(len(edges) + 1)).tolist()
    evidence = np.zeros((len(edges), len(SHIFTS)))
    if len(edge) == 0:
        return evidence
    light, weight, window = light[kept], weight[kept], read.window[kept]
    light = light - (np.sum(light * weight, axis=1) / weight.sum(axis=1))[:, None]
    sums = PixelBins.of(read.d[kept], weight, blur, window=window).sums(light)
    power, count = sums.power.sum(axis=1), sums.count.sum(axis=1)
    contrast = medians(2.0 * np.sqrt(power / count) + 1.0, edge, bounds)
    prior = np.eye(N_AMPLITUDES) * ((COMMON[POLISHED] * contrast[:, None]) ** -2)[edge, None]
    blurs = np.full(len(edges), blur)
    design = profile_functions(half_width, blurs, outer, POLISHED)[0][edge]
    whole = (0, len(edge))
    normal, right = [], []
    for shift in SHIFTS:
        values, slopes = powers((sums.grid - shift) / blur)
        at_bins = values[None], slopes[None] / blur, whole
        normal.append(design @ sums.products(*at_bins) @ design.swapaxes(1, 2))
        right.append((design @ sums.with_light(*at_bins)[..., None])[..., 0])
    normals, rights = np.array(normal), np.array(right)  # (n_shifts, n, ...)
    noise = np.full(len(edges), MIN_NOISE)
    for _ in range(NOISE_ROUNDS):
        variance = noise[edge]
        amplitude = applied(np.linalg.inv(normals + variance[:, None, None] * prior), rights)
        left = power - np.sum(amplitude * (2.0 * rights - applied(normals, amplitude)), axis=-1)
        of_block = np.maximum(left.min(axis=0), 0.0) / np.maximum(count - N_AMPLITUDES, 1.0)
        noise = np.fmax(medians(of_block, edge, bounds), MIN_NOISE)
    variance = noise[edge]
    system = normals / variance[:, None, None] + prior
    pull = rights / variance[:, None]
    explained = np.sum(pull * np.linalg.solve(system, pull[..., None])[..., 0], axis=-1)
    likelihood = 0.5 * (explained - np.linalg.slogdet(system)[1])
    vote = np.logaddexp(-MOST_VOTE, likelihood - likelihood.max(axis=0))
    # Too deep inside the limb its expansion is no use, and with no surface in sight there is none.
    surface = inner[edge] - SHIFTS[:, None]
    vote[(surface > MAX_DEPTH * half_width[edge]) | (surface <= 0.0)] = -MOST_VOTE
    for k in np.unique(edge).tolist():
        evidence[k] = vote[:, bounds[k] : bounds[k + 1]].sum(axis=1)
    return evidence
