"""Why outlines are rejected: by how much they disagree, and which other edge they lie on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.linearize import offsets_of
from legcal.refinement.problem import FitProblem
from legcal.refinement.state import State
from legcal.vision.cylinder import EPSILON

DISAGREES = "disagrees with the fit"  # the beginning of a reason
_ON_AN_EDGE = 1.5  # [px] at both ends
_MUCH_NEARER = 0.25  # of the distance from the outline that it was taken for


def rejection_reasons(
    problem: FitProblem, state: State, rejected: IntArray, offsets: Array
) -> list[str]:
    """Return why outlines disagree with a fit, in words.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where the fit ended.
    rejected : (m,) array of int
        The rejected ones of the problem's outlines.
    offsets : (n, 2) array
        How far both ends of all outlines are from where the fit puts them [px].
    """
    away = np.abs(offsets[rejected]).max(axis=1, initial=0.0)
    reasons = [f"{DISAGREES} by {distance:.1f} px" for distance in away.tolist()]
    names, from_edges = _distances_from_edges(problem, state, rejected)
    for i, distances in enumerate(from_edges):
        nearest = int(np.argmin(distances))
        if distances[nearest] < min(_ON_AN_EDGE, _MUCH_NEARER * away[i]):
            reasons[i] += f", lies on {names[nearest]}"
    return reasons


def _distances_from_edges(
    problem: FitProblem, state: State, rejected: IntArray
) -> tuple[list[str], Array]:
    """Return the names of all edges, and how far (m, n_edges) outlines are from each [px]."""
    o, names = problem.outlines, problem.legs.names
    part = np.repeat(np.arange(len(o.parts)), len(EPSILON))
    epsilon = np.tile(EPSILON, len(o.parts))
    edges = [
        f"edge {edge + 1} of {names[leg]}.{link}"
        for leg, link in o.parts
        for edge in range(len(EPSILON))
    ]
    outline, edge = np.repeat(rejected, len(edges)), np.tile(np.arange(len(edges)), len(rejected))
    constants = o.constants[outline].copy()
    constants[:, 8] = epsilon[edge]
    as_others = replace(
        o,
        index=o.index[outline],
        leg=np.array([leg for leg, _ in o.parts], dtype=np.intp)[part[edge]],
        view=o.view[outline],
        pose=o.pose[outline],
        radius=part[edge],
        feet=o.feet[outline],
        pixels=o.pixels[outline],
        constants=constants,
        covariance=o.covariance[outline],
        by_gamma=o.by_gamma[outline],
        bias_index=np.zeros((len(outline), 0), dtype=np.intp),
        bias_shift=np.zeros((len(outline), 0, 2)),
    )
    away = np.abs(offsets_of(replace(problem, outlines=as_others), state)).max(axis=1, initial=0.0)
    return edges, away.reshape(len(rejected), len(edges))
