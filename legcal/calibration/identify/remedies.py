"""Remedies for what a session leaves open: more images, cameras, boards, known parameters.

Each is a candidate that is tested by computing the ranks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.identify.ranks import Analysis, missing, undetermined
from legcal.calibration.identify.report import (
    Remedy,
    WeakDirection,
)
from legcal.calibration.identify.session import (
    Session,
    cameras_for,
    legs_around,
    neighbours,
)
from legcal.machine.parameters import legs_in_words, list_in_words

_MOST_OF_A_KIND = 2
_MOST_TRIED = 8  # of a kind
_MOST_FIXED = 4  # parameters
_ENOUGH_IMAGES = 15  # a view
_KNOWN = 4e11  # 1 / mean leg length


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
