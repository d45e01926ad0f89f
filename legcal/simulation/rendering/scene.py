"""What stays the same in the images of a view: camera, light and surroundings."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, Image
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.coarse_shadows import CoarseSurface
from legcal.simulation.rendering.paint import Canvas, Painter
from legcal.simulation.rendering.rays import PixelRays, Single, pixel_rays
from legcal.simulation.rendering.sensor import develop
from legcal.simulation.rendering.shading import Lighting
from legcal.simulation.rendering.shadows import Lamp, Occluders
from legcal.simulation.rendering.solid_in_view import SolidInView, in_view
from legcal.simulation.rendering.surroundings import Surroundings, draw_surroundings
from legcal.simulation.rendering.texture import background
from legcal.simulation.solids import PlacedSolid
from legcal.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class Scene:
    """A camera in front of its surroundings, painted once for all images of a view.

    Attributes
    ----------
    T_camera_base : RigidTransform
        Pose of the base frame in the camera.
    appearance : Appearance
        The looks.
    surroundings : Surroundings
        What stands around.
    painter : Painter
        Paints with the camera and the light.
    canvas : Canvas
        The surroundings, their light apart by lamp.
    bystanders, foreground : tuple of SolidInView
        What stands around and casts shadows on the machine, and what hangs in front of it.
    """

    T_camera_base: RigidTransform
    appearance: Appearance
    surroundings: Surroundings
    painter: Painter
    canvas: Canvas
    bystanders: tuple[SolidInView, ...]
    foreground: tuple[SolidInView, ...]

    def render(self, placed: Sequence[PlacedSolid], rng: np.random.Generator) -> Image:
        """Return a photograph of solids in this scene.

        Parameters
        ----------
        placed : sequence of PlacedSolid
            The machine.
        rng : numpy.random.Generator
            Source of the sensor's noise.

        Returns
        -------
        (height, width) array of uint8 or uint16
            Grey levels, or blue, green, red along a third axis.
        """
        rays = self.painter.rays
        solids = [*in_view(placed, self.T_camera_base), *self.foreground]
        canvas = Canvas(self.canvas.z.copy(), self._backdrop(solids))
        self.painter.paint(canvas, solids, self.bystanders)
        radiance = canvas.terms[0].reshape(-1, rays.height, rays.width)
        grey = (
            radiance[0]
            if len(radiance) == 1
            else np.ascontiguousarray(np.moveaxis(radiance, 0, -1))
        )
        return develop(grey, self.appearance, rng)

    def _backdrop(self, solids: Sequence[SolidInView]) -> Single:
        """Return the surroundings with the shadows of solids, (1, n_channels, n)."""
        total: Single = self.canvas.terms[0].copy()
        occluders = Occluders(solids)
        for lamp, light in zip(self.painter.light.lamps, self.canvas.terms[1:], strict=True):
            if lamp.shadows:
                total += light * self._around.seen(lamp, occluders)
            else:
                total += light
        return np.asarray(total[None])

    @cached_property
    def _around(self) -> CoarseSurface:
        """The surfaces on which the machine casts shadows; no lamp lights the background."""
        near = np.flatnonzero(np.isfinite(self.canvas.z))
        return CoarseSurface(self.painter.rays, near, self.canvas.z[near])


def prepare_scene(
    placed: Sequence[PlacedSolid],
    camera: Camera,
    T_base_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
) -> Scene:
    """Return the scene of a view: its surroundings drawn, lit and painted.

    Parameters
    ----------
    placed : sequence of PlacedSolid
        The machine in some pose: what stands around keeps away from it, and lights and table are
        placed around it.
    camera : Camera
        The camera.
    T_base_camera : RigidTransform
        Its pose.
    appearance : Appearance
        The looks.
    rng : numpy.random.Generator
        Source of the surroundings.

    Returns
    -------
    Scene
        The scene, for any number of images.
    """
    rays = pixel_rays(camera)
    T_camera_base = T_base_camera.inv()
    surroundings = draw_surroundings(placed, camera, T_base_camera, appearance, rng)
    light = _lighting(surroundings, T_camera_base, appearance)
    painter = Painter(rays, light, appearance.samples)
    canvas = _empty(rays, light, appearance, rng)
    bystanders = in_view(surroundings.clutter, T_camera_base)
    painter.paint(canvas, [*in_view(surroundings.floor, T_camera_base), *bystanders])
    foreground = in_view(surroundings.cables, T_camera_base)
    return Scene(
        T_camera_base,
        appearance,
        surroundings,
        painter,
        canvas,
        tuple(bystanders),
        tuple(foreground),
    )


def render(
    placed: Sequence[PlacedSolid],
    camera: Camera,
    T_base_camera: RigidTransform,
    appearance: Appearance,
    rng: np.random.Generator,
) -> Image:
    """Return one photograph; :func:`prepare_scene` saves half of the time for more of a view.

    Parameters
    ----------
    placed, camera, T_base_camera, appearance
        As for :func:`prepare_scene`.
    rng : numpy.random.Generator
        Source of the surroundings and the noise.

    Returns
    -------
    (height, width) array of uint8 or uint16
        Grey levels, or blue, green, red along a third axis.
    """
    return prepare_scene(placed, camera, T_base_camera, appearance, rng).render(placed, rng)


def _lighting(
    surroundings: Surroundings, T_camera_base: RigidTransform, appearance: Appearance
) -> Lighting:
    """Return the light in the camera frame, its distances in radii of the machine."""
    lamps = []
    for light in appearance.lights:
        direction = np.array(light.direction) / np.linalg.norm(light.direction)
        distance = light.distance * surroundings.radius
        if light.with_camera:
            direction = T_camera_base.rotation.inv().apply(direction * [1.0, -1.0, -1.0])
        where: Array = surroundings.centre + distance * direction
        lamps.append(
            Lamp(
                position=np.asarray(T_camera_base.apply(where)),
                power=light.strength * distance**2,
                radius=light.radius * surroundings.radius,
                shadows=light.shadows and appearance.shadows,
            )
        )
    return Lighting(
        lamps=tuple(lamps),
        ambient=appearance.ambient,
        up=np.asarray(T_camera_base.rotation.apply(surroundings.up)),
        limb=appearance.limb,
        specular=appearance.specular,
        texture=appearance.texture,
        colour=appearance.colour,
    )


def _empty(
    rays: PixelRays, light: Lighting, appearance: Appearance, rng: np.random.Generator
) -> Canvas:
    """Return the background alone."""
    n = rays.width * rays.height
    terms = np.zeros((1 + len(light.lamps), light.n_channels, n), dtype=np.float32)
    terms[0] = appearance.background
    if appearance.background_contrast > 0.0:
        picture = background(rays.width, rays.height, appearance.background_contrast, rng)
        terms[0] *= picture.ravel()
    return Canvas(np.full(n, np.inf, dtype=np.float32), terms)
