"""Looking again: views fitted to their outlines, and missing legs measured near there.

The one mechanism for it: a fit says where all legs of a view are and how well that is known; legs
that do not suit it are rejected, those that are missing are looked for within what it knows, and
the view is fitted again. Outlines of wrong edges agree on no fit, which also tells camera poses
from each other that edge pairs do not.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from legcal.data import Outlines, is_edited, join_outlines
from legcal.geometry import Array, BoolArray
from legcal.perception.detection import NOT_PLACED, measure_outlines
from legcal.perception.outline import OUTSIDE
from legcal.perception.placement import Group, Placement, Search
from legcal.perception.view_fit import (
    ViewFit,
    fit_view,
    least_evidence,
    reversed_pose,
    sideways_sigmas,
)
from legcal.workers import Run, in_turn

DISAGREES = "disagrees with the other legs of its view"  # a reason
WINDOW = 2.0, 3.0  # around a fit: [px], standard deviations
WIDEST = 40.0  # [px]
CLEAR = 0.7  # of the evidence that a doubtful pose must have, where edge pairs leave no doubt
Fits = list[ViewFit | None]  # of groups; None where one was not placed or has no outlines


def look_again(
    search: Search,
    groups: Sequence[Group],
    placement: Placement,
    outlines: Outlines,
    *,
    together: bool = True,
    run: Run = in_turn,
    progress: Callable[[int], None] | None = None,
) -> tuple[Placement, Outlines, Fits]:
    """Fit all views to their outlines, and look for the legs that are missing near that.

    Return cameras and joint centres by the outlines, the outlines that agree with them (what was
    looked for and not found keeps its reason), and the fits. ``together`` is as for
    :func:`legcal.perception.outline.measure`.
    """
    fits = _turned_over(search, groups, placement, outlines)
    placement = _by_fits(search, groups, placement, fits)
    outlines, fits = _agreeing(search, groups, placement, outlines, fits)
    placement = _by_fits(search, groups, placement, fits)
    near = replace(placement, window=_windows(search, groups, fits, outlines))
    rows = sorted(row for group in groups for row in group.rows)
    again, _ = measure_outlines(search, near, rows, together=together, run=run, progress=progress)
    found = set(zip(again.row[again.used].tolist(), again.leg[again.used].tolist(), strict=True))
    kept = outlines.choose(~_among(outlines, found))
    outlines = join_outlines([kept, again.choose(_among(again, found))])
    fits = _fits(search, groups, placement, outlines)
    outlines, fits = _agreeing(search, groups, placement, outlines, fits)
    placement = _believed(search, groups, _by_fits(search, groups, placement, fits), fits)
    placed = np.array([T is not None for T in placement.T_base_camera])
    lost = ~placed[search.measurements.view[outlines.row]]
    return placement, outlines.reject(lost & ~is_edited(outlines), NOT_PLACED), fits


def _fits(
    search: Search, groups: Sequence[Group], placement: Placement, outlines: Outlines
) -> Fits:
    """Return the fit of each group."""
    fits: Fits = []
    for group in groups:
        v = group.views[0]
        T = placement.T_base_camera[v]
        if T is None:
            fits.append(None)
            continue
        T_base_group = T * group.T_group_camera[v].inv()
        fits.append(fit_view(search, group, T_base_group, placement.shift[v], outlines))
    return fits


def _turned_over(
    search: Search, groups: Sequence[Group], placement: Placement, outlines: Outlines
) -> Fits:
    """Return fits, with near and far exchanged where outlines suit that better."""
    fits = _fits(search, groups, placement, outlines)
    for g, (group, fit) in enumerate(zip(groups, fits, strict=True)):
        if fit is None or len(group.views) > 1 or fit.suits:
            continue
        other = reversed_pose(search, group, fit.T_base_group)
        over = fit_view(search, group, other, np.zeros_like(fit.shift), outlines)
        if over is not None and over.evidence > fit.evidence:
            fits[g] = over
    return fits


def _agreeing(
    search: Search,
    groups: Sequence[Group],
    placement: Placement,
    outlines: Outlines,
    fits: Fits,
) -> tuple[Outlines, Fits]:
    """Return outlines without those of legs that do not fit, and the fits to the others."""
    wrong = {
        one
        for fit in fits
        if fit is not None
        for one in zip(fit.row[fit.misfits].tolist(), fit.leg[fit.misfits].tolist(), strict=True)
    }
    if not wrong:
        return outlines, fits
    out = _among(outlines, wrong) & ~is_edited(outlines)  # what people edited stays
    outlines = outlines.reject(out, DISAGREES)
    return outlines, _fits(search, groups, placement, outlines)


def _by_fits(
    search: Search, groups: Sequence[Group], placement: Placement, fits: Fits
) -> Placement:
    """Return cameras and joint centres by the fits, those of other groups as recognised."""
    T, shift = list(placement.T_base_camera), placement.shift.copy()
    for group, fit in zip(groups, fits, strict=True):
        if fit is not None:
            for v in group.views:
                T[v], shift[v] = fit.T_base_group * group.T_group_camera[v], fit.shift
    recognised = placement.shifted(search, shift)
    A, B = placement.A_base.copy(), placement.B_base.copy()
    for group, fit in zip(groups, fits, strict=True):
        joints = recognised.A_base, recognised.B_base
        if fit is not None:
            joints = fit.joints(search.A_base, search.B_base)
        A[group.rows], B[group.rows] = (X[group.rows] for X in joints)
    return replace(recognised, T_base_camera=tuple(T), A_base=A, B_base=B)


def _believed(
    search: Search, groups: Sequence[Group], placement: Placement, fits: Fits
) -> Placement:
    """Return cameras without those for which hardly an outline speaks, near no rough pose."""
    T, unplaced = list(placement.T_base_camera), dict(placement.unplaced)
    for group, fit in zip(groups, fits, strict=True):
        least = CLEAR * least_evidence(group)
        is_sure = fit is not None and fit.is_determined and fit.evidence >= least
        if group.hint is not None or T[group.views[0]] is None or is_sure:
            continue
        names = [search.measurements.views[v].name for v in group.views]
        n, n_images = 0 if fit is None else int(fit.n_outlines.sum()), len(group.rows)
        why = (
            f"view {group_name(names)}: its camera could not be placed: found only {n} outlines "
            f"that agree in its {n_images} image{'s' * (n_images != 1)}, needed more than other "
            "edges give by chance; add images at other readings, in better light, or a rough "
            "T_base_camera."
        )
        unplaced |= dict.fromkeys(names, why)
        for v in group.views:
            T[v] = None
    return replace(placement, T_base_camera=tuple(T), unplaced=unplaced)


def group_name(names: Sequence[str]) -> str:
    """Return the name of a view, or of a group."""
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


def _windows(search: Search, groups: Sequence[Group], fits: Fits, outlines: Outlines) -> Array:
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


def _among(outlines: Outlines, legs: set[tuple[int, int]]) -> BoolArray:
    """Return which outlines are of some legs in images, (row, leg)."""
    own = zip(outlines.row.tolist(), outlines.leg.tolist(), strict=True)
    return np.array([one in legs for one in own], dtype=np.bool_)
