"""The XML of a mechanism, parsed so that a file can do no harm."""

from pathlib import Path
from typing import Any

from lxml import etree

from legcal.errors import ModelError


def parse_robot(path: Path, content: bytes) -> etree._Element:
    """Return the ``<robot>`` of a URDF, without comments, entities or the network.

    Raises
    ------
    ModelError
        If it is not well-formed XML in UTF-8, has a document type, or is no named robot.
    """
    robot = parse_xml(path, content, "URDF")
    if robot.tag != "robot":
        raise ModelError(
            f"{path}, line {robot.sourceline}: the URDF could not be read: found <{robot.tag}> "
            "as its outermost element, needed <robot>; give the URDF of the mechanism."
        )
    if not robot.get("name", "").strip():
        raise ModelError(
            f"{path}, line {robot.sourceline}: the URDF could not be read: found <robot> without "
            "a name, needed one; write <robot name=...>."
        )
    return robot


def parse_xml(path: Path, content: bytes, what: str) -> etree._Element:
    """Return the outermost element of an XML file, without comments, entities or the network.

    Parameters
    ----------
    path : Path
        The file, for messages.
    content : bytes
        What it holds.
    what : str
        What it is, for messages: ``URDF``.

    Raises
    ------
    ModelError
        If it is not well-formed XML in UTF-8 or has a document type.
    """
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False,
        remove_comments=True, remove_pis=True,
    )  # fmt: skip
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        line = error.lineno or 1
        raise ModelError(
            f"{path}, line {line}: the {what} could not be read: found {error.msg}, needed "
            "well-formed XML; mend that line, or copy the file again if it was cut off."
        ) from error
    document: Any = root.getroottree().docinfo
    if document.doctype or document.internalDTD is not None:
        raise ModelError(
            f"{path}: the {what} could not be read: found a document type (<!DOCTYPE>), whose "
            "entities are never expanded, needed plain XML; remove it."
        )
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ModelError(
            f"{path}: the {what} could not be read: found text in another encoding, needed "
            "UTF-8; save it as UTF-8."
        ) from error
    return root
