"""What every format of mechanism is read as: a tree, the closures that close it, its motors."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.urdf import Urdf


@dataclass(frozen=True, eq=False)
class Source:
    """A mechanism as one of its formats has it.

    Attributes
    ----------
    path : Path
        The file that closes the loops; messages name it.
    file : MechanismFile
        Closures, motors and the ``legcal`` block, as a mechanism YAML would have them.
    urdf : Urdf
        The tree. ``urdf.content`` is the URDF on disk, or one that was made of another format.
    converted : bool
        Whether ``urdf.content`` was made of another format, so that ``urdf.path`` names the file
        of that format.
    notes : tuple of str
        What the reader should know of the conversion, one sentence each.
    values : mapping of str to float
        Joint values [rad, m] of the configuration that the file is drawn in; others are zero.
    poses : mapping of str to RigidTransform or None
        Where the links are in a closed configuration near that one, in the root link; None
        where none was looked for or found.
    """

    path: Path
    file: MechanismFile
    urdf: Urdf
    converted: bool = False
    notes: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    poses: Mapping[str, RigidTransform] | None = None
