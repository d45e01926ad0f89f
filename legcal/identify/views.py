"""Views as people give them: names of legs, checked."""

from __future__ import annotations

from collections.abc import Sequence

from legcal.errors import UsageError
from legcal.files.schema import closest

MOST_VIEWS, MOST_IMAGES = 50, 2000  # of a session; more says nothing new and takes minutes


def read_views(
    views: Sequence[Sequence[str]], leg_names: Sequence[str], images: int
) -> tuple[tuple[int, ...], ...]:
    """Return the legs of each view as indices.

    Parameters
    ----------
    views : sequence of sequences of str
        Names of the legs that each camera position shows.
    leg_names : sequence of str
        All legs.
    images : int
        Number of images a view.

    Raises
    ------
    UsageError
        With one sentence for each thing that is wrong.
    """
    problems = []
    if images < 1:
        problems.append(
            f"The views could not be judged: found {images} images a view, needed at least 1; "
            "pass --images 15 or leave it out."
        )
    if len(views) > MOST_VIEWS:
        raise UsageError(
            f"The views could not be judged: found {len(views)} of them, needed at most "
            f"{MOST_VIEWS}; leave out views of the same legs."
        )
    if images * max(len(views), 1) > MOST_IMAGES:
        problems.append(
            f"The views could not be judged: found {images} images a view, needed at most "
            f"{MOST_IMAGES} in all views together; pass fewer --images."
        )
    for v, view in enumerate(views, start=1):
        if isinstance(view, str):
            problems.append(
                f"View {v} could not be used: found the text '{view}', needed a sequence of leg "
                "names; pass one list of names a view."
            )
            continue
        unnamed = [name for name in view if not isinstance(name, str)]
        if unnamed:
            problems.append(
                f"View {v} could not be used: found {unnamed[0]!r}, needed names of legs; pass "
                "texts."
            )
            continue
        names = [name.strip() for name in view]
        if not any(names):
            problems.append(
                f"View {v} could not be used: found no leg, needed at least one; name its legs, "
                f"such as --view {','.join(leg_names[:3])}."
            )
            continue
        for name in dict.fromkeys(names):
            if name not in leg_names:
                problems.append(
                    f"View {v} could not be used: found '{name}', needed a leg of the model; "
                    f"{closest(name, leg_names)}"
                )
            elif names.count(name) > 1:
                problems.append(
                    f"View {v} could not be used: found leg '{name}' {names.count(name)} times, "
                    "needed every leg at most once; name it once."
                )
    if problems:
        raise UsageError(problems)
    return tuple(tuple(sorted(leg_names.index(name.strip()) for name in view)) for view in views)
