"""The shapes that a machine and its surroundings are made of."""

from dataclasses import dataclass

from legcal.geometry.types import Array, IntArray


@dataclass(frozen=True)
class Cylinder:
    """A closed cylinder about the z axis, its middle at the origin.

    Attributes
    ----------
    radius, length : float
        Its size [m].
    """

    radius: float
    length: float


@dataclass(frozen=True)
class Sphere:
    """A sphere about the origin.

    Attributes
    ----------
    radius : float
        Its size [m].
    """

    radius: float


@dataclass(frozen=True)
class Box:
    """A box along the axes, its middle at the origin.

    Attributes
    ----------
    size : tuple of float
        Its whole lengths along x, y, z [m].
    """

    size: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A surface of triangles.

    Attributes
    ----------
    vertices : (n, 3) array
        Points [m].
    faces : (m, 3) array of int
        The corners of each triangle.
    """

    vertices: Array
    faces: IntArray


Shape = Cylinder | Sphere | Box | Mesh
