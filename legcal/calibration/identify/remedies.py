"""Remedies: the smallest sufficient sets of views, calibration boards, and other changes.

Views are recommended by the paper's counts and the ranks. Remedies are candidates, tested by
computing the ranks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.calibration.identify.ranks import Analysis, missing, undetermined
from legcal.calibration.identify.report import (
    Recommendation,
    Remedy,
    WeakDirection,
)
from legcal.calibration.identify.session import (
    Session,
    cameras_for,
    legs_around,
    neighbours,
    planned_session,
)
from legcal.calibration.joint_fit.predicted import DEFAULT_NOISE, PredictedNoise
from legcal.geometry.types import Array
from legcal.machine.leg import JointType
from legcal.machine.model import Machine
from legcal.machine.parameters import legs_in_words, list_in_words
from legcal.paper.conditions import count_conditions, three_legs_at_once

_MOST_VIEWS = 4
_MOST_WINDOWS = 12  # tested views of one size, evenly around the base
_MOST_OF_A_KIND = 2
_MOST_TRIED = 8  # of a kind
_MOST_FIXED = 4  # parameters
_ENOUGH_IMAGES = 15  # a view
_KNOWN = 4e11  # 1 / mean leg length


def recommend(
    machine: Machine,
    images: int,
    noise: PredictedNoise = DEFAULT_NOISE,
    *,
    board: bool = False,  # a calibration board on the base relates the cameras
    platform_board: bool = False,  # a calibration board on the platform shows its poses
) -> tuple[Recommendation, ...]:
    """Return the smallest sufficient sets of views, fewest camera positions first.

    For each number of camera positions, the fewest legs per view; of sets of that size, the one
    with the smallest standard deviation of the platform. More positions are listed only if fewer
    legs per view suffice; the user knows how many legs one camera can see.

    Empty if no set suffices.
    """
    recommendations = list[Recommendation]()
    candidates = _Candidates(machine, images, noise, board=board, platform_board=platform_board)
    size_limit = machine.n_legs + 1
    for n_views in range(1, _MOST_VIEWS + 1):
        for size in range(1, size_limit):
            best = candidates.best(n_views, size)
            if best is not None:
                recommendations.append(best)
                size_limit = size
                break
    return tuple(recommendations)


class _Candidates:
    """Candidate views of neighbouring legs, with their information."""

    def __init__(
        self,
        machine: Machine,
        images: int,
        noise: PredictedNoise,
        *,
        board: bool,
        platform_board: bool,
    ) -> None:
        self.machine, self.images = machine, images
        every = [range(machine.n_legs)]
        self.session = planned_session(
            machine, every, images, board=board, platform_board=platform_board
        )
        self.every = Analysis(self.session, noise=noise)
        self.motion = self.every.motion
        self.ring = legs_around(self.session)
        self.of_size: dict[int, list[Analysis]] = {}

    def best(self, n_views: int, size: int) -> Recommendation | None:
        """Return the best set of *n_views* views of *size* legs; None if none suffices."""
        windows = self.windows(size)
        best: tuple[float, Recommendation] | None = None
        for which in combinations(range(len(windows)), n_views):
            views = [windows[k] for k in which]
            if not self.counts_hold(views):
                continue
            chosen = [self.analyses(size)[k] for k in which]
            information = self.together(chosen)
            if missing(self.session, information, self.motion):
                continue
            sigma = self.motion.sigma(information)
            worst = float(np.linalg.svd(information, compute_uv=False)[-1])
            rank = 1.0 / worst if sigma is None else sigma.dX_m
            if best is None or rank < best[0]:
                names = tuple(tuple(self.session.leg_names[j] for j in legs) for legs in views)
                best = (rank, Recommendation(names, size, sigma))
        return None if best is None else best[1]

    def windows(self, size: int) -> list[tuple[int, ...]]:
        """Return groups of neighbours around the base, or several views of all legs."""
        if size >= self.machine.n_legs:
            return [tuple(range(self.machine.n_legs))] * _MOST_VIEWS
        views = neighbours(self.ring, size)
        return views[:: -(-len(views) // _MOST_WINDOWS)]

    def counts_hold(self, views: Sequence[Sequence[int]]) -> bool:
        """Whether the paper's counts hold."""
        s = self.session
        counts = count_conditions(
            views,
            s.n_legs,
            spatial=s.spatial,
            revolute=[j for j, leg in enumerate(s.legs) if leg.base_joint is JointType.REVOLUTE],
            passive=np.flatnonzero(~s.with_length).tolist(),
            board=bool(s.board.all()),
            actuators=s.on_actuators,
        )
        at_once = three_legs_at_once(views, s.legs, spatial=s.spatial)
        return not any(c.fails for c in (*counts, at_once))

    def together(self, chosen: Sequence[Analysis]) -> Array:
        """Combine the information of views on the parameters.

        Views of a board on the base share its pose; a board on the platform has one pose.
        """
        first, *others = (a.contributions for a in chosen)
        joined = first.with_more(others)
        rows = np.concatenate([joined.all_gains(), joined.known])
        return self.every.of_parameters(rows, joined.basis)

    def analyses(self, size: int) -> list[Analysis]:
        """Analyse every candidate view of *size* legs by itself."""
        if size not in self.of_size:
            views = self.windows(size)
            seen = np.zeros((len(views), self.machine.n_legs), dtype=np.bool_)
            for row, legs in zip(seen, views, strict=True):
                row[list(legs)] = True
            cameras = cameras_for(self.session, views)
            self.of_size[size] = [
                self.every.elsewhere(
                    replace(self.session, seen=seen[[k]], cameras=cameras[k : k + 1])
                )
                for k in range(len(views))
            ]
        return self.of_size[size]


