"""What every format of mechanism is read as: a tree, the closures that close it, its motors."""

from dataclasses import dataclass
from pathlib import Path

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
    """

    path: Path
    file: MechanismFile
    urdf: Urdf
    converted: bool = False
    notes: tuple[str, ...] = ()
