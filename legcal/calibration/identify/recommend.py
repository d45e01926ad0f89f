"""The smallest sets of views that satisfy the paper's counts and the ranks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.calibration.identify.information import compress, eliminate
from legcal.calibration.identify.planning import cameras_for, planned_session
from legcal.calibration.identify.ranks import Analysis, PlatformError, missing
from legcal.calibration.identify.session import legs_around, neighbours
from legcal.calibration.identify.steps import base_by_frames, offsets_from_distances, scattered
from legcal.geometry import Array
from legcal.machine import Machine
from legcal.paper import count_conditions, three_legs_at_once

_CAMERA = 6  # unknowns of its pose
_MOST_VIEWS = 4
_MOST_WINDOWS = 12  # views of one size that are tried; of more legs, evenly around the base


@dataclass(frozen=True)
class Recommendation:
    """A set of views that satisfies the paper's conditions and the ranks."""

    # the legs that each camera position shows: neighbours around the base
    views: tuple[tuple[str, ...], ...]
    legs_a_view: int  # how many these are
    # standard deviation of the platform to expect; None where the motors do not determine its pose
    platform_sigma: PlatformError | None


def recommend(
    machine: Machine,
    images: int,
    *,
    board: bool = False,  # whether a calibration board on the base ties the cameras to each other
) -> tuple[Recommendation, ...]:
    """Return the smallest sets of views that suffice, fewest camera positions first.

    For each number of camera positions the fewest legs a view; of all sets of that size the one
    with the smallest standard deviation of the platform. More positions are listed only where fewer
    legs a view suffice then: which legs one camera can see, the user knows.

    Empty where no set was found.
    """
    found = list[Recommendation]()
    candidates = _Candidates(machine, images, board=board)
    most = machine.n_legs + 1
    for n_views in range(1, _MOST_VIEWS + 1):
        for size in range(1, most):
            best = candidates.best(n_views, size)
            if best is not None:
                found.append(best)
                most = size
                break
    return tuple(found)


class _Candidates:
    """Views of neighbouring legs, and what each says."""

    def __init__(self, machine: Machine, images: int, *, board: bool) -> None:
        self.machine, self.images = machine, images
        self.session = planned_session(machine, [range(machine.n_legs)], images, board=board)
        self.every = Analysis(self.session)
        self.motion = self.every.motion
        self.ring = legs_around(self.session)
        self.of_size: dict[int, list[Analysis]] = {}

    def best(self, n_views: int, size: int) -> Recommendation | None:
        """Return the best set of so many views of so many legs, or None if none suffices."""
        windows = self.windows(size)
        best: tuple[float, Recommendation] | None = None
        for which in combinations(range(len(windows)), n_views):
            views = [windows[k] for k in which]
            if not self.counts_hold(views):
                continue
            chosen = [self.analyses(size)[k] for k in which]
            information = self.together(chosen)
            if not self.suffices(chosen, information):
                continue
            sigma = self.motion.sigma(information)
            worst = float(np.linalg.svd(information, compute_uv=False)[-1])
            rank = 1.0 / worst if sigma is None else sigma.dX_m
            if best is None or rank < best[0]:
                names = tuple(tuple(self.session.leg_names[j] for j in legs) for legs in views)
                best = (rank, Recommendation(names, size, sigma))
        return None if best is None else best[1]

    def windows(self, size: int) -> list[tuple[int, ...]]:
        """Return neighbours around the base; several cameras where all legs are neighbours."""
        if size >= self.machine.n_legs:
            return [tuple(range(self.machine.n_legs))] * _MOST_VIEWS
        views = neighbours(self.ring, size)
        return views[:: -(-len(views) // _MOST_WINDOWS)]

    def counts_hold(self, views: Sequence[Sequence[int]]) -> bool:
        """Say whether the paper's counts hold."""
        s = self.session
        counts = count_conditions(
            views,
            s.n_legs,
            spatial=s.spatial,
            revolute=[j for j, leg in enumerate(s.legs) if leg.base_joint == "R"],
            passive=np.flatnonzero(~s.with_length).tolist(),
            board=bool(s.board.all()),
        )
        at_once = three_legs_at_once(views, s.legs, spatial=s.spatial)
        return not any(c.fails for c in (*counts, at_once))

    def together(self, chosen: Sequence[Analysis]) -> Array:
        """Return what views say of the parameters at once; a board makes them one camera."""
        if not self.session.board.all():
            return compress(np.concatenate([a.information for a in chosen]))
        rows = np.concatenate([a.of_cameras for a in chosen])
        return compress(eliminate(rows[None], _CAMERA))

    def base_together(self, chosen: Sequence[Analysis]) -> Array:
        """Return what views say in step 2."""
        if not self.session.board.all():
            return np.concatenate([a.default_steps[0].information for a in chosen])
        by_view = [base_by_frames(a.session, a.located)[1] for a in chosen]
        rows = np.concatenate([x.reshape(-1, x.shape[2]) for x in by_view])
        return eliminate(rows[None], _CAMERA)[:, chosen[0].default_steps[0].columns]

    def analyses(self, size: int) -> list[Analysis]:
        """Return what each view of so many legs says alone."""
        if size not in self.of_size:
            views = self.windows(size)
            seen = np.zeros((len(views), self.machine.n_legs), dtype=np.bool_)
            for row, legs in zip(seen, views, strict=True):
                row[list(legs)] = True
            camera = cameras_for(self.session, views)
            poses = np.arange(len(self.session.t))
            self.of_size[size] = [
                self.every.elsewhere(
                    replace(self.session, seen=seen[[k]], camera=camera[[k]]), poses
                )
                for k in range(len(views))
            ]
        return self.of_size[size]

    def suffices(self, chosen: Sequence[Analysis], information: Array) -> bool:
        """Say whether views determine all that moves the platform, at once and step by step."""
        session, n_p = self.session, len(self.session.unit)
        if missing(session, information, self.motion):
            return False
        last = np.concatenate([a.default_steps[2].information for a in chosen])
        for k, rows in ((0, self.base_together(chosen)), (2, last)):
            step = replace(chosen[0].default_steps[k], information=rows)
            if missing(session, scattered(step, n_p), self.motion):
                return False
        together = (
            np.concatenate(parts) for parts in zip(*(a.distances for a in chosen), strict=True)
        )
        offsets = offsets_from_distances(session, *together)
        return not missing(session, scattered(offsets, n_p), self.motion)