def find_remedies(
    analysis: Analysis,  # of the session
    # plans the session with another number of images a view; None for a recorded one
    replanned: Callable[[int], Session] | None,
) -> tuple[Remedy, ...]:
    """Return remedies for undetermined directions.

    Remedies that determine all parameters, else those sufficient for the platform, else those that
    raise a rank.
    """
    n_parameters = analysis.full.of
    before = _score(analysis)
    kinds: list[Iterable[_Candidate]] = [
        _more_images(analysis, replanned),
        _further_cameras(analysis),
        _board(analysis),
        _known_parameters(analysis),
    ]
    helpful = tuple(r for kind in kinds for r in _try_kind(kind, before, n_parameters))
    sufficient = tuple(r for r in helpful if r.enough)
    everything = tuple(r for r in sufficient if r.full_rank == n_parameters)
    return everything or sufficient or helpful


@dataclass(frozen=True)
class _Score:
    """How many directions are open, and how many of them move the platform."""

    open: int
    harmful: int


# What to do, the analysis with that, and parameters that are known then
_Candidate = tuple[str, Analysis, Sequence[int]]


def _score(analysis: Analysis, known: Sequence[int] = ()) -> _Score:
    """Count the open directions with some parameters *known*."""
    session, motion = analysis.session, analysis.motion
    extra = np.zeros((len(known), len(session.unit)))
    extra[np.arange(len(known)), list(known)] = _KNOWN / session.mean_length
    rows = np.concatenate([analysis.information, extra])
    return _Score(len(undetermined(session, rows)), missing(session, rows, motion))


def _try_kind(kind: Iterable[_Candidate], before: _Score, n_parameters: int) -> list[Remedy]:
    """Return the first few sufficient candidates of a kind, else the most helpful one."""
    sufficient, helpful = list[Remedy](), list[tuple[int, Remedy]]()
    for tried, (text, changed, known) in enumerate(kind):
        after = _score(changed, known)
        gain = before.harmful - after.harmful
        if gain <= 0:
            continue
        complete = after.harmful == 0
        remedy = Remedy(text, n_parameters - after.open, complete)
        if complete:
            sufficient.append(remedy)
        else:
            helpful.append((gain, remedy))
        if len(sufficient) == _MOST_OF_A_KIND or tried + 1 >= _MOST_TRIED:
            break
    return sufficient or [r for _, r in sorted(helpful, key=lambda pair: -pair[0])[:1]]


