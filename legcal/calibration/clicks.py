"""Clicks on joints (``landmarks.csv``) against a fit: how far they are from its joints."""

from __future__ import annotations

import numpy as np

from legcal.calibration.joint_fit.solution import Solution
from legcal.data.dataset import Dataset
from legcal.data.landmarks import Landmarks, joint_name
from legcal.data.measurements import row_names
from legcal.geometry.motions import components
from legcal.geometry.types import Array
from legcal.machine.rods import ends_at_poses

# Of half the clicks of a view from where a fit has their joints: hands are steadier
MAX_CLICK_SIGMAS = 4.0


def click_distances(dataset: Dataset, solution: Solution) -> dict[str, tuple[float, float]]:
    """Return how far clicks are from where a fit has their joints, and may be, by view [px].

    Both are medians: a click in two may be on another joint. Of a view without an outline in the
    fit nothing is said: its camera is not one of the fit.
    """
    if dataset.landmarks is None:
        return {}
    clicks, m = dataset.landmarks, dataset.measurements
    view, off = m.view[clicks.row], _off_clicks(dataset.landmarks, dataset, solution)
    own, most = off[np.arange(len(clicks)), clicks.leg, clicks.end], MAX_CLICK_SIGMAS
    outlines = solution.outlines
    fitted = np.unique(m.view[outlines.row[outlines.used]])
    return {
        m.views[v].name: (
            float(np.median(own[view == v])),
            most * float(np.median(clicks.sigma_px[view == v])),
        )
        for v in np.intersect1d(view, fitted).tolist()
    }


def _off_clicks(clicks: Landmarks, dataset: Dataset, solution: Solution) -> Array:
    """Return how far each click is from all joints as a fit has them, (n, n_legs, 2) [px]."""
    m = dataset.measurements
    joints = np.stack(ends_at_poses(solution.legs, *components(solution.T_Rb_Re)), axis=2)
    off = np.full((len(clicks), *joints.shape[1:3]), np.inf)
    for of_click, row, px in zip(off, clicks.row.tolist(), clicks.px, strict=True):
        v = int(m.view[row])
        P = solution.T_camera_Rb[v].apply(joints[m.pose[row]].reshape(-1, 3))
        P = P.reshape(*of_click.shape, 3)
        ahead = P[..., 2] > 0.0
        of_click[ahead] = np.linalg.norm(solution.cameras[v].project(P[ahead]) - px, axis=-1)
    return off


def click_notes(dataset: Dataset, solution: Solution) -> list[str]:
    """Return a note on each click that a fit contradicts, in views whose other clicks agree."""
    if dataset.landmarks is None:
        return []
    clicks, m, legs = dataset.landmarks, dataset.measurements, dataset.machine.leg_names
    agree = [name for name, (px, most) in click_distances(dataset, solution).items() if px <= most]
    names, notes = row_names(m), list[str]()
    every = zip(clicks.row_keys(), clicks.sigma_px.tolist(), strict=True)
    for ((row, leg, end), sigma), off in zip(
        every, _off_clicks(clicks, dataset, solution), strict=True
    ):
        own, most, view = float(off[leg, end]), MAX_CLICK_SIGMAS * sigma, m.views[m.view[row]].name
        if own <= most or view not in agree:
            continue
        near_leg, near_end = np.unravel_index(int(np.argmin(off)), off.shape)
        near = joint_name(legs[int(near_leg)], int(near_end))
        perhaps = f"perhaps it shows {near}; " if off.min() <= most else ""
        notes.append(
            f"The click on {joint_name(legs[leg], end)} in {names[row]} (view {view}) is {own:.0f} "
            f"px from where the fit has this joint, needed at most {most:.0f} px; {perhaps}correct "
            "or remove it."
        )
    return notes
