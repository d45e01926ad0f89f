"""Poses that bars leave in doubt, judged by the outlines that can be measured at them.

Bars are found without knowing where legs should be, and many legs have none. Near the legs of the
right pose most outlines can be measured all the same, and one fit suits all of them; near those of
a wrong one hardly any can, or no fit does.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.detection.detect import detect_outlines
from legcal.geometry.types import Array
from legcal.observations.outlines import Outlines
from legcal.recognition.agreement import Picture, Poses
from legcal.recognition.closer import look_closer
from legcal.recognition.groups import Group
from legcal.recognition.place import with_first
from legcal.recognition.placed import Placed
from legcal.recognition.radii import NO_OTHER_RADII
from legcal.recognition.recognised import Recognised
from legcal.recognition.searching import Search
from legcal.recognition.view_fit import ViewFit, fit_view, least_evidence

N_POSES, N_CLOSER = 4, 3  # that are looked at, and at the best of which missing legs are sought
# How many times the evidence for any other pose one needs, and how much more than the least.
TIMES, MORE = 1.6, 3.0
TIMES_AGREED, MORE_AGREED = 1.5, 0.0  # the same where bars are convincing by themselves
WITHOUT_RIVAL = 4.0  # times the evidence for others, from which on no more is needed either
TIMES_ALONE, MORE_ALONE = 2.5, 6.0  # and of a single image
JOINT_ERROR = 3e-3  # of the legs as a pose has them [m]
SAME_PX, SAME_PART = 3.0, 0.7  # of outlines that two poses share: how near, how many of them


@dataclass(frozen=True, eq=False)
class _Look:
    """What outlines say of a pose."""

    found: Recognised
    outlines: Outlines
    fit: ViewFit | None

    @property
    def evidence(self) -> float:
        """How much they speak for it."""
        return 0.0 if self.fit is None else self.fit.evidence


def look_again(search: Search, group: Group, placed: Placed, pictures: Sequence[Picture]) -> Placed:
    """Return poses with the one first that outlines speak for, and whether they leave a doubt.

    Parameters
    ----------
    search : Search
        The images and the model.
    group : Group
        Views that are placed together.
    placed : Placed
        Their poses by bars.
    pictures : sequence of Picture
        Of the group.
    """
    near = placed.hinted and placed.is_convincing
    if len(placed.poses) == 0 or near or placed.is_clear:
        return placed
    few = replace(group, rows=group.some)
    looks = [_look(search, few, placed, 0)]
    if not (placed.leads_clearly and _is_decided(looks, placed, few)):
        looks += [_look(search, few, placed, i) for i in range(1, min(N_POSES, len(placed.poses)))]
        if not (placed.is_convincing and _is_decided(looks, placed, few)):
            by_both = placed.score[: len(looks)] + [look.evidence for look in looks]
            for i in np.argsort(-by_both, kind="stable")[:N_CLOSER].tolist():
                looks[i] = _look_closer(search, few, looks[i])
    best = _best(looks)
    fit = looks[best].fit
    if fit is None or not _is_decided(looks, placed, few):
        return replace(placed, by_outlines=False)
    T = fit.T_base_group.inv()
    pose = Poses(T.rotation.as_matrix()[None], T.translation[None], fit.shift[None])
    return replace(with_first(placed, best, pose, pictures), by_outlines=True)


def _best(looks: Sequence[_Look]) -> int:
    """Return the pose that outlines speak for most."""
    return int(np.argmax([look.evidence for look in looks]))


def _is_decided(looks: Sequence[_Look], placed: Placed, group: Group) -> bool:
    """Say whether outlines speak for one pose, and not nearly as much for another one."""
    best = _best(looks)
    others = [
        look.evidence
        for i, look in enumerate(looks)
        if i != best and not _same(look.outlines, looks[best].outlines)
    ]
    more, times = (MORE, TIMES) if len(group.rows) > 1 else (MORE_ALONE, TIMES_ALONE)
    fit, other = looks[best].fit, max(others, default=0.0)
    if fit is None or not fit.is_determined:
        return False
    if best == 0 and placed.is_convincing:
        more, times = MORE_AGREED, TIMES_AGREED
    elif len(group.rows) > 1 and fit.evidence >= WITHOUT_RIVAL * other:
        more = MORE_AGREED
    return fit.evidence >= max(least_evidence(group) + more, times * other)


def _look(search: Search, group: Group, placed: Placed, i: int) -> _Look:
    """Measure outlines at a pose, and fit it to them."""
    m, shift = search.measurements, placed.poses.shift[i]
    T: list[RigidTransform | None] = [None] * len(m.views)
    for v in group.views:
        T[v] = placed.pose(i) * group.T_group_camera[v]
    n_views = len(m.views)
    shifts = np.broadcast_to(shift, (n_views, *shift.shape)).copy()
    error: Array = np.full((n_views, search.n_legs), JOINT_ERROR)
    found = Recognised(T, shifts, error, {}, NO_OTHER_RADII)
    image = tuple(name if row in group.rows else "" for row, name in enumerate(m.image))
    outlines = detect_outlines(
        search.load,
        replace(m, image=image),
        search.A_base + shift[:, 0],
        search.B_base + shift[:, 1],
        search.cylinders,
        T,
        search.wanted,
        [str(leg + 1) for leg in range(search.n_legs)],
        joint_error=error,
    )
    fit = fit_view(search, group, placed.pose(i), shift, outlines)
    return _Look(found, outlines, fit)


def _look_closer(search: Search, group: Group, look: _Look) -> _Look:
    """Return a look with the legs that are missing at a pose, as far as they are found."""
    if look.fit is None:
        return look
    names = [str(leg + 1) for leg in range(search.n_legs)]
    closer = look_closer(search, [group], look.found, look.outlines, names)
    return _Look(closer.recognised, closer.outlines, closer.fits[0])


def _same(one: Outlines, other: Outlines) -> bool:
    """Say whether two poses have most legs at the same places."""
    where = [
        {
            (row, leg, part, edge): middle
            for row, leg, part, edge, middle, used in zip(
                o.row.tolist(), o.leg.tolist(), o.part, o.edge.tolist(), o.ends, o.used, strict=True
            )
            if used
        }
        for o in (one, other)
    ]
    common = [key for key in where[0] if key in where[1]]
    alike = sum(_gap(where[0][key], where[1][key]) <= SAME_PX for key in common)
    return alike >= SAME_PART * max(1, min(len(w) for w in where))


def _gap(one: Array, other: Array) -> float:
    """Return how far the middle of a line (2, 2) is from another line [px]."""
    along = other[1] - other[0]
    step = one.mean(axis=0) - other[0]
    return float(abs(along[0] * step[1] - along[1] * step[0]) / np.linalg.norm(along))
