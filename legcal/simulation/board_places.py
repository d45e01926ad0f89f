"""Where a calibration board stands on the base of a machine, so that cameras see it and the legs.

It lies flat near the base joints, among the legs or beside them; for cameras whose places are given
it may also be raised and turned towards them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotVisible
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.mechanism.model import Mechanism
from legcal.progress import Report, no_progress
from legcal.simulation.camera_places import scored_places, upward
from legcal.simulation.images import Viewpoint
from legcal.simulation.placed_board import PlacedBoard
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.visibility import legs_in_image
from legcal.vision.board import Board
from legcal.vision.camera import Camera

_ENOUGH = 2  # places with cameras, of which the better is taken
_TRIED = 5  # poses at which places are judged
_SIDES = 4  # directions beside the machine
_AWAY = 1.05  # half diagonals of the board beyond the base joints
_LEVELS = (0.0, -0.08, 0.25)  # of the size of the machine, above the base joints
_TILTS = (0.0, 0.6, 1.1)  # [rad] from lying flat, towards cameras with given places
_SAMPLES = 32  # points of a leg when it is asked whether the board hides it
_HIDDEN = 0.9  # of what is seen of the legs that must stay seen


@dataclass(frozen=True, eq=False)
class BoardScene:
    """A board in its place and the cameras that see it.

    Attributes
    ----------
    placed : PlacedBoard
        The board.
    machines : tuple of PosedMachine
        The machine in every pose, with the board.
    places : tuple of RigidTransform
        T_base_camera of every view.
    """

    placed: PlacedBoard
    machines: tuple[PosedMachine, ...]
    places: tuple[RigidTransform, ...]


def board_and_cameras(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Sequence[Camera],
    rng: np.random.Generator,
    progress: Report = no_progress,
) -> BoardScene:
    """Return a board on the base of a machine, and cameras around both.

    Parameters
    ----------
    board : Board
        The board.
    mechanism, machines, cameras, rng, progress
        As for :func:`legcal.simulation.camera_places.places_around`.

    Raises
    ------
    NotVisible
        If no place is found from which every camera sees the board and a leg.
    """
    tried = _some(machines)
    good: list[tuple[float, PlacedBoard, tuple[RigidTransform, ...]]] = []
    for placed in _lying(board, mechanism, tried):
        if len(good) == _ENOUGH:
            break
        together = [placed.beside(machine) for machine in machines]
        places, score = scored_places(
            mechanism, together, cameras, copy.deepcopy(rng), progress, placed
        )
        if score > 0.0:
            good.append((score, placed, places))
    if not good:
        raise NotVisible(_nowhere(board, "every camera around the machine", "use a smaller board"))
    _, placed, places = max(good, key=lambda found: found[0])
    return BoardScene(placed, tuple(placed.beside(machine) for machine in machines), places)


def board_before(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    views: Sequence[Viewpoint],
) -> BoardScene:
    """Return a board where cameras whose places are given see it.

    Parameters
    ----------
    board : Board
        The board.
    mechanism, machines
        The true machine, and it in its poses.
    views : sequence of Viewpoint
        The cameras.

    Raises
    ------
    NotVisible
        If there is no place at which all of them see it.
    """
    tried = _some(machines)
    towards = np.mean([view.T_base_camera.translation for view in views], axis=0)
    best: tuple[float, PlacedBoard] | None = None
    for placed in _lying(board, mechanism, tried, towards):
        seen = min(_share(placed, tried, view) for view in views)
        if (
            seen > 0.0
            and (best is None or seen > best[0])
            and not _hides(placed, mechanism, tried, views)
        ):
            best = seen, placed
    if best is None:
        raise NotVisible(
            _nowhere(board, "all of the given cameras", "turn or move the cameras, or use another")
        )
    placed = best[1]
    together = tuple(placed.beside(machine) for machine in machines)
    return BoardScene(placed, together, tuple(view.T_base_camera for view in views))


def _some(machines: Sequence[PosedMachine]) -> list[PosedMachine]:
    """Return a machine in a few of its poses."""
    return [machines[i] for i in np.unique(np.linspace(0, len(machines) - 1, _TRIED).astype(int))]


def _lying(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    towards: Array | None = None,
) -> list[PlacedBoard]:
    """Return places near the base that the machine leaves free, also tilted towards a point."""
    up = upward(mechanism)
    A = mechanism.A_base
    middle = A.mean(axis=0)
    joints = np.concatenate([part for m in machines for part in (m.A, m.B)])
    size = float(np.linalg.norm(np.ptp(joints, axis=0)))
    flat = A - middle - ((A - middle) @ up)[:, None] * up
    reach = float(np.linalg.norm(flat, axis=1).max())
    half = 0.5 * float(np.linalg.norm(np.ptp(board.extent, axis=0)))
    x, y = normal_basis(up)
    around = [np.cos(t) * x + np.sin(t) * y for t in 2.0 * np.pi * np.arange(_SIDES) / _SIDES]
    feet = [(np.zeros(3), x)]
    feet += [((reach + _AWAY * half) * side, side) for side in around]
    found = []
    for foot, side in feet:
        for level in _LEVELS:
            place = middle + foot + level * size * up
            for tilt in _TILTS if towards is not None else _TILTS[:1]:
                normal = up if towards is None else _tilted(up, towards - place, tilt)
                placed = PlacedBoard(board, _facing(board, place, normal, side))
                if not any(placed.runs_through(machine) for machine in machines):
                    found.append(placed)
                    break
            else:
                continue
            break  # one level at each foot
    return found


def _tilted(up: Array, way: Array, tilt: float) -> Array:
    """Return a direction that leans from *up* towards a way by an angle."""
    level = way - (way @ up) * up
    length = float(np.linalg.norm(level))
    if length < 1e-9:
        return up
    return np.asarray(np.cos(tilt) * up + np.sin(tilt) * level / length)


def _facing(board: Board, place: Array, normal: Array, side: Array) -> RigidTransform:
    """Return T_base_board with the middle of the print at a place and its face along a normal."""
    z = normal if board.kind == "aprilgrid" else -normal
    y = side - (side @ z) * z
    if np.linalg.norm(y) < 1e-6:
        y = normal_basis(z)[0]
    y = y / np.linalg.norm(y)
    turn = Rotation.from_matrix(np.column_stack([np.cross(y, z), y, z]))
    return RigidTransform.from_components(place - turn.apply(board.extent.mean(axis=0)), turn)


def _share(placed: PlacedBoard, machines: Sequence[PosedMachine], view: Viewpoint) -> float:
    """Return the share of the corners that a view shows, zero if too few in one of the poses."""
    shown = [
        placed.seen(placed.beside(machine), view.camera, view.T_base_camera) for machine in machines
    ]
    enough = [placed.is_enough(seen) for seen in shown]
    return float(np.mean(shown)) if all(enough) else 0.0


def _hides(
    placed: PlacedBoard,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    views: Sequence[Viewpoint],
) -> bool:
    """Say whether a board hides much of the legs."""
    for view in views:
        lengths = []
        for bodies in (machines, [placed.beside(machine) for machine in machines]):
            shown = [
                legs_in_image(
                    mechanism.legs, machine, view.camera, view.T_base_camera, samples=_SAMPLES
                )
                for machine in bodies
            ]
            lengths.append(sum(leg.length_px for legs in shown for leg in legs if leg.is_seen))
        if lengths[1] < _HIDDEN * lengths[0]:
            return True
    return False


def _nowhere(board: Board, who: str, remedy: str) -> str:
    """Return that a board has no place."""
    width, height = np.ptp(board.extent, axis=0)[:2].tolist()
    return (
        f"The board could not be placed: found no place near the base at which {who} would see a "
        f"{board.kind} of {1000 * width:.0f} x {1000 * height:.0f} mm well enough, needed one in "
        f"all images; {remedy}."
    )
