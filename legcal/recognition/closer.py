"""Legs that were not found at first, searched for once more near a fit of their view.

Bars place a camera so well that outlines must be looked for some way around. A fit to those that
were found tells where the missing ones are, and how well that is known: near enough, one outline of
a leg is enough. What does not agree with the fit is searched for again as well.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from legcal.detection.detect import NOT_PLACED, detect_outlines
from legcal.detection.outline import OUTSIDE, outline_parts
from legcal.geometry.types import Array, BoolArray
from legcal.observations.outlines import Outlines
from legcal.observations.sets import choose_outlines, is_edited, join_outlines
from legcal.recognition.groups import Group
from legcal.recognition.near_fit import reversed_pose, sideways_sigmas
from legcal.recognition.recognised import Recognised, shifted
from legcal.recognition.searching import Search
from legcal.recognition.sentences import few_outlines, named
from legcal.recognition.view_fit import ViewFit, fit_view, least_evidence
from legcal.workers import Run, in_turn

DISAGREES = "disagrees with the other legs of its view"  # a reason
WINDOW = 2.0, 3.0  # around a fit: [px], standard deviations
WIDEST = 40.0  # [px]
CLEAR = 0.7  # of the evidence that a doubtful pose must have, where bars leave no doubt
Legs = set[tuple[int, int]]  # in images: row and leg


@dataclass(frozen=True, eq=False)
class Closer:
    """What a closer look gave.

    Attributes
    ----------
    recognised : Recognised
        Cameras and joints by the outlines.
    A_base, B_base : (n_rows, n_legs, 3) array
        Joint centres where the images see them [m].
    outlines : Outlines
        Those that agree with them; what was searched for and not found keeps its reason.
    fits : tuple of ViewFit or None
        The fit of each group; None where it was not placed or has no outlines.
    """

    recognised: Recognised
    A_base: Array
    B_base: Array
    outlines: Outlines
    fits: tuple[ViewFit | None, ...]


def look_closer(
    search: Search,
    groups: Sequence[Group],
    found: Recognised,
    outlines: Outlines,
    leg_names: Sequence[str],
    *,
    together: bool = True,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> Closer:
    """Fit all views to their outlines, and look for the legs that are missing near that.

    Parameters
    ----------
    search : Search
        The images and the model.
    groups : sequence of Group
        Views that are placed together.
    found : Recognised
        Where the legs and the cameras are.
    outlines : Outlines
        Measured near there.
    leg_names : sequence of str
        Names of the legs.
    together : bool
        As for :func:`legcal.detection.outline.outline_parts`.
    run : callable
        How images are searched.
    progress : callable, optional
        Called with the row of each image that was searched again.
    """
    fits = _turned_over(search, groups, found, outlines)
    found = _fitted(groups, found, fits)
    outlines, fits = _agreeing(search, groups, found, outlines, fits)
    window = _windows(search, groups, fits, outlines)
    found = _fitted(groups, found, fits)
    A, B = _joints(search, groups, found, fits)
    again = detect_outlines(
        search.load,
        search.measurements,
        A,
        B,
        search.cylinders,
        found.T_base_camera,
        search.wanted,
        leg_names,
        window=window,
        progress=progress,
        run=run,
        method=partial(outline_parts, together=together, foretold=True),
    )
    outlines = _merged(outlines, again)
    fits = _fits(search, groups, found, outlines)
    outlines, fits = _agreeing(search, groups, found, outlines, fits)
    found = _believed(search, groups, _fitted(groups, found, fits), fits)
    placed = np.array([T is not None for T in found.T_base_camera])
    outlines = _rejected(outlines, ~placed[search.measurements.view[outlines.row]], NOT_PLACED)
    return Closer(found, *_joints(search, groups, found, fits), outlines, tuple(fits))


def _agreeing(
    search: Search,
    groups: Sequence[Group],
    found: Recognised,
    outlines: Outlines,
    fits: list[ViewFit | None],
) -> tuple[Outlines, list[ViewFit | None]]:
    """Return outlines without misfits, and the fits to the others."""
    if not any(fit is not None and fit.misfits.any() for fit in fits):
        return outlines, fits
    outlines = _without_misfits(outlines, fits)
    return outlines, _fits(search, groups, found, outlines)


def _fits(
    search: Search, groups: Sequence[Group], found: Recognised, outlines: Outlines
) -> list[ViewFit | None]:
    """Return the fit of each group; None where it was not placed or has no outlines."""
    fits: list[ViewFit | None] = []
    for group in groups:
        v = group.views[0]
        T = found.T_base_camera[v]
        if T is None:
            fits.append(None)
            continue
        T_base_group = T * group.T_group_camera[v].inv()
        fits.append(fit_view(search, group, T_base_group, found.shift[v], outlines))
    return fits


def _turned_over(
    search: Search, groups: Sequence[Group], found: Recognised, outlines: Outlines
) -> list[ViewFit | None]:
    """Return fits, with near and far exchanged where outlines suit that better."""
    fits = _fits(search, groups, found, outlines)
    for g, (group, fit) in enumerate(zip(groups, fits, strict=True)):
        if fit is None or len(group.views) > 1 or fit.suits:
            continue
        other = reversed_pose(search, group, fit.T_base_group)
        over = fit_view(search, group, other, np.zeros_like(fit.shift), outlines)
        if over is not None and over.evidence > fit.evidence:
            fits[g] = over
    return fits


def _without_misfits(outlines: Outlines, fits: Sequence[ViewFit | None]) -> Outlines:
    """Return outlines without those of legs that do not fit; what people edited stays."""
    wrong: Legs = set()
    for fit in fits:
        if fit is not None:
            wrong.update(
                zip(fit.row[fit.misfits].tolist(), fit.leg[fit.misfits].tolist(), strict=True)
            )
    return _rejected(outlines, _among(outlines, wrong), DISAGREES)


def _rejected(outlines: Outlines, wrong: BoolArray, why: str) -> Outlines:
    """Return outlines without some of those that were used."""
    out = outlines.used & wrong & ~is_edited(outlines)
    reason = tuple(
        why if is_out else reason
        for is_out, reason in zip(out.tolist(), outlines.reason, strict=True)
    )
    return replace(outlines, used=outlines.used & ~out, reason=reason)


def _believed(
    search: Search, groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> Recognised:
    """Return cameras without those for which hardly an outline speaks, near no rough pose."""
    T, unplaced = list(found.T_base_camera), dict(found.unplaced)
    for group, fit in zip(groups, fits, strict=True):
        least = CLEAR * least_evidence(group)
        is_sure = fit is not None and fit.is_determined and fit.evidence >= least
        if group.hint is not None or T[group.views[0]] is None or is_sure:
            continue
        name = named([search.measurements.views[v].name for v in group.views])
        n = 0 if fit is None else int(fit.n_outlines.sum())
        for v in group.views:
            T[v], unplaced[v] = None, few_outlines(name, n, len(group.rows))
    return replace(found, T_base_camera=T, unplaced=unplaced)


def _windows(
    search: Search, groups: Sequence[Group], fits: Sequence[ViewFit | None], outlines: Outlines
) -> Array:
    """Return how far missing legs may be from a fit (n_rows, n_legs) [px]; NaN for others."""
    missing = np.zeros((search.measurements.n_rows, search.n_legs), dtype=np.bool_)
    visible = [not why.startswith((OUTSIDE, NOT_PLACED)) for why in outlines.reason]
    missing[outlines.row[visible], outlines.leg[visible]] = True
    missing[outlines.row[outlines.used], outlines.leg[outlines.used]] = False
    window = np.full(missing.shape, np.nan)
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None and missing[group.rows].any():
            sigma = sideways_sigmas(search, group, fit)[group.rows]
            near = np.minimum(WINDOW[0] + WINDOW[1] * sigma, WIDEST)
            window[group.rows] = np.where(missing[group.rows], near, np.nan)
    return window


def _merged(outlines: Outlines, again: Outlines) -> Outlines:
    """Return outlines with those of legs that were found again in their place."""
    found = set(zip(again.row[again.used].tolist(), again.leg[again.used].tolist(), strict=True))
    kept, new = choose_outlines(outlines, ~_among(outlines, found)), _among(again, found)
    return join_outlines([kept, choose_outlines(again, new)])


def _among(outlines: Outlines, legs: Legs) -> BoolArray:
    """Return which outlines are of some legs."""
    own = zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True)
    return np.array([one in legs for one in own], dtype=np.bool_)


def _fitted(
    groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> Recognised:
    """Return cameras and shifts by the fits."""
    T, shift = list(found.T_base_camera), found.shift.copy()
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            for v in group.views:
                T[v], shift[v] = fit.T_base_group * group.T_group_camera[v], fit.shift
    return replace(found, T_base_camera=T, shift=shift)


def _joints(
    search: Search, groups: Sequence[Group], found: Recognised, fits: Sequence[ViewFit | None]
) -> tuple[Array, Array]:
    """Return joint centres (n_rows, n_legs, 3) by the fits, elsewhere as they were recognised."""
    A, B = shifted(found, search.measurements.view, search.A_base, search.B_base)
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            by_fit = fit.joints(search.A_base, search.B_base)
            A[group.rows], B[group.rows] = (X[group.rows] for X in by_fit)
    return A, B
