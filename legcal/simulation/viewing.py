"""Who looks at a simulated machine: cameras that stand, or one in the hand, and the board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotVisible
from legcal.mechanism.model import Mechanism
from legcal.progress import Report
from legcal.simulation.board_choice import chosen_board
from legcal.simulation.board_places import BoardScene, board_and_cameras, board_before
from legcal.simulation.camera_places import place_somewhere, places_around
from legcal.simulation.images import Images, Viewpoint
from legcal.simulation.placed_board import PlacedBoard
from legcal.simulation.posed_machine import PosedMachine
from legcal.simulation.settings import SimulationSettings
from legcal.vision.board import Board
from legcal.vision.camera import Camera

_GOOD, _TRIES = 3, 60  # places that see board and legs, of which the best is taken; and tries


@dataclass(frozen=True, eq=False)
class Viewing:
    """Cameras, the machine as they see it, and the board.

    Attributes
    ----------
    views : tuple of Viewpoint
        The cameras; of one in the hand a place for each image.
    machines : tuple of PosedMachine
        The machine in every pose, with the board beside it; for hand-held views once for each
        image.
    board : PlacedBoard or None
        The board.
    groups : tuple of str
        The view of ``dataset.yaml`` that each camera belongs to where cameras are in the hand;
        empty where they stand.
    """

    views: tuple[Viewpoint, ...]
    machines: tuple[PosedMachine, ...]
    board: PlacedBoard | None = None
    groups: tuple[str, ...] = ()


def look_at_machine(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    settings: SimulationSettings,
    cameras: Mapping[str, Camera],
    places: Mapping[str, RigidTransform],
    *,
    shared: bool,
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> Viewing:
    """Return the cameras that settings ask for, and the board.

    Parameters
    ----------
    mechanism, machines
        The true machine, and it in its poses.
    settings : SimulationSettings
        What to simulate.
    cameras : mapping of str to Camera
        The camera of each view.
    places : mapping of str to RigidTransform
        T_base_camera of each view where they are given; empty to look for them.
    shared : bool
        Whether all views see all poses.
    chance : mapping of str to numpy.random.Generator
        Source of ``cameras``.
    progress : callable
        Called as ``progress(stage, done, total)``.

    Raises
    ------
    DatasetError, NotVisible
        If a file is malformed, or no place is found.
    """
    board = chosen_board(settings.board, machines)
    if not settings.hand_held or board is None:
        return _standing(mechanism, machines, cameras, places, board, chance, progress)
    n, own = len(machines), len(machines) // len(cameras)
    of_view = [
        [machines[p] for p in (range(n) if shared else range(v * own, (v + 1) * own))]
        for v in range(len(cameras))
    ]
    return _hand_held(mechanism, of_view, cameras, board, chance, progress)


def _standing(
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Mapping[str, Camera],
    places: Mapping[str, RigidTransform],
    board: Board | None,
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> Viewing:
    """Return cameras that stand around a machine, and a board that all of them see."""
    given = [Viewpoint(name, cameras[name], T) for name, T in places.items()]
    if board is None and given:
        return Viewing(tuple(given), tuple(machines))
    if board is None:
        lenses = list(cameras.values())
        found = places_around(mechanism, machines, lenses, chance["cameras"], progress)
        return Viewing(_named(cameras, found), tuple(machines))
    if given:
        scene = board_before(board, mechanism, machines, given)
    else:
        scene = _around(board, mechanism, machines, cameras, chance, progress)
    return Viewing(_named(cameras, scene.places), scene.machines, scene.placed)


def _hand_held(
    mechanism: Mechanism,
    machines: Sequence[Sequence[PosedMachine]],
    cameras: Mapping[str, Camera],
    board: Board,
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> Viewing:
    """Return cameras in the hand: a place for each image, from which it shows board and legs."""
    poses = [machine for of_view in machines for machine in of_view]
    placed = _around(board, mechanism, poses, cameras, chance, progress).placed
    together: list[PosedMachine] = []
    views: list[Viewpoint] = []
    groups: list[str] = []
    for (name, camera), of_view in zip(cameras.items(), machines, strict=True):
        for k, machine in enumerate(of_view):
            progress("Camera places", len(views), len(poses))
            beside = placed.beside(machine)
            T = _in_the_hand(mechanism, beside, camera, placed, chance["cameras"])
            if T is None:
                raise NotVisible(
                    f"view {name}: a camera in the hand could not be placed: found none of "
                    f"{_TRIES} places from which image {k + 1} shows the board and a leg, needed "
                    "one; use a smaller board."
                )
            together.append(beside)
            views.append(Viewpoint(f"{name}-{k + 1}", camera, T))
            groups.append(name)
    progress("Camera places", len(poses), len(poses))
    return Viewing(tuple(views), tuple(together), placed, tuple(groups))


def numbered(
    images: Images, views: Sequence[Viewpoint], groups: Sequence[str]
) -> tuple[Images, tuple[Viewpoint, ...], tuple[str, ...]]:
    """Return hand-held views counted anew by the images that are left, one for each of them.

    Parameters
    ----------
    images : Images
        The images that the dataset has rows for.
    views, groups : sequence
        Cameras in the hand, and the views of ``dataset.yaml`` that they belong to.
    """
    counts: dict[str, int] = {}
    left, names = [], []
    for v in images.view.tolist():
        name = groups[v]
        counts[name] = counts.get(name, 0) + 1
        left.append(replace(views[v], name=f"{name}-{counts[name]}"))
        names.append(name)
    own = replace(images, view=np.arange(len(images), dtype=np.intp))
    return own, tuple(left), tuple(names)


def _around(
    board: Board,
    mechanism: Mechanism,
    machines: Sequence[PosedMachine],
    cameras: Mapping[str, Camera],
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> BoardScene:
    """Return a board and standing cameras around it."""
    lenses = list(cameras.values())
    return board_and_cameras(board, mechanism, machines, lenses, chance["cameras"], progress)


def _named(
    cameras: Mapping[str, Camera], places: Sequence[RigidTransform]
) -> tuple[Viewpoint, ...]:
    """Return cameras in their places."""
    return tuple(
        Viewpoint(name, camera, T)
        for (name, camera), T in zip(cameras.items(), places, strict=True)
    )


def _in_the_hand(
    mechanism: Mechanism,
    machine: PosedMachine,
    camera: Camera,
    placed: PlacedBoard,
    rng: np.random.Generator,
) -> RigidTransform | None:
    """Return a place that shows board and legs, the best of a few; None if there is none."""
    good = []
    for _ in range(_TRIES):
        T, score = place_somewhere(mechanism, machine, camera, rng, placed)
        if score > 0.0:
            good.append((score, T))
        if len(good) == _GOOD:
            break
    return max(good, key=lambda found: found[0])[1] if good else None
