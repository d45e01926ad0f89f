"""Parameters and legs in words."""

from __future__ import annotations

import re
from collections.abc import Sequence

_MOST_GROUPS = 4  # of joints in one direction
_TIMES = {2: "two", 3: "three", 4: "four"}
_NOUN = {
    "base": ("base joint", "base joints"),
    "platform": ("platform joint", "platform joints"),
    "offset": ("offset of leg", "offsets of legs"),
    "length": ("length of leg", "lengths of legs"),
    "base_axis": ("base axis of leg", "base axes of legs"),
    "platform_axis": ("platform axis of leg", "platform axes of legs"),
    "twist": ("twist of leg", "twists of legs"),
}


def joined(words: Sequence[str]) -> str:
    """Return words as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def leg_labels(leg_names: Sequence[str]) -> dict[str, str]:
    """Return what to call each leg after the word leg: its number where its name is one."""
    numbers = [re.fullmatch(r"[Ll]eg[_-]?(\d+)", name) for name in leg_names]
    labels = {
        name: match.group(1) if match else name
        for name, match in zip(leg_names, numbers, strict=True)
    }
    return labels if len(set(labels.values())) == len(labels) else {name: name for name in labels}


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


def describe_direction(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return a combination of parameters in words.

    Parameters
    ----------
    parameters : sequence of str
        Names of the parameters that change.
    leg_names : sequence of str
        All legs.

    Returns
    -------
    str
        ``z of platform joints 2 and 4 together``, ``offset of leg 3``.
    """
    labels = leg_labels(leg_names)
    coordinates: dict[tuple[str, str], list[str]] = {}
    for name in parameters:
        leg, kind, *rest = _split(name, leg_names)
        coordinates.setdefault((kind, leg), []).append(rest[0] if rest else "")
    groups: dict[tuple[str, str], list[str]] = {}
    for (kind, leg), which in coordinates.items():
        axes = joined(sorted(which))
        if kind.endswith("_axis"):
            axes = f"angle{'s' * (len(which) > 1)} {axes}"
        groups.setdefault((kind, axes), []).append(leg)
    phrases = []
    for (kind, axes), legs in groups.items():
        ordered = [labels[name] for name in leg_names if name in legs]
        noun = _NOUN[kind][len(ordered) > 1]
        phrases.append(f"{axes + ' of ' if axes else ''}{noun} {joined(ordered)}")
    if len(phrases) > _MOST_GROUPS:
        more = len(phrases) - _MOST_GROUPS + 1
        phrases = [*phrases[: _MOST_GROUPS - 1], f"{more} more such changes"]
    together = " together" if len(coordinates) > 1 else ""
    return f"{joined(phrases)}{together}"


def _split(name: str, leg_names: Sequence[str]) -> tuple[str, ...]:
    """Return leg, kind and coordinate of a parameter; leg names may contain dots."""
    leg = max((n for n in leg_names if name.startswith(f"{n}.")), key=len)
    return (leg, *name[len(leg) + 1 :].split("."))
