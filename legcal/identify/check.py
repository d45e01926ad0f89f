"""Whether a dataset can determine the parameters at all, asked before any image is searched."""

from __future__ import annotations

from legcal.dataset.folder import Dataset
from legcal.errors import NotIdentifiable
from legcal.identify.analysis import identifiability_of_dataset
from legcal.identify.identifiability import Identifiability
from legcal.identify.weak import Ranks
from legcal.refinement.choices import NO_CHOICES, Choices


def check_identifiable(dataset: Dataset, choices: Choices = NO_CHOICES) -> tuple[str, ...]:
    """Return what a dataset leaves open that does no harm, one sentence each.

    Parameters
    ----------
    dataset : Dataset
        Its views are taken to show the legs that they name, or all: what even then stays open
        cannot be found.
    choices : Choices
        Parameters that are fixed or known from elsewhere: they are no longer open.

    Raises
    ------
    NotIdentifiable
        If a direction that moves the platform is not determined by everything at once.
    """
    report = identifiability_of_dataset(dataset, choices)
    if not report.identifiable:
        raise NotIdentifiable(_refusal(dataset, report))
    notes = []
    if any(not weak.harmless for weak in report.staged.weak):
        notes.append(
            f"The four steps alone leave open {_directions(report.staged, harmless=False)}; the "
            "fit of everything does not."
        )
    if report.full.weak:  # what is left is harmless
        notes.append(
            "Not determined, and without effect on the platform: "
            f"{_directions(report.full, harmless=True)}."
        )
    return tuple(notes)


def _refusal(dataset: Dataset, report: Identifiability) -> str:
    """Return why a dataset cannot be calibrated from, and what would mend it."""
    remedies = [remedy.remedy for remedy in report.remedies if remedy.enough]
    remedy = remedies[0] if remedies else "add images of other poses, and of more legs at once"
    return (
        f"{dataset.folder}: the parameters cannot be identified: found that these views and poses "
        f"determine {report.full.rank} of {report.full.of} at best and leave open "
        f"{_directions(report.full, harmless=False)}, needed everything that moves the platform; "
        f"{remedy}, or state what is known of them with --prior."
    )


def _directions(ranks: Ranks, *, harmless: bool) -> str:
    """Return the simplest direction that stays open, in words, and how many there are."""
    words = [weak.direction for weak in ranks.weak if weak.harmless == harmless]
    simplest = min(words, key=len)
    if len(words) == 1:
        return simplest
    return f"{len(words)} independent changes of them, such as {simplest}"
