"""Reading a mechanism of any format: which one it is, and the reader of that format."""

from pathlib import Path

from legcal.errors import ModelError, OutOfClass
from legcal.mechanism.files import find_model, read_file, yaml_of_urdf
from legcal.mechanism.robot_xml import parse_xml
from legcal.mechanism.sources.closed_start import completed
from legcal.mechanism.sources.components import check_one_mechanism
from legcal.mechanism.sources.mechanism_yaml import read_yaml_source
from legcal.mechanism.sources.mjcf import read_mjcf_source
from legcal.mechanism.sources.source import Source
from legcal.mechanism.sources.urdf_loops import has_loops, read_loop_source

XML_SUFFIXES = (".urdf", ".xml", ".mjcf")


def read_source(model: str | Path) -> Source:
    """Return the tree and the closures of a mechanism, checked in themselves.

    Parameters
    ----------
    model : str or Path
        A mechanism YAML or a folder with ``robot.yaml``; a URDF with its YAML beside it (or in
        ``../models``) or with loops of its own; an MJCF file; or the name of a shipped model.

    Raises
    ------
    ModelError
        If a file is missing or malformed; all problems of a file at once.
    OutOfClass
        If nothing closes the loops, or there are two mechanisms.
    """
    path = find_model(model)
    is_xml = path.suffix.lower() in XML_SUFFIXES
    source = _read_xml(path) if is_xml else read_yaml_source(path)
    if source.file.legcal is not None:
        return source
    check_one_mechanism(source.urdf, source.file.closed_loop, source.path)
    return completed(source)


def _read_xml(path: Path) -> Source:
    """Return the mechanism of an XML file, whose outermost element tells the format."""
    beside = yaml_of_urdf(path)
    if beside is not None and path.suffix.lower() != ".mjcf":
        return read_yaml_source(beside)
    content = read_file(path, "mechanism file")
    root = parse_xml(path, content, "mechanism file")
    if root.tag == "mujoco":
        return read_mjcf_source(path, content)
    if root.tag != "robot":
        raise ModelError(
            f"{path}, line {root.sourceline}: the mechanism could not be read: found <{root.tag}> "
            "as the outermost element, needed <robot> (URDF) or <mujoco> (MJCF); give one of them."
        )
    if has_loops(root):
        return read_loop_source(path, content)
    raise OutOfClass(
        f"{path}: this is not a parallel mechanism: found a URDF, which is a tree without closed "
        f"loops, and no YAML that closes them; write {path.with_suffix('.yaml')} with closed_loop, "
        "type, name_mot and a legcal block."
    )
