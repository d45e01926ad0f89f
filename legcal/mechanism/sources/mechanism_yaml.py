"""A mechanism as a URDF with a YAML: ours, or a ``robot.yaml`` as Gepetto writes it."""

from pathlib import Path

from lxml import etree

from legcal.errors import ModelError
from legcal.mechanism.files import find_urdf
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.schema import MechanismFile, read_mechanism_file
from legcal.mechanism.sources.source import Source
from legcal.mechanism.sources.stand_ins import check_stand_ins, replace_stand_ins
from legcal.mechanism.urdf import Urdf, parse_urdf, read_urdf

_NO_BLOCK = (
    ("legcal.home could not be used", "the pose that the file draws could not be used"),
    ("legcal.home is not given", "no closed pose was found near the one that the file draws"),
    ("write legcal.home", "add a block legcal with home"),
    ("correct legcal.home", "add a block legcal with another home"),
    ("check legcal.home or the limits", "check the limits, or add a block legcal with home"),
    ("correct legcal.base or legcal.platform", "add a block legcal with another base or platform"),
    (", legcal.base and legcal.platform", ", or add a block legcal with another base and platform"),
    ("write legcal.base, legcal.platform and legcal.legs",
     "add a block legcal with base, platform and legs"),
)  # fmt: skip


def read_yaml_source(path: Path) -> Source:
    """Return a mechanism from its YAML and the URDF that it names.

    A file without the block ``legcal`` may leave the travel of sliders open, as Gepetto's do.

    Raises
    ------
    ModelError
        With one sentence for each problem of a file.
    """
    file = read_mechanism_file(path)
    block = file.legcal
    urdf = read_urdf(
        find_urdf(path, None if block is None else block.urdf), travel_needed=block is not None
    )
    check_stand_ins(file, urdf, path)
    if not file.joint_name:
        return Source(path, file, urdf, words=_NO_BLOCK if block is None else ())
    return _converted(path, file, urdf)


def _converted(path: Path, file: MechanismFile, urdf: Urdf) -> Source:
    """Return a mechanism whose URDF has joints that stand for others."""
    robot = parse_robot(urdf.path, urdf.content)
    frames = replace_stand_ins(robot, file, urdf)
    content = etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"
    travel_needed = file.legcal is not None
    completed = parse_urdf(urdf.path, content, travel_needed=travel_needed)
    changes = {
        "closed_loop": [[frames.get(name, name) for name in pair] for pair in file.closed_loop],
        "joint_name": [],
        "joint_type": [],
    }
    if file.legcal is not None:
        on_replaced = [joint for joint in file.legcal.legs.values() if joint in frames]
        if on_replaced:
            raise ModelError(
                f"{path}: legcal.legs could not be used: found '{on_replaced[0]}', which stands "
                "for another joint (joint_name), needed another joint of that leg; name its "
                "prismatic joint."
            )
    words = _NO_BLOCK if file.legcal is None else ()
    return Source(path, file.model_copy(update=changes), completed, True, words=words)
