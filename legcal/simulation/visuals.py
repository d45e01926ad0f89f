"""The visuals of a URDF, every shape of them, as the file has them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError
from legcal.mechanism.robot_xml import parse_robot
from legcal.mechanism.urdf import Urdf
from legcal.mechanism.urdf_checks import number_list
from legcal.simulation.shapes import Box, Cylinder, Mesh, Shape, Sphere

_SIZES = {"cylinder": ("radius", "length"), "sphere": ("radius",), "box": ("size",)}


class Visual(NamedTuple):
    """A visual of a link: its shape, its pose there, and its colour (r, g, b) if it has one."""

    link: str
    shape: Shape
    T_link_shape: RigidTransform
    colour: tuple[float, float, float] | None


def visuals(urdf: Urdf) -> list[Visual]:
    """Return all visuals of a tree in the order of the file.

    Raises
    ------
    ModelError
        If a shape has no size, or if a mesh is missing or has no triangles; all of them at once.
    """
    robot = parse_robot(urdf.path, urdf.content)
    named = {m.get("name", ""): _rgb(m) for m in robot.findall("material")}
    problems: list[str] = []
    found = []
    for link in robot.findall("link"):
        for visual in link.findall("visual"):
            geometry = visual.find("geometry")
            if geometry is None or len(geometry) == 0:
                continue
            try:
                shape = _shape(urdf.path, geometry[0])
            except ValueError as error:
                problems.append(
                    f"{urdf.path}, line {visual.sourceline}: the visual of link "
                    f"'{link.get('name')}' could not be shown: {error}."
                )
                continue
            material = visual.find("material")
            colour = None
            if material is not None:
                colour = _rgb(material) or named.get(material.get("name", ""))
            found.append(Visual(link.get("name", ""), shape, _origin(visual), colour))
    if problems:
        raise ModelError(problems)
    return found


def _shape(urdf_path: Path, element: etree._Element) -> Shape:
    """Return the shape of a ``<geometry>``; ValueError says what was found and needed."""
    tag = str(element.tag)
    if tag == "mesh":
        return _mesh(urdf_path, element)
    if tag not in _SIZES:
        raise ValueError(
            f"found <{tag}>, needed a cylinder, sphere, box or mesh; write one of them"
        )
    sizes = {name: _numbers(element, name, 3 if name == "size" else 1) for name in _SIZES[tag]}
    if tag == "cylinder":
        return Cylinder(sizes["radius"][0], sizes["length"][0])
    if tag == "sphere":
        return Sphere(sizes["radius"][0])
    return Box((sizes["size"][0], sizes["size"][1], sizes["size"][2]))


def _numbers(element: etree._Element, name: str, count: int) -> list[float]:
    """Return sizes that must be positive."""
    numbers = number_list(element.get(name, ""), count)
    if numbers is None or min(numbers) <= 0.0:
        raise ValueError(
            f'found <{element.tag} {name}="{element.get(name, "")}">, needed '
            f"{'a positive number' if count == 1 else f'{count} positive numbers'}; write it [m]"
        )
    return numbers


def _mesh(urdf_path: Path, element: etree._Element) -> Mesh:
    """Return the triangles of a mesh file, which is looked for as other tools look for it."""
    import trimesh  # half a second: only where there is something to read

    name = element.get("filename", "")
    path = _found(urdf_path, name)
    if path is None:
        raise ValueError(
            f"found no mesh file '{name}', needed it beside the URDF; copy it or correct the name"
        )
    try:
        mesh: Any = trimesh.load(str(path), force="mesh")
        vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    except (ValueError, KeyError, IndexError, AttributeError, TypeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(
            f"found a mesh file '{name}' that cannot be read ({reason}), needed a complete one; "
            "export it again"
        ) from error
    if not len(faces) or not np.all(np.isfinite(vertices)):
        raise ValueError(
            f"found no triangles in the mesh file '{name}', needed some; export it again"
        )
    scale = number_list(element.get("scale", "1 1 1"), 3) or [1.0, 1.0, 1.0]
    return Mesh(vertices * np.array(scale), faces.astype(np.intp))


def _found(urdf_path: Path, name: str) -> Path | None:
    """Return the file that a URDF names: as it stands, or from a folder above the URDF."""
    if not name.strip() or "\0" in name:
        return None
    plain = Path(name.split("://", 1)[-1])
    tails = [plain, Path(*plain.parts[1:])] if "://" in name and len(plain.parts) > 1 else [plain]
    for folder in urdf_path.absolute().parents:
        for tail in tails:
            if (folder / tail).is_file():
                return folder / tail
    return None


def _origin(visual: etree._Element) -> RigidTransform:
    """Return T_link_shape."""
    origin = visual.find("origin")
    if origin is None:
        return RigidTransform.identity()
    xyz, rpy = (number_list(origin.get(key, "0 0 0"), 3) for key in ("xyz", "rpy"))
    rotation = Rotation.from_euler("xyz", rpy or [0.0, 0.0, 0.0])
    return RigidTransform.from_components(xyz or [0.0, 0.0, 0.0], rotation)


def _rgb(material: etree._Element) -> tuple[float, float, float] | None:
    """Return the colour of a ``<material>``, 0 to 1, or None where it has none."""
    color = material.find("color")
    rgba = None if color is None else number_list(color.get("rgba", ""), 4)
    if rgba is None:
        return None
    r, g, b = (min(max(x, 0.0), 1.0) for x in rgba[:3])
    return r, g, b
