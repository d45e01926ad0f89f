"""Whether a dataset can determine the parameters at all, asked before any image is searched."""

from __future__ import annotations

from legcal.dataset.folder import Dataset
from legcal.errors import NotIdentifiable
from legcal.identify.analysis import Identifiability, identifiability_of_dataset
from legcal.identify.weak import Ranks

_NAMED = 3  # directions in one message


def check_identifiable(dataset: Dataset) -> tuple[str, ...]:
    """Return what a dataset leaves open that does no harm, one sentence each.

    Parameters
    ----------
    dataset : Dataset
        Its views are taken to show the legs that they name, or all: what even then stays open
        cannot be found.

    Raises
    ------
    NotIdentifiable
        If a direction that moves the platform is not determined by everything at once.
    """
    report = identifiability_of_dataset(dataset)
    if not report.identifiable:
        raise NotIdentifiable(_refusal(dataset, report))
    notes = []
    if not report.staged.complete:
        notes.append(
            f"The four steps alone leave {_directions(report.staged, harmless=False)} open; the "
            "fit of everything does not."
        )
    if report.full.weak:
        notes.append(
            f"Not determined, and without effect on the platform: "
            f"{_directions(report.full, harmless=True)}."
        )
    return tuple(notes)


def _refusal(dataset: Dataset, report: Identifiability) -> str:
    """Return why a dataset cannot be calibrated from, and what would mend it."""
    remedies = [remedy.remedy for remedy in report.remedies if remedy.enough]
    remedy = remedies[0] if remedies else "add images of other poses, and of more legs at once"
    return (
        f"{dataset.folder}: the parameters cannot be identified: found that these views and poses "
        f"determine {report.full.rank} of {report.full.of} at best and leave "
        f"{_directions(report.full, harmless=False)} open, needed everything that moves the "
        f"platform; {remedy}."
    )


def _directions(ranks: Ranks, *, harmless: bool) -> str:
    """Return the first directions that stay open, in words."""
    words = [weak.direction for weak in ranks.weak if weak.harmless == harmless]
    more = [f"{len(words) - _NAMED} more"] if len(words) > _NAMED else []
    return ", ".join([*words[:_NAMED], *more])
