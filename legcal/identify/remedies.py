"""What would mend what is missing: candidates, each tried by computing the ranks again."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from legcal.geometry.types import Array
from legcal.identify.cameras import FOCAL_PX, default_cameras
from legcal.identify.ranks import Analysis, missing, scattered
from legcal.identify.session import Session
from legcal.identify.words import legs_in_words

_MOST = 6  # remedies told
_MOST_FIXED = 4  # parameters tried
_SEED = 2003
_ORDINAL = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")


@dataclass(frozen=True)
class Remedy:
    """Something that would help, with the ranks that it gives.

    Attributes
    ----------
    remedy : str
        What to do.
    staged_rank, full_rank : int
        The ranks that it gives, of all parameters; what is fixed counts as known.
    enough : bool
        Whether it determines everything that moves the platform, step by step and at once.
    """

    remedy: str
    staged_rank: int
    full_rank: int
    enough: bool


def find_remedies(analysis: Analysis) -> tuple[Remedy, ...]:
    """Return what would help where directions are not determined.

    Parameters
    ----------
    analysis : Analysis
        What is known so far.

    Returns
    -------
    tuple of Remedy
        Only what raises a rank: what is enough first.
    """
    session = analysis.session
    before = _score(analysis)
    found: list[Remedy] = []
    for text, tried in _candidates(analysis):
        remedy = _judge(text, _score(tried), before, len(session.unit))
        if remedy is not None:
            found.append(remedy)
    found += _fixed(analysis, before)
    enough = [r for r in found if r.enough]
    helps = [] if len(enough) >= 2 else [r for r in found if not r.enough]
    return tuple([*enough, *helps][:_MOST])


@dataclass(frozen=True)
class _Score:
    """How many directions steps and everything at once leave open; those that move the platform."""

    staged: int
    full: int
    staged_harm: int
    full_harm: int


def _score(analysis: Analysis, fixed: Sequence[int] = ()) -> _Score:
    """Return what is open, some parameters being known."""
    session, motion = analysis.session, analysis.motion
    n_p = len(session.unit)
    extra = np.zeros((len(fixed), n_p))
    extra[np.arange(len(fixed)), list(fixed)] = 1e12
    rows = [np.concatenate([scattered(s, n_p), extra]) for s in analysis.default_steps]
    full = np.concatenate([analysis.information, extra])
    return _Score(
        sum(_open(session, r) for r in rows),
        _open(session, full),
        sum(missing(session, r, motion) for r in rows),
        missing(session, full, motion),
    )


def _open(session: Session, rows: Array) -> int:
    """Return how many directions rows leave open."""
    from legcal.identify.weak import undetermined

    return len(undetermined(session, rows))


def _judge(text: str, after: _Score, before: _Score, n_p: int) -> Remedy | None:
    """Return a remedy if it helps and hurts nowhere."""
    worse = after.staged_harm > before.staged_harm or after.full_harm > before.full_harm
    better = after.staged_harm < before.staged_harm or after.full_harm < before.full_harm
    if worse or not better:
        return None
    enough = after.staged_harm == 0 and after.full_harm == 0
    return Remedy(text, n_p - after.staged, n_p - after.full, enough)


def _candidates(analysis: Analysis) -> Iterator[tuple[str, Analysis]]:
    """Return things to do about cameras and images, each with the analysis that it gives."""
    session = analysis.session
    weak = _weak_legs(analysis)
    ring = legs_around(session)
    largest = max(3, *(len(view) for view in session.views))
    for v, legs in _wider_views(session, weak, ring):
        together = legs_in_words(legs, session.leg_names)
        yield (
            f"see {together} together in view {v + 1}",
            _derived(analysis, _widened(session, v, legs)),
        )
    place = _ORDINAL[session.n_views] if session.n_views < len(_ORDINAL) else "further"
    article = "an" if place == "eighth" else "a"
    for legs in _windows(ring, sorted({3, min(4, session.n_legs), largest}), weak):
        text = f"add {article} {place} camera position ({legs_in_words(legs, session.leg_names)})"
        yield text, _derived(analysis, _extended(session, legs))
    yield (
        "put a calibration board on the base that every camera sees",
        replace(analysis, common_cameras=True),
    )


def _derived(analysis: Analysis, session: Session) -> Analysis:
    """Return the analysis of another session of the same machine and poses."""
    derived = Analysis(session, analysis.common_cameras)
    derived.__dict__["motion"] = analysis.motion
    return derived


def _fixed(analysis: Analysis, before: _Score) -> list[Remedy]:
    """Return the parameters that help when they are measured otherwise and held."""
    session = analysis.session
    names = session.parametrization.names
    weak = [d for d in (*analysis.full.weak, *analysis.staged.weak) if not d.harmless]
    first = list(dict.fromkeys(d.parameters[0] for d in weak))
    found = []
    if 1 < len(first) <= _MOST_FIXED:
        tried = [*[(name,) for name in first], tuple(first)]
    else:
        tried = [(name,) for name in first[:_MOST_FIXED]]
    for which in tried:
        score = _score(analysis, [names.index(name) for name in which])
        text = f"measure and fix {' and '.join(which)}"
        remedy = _judge(text, score, before, len(session.unit))
        if remedy is not None:
            found.append(remedy)
    return found


def _weak_legs(analysis: Analysis) -> list[int]:
    """Return the legs whose parameters are not determined."""
    names = analysis.session.leg_names
    weak = [d for d in (*analysis.full.weak, *analysis.staged.weak) if not d.harmless]
    touched = {p for d in weak for p in d.parameters}
    return [j for j, name in enumerate(names) if any(p.startswith(f"{name}.") for p in touched)]


def legs_around(session: Session) -> list[int]:
    """Return the legs in their order around the base."""
    points = session.A + (session.arm + session.t[:, None]).mean(axis=0)
    centred = points - points.mean(axis=0)
    _, _, basis = np.linalg.svd(session.A - session.A.mean(axis=0))
    angle = np.arctan2(centred @ basis[1], centred @ basis[0])
    return [int(j) for j in np.argsort(angle, kind="stable")]


def _windows(ring: list[int], sizes: Sequence[int], weak: Sequence[int]) -> list[tuple[int, ...]]:
    """Return neighbours around the base that include weak legs, small groups first."""
    found = []
    n = len(ring)
    for size in sizes:
        for start in range(n if size < n else 1):
            legs = tuple(sorted(ring[(start + k) % n] for k in range(min(size, n))))
            if not weak or set(legs) & set(weak):
                found.append(legs)
    return list(dict.fromkeys(found))


def _wider_views(
    session: Session, weak: Sequence[int], ring: list[int]
) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Return views with one or two legs more, so that weak legs are seen with others."""
    place = {j: k for k, j in enumerate(ring)}
    n = len(ring)

    def apart(j: int, legs: Sequence[int]) -> int:
        steps = [abs(place[j] - place[g]) for g in legs]
        return min((min(s, n - s) for s in steps), default=0)

    for more in (1, 2):
        tried = set()
        for v, view in enumerate(session.views):
            others = [j for j in range(n) if j not in view]
            choices = [c for c in combinations(others, more) if set(c) | set(view)]
            choices = [c for c in choices if not weak or (set(c) | set(view)) & set(weak)]
            choices.sort(key=lambda c: sum(apart(j, view) for j in c))
            for choice in choices[:3]:
                legs = tuple(sorted((*view, *choice)))
                if legs not in tried:
                    tried.add(legs)
                    yield v, legs


def _widened(session: Session, v: int, legs: Sequence[int]) -> Session:
    """Return a session in which a view shows other legs."""
    seen = session.seen.copy()
    seen[v] = False
    seen[v, list(legs)] = True
    return replace(session, seen=seen)


def _extended(session: Session, legs: Sequence[int]) -> Session:
    """Return a session with one more camera, for as many images as the first."""
    images = session.pose[session.view == 0]
    new = len(session.t) + np.arange(len(images))
    rng = np.random.default_rng(_SEED)
    B = (session.arm + session.t[:, None]).mean(axis=0)
    camera = default_cameras(session.A, B, [legs], session.spatial, rng)
    seen = np.zeros((1, session.n_legs), dtype=np.bool_)
    seen[0, list(legs)] = True
    return replace(
        session,
        R=np.concatenate([session.R, session.R[images]]),
        t=np.concatenate([session.t, session.t[images]]),
        view=np.concatenate([session.view, np.full(len(images), session.n_views)]),
        pose=np.concatenate([session.pose, new]),
        seen=np.concatenate([session.seen, seen]),
        camera=np.concatenate([session.camera, camera]),
        focal=np.append(session.focal, FOCAL_PX),
    )
