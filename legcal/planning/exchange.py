"""Choose images: greedily, then by exchanges, with low-rank updates of the covariance.

A session has slots for views. Candidates of a slot are rows U of images (:class:`Contributions`),
all on the same unknowns. With the covariance S of all unknowns, an image more leaves
S - S U^T (1 + U S U^T)^-1 U S, and an image less the same with other signs; the criterion is a
function of the block of the machine, so that only that block is computed for a candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.planning.information import KINEMATIC, Contributions
from legcal.progress import Report, no_progress

Criterion = Callable[
    [Array], Array
]  # covariances (n, p, p) of the machine -> (n,), smaller: better

_BATCH = 64  # candidates that are judged at once
_TRIED = 90  # of all candidates, for each image that is chosen
_MIN_GAIN = 1e-4  # of the criterion, for which images are exchanged
_MAX_PASSES = 8
_LEAST_LEFT = 1e-9  # share of a variance, of which updates would be rounding


class Session:
    """The covariance of all unknowns with the images that are chosen."""

    def __init__(self, slots: Sequence[Contributions], given: Sequence[Contributions] = ()) -> None:
        names: dict[str, int] = {}
        self.places: list[IntArray] = []
        for s, slot in enumerate((*slots, *given)):
            own = [f"{s}/{name}" if ": " in name else name for name in slot.names]
            self.places.append(np.array([names.setdefault(name, len(names)) for name in own]))
        self.information = np.zeros((len(names), len(names)))
        for place, slot in zip(self.places, (*slots, *given), strict=True):
            self.information[np.ix_(place, place)] = slot.prior
        for place, slot in zip(self.places[len(slots) :], given, strict=True):
            stacked = slot.all_gains()
            self.information[np.ix_(place, place)] += stacked.T @ stacked
        self.names = names
        self.slots, self.given = list(slots), list(given)
        self._at: dict[tuple[int, int], list[int]] = {}  # the images that are chosen of each site
        self.p = sum(name.startswith(KINEMATIC) for name in names)
        self.covariance = np.linalg.inv(self.information)

    @property
    def machine(self) -> Array:
        """The covariance (p, p) of the coordinates of the machine."""
        return np.asarray(self.covariance[: self.p, : self.p], dtype=np.float64)

    def changed(self, slot: int, image: int, sign: float) -> None:
        """Add (+1) an image to a slot, or take it away (-1)."""
        at = self._at.setdefault((slot, int(self.slots[slot].site[image])), [])
        if sign > 0.0:
            at.append(image)
            self._update(slot, image, len(at), 1.0)
            return
        place = at.index(image)
        for k in range(place, len(at)):
            self._update(slot, at[k], k + 1, -1.0)
        at.remove(image)
        for k in range(place, len(at)):
            self._update(slot, at[k], k + 1, 1.0)

    def _update(self, slot: int, image: int, number: int, sign: float) -> None:
        """Add (+1) what an image adds as that many-th of its site, or take it away (-1)."""
        U = self.slots[slot].gains(np.array([image]), np.array([number]))[0]
        place = self.places[slot]
        self.information[np.ix_(place, place)] += sign * (U.T @ U)
        K = U @ self.covariance[place]
        S = np.eye(len(U)) + sign * (K[:, place] @ U.T)
        variances, turn = np.linalg.eigh(S)
        if variances[0] < _LEAST_LEFT:  # hardly anything is known without these rows
            self.renewed()
            return
        half = (turn / np.sqrt(variances)).T @ K
        self.covariance -= sign * (half.T @ half)

    def renewed(self) -> None:
        """Invert the information, without what updates have rounded."""
        self.covariance = np.linalg.inv(self.information)

    def with_one_more(self, slot: int, images: IntArray) -> Array:
        """Return the covariances (n, p, p) of the machine with one of some images more."""
        place = self.places[slot]
        block, p = self.covariance[np.ix_(place, place)], self.p
        own = self._next(slot, images)
        with_own = own @ block
        S = np.eye(own.shape[1]) + with_own @ np.swapaxes(own, 1, 2)
        half = with_own[..., :p]
        return np.asarray(self.machine - np.swapaxes(half, 1, 2) @ np.linalg.solve(S, half))

    def _next(self, slot: int, images: IntArray) -> Array:
        """Return the rows (n, r, m) that images add to those chosen of their sites."""
        own = self.slots[slot]
        count = [len(self._at.get((slot, site), ())) for site in own.site[images].tolist()]
        return own.gains(images, 1 + np.array(count))

    def fitted(self) -> Array:
        """Return the covariance (p, p) of the machine by a fit of the given images alone.

        Errors at places move it.
        """
        found = self.machine
        for place, slot in zip(self.places[len(self.slots) :], self.given, strict=True):
            moved = np.einsum("krm,krc->mc", slot.rows, slot.shifts)
            moved = self.covariance[: self.p, place] @ moved
            found = found + moved @ moved.T
        return np.asarray(found, dtype=np.float64)


@dataclass
class Chosen:
    """The images of a session: slot and candidate of each."""

    images: list[tuple[int, int]] = field(default_factory=list)
    value: float = np.inf  # of the criterion
    history: list[float] = field(default_factory=list)  # the same with 1, 2, ... images


def choose(
    session: Session,
    n_images: int,
    criterion: Criterion,
    rng: np.random.Generator,
    least: int,  # images of each slot
    most: int,
    *,
    is_enough: Callable[[float], bool] = lambda _: False,
    progress: Report = no_progress,
) -> Chosen:
    """Return the images that one after the other lower the criterion most."""
    found = Chosen()
    n_slots = len(session.slots)
    while len(found.images) < n_images:
        count = [sum(s == slot for s, _ in found.images) for slot in range(n_slots)]
        missing = [max(least - c, 0) for c in count]
        left = n_images - len(found.images)
        open_slots = [
            s for s in range(n_slots)
            if count[s] < most and (missing[s] > 0 or sum(missing) < left)
        ]  # fmt: skip
        slot, image, value = _best(session, open_slots, criterion, rng, set(found.images))
        session.changed(slot, image, 1.0)
        found.images.append((slot, image))
        found.value = value
        found.history.append(value)
        progress("Images", len(found.images), n_images)
        if is_enough(value) and min(count) >= least:
            break
    session.renewed()
    return found


def exchange(
    session: Session,
    found: Chosen,
    criterion: Criterion,
    rng: np.random.Generator,
    least: int,
    most: int,
    *,
    progress: Report = no_progress,
    stop: Callable[[], bool] = lambda: False,
) -> Chosen:
    """Return the same number of images after exchanging single ones while that helps."""
    found.value = float(criterion(session.machine[None])[0])
    for turn in range(_MAX_PASSES):
        before = found.value
        for i, (slot, image) in enumerate(list(found.images)):
            if stop():
                break
            others = [pair for k, pair in enumerate(found.images) if k != i]
            count = [sum(s == other for s, _ in others) for other in range(len(session.slots))]
            open_slots = [s for s in range(len(count)) if count[s] < most]
            if count[slot] < least:
                open_slots = [slot]
            session.changed(slot, image, -1.0)
            new = _best(session, open_slots, criterion, rng, set(found.images))
            if new[2] < found.value * (1.0 - _MIN_GAIN):
                slot, image, found.value = new
                found.images[i] = slot, image
            session.changed(slot, image, 1.0)
        session.renewed()
        found.value = float(criterion(session.machine[None])[0])
        progress("Exchanges", turn + 1, _MAX_PASSES)
        if found.value > before * (1.0 - 10.0 * _MIN_GAIN):
            break
    progress("Exchanges", _MAX_PASSES, _MAX_PASSES)
    return found


def _best(
    session: Session,
    slots: Sequence[int],
    criterion: Criterion,
    rng: np.random.Generator,
    taken: set[tuple[int, int]],
) -> tuple[int, int, float]:
    """Return the best of some candidates that are drawn: slot, image, and the criterion with it."""
    every = [
        (s, k) for s in slots for k in range(len(session.slots[s].rows)) if (s, k) not in taken
    ]
    drawn = rng.permutation(len(every))[:_TRIED].tolist()
    best = (-1, -1, np.inf)
    for slot in slots:
        own = np.array([every[i][1] for i in drawn if every[i][0] == slot], dtype=np.intp)
        for part in np.split(own, range(_BATCH, len(own), _BATCH)) if len(own) else []:
            values = criterion(session.with_one_more(slot, part))
            k = int(np.argmin(values))
            if values[k] < best[2]:
                best = slot, int(part[k]), float(values[k])
    return best
