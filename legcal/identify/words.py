"""Legs and views in words."""

from __future__ import annotations

from collections.abc import Sequence

from legcal.mechanism.parameter_words import joined, leg_labels

_TIMES = {2: "two", 3: "three", 4: "four"}


def views_in_words(views: Sequence[str]) -> str:
    """Return views one after the other, equal ones once: ``1,2,3 from two places``."""
    said = []
    for view in dict.fromkeys(views):
        times = list(views).count(view)
        said.append(view if times == 1 else f"{view} from {_TIMES.get(times, times)} places")
    return "; ".join(said)


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {joined([labels[leg_names[j]] for j in legs])}"
