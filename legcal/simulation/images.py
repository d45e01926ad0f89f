"""Which images a simulated dataset has: for each its view, its pose and the legs it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotVisible, UsageError
from legcal.geometry.types import IntArray
from legcal.mechanism.leg import Leg
from legcal.progress import Report, no_progress
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.visibility import SEEN, SHORTEST_PX, LegView, legs_in_image
from legcal.vision.camera import Camera


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A simulated camera and where it stands.

    Attributes
    ----------
    name : str
        The view.
    camera : Camera
        Its intrinsics.
    T_base_camera : RigidTransform
        Its true pose in the base link.
    """

    name: str
    camera: Camera
    T_base_camera: RigidTransform


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a dataset, in the order of its rows.

    Attributes
    ----------
    view, pose, repeat : (n_rows,) array of int
        Indices; ``repeat`` counts the images of one pose in one view.
    shown : tuple, for each row a tuple of LegView, one for each leg
        What the images show. Images of one pose in one view show the same.
    """

    view: IntArray
    pose: IntArray
    repeat: IntArray
    shown: tuple[tuple[LegView, ...], ...]

    def __len__(self) -> int:
        return len(self.view)

    def seen(self, row: int) -> list[int]:
        """Return the legs that an image shows well enough to be measured."""
        return [j for j, leg in enumerate(self.shown[row]) if leg.is_seen]

    def seen_in_view(self, view: int, least: float = 0.0) -> list[int]:
        """Return the legs that more than a part of the images of a view show."""
        rows = np.flatnonzero(self.view == view)
        seen = np.array([[leg.is_seen for leg in self.shown[row]] for row in rows])
        return [int(j) for j in np.flatnonzero(seen.mean(axis=0) > least)]

    def chosen(self, rows: Sequence[int]) -> Images:
        """Return some of the images."""
        index = np.asarray(rows, dtype=np.intp)
        shown = tuple(self.shown[row] for row in rows)
        return Images(self.view[index], self.pose[index], self.repeat[index], shown)


def take_images(
    legs: Sequence[Leg],
    machines: Sequence[PosedMachine],
    viewpoints: Sequence[Viewpoint],
    n_images: int,
    *,
    shared_poses: bool,
    progress: Report = no_progress,
) -> Images:
    """Return the images that cameras take of a machine in its poses.

    Parameters
    ----------
    legs : sequence of Leg
        The legs of the true machine.
    machines : sequence of PosedMachine
        The machine in every pose: those of all views, or those of the first view, then those of
        the second, and so on.
    viewpoints : sequence of Viewpoint
        The cameras.
    n_images : int
        Images of each pose in each view.
    shared_poses : bool
        Every view sees all poses.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    UsageError
        If a camera is inside the machine.
    NotVisible
        If a view shows no leg.
    """
    own = len(machines) // len(viewpoints)
    of_view = [
        range(len(machines)) if shared_poses else range(v * own, (v + 1) * own)
        for v in range(len(viewpoints))
    ]
    rows: list[tuple[int, int, int]] = []
    shown: list[tuple[LegView, ...]] = []
    problems = []
    for v, (viewpoint, poses) in enumerate(zip(viewpoints, of_view, strict=True)):
        progress("Views", v, len(viewpoints))
        camera, T = viewpoint.camera, viewpoint.T_base_camera
        _refuse_inside(viewpoint, [machines[p] for p in poses])
        views = [legs_in_image(legs, machines[p], camera, T) for p in poses]
        if not any(leg.is_seen for view in views for leg in view):
            problems.append(_sees_nothing(viewpoint.name, legs, views))
        for p, view in zip(poses, views, strict=True):
            rows += [(v, p, k) for k in range(n_images)]
            shown += [view] * n_images
    progress("Views", len(viewpoints), len(viewpoints))
    if problems:
        raise NotVisible(problems)
    view_of_row, pose_of_row, repeat_of_row = np.array(rows, dtype=np.intp).T
    return Images(view_of_row, pose_of_row, repeat_of_row, tuple(shown))


def _refuse_inside(viewpoint: Viewpoint, machines: Sequence[PosedMachine]) -> None:
    """Raise UsageError if a camera is inside the machine in one of the poses."""
    centre = viewpoint.T_base_camera.translation
    if any(machine.encloses(centre) for machine in machines):
        x, y, z = centre
        raise UsageError(
            f"view {viewpoint.name}: its camera could not be placed: found it inside the machine, "
            f"at ({x:.3f}, {y:.3f}, {z:.3f}) m in the base link, needed a place outside in all "
            "poses; move the camera."
        )


def _sees_nothing(name: str, legs: Sequence[Leg], views: Sequence[Sequence[LegView]]) -> str:
    """Return that a view shows no leg, and what it shows."""
    start = f"view {name}: its images could not be simulated: found"
    if not any(leg.cylinders for leg in legs):
        return (
            f"{start} no leg with a visible cylinder in the model, needed URDF visuals that are "
            "cylinders coaxial with the legs; add them."
        )
    most = max(leg.share for view in views for leg in view)
    if most >= SEEN:
        longest = max(leg.length_px for view in views for leg in view)
        return (
            f"{start} that legs are at most {longest:.1f} px long in them, needed "
            f"{SHORTEST_PX:g} px of a tube or rod; move the camera nearer (its place is in "
            "metres), or give it a longer focal length."
        )
    return (
        f"{start} that no image shows a leg (at best {100.0 * most:.0f} % of one), needed an "
        f"unhidden stretch of {100.0 * SEEN:.0f} % of at least one leg; turn or move the camera."
    )
