"""The YAML of a mechanism, written: :mod:`legcal.mechanism.schema` reads it."""

from collections.abc import Sequence
from typing import Any

import yaml


def mechanism_yaml(
    loops: Sequence[tuple[str, str, str]], motors: Sequence[str], legcal: dict[str, Any]
) -> str:
    """Return the YAML of a mechanism.

    Parameters
    ----------
    loops : sequence of tuples of str
        The two frames of every closure, and its type.
    motors : sequence of str
        The joints with motors.
    legcal : dict
        The block ``legcal`` without its version.
    """
    document = {
        "closed_loop": [[one, two] for one, two, _ in loops],
        "type": [kind for *_, kind in loops],
        "name_mot": motors,
        "joint_name": [],
        "joint_type": [],
        "legcal": {"version": 1, **legcal},
    }
    return str(
        yaml.safe_dump(document, sort_keys=False, default_flow_style=False, allow_unicode=True)
    )
