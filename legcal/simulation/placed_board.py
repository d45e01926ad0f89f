"""A calibration board that stands on the base of a simulated machine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import RigidTransform

from legcal.dataset.board_entry import board_document
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.geometry.types import Array, BoolArray
from legcal.simulation.board_print import BoardPrint
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.shapes import Box
from legcal.simulation.solids import Material, PlacedSolid, Solid
from legcal.simulation.visibility import pixels_in_image
from legcal.vision.board import Board
from legcal.vision.camera import Camera

_THICKNESS = 0.02  # of the longer side of the plate
_RIM = 0.06  # of the longer side that stays white around the print
_LEAST_COSINE = 0.42  # between the normal and the line of sight at which corners are seen
_BESIDE = 0.3  # of a square around a corner that must be seen with it
_IN_FRONT = 0.2  # of the thickness before a corner from which on a hit hides it
_LEAST_SHARE = 0.5  # of the corners that an image must show to count
_LEAST_CORNERS = 8


@dataclass(frozen=True, eq=False)
class PlacedBoard:
    """A board in its place.

    Attributes
    ----------
    board : Board
        The board.
    T_base_board : RigidTransform
        Its pose in the base link.
    """

    board: Board
    T_base_board: RigidTransform

    def document(self) -> dict[str, Any]:
        """Return the board as the block of ``dataset.yaml`` has it, with its pose."""
        return board_document(self.board) | {"T_base_board": motion_to_xyz_quat(self.T_base_board)}

    @property
    def towards_viewer(self) -> float:
        """Return 1 where the z axis of the board comes out of its print, else -1."""
        return 1.0 if self.board.kind == "aprilgrid" else -1.0

    @cached_property
    def plate(self) -> PlacedSolid:
        """The plate that the board is printed on."""
        low, high = self.board.extent.min(axis=0), self.board.extent.max(axis=0)
        longer = float((high - low).max())
        thickness = _THICKNESS * longer
        x, y, _ = (high - low + 2.0 * _RIM * longer).tolist()
        middle = 0.5 * (low + high) - [0.0, 0.0, 0.5 * self.towards_viewer * thickness]
        T_board_plate = RigidTransform.from_translation(middle)
        face = 5 if self.towards_viewer > 0.0 else 2
        sheet = BoardPrint.of(self.board, face, middle[:2])
        material = Material(albedo=0.8, specular=0.0, shininess=10.0, limb=0.0, sheet=sheet)
        T = self.T_base_board * T_board_plate
        solid = Solid("calibration board", None, Box((x, y, thickness)), T, material)
        return PlacedSolid(solid, T)

    def beside(self, machine: PosedMachine) -> PosedMachine:
        """Return a machine in a pose together with the plate."""
        size = self.plate.solid.shape
        assert isinstance(size, Box)
        mesh = trimesh.creation.box(size.size)
        return replace(
            machine,
            solids=(*machine.solids, self.plate),
            vertices=np.concatenate(
                [machine.vertices, self.plate.T_base_solid.apply(mesh.vertices)]
            ),
            faces=np.concatenate([machine.faces, mesh.faces + len(machine.vertices)]),
        )

    def runs_through(self, machine: PosedMachine) -> bool:
        """Say whether the plate runs through a machine, or something lies right on its print."""
        size = self.plate.solid.shape
        assert isinstance(size, Box)
        half = 0.5 * np.array(size.size)
        for corner in ([-1.0, -1.0], [1.0, -1.0]):  # rays from two corners to the sides across
            for height in (-0.5, 0.5, 2.0):  # in the plate, and above its print
                steps = np.linspace(-1.0, 1.0, 13)
                far = np.concatenate(
                    [
                        np.column_stack([steps, np.ones(13)]),
                        np.column_stack([np.full(13, -corner[0]), steps]),
                    ]
                )
                plane = np.vstack([corner, far]) * half[:2]
                z = self.towards_viewer * height * half[2]
                points = self.plate.T_base_solid.apply(
                    np.column_stack([plane, np.full(len(plane), z)])
                )
                if machine.hidden(points[0], points[1:], np.zeros(len(far))).any():
                    return True
        return False

    def seen(
        self, machine: PosedMachine, camera: Camera, T_base_camera: RigidTransform
    ) -> BoolArray:
        """Return which corners an image shows, (n_corners,).

        Parameters
        ----------
        machine : PosedMachine
            The machine in its pose, with the plate.
        camera, T_base_camera
            The camera and its pose.
        """
        points = self._watched
        base = self.T_base_board.apply(points.reshape(-1, 3))
        centre = T_base_camera.translation
        eye = self.T_base_board.inv().apply(centre)
        sight = eye - points
        cosine = self.towards_viewer * sight[..., 2] / np.linalg.norm(sight, axis=-1)
        _, inside = pixels_in_image(camera, T_base_camera.inv().apply(base))
        free = (inside & (cosine.ravel() > _LEAST_COSINE)).copy()
        size = self.plate.solid.shape
        assert isinstance(size, Box)
        margin = np.full(int(free.sum()), _IN_FRONT * size.size[2])
        if free.any():
            free[free] = ~machine.hidden(centre, base[free], margin)
        seen = np.all(free.reshape(points.shape[:2]), axis=1)
        if self.board.kind == "chessboard" and not seen.all():
            seen[:] = False  # it is found as a whole or not at all
        return np.asarray(seen)

    def is_enough(self, seen: BoolArray) -> bool:
        """Say whether so many corners, as :meth:`seen` returns them, place a camera well."""
        return int(seen.sum()) >= max(_LEAST_SHARE * len(seen), min(_LEAST_CORNERS, len(seen)))

    @cached_property
    def _watched(self) -> Array:
        """Points (n_corners, 5, 3) in the board frame that must be seen: corners and around."""
        step = _BESIDE * self.board.side
        aside = step * np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
        return np.asarray(self.board.points[:, None] + aside)


def without_pose(document: dict[str, Any] | None) -> dict[str, Any] | None:
    """Return the block of a board as it is where its pose is not known."""
    if document is None:
        return None
    return {key: value for key, value in document.items() if key != "T_base_board"}
