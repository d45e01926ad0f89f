"""What stands around a machine: a table, rods, boxes and balls behind it, cables before it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.solid_in_view import holding_sphere
from legcal.simulation.shapes import Box, Cylinder, Shape, Sphere
from legcal.simulation.solids import Material, PlacedSolid, Solid
from legcal.vision.camera import Camera

_TABLE = Material(albedo=0.22, specular=0.06, shininess=12.0, limb=0.0, texture=0.08,
                  tint=(1.15, 1.0, 0.85))  # fmt: skip
_CABLE = Material(albedo=0.04, specular=0.15, shininess=15.0, limb=0.2)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What does not move, in the base frame.

    Attributes
    ----------
    centre : (3,) array
        The middle of the machine [m].
    radius : float
        The radius of a sphere around the machine [m].
    up : (3,) array
        The side of the base on which the machine stands.
    floor, clutter, cables : tuple of PlacedSolid
        Below, behind and around, and in front of the machine.
    """

    centre: Array
    radius: float
    up: Array
    floor: tuple[PlacedSolid, ...]
    clutter: tuple[PlacedSolid, ...]
    cables: tuple[PlacedSolid, ...]


def draw_surroundings(
    placed: Sequence[PlacedSolid],
    camera: Camera,
    T_base_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
) -> Surroundings:
    """Draw what stands around a machine in one view.

    Parameters
    ----------
    placed : sequence of PlacedSolid
        The machine in some pose.
    camera, T_base_camera
        The camera and its pose: clutter stands where it looks.
    appearance : Appearance
        How much there is.
    rng : numpy.random.Generator
        Source.
    """
    centre, radius = _around(placed)
    up = np.array([0.0, 0.0, 1.0])
    eye = T_base_camera.translation
    floor = _table(placed, centre, radius, up, eye) if appearance.table else ()
    return Surroundings(
        centre=centre,
        radius=radius,
        up=up,
        floor=floor,
        clutter=tuple(
            _piece(i, centre, radius, camera, T_base_camera, rng) for i in range(appearance.clutter)
        ),
        cables=tuple(
            _cable(i, centre, radius, T_base_camera, rng) for i in range(appearance.cables)
        ),
    )


def _around(placed: Sequence[PlacedSolid]) -> tuple[Array, float]:
    """Return the middle and the radius of a sphere around solids; a unit sphere around nothing."""
    if not placed:
        return np.zeros(3), 1.0
    spheres = [(p.T_base_solid, *holding_sphere(p.solid.shape)) for p in placed]
    middles = np.array([T.apply(middle) for T, middle, _ in spheres])
    reaches = np.array([reach for _, _, reach in spheres])
    low, high = (middles - reaches[:, None]).min(axis=0), (middles + reaches[:, None]).max(axis=0)
    centre = 0.5 * (low + high)
    return centre, float((np.linalg.norm(middles - centre, axis=1) + reaches).max())


def _table(
    placed: Sequence[PlacedSolid], centre: Array, radius: float, up: Array, eye: Array
) -> tuple[PlacedSolid, ...]:
    """Return a table right below the lowest solid; none where it would hide the machine."""
    lowest = min((_lowest(p, up) for p in placed), default=-radius)
    if float(eye @ up) <= lowest:
        return ()
    size = 4.0 * radius, 3.2 * radius, 0.06 * radius
    foot = centre + (lowest - float(centre @ up) - 0.5 * size[2]) * up
    T = RigidTransform.from_components(foot, Rotation.from_euler("z", 0.3))
    return (_placed("table", Box(size), T, _TABLE),)


def _lowest(placed: PlacedSolid, up: Array) -> float:
    """Return the height of the lowest point of a solid."""
    shape, T = placed.solid.shape, placed.T_base_solid
    if isinstance(shape, Cylinder):
        c = abs(float(T.rotation.as_matrix()[:, 2] @ up))
        down = 0.5 * shape.length * c + shape.radius * max(1.0 - c * c, 0.0) ** 0.5
        return float(T.translation @ up) - float(down)
    middle, reach = holding_sphere(shape)
    if isinstance(shape, Box):
        reach = 0.5 * float(np.abs(T.rotation.as_matrix().T @ up) @ np.array(shape.size))
    return float(T.apply(middle) @ up) - reach


def _piece(
    number: int,
    centre: Array,
    radius: float,
    camera: Camera,
    T_base_camera: RigidTransform,
    rng: np.random.Generator,
) -> PlacedSolid:
    """Return a rod, box or ball behind the machine, somewhere in the picture."""
    depth = float(T_base_camera.inv().apply(centre)[2])
    pixel = rng.uniform([-0.05, -0.05], [1.05, 1.05]) * [camera.width, camera.height]
    xy = camera.undistort(np.clip(pixel, 0.0, [camera.width - 1.0, camera.height - 1.0])[None])[0]
    z = max(depth, 0.0) + radius * rng.uniform(1.6, 5.0)
    size = radius * rng.uniform(0.2, 1.0) * (z / max(depth, radius))
    kind = rng.choice(3, p=[0.5, 0.4, 0.1])
    shape: Shape
    if kind == 0:
        shape = Cylinder(size * rng.uniform(0.03, 0.15), size * rng.uniform(1.5, 4.0))
    elif kind == 1:
        a, b, c = (size * rng.uniform(0.3, 1.2, 3)).tolist()
        shape = Box((a, b, c))
    else:
        shape = Sphere(0.3 * size)
    z += holding_sphere(shape)[1]
    turn = (
        Rotation.random(rng=rng) if kind == 0 else Rotation.from_euler("z", rng.uniform(0.0, 7.0))
    )
    where = T_base_camera.apply(z * np.array([xy[0], xy[1], 1.0]))
    material = Material(
        albedo=float(rng.uniform(0.05, 0.7)),
        specular=float(rng.choice([0.05, 0.15, 0.6])),
        shininess=float(rng.uniform(10.0, 60.0)),
        limb=float(rng.uniform(0.1, 0.4)),
        texture=float(rng.uniform(0.0, 0.2)),
        tint=_tint(rng),
    )
    return _placed(
        f"clutter{number + 1}", shape, RigidTransform.from_components(where, turn), material
    )


def _cable(
    number: int,
    centre: Array,
    radius: float,
    T_base_camera: RigidTransform,
    rng: np.random.Generator,
) -> PlacedSolid:
    """Return a thin dark cylinder that crosses the picture between camera and machine."""
    eye = T_base_camera.translation
    way = centre - eye
    distance = float(np.linalg.norm(way))
    t = rng.uniform(0.45, 0.9) * max(1.0 - radius / distance, 0.3)
    width = radius * t
    aside = T_base_camera.rotation.apply([*rng.uniform(-0.8, 0.8, 2), 0.0])
    turn = T_base_camera.rotation * Rotation.from_euler(
        "xz", [np.pi / 2 + rng.uniform(-0.3, 0.3), rng.uniform(0.0, np.pi)]
    )
    where = eye + t * way + width * aside
    shape = Cylinder(width * rng.uniform(0.006, 0.02), 6.0 * width)
    return _placed(f"cable{number + 1}", shape, RigidTransform.from_components(where, turn), _CABLE)


def _placed(name: str, shape: Shape, T: RigidTransform, material: Material) -> PlacedSolid:
    """Return a solid that is no part of the machine."""
    return PlacedSolid(Solid(name, None, shape, T, material), T)


def _tint(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a colour of mean 1."""
    rgb = rng.uniform(0.5, 1.0, 3) ** 1.5
    r, g, b = (3.0 * rgb / rgb.sum()).tolist()
    return r, g, b
