"""What every format of mechanism is read as: a tree, the closures that close it, its motors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from scipy.spatial.transform import RigidTransform

from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.urdf import Urdf

DRAWING = (
    ("legcal.home is not given", "no closed pose was found near the one that the file draws"),
    ("write legcal.home", "draw the machine nearer to closed"),
    ("legcal.home", "the pose that the file draws"),
    (", legcal.base and legcal.platform", " and that the root is the base"),
    ("legcal.base or legcal.platform", "the joints between them"),
    ("write legcal.", "write a mechanism YAML with legcal."),
)


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
    words: Sequence[tuple[str, str]] = ()

    def in_its_words(self, problem: str) -> str:
        """Return a message that names keys of the YAML in the words of this format."""
        for key, word in self.words:
            problem = problem.replace(key, word)
        return problem