def _more_images(
    analysis: Analysis, replanned: Callable[[int], Session] | None
) -> Iterator[_Candidate]:
    """Yield a session with more images a view."""
    images = int(np.bincount(analysis.session.view).min())
    if replanned is not None and images < _ENOUGH_IMAGES:
        text = f"take {_ENOUGH_IMAGES} images a view instead of {images}"
        yield text, analysis.elsewhere(replanned(_ENOUGH_IMAGES)), ()


def _further_cameras(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield further camera positions that show weak legs and their neighbours."""
    session, weak = analysis.session, _weak_legs(analysis)
    ring = legs_around(session)
    largest = max(len(view) for view in session.views)
    for size in sorted({min(k, session.n_legs) for k in (3, 4, largest)}):
        groups = [legs for legs in neighbours(ring, size) if set(weak) & set(legs)]
        groups.sort(key=lambda legs: -len(set(weak) & set(legs)))
        for legs in groups:
            named = legs_in_words(legs, session.leg_names)
            more = analysis.elsewhere(_extended(session, legs))
            yield f"add a camera position ({named})", more, ()


def _board(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield a calibration board on the base, and one on the platform."""
    if len(set(analysis.session.frame.tolist())) > 1:
        text = "put a calibration board on the base, visible to every camera"
        yield text, analysis.with_board(), ()
    if not analysis.session.platform_board.any():
        text = "put a calibration board on the platform, visible to every camera"
        yield text, analysis.with_board("platform"), ()


def _known_parameters(analysis: Analysis) -> Iterator[_Candidate]:
    """Yield parameters to measure otherwise and fix: one of each direction, or all of them."""
    names = analysis.session.parametrization.names
    first = list(dict.fromkeys(d.parameters[0] for d in _harmful(analysis)))
    choices: list[tuple[str, ...]] = [(name,) for name in first[:_MOST_FIXED]]
    if 1 < len(first) <= _MOST_FIXED:
        choices.append(tuple(first))
    for which in choices:
        known = [names.index(name) for name in which]
        yield f"fix {list_in_words(which)}", analysis, known


def _weak_legs(analysis: Analysis) -> list[int]:
    touched = {p for d in _harmful(analysis) for p in d.parameters}
    names = analysis.session.leg_names
    return [j for j, name in enumerate(names) if any(p.startswith(f"{name}.") for p in touched)]


def _harmful(analysis: Analysis) -> list[WeakDirection]:
    return [d for d in analysis.full.weak if not d.harmless]


def _extended(session: Session, legs: Sequence[int]) -> Session:
    """Add a camera with as many images as the first."""
    images = session.pose[session.view == 0]
    new = len(session.t) + np.arange(len(images))
    seen = np.zeros((1, session.n_legs), dtype=np.bool_)
    seen[0, list(legs)] = True
    (further,) = cameras_for(session, [legs])
    return replace(
        session,
        R=np.concatenate([session.R, session.R[images]]),
        t=np.concatenate([session.t, session.t[images]]),
        unread=np.concatenate([session.unread, session.unread[images]]),
        view=np.concatenate([session.view, np.full(len(images), session.n_views)]),
        pose=np.concatenate([session.pose, new]),
        seen=np.concatenate([session.seen, seen]),
        cameras=(*session.cameras, replace(further, name="further")),
        board=np.append(session.board, session.board.all()),
        platform_board=np.append(
            session.platform_board,
            np.full(len(images), session.platform_board.all())[: len(session.platform_board)],
        ),
    )
