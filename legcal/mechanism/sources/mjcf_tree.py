"""What is found in an MJCF file while its bodies are written as a URDF."""

from dataclasses import dataclass, field

from scipy.spatial.transform import RigidTransform

from legcal.mechanism.sources.mjcf_values import Values
from legcal.mechanism.sources.tree_text import TreeText

WORLD = "world"


@dataclass
class MjcfTree:
    """What is found while the bodies are walked.

    Attributes
    ----------
    text : TreeText
        The URDF.
    poses : dict of str to RigidTransform
        The bodies in the world in the configuration of the file, where its loops are closed.
    sites : dict of str to (str, RigidTransform)
        Body and pose there of every named site.
    joints : dict of str to str
        The type of every hinge, slide, ball or free joint.
    references : dict of str to float
        The values [rad, m] of hinges and slides in the configuration of the file.
    taken : set of str
        Names that no new link or joint may have.
    driven : frozenset of str
        The joints that actuators drive or sensors measure.
    """

    values: Values
    text: TreeText = field(default_factory=TreeText)
    poses: dict[str, RigidTransform] = field(default_factory=dict)
    sites: dict[str, tuple[str, RigidTransform]] = field(default_factory=dict)
    joints: dict[str, str] = field(default_factory=dict)
    references: dict[str, float] = field(default_factory=dict)
    taken: set[str] = field(default_factory=set)
    driven: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Place:
    """Where in the tree an element stands: its body, the frame it is written in, its class."""

    body: str
    T_body_frame: RigidTransform
    childclass: str


def unused(tree: MjcfTree, name: str) -> str:
    """Return a name that nothing in the file has, and take it."""
    found = tree.text.unused(name, tree.taken)
    tree.taken.add(found)
    return found
