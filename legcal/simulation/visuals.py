"""The visuals of a URDF, every shape of them, read with yourdfpy.

What yourdfpy would pass over or stumble on is looked for before, and said with its line.
"""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform

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
                _check(urdf.path, geometry[0])
                shape, T = _shown(urdf.path, visual)
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
            found.append(Visual(link.get("name", ""), shape, T, colour))
    if problems:
        raise ModelError(problems)
    return found


def _check(urdf_path: Path, element: etree._Element) -> None:
    """Check a shape; ValueError says what was found and needed."""
    tag = str(element.tag)
    if tag == "mesh":
        _check_mesh(urdf_path, element)
    elif tag not in _SIZES:
        raise ValueError(
            f"found <{tag}>, needed a cylinder, sphere, box or mesh; write one of them"
        )
    for name in _SIZES.get(tag, ()):
        text, count = element.get(name, ""), 3 if name == "size" else 1
        numbers = number_list(text, count)
        if numbers is None or min(numbers) <= 0.0:
            needed = "a positive number" if count == 1 else f"{count} positive numbers"
            raise ValueError(f'found <{tag} {name}="{text}">, needed {needed}; write it [m]')


def _check_mesh(urdf_path: Path, element: etree._Element) -> None:
    """Check that a mesh has a file and a size."""
    name, scale = element.get("filename", ""), element.get("scale", "1 1 1")
    if _found(urdf_path, name) is None:
        raise ValueError(
            f"found no mesh file '{name}', needed it beside the URDF; copy it or correct the name"
        )
    factors = number_list(scale, 3)
    if factors is None or min(abs(factor) for factor in factors) == 0.0:
        raise ValueError(
            f'found <mesh scale="{scale}">, needed 3 numbers other than zero; correct it'
        )


def _shown(urdf_path: Path, visual: etree._Element) -> tuple[Shape, RigidTransform]:
    """Return the shape of a visual and T_link_shape, as yourdfpy has them.

    A mesh is scaled and placed by yourdfpy, its vertices are those in the link. ValueError says
    what was found and needed where its file holds none.
    """
    from yourdfpy import URDF  # half a second: only where there is something to read

    if visual.find("geometry/mesh") is not None:
        return _mesh(urdf_path, visual), RigidTransform.identity()
    alone = io.BytesIO(_alone(visual))
    robot: Any = URDF.load(alone, build_scene_graph=False, load_meshes=False).robot
    (read,) = robot.links[0].visuals
    T = RigidTransform.from_matrix(np.asarray(read.origin, dtype=float))
    cylinder, sphere = read.geometry.cylinder, read.geometry.sphere
    if cylinder is not None:
        return Cylinder(float(cylinder.radius), float(cylinder.length)), T
    if sphere is not None:
        return Sphere(float(sphere.radius)), T
    x, y, z = (float(side) for side in read.geometry.box.size)
    return Box((x, y, z)), T


def _mesh(urdf_path: Path, visual: etree._Element) -> Mesh:
    """Return the triangles of a mesh file in the link, from the scene that yourdfpy makes of it."""
    from yourdfpy import URDF

    name = visual.find("geometry/mesh").get("filename", "")  # type: ignore[union-attr]
    try:
        scene: Any = URDF.load(
            io.BytesIO(_alone(visual)),
            filename_handler=lambda fname: str(_found(urdf_path, fname)),
        ).scene
        mesh = scene.to_geometry()
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
    return Mesh(vertices, faces.astype(np.intp))


def _alone(visual: etree._Element) -> bytes:
    """Return a URDF of one link with the shape and the place of a visual, and nothing else."""
    robot = etree.Element("robot", {"name": "visual"})
    shown = etree.SubElement(etree.SubElement(robot, "link", {"name": "link"}), "visual")
    origin = visual.find("origin")
    place = {}
    for key in ("xyz", "rpy"):
        numbers = None if origin is None else number_list(origin.get(key, ""), 3)
        place[key] = " ".join(repr(x) for x in numbers or (0.0, 0.0, 0.0))
    etree.SubElement(shown, "origin", place)
    shape = visual.find("geometry")[0]  # type: ignore[index]
    geometry = etree.SubElement(shown, "geometry")
    etree.SubElement(geometry, str(shape.tag), {str(k): str(v) for k, v in shape.attrib.items()})
    return etree.tostring(robot)


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


def _rgb(material: etree._Element) -> tuple[float, float, float] | None:
    """Return the colour of a ``<material>``, 0 to 1, or None where it has none."""
    color = material.find("color")
    rgba = None if color is None else number_list(color.get("rgba", ""), 4)
    if rgba is None:
        return None
    r, g, b = (min(max(x, 0.0), 1.0) for x in rgba[:3])
    return r, g, b
