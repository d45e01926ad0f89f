"""Names of parts of a mechanism file and clauses of remedies, by file format, for messages.

A mechanism YAML with a block ``legcal`` states home, base, platform and legs; without the block
they follow from the tree and its drawn pose. MJCF files and URDFs with loops have no place for a
block: what they leave open is an option of ``legcal inspect``, which writes a model with a block.
"""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Wording:
    """Nouns for parts of a file, and clauses of remedies."""

    closures: str = "closed_loop"
    root: str = "the root of the URDF"
    home: str = "legcal.home"
    no_home: str = "legcal.home is not given"
    state_home: str = "write legcal.home"
    correct_home: str = "correct legcal.home"
    state_readings: str = "write legcal.home_readings with the reading of each actuator at home"
    state_ends: str = "write legcal.base, legcal.platform and legcal.legs"
    correct_ends: str = "correct legcal.base or legcal.platform"


BLOCK = Wording()
NO_BLOCK = Wording(
    home="the pose that the file draws",
    no_home="the file draws no closed pose",
    state_home="add a block legcal with home",
    correct_home="add a block legcal with another home",
    state_readings="add a block legcal with home and home_readings",
    state_ends="add a block legcal with base, platform and legs",
    correct_ends="add a block legcal with another base or platform",
)
_NAMED_ENDS = (
    "name the links, with legcal inspect FILE --base LINK --platform LINK --write DIR, and use the "
    "model in DIR"
)
_DRAWING = replace(
    NO_BLOCK,
    state_home="draw the machine nearer to closed",
    correct_home="correct the pose that the file draws",
    state_readings="draw the machine closed",
    state_ends=_NAMED_ENDS,
    correct_ends=_NAMED_ENDS,
)
URDF_LOOPS = replace(_DRAWING, closures="<loop_joint> or <constraint>")
MJCF = replace(_DRAWING, closures="<equality>", root="<worldbody>")
