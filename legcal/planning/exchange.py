"""Select images: greedily, then by exchanges, with low-rank updates of the covariance.

A session has a slot for each view. The candidates of a slot are information rows U of images
(:class:`Contributions`) over the same unknowns. Adding an image updates the covariance S of all
unknowns to S - S U^T (1 + U S U^T)^-1 U S, and removing one changes the signs. The criterion
depends on the machine's block, so that only this block is computed for a candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from legcal.calibration.joint_fit.platform import (
    PlatformError,
    expected_error,
    platform_by_parameters,
)
from legcal.calibration.joint_fit.predicted import Contributions, joined
from legcal.calibration.joint_fit.variables import FittedLegs
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, IntArray
from legcal.machine.configurations import workspace
from legcal.machine.kinematics import platforms_in_base
from legcal.machine.model import Machine
from legcal.progress import Report, no_progress

Criterion = Callable[
    [Array], Array
]  # covariances (n, p, p) of the machine -> (n,), smaller: better

_BATCH = 64  # candidates evaluated at once
_N_DRAWN = 90  # random candidates for each selected image
_MIN_GAIN = 1e-4  # relative gain of the criterion for an exchange
_MAX_PASSES = 8
_MIN_EIGENVALUE = 1e-9  # of an update, below which the covariance is inverted anew


class Session:
    """The information and covariance of all unknowns for the selected images."""

    def __init__(self, slots: Sequence[Contributions], given: Sequence[Contributions] = ()) -> None:
        self.columns, self.information = joined((*slots, *given))
        for columns, slot in zip(self.columns[len(slots) :], given, strict=True):
            stacked = slot.all_gains()
            self.information[np.ix_(columns, columns)] += stacked.T @ stacked
        self.slots = list(slots)
        self._chosen_at: dict[tuple[int, int], list[int]] = {}  # selected images of each site
        self.p = (*slots, *given)[0].basis.shape[1]
        self.covariance = np.linalg.inv(self.information)

    @property
    def machine(self) -> Array:
        """The covariance (p, p) of the coordinates of the machine."""
        return np.asarray(self.covariance[: self.p, : self.p], dtype=np.float64)

    def changed(self, slot: int, image: int, sign: float) -> None:
        """Add (+1) an image to a slot, or remove it (-1)."""
        chosen_at_site = self._chosen_at.setdefault((slot, int(self.slots[slot].site[image])), [])
        if sign > 0.0:
            chosen_at_site.append(image)
            self._update(slot, image, len(chosen_at_site), 1.0)
            return
        position = chosen_at_site.index(image)
        for k in range(position, len(chosen_at_site)):
            self._update(slot, chosen_at_site[k], k + 1, -1.0)
        chosen_at_site.remove(image)
        for k in range(position, len(chosen_at_site)):
            self._update(slot, chosen_at_site[k], k + 1, 1.0)

    def _update(self, slot: int, image: int, number: int, sign: float) -> None:
        """Add (+1) or remove (-1) the rows of an image that is the *number*-th of its site."""
        U = self.slots[slot].gains(np.array([image]), np.array([number]))[0]
        columns = self.columns[slot]
        self.information[np.ix_(columns, columns)] += sign * (U.T @ U)
        K = U @ self.covariance[columns]
        S = np.eye(len(U)) + sign * (K[:, columns] @ U.T)
        variances, eigenvectors = np.linalg.eigh(S)
        if variances[0] < _MIN_EIGENVALUE:  # hardly anything is known without these rows
            self.renewed()
            return
        half = (eigenvectors / np.sqrt(variances)).T @ K
        self.covariance -= sign * (half.T @ half)

    def renewed(self) -> None:
        """Invert the information anew, against the rounding of updates."""
        self.covariance = np.linalg.inv(self.information)

    def with_one_more(self, slot: int, images: IntArray) -> Array:
        """Return the covariances (n, p, p) of the machine with each of *images* added."""
        columns = self.columns[slot]
        block, p = self.covariance[np.ix_(columns, columns)], self.p
        candidates = self.slots[slot]
        sites = candidates.site[images].tolist()
        number = [1 + len(self._chosen_at.get((slot, site), ())) for site in sites]
        rows = candidates.gains(images, np.array(number))
        rows_covariance = rows @ block
        S = np.eye(rows.shape[1]) + rows_covariance @ np.swapaxes(rows, 1, 2)
        half = rows_covariance[..., :p]
        return np.asarray(self.machine - np.swapaxes(half, 1, 2) @ np.linalg.solve(S, half))


@dataclass
class Chosen:
    """The selected images: slot and candidate of each."""

    images: list[tuple[int, int]] = field(default_factory=list)
    value: float = np.inf  # of the criterion
    history: list[float] = field(default_factory=list)  # criterion with 1, 2, ... images


def choose(
    session: Session,
    n_images: int,
    criterion: Criterion,
    rng: np.random.Generator,
    least: int,  # images of each slot
    *,
    is_enough: Callable[[float], bool] = lambda _: False,
    progress: Report = no_progress,
) -> Chosen:
    """Select images greedily: each lowers the criterion most."""
    chosen = Chosen()
    n_slots = len(session.slots)
    while len(chosen.images) < n_images:
        count = [sum(s == slot for s, _ in chosen.images) for slot in range(n_slots)]
        missing = [max(least - c, 0) for c in count]
        remaining = n_images - len(chosen.images)
        open_slots = [s for s in range(n_slots) if missing[s] > 0 or sum(missing) < remaining]
        slot, image, value = _best_candidate(
            session, open_slots, criterion, rng, set(chosen.images)
        )
        session.changed(slot, image, 1.0)
        chosen.images.append((slot, image))
        chosen.value = value
        chosen.history.append(value)
        progress("Images", len(chosen.images), n_images)
        if is_enough(value) and min(count) >= least:
            break
    session.renewed()
    return chosen


def exchange(
    session: Session,
    chosen: Chosen,
    criterion: Criterion,
    rng: np.random.Generator,
    least: int,
    *,
    progress: Report = no_progress,
) -> Chosen:
    """Exchange single images while the criterion improves."""
    chosen.value = float(criterion(session.machine[None])[0])
    for turn in range(_MAX_PASSES):
        before = chosen.value
        for i, (slot, image) in enumerate(list(chosen.images)):
            is_needed = sum(s == slot for s, _ in chosen.images) <= least
            open_slots = [slot] if is_needed else range(len(session.slots))
            session.changed(slot, image, -1.0)
            replacement = _best_candidate(session, open_slots, criterion, rng, set(chosen.images))
            if replacement[2] < chosen.value * (1.0 - _MIN_GAIN):
                slot, image, chosen.value = replacement
                chosen.images[i] = slot, image
            session.changed(slot, image, 1.0)
        session.renewed()
        chosen.value = float(criterion(session.machine[None])[0])
        progress("Exchanges", turn + 1, _MAX_PASSES)
        if chosen.value > before * (1.0 - 10.0 * _MIN_GAIN):
            break
    progress("Exchanges", _MAX_PASSES, _MAX_PASSES)
    return chosen


def _best_candidate(
    session: Session,
    slots: Sequence[int],
    criterion: Criterion,
    rng: np.random.Generator,
    taken: set[tuple[int, int]],
) -> tuple[int, int, float]:
    """Best of randomly drawn candidates: slot, image, and its criterion."""
    candidates = [
        (s, k) for s in slots for k in range(len(session.slots[s].rows)) if (s, k) not in taken
    ]
    drawn = rng.permutation(len(candidates))[:_N_DRAWN].tolist()
    best = (-1, -1, np.inf)
    for slot in slots:
        images = np.array(
            [candidates[i][1] for i in drawn if candidates[i][0] == slot], dtype=np.intp
        )
        for batch in np.split(images, range(_BATCH, len(images), _BATCH)) if len(images) else []:
            values = criterion(session.with_one_more(slot, batch))
            k = int(np.argmin(values))
            if values[k] < best[2]:
                best = slot, int(batch[k]), float(values[k])
    return best


# The criterion


@dataclass(frozen=True, eq=False)
class Workspace:
    """Sensitivity of the platform to the parameters, over the workspace."""

    by_parameters: Array  # (w, 6, p): rotation vectors, displacements of the origin of R_e
    joints: Array  # (w, n_joints, 3, p): displacements of platform joints [m]

    def error(self, covariance: Array) -> PlatformError:
        """Return the error of the platform for a covariance (p, p) of the parameters."""
        return expected_error(self.by_parameters, covariance)


def workspace_of(machine: Machine, legs: FittedLegs) -> Workspace | None:
    """Return the workspace of a machine; None if readings do not determine its poses."""
    if not machine.is_determined:
        return None
    try:
        poses = platforms_in_base(machine, workspace(machine)[1])
        by = platform_by_parameters(legs.nominal, legs.parametrization, machine.frame_legs, poses)
    except (DidNotConverge, NotIdentifiable):
        return None
    R = np.array([T.rotation.as_matrix() for T in poses])
    arms = np.einsum("wij,lj->wli", R, np.array([leg.B for leg in legs.nominal]))
    turned = -cross(arms[:, :, None], np.swapaxes(by[:, None, :3], 2, 3))  # (w, l, p, 3)
    return Workspace(by, np.swapaxes(turned, 2, 3) * -1.0 + by[:, None, 3:])


def criterion_of(
    work: Workspace | None,
    legs: FittedLegs,
    basis: Array,  # (n_parameters, p)
) -> Criterion:
    """Return the criterion: of covariances (n, p, p) in the coordinates of a basis."""
    if work is not None:
        moves = np.concatenate(list(np.moveaxis(work.joints, 1, 0)), axis=1) @ basis
        weights = np.einsum("wri,wrj->wij", moves, moves) / work.joints.shape[1]
        mean = weights.mean(axis=0)
        return lambda S: np.sqrt(np.maximum(np.einsum("ij,nij->n", mean, S), 0.0))
    length = float(np.mean([np.linalg.norm(leg.B) + leg.q0 for leg in legs.nominal]))
    unit = np.array([1.0 if unit == "m" else length for unit in legs.parametrization.units])
    p = basis.shape[1]
    scale = float(np.linalg.slogdet(basis.T @ np.diag(unit**2) @ basis)[1])
    return lambda S: np.exp((np.linalg.slogdet(S)[1] + scale) / (2.0 * p))
