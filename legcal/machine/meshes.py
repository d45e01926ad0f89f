"""Mesh files named in the visuals of a URDF."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from legcal.geometry.lines import cross
from legcal.geometry.motions import matrix_applied
from legcal.geometry.types import Array, IntArray
from legcal.machine.urdf import origins_of

_UNREADABLE = (ValueError, KeyError, IndexError, AttributeError, TypeError, OSError)
GRAZING = 1e-5  # sine of the angle of a ray and a triangle below which the triangle hides nothing


def read_mesh(urdf_path: Path, visual: etree._Element) -> tuple[Array, IntArray]:
    """Return the corners (n, 3) in the link [m] and the triangles (m, 3) of a mesh file.

    Raises ValueError if the file holds no mesh.
    """
    vertices, faces = mesh_of_file(urdf_path, visual)
    return matrix_applied(origins_of([visual])[0], vertices), faces


def mesh_of_file(urdf_path: Path, visual: etree._Element) -> tuple[Array, IntArray]:
    """Return a mesh as :func:`read_mesh`, with its corners in the frame of its file."""
    shape = visual.find("geometry/mesh")
    stated = [] if shape is None else [(str(k), str(v)) for k, v in shape.attrib.items()]
    file = mesh_file(urdf_path, dict(stated).get("filename", ""))
    written = None if file is None else file.stat().st_mtime_ns
    return _loaded(urdf_path, tuple(stated), written)


@lru_cache(maxsize=512)  # a CAD export has hundreds, which are read for each part of a model
def _loaded(
    urdf_path: Path,
    shape: tuple[tuple[str, str], ...],
    written: int | None,  # when: another export is read again
) -> tuple[Array, IntArray]:
    """Return corners and triangles of the scene in the file of a ``<mesh>``, scaled as it says."""
    import trimesh  # half a second: imported only for meshes

    name = dict(shape).get("filename", "")
    try:
        scale = [float(text) for text in dict(shape).get("scale", "1").split()]
        file = str(mesh_file(urdf_path, name))
        scene: Any = trimesh.load_scene(file, ignore_broken=True, skip_materials=True)
        mesh = scene.scaled(scale[0] if len(scale) == 1 else scale).to_geometry()
        vertices, faces = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    except (*_UNREADABLE, ImportError) as error:  # packages that few formats need
        reason = " ".join(str(error).split())
        raise ValueError(
            f"found a mesh file '{name}' that cannot be read ({reason}), needed a complete one; "
            "export it again"
        ) from error
    if not len(faces) or not np.all(np.isfinite(vertices)):
        raise ValueError(
            f"found no triangles in the mesh file '{name}', needed some; export it again"
        )
    vertices.flags.writeable = False
    return vertices, faces.astype(np.intp)


def mesh_file(urdf_path: Path, name: str) -> Path | None:
    """Return the path of a file named in a URDF: as stated, or relative to a folder above it."""
    if not name.strip() or "\0" in name:
        return None
    plain = Path(name.split("://", 1)[-1])
    tails = [plain, Path(*plain.parts[1:])] if "://" in name and len(plain.parts) > 1 else [plain]
    for folder in urdf_path.absolute().parents:
        for tail in tails:
            if (folder / tail).is_file():
                return folder / tail
    return None


def first_hits(
    caster: Any, corners: Array, triangles: IntArray, origin: Array, points: Array
) -> Array:
    """Return the first hits of triangles by rays from an origin to points (n, 3), (n,) [m].

    They are distances from the origin, (3,) or (n, 3), infinite without a hit. *caster* is the
    :func:`ray_caster` of the triangles.
    """
    way = points - origin
    start = np.broadcast_to(origin, way.shape)
    ray = way / np.linalg.norm(way, axis=1)[:, None]
    hits = np.full(len(points), np.inf)
    triangle, index = caster.intersects_id(start, ray, multiple_hits=False)
    corner = corners[triangles[triangle]]
    normal = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    towards = np.sum(normal * ray[index], axis=1)
    is_hit = np.abs(towards) > GRAZING * np.linalg.norm(normal, axis=1)
    index, reached = index[is_hit], np.sum(normal * (corner[:, 0] - start[index]), axis=1)[is_hit]
    hits[index] = reached / towards[is_hit]
    return hits


def ray_caster(vertices: Array, triangles: IntArray | None) -> Any:
    """Return the ray caster of trimesh for triangles: Embree, or a far slower one without it."""
    import trimesh  # 30 MB and half a second: imported only for meshes

    return trimesh.Trimesh(vertices, triangles, process=False).ray
