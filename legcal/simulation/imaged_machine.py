"""A true machine in its poses, the cameras that look at it, and what their images show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotVisible
from legcal.machine import Configurations, Mechanism
from legcal.progress import Report
from legcal.simulation.board import PlacedBoard, chosen_board
from legcal.simulation.cameras import (
    BoardScene,
    board_and_cameras,
    board_before,
    mild_lens,
    place_somewhere,
    places_around,
    read_cameras,
    read_lens,
)
from legcal.simulation.folder import pose_labels
from legcal.simulation.poses import commanded_poses, given_poses
from legcal.simulation.settings import Level, SimulationSettings
from legcal.simulation.solids import PosedMachine, dressed, pose_machine
from legcal.simulation.visibility import Images, Viewpoint, take_images
from legcal.vision import Board, Camera

_GOOD, _TRIES = 3, 60  # places that see board and legs, of which the best is taken; and tries


@dataclass(frozen=True, eq=False)
class Viewing:
    """Cameras, the machine as they see it, and the board."""

    views: tuple[Viewpoint, ...]  # the cameras; of one in the hand a place for each image
    # the machine in every pose, with the board beside it; for hand-held views once for each image
    machines: tuple[PosedMachine, ...]
    board: PlacedBoard | None = None
    # the view of ``dataset.yaml`` that each camera belongs to where cameras are in the hand; empty
    # where they stand
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
    """Return the cameras that settings ask for, and the board."""
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
    """Return hand-held views counted anew by the images that are left, one for each of them."""
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


@dataclass(frozen=True, eq=False)
class ImagedMachine:
    """A true machine, its poses and its images."""

    truth: Mechanism  # the true machine
    # poses, labels, machines: its poses, their names, and the machine in each of them
    poses: Configurations
    labels: tuple[str, ...]
    machines: tuple[PosedMachine, ...]
    views: tuple[Viewpoint, ...]
    images: Images  # the images that the dataset has rows for
    left_out: int  # images that show no leg, which a dataset of axes or outlines has no row for
    board: PlacedBoard | None = None  # the calibration board on the base
    # the view of ``dataset.yaml`` that each camera belongs to where cameras are in the hand; empty
    # where they stand
    groups: tuple[str, ...] = ()


def image_machine(
    truth: Mechanism,
    nominal: Mechanism,
    settings: SimulationSettings,
    chance: Mapping[str, np.random.Generator],
    progress: Report,
) -> ImagedMachine:
    """Return a machine in its poses and what its cameras show of it."""
    cameras, places = _cameras(settings)
    n_views = len(cameras)
    shared = settings.shared_poses or isinstance(settings.poses, Path)
    if isinstance(settings.poses, Path):
        poses = given_poses(truth, settings.poses)
    else:
        n_poses = settings.poses * (1 if shared else n_views)
        poses = commanded_poses(
            truth, nominal, n_poses, chance["poses"], settings.sampling, progress
        )
    settings.check_images(n_views, len(poses.poses) // (1 if shared else n_views))
    # Meshes lie beside the nominal URDF, of which that of the true machine is a copy.
    shown = replace(truth, urdf=replace(truth.urdf, path=nominal.urdf.path))
    machines = pose_machine(truth, dressed(shown), poses)
    viewing = look_at_machine(
        truth, machines, settings, cameras, places,
        shared=shared, chance=chance, progress=progress,
    )  # fmt: skip
    views = viewing.views
    if settings.level is Level.PHOTOGRAPHS:
        views = _encoding(views, settings.appearance.gamma, settings.tell_gamma)
    in_hand = len(viewing.groups) > 0
    images = take_images(
        truth.legs, viewing.machines, views, settings.images,
        shared_poses=shared and not in_hand, progress=progress,
    )  # fmt: skip
    images = replace(images, pose=images.pose % len(machines))
    rows = list(range(len(images)))
    if settings.level is not Level.PHOTOGRAPHS:
        rows = [row for row in rows if images.seen(row)]
    kept, left_out = images.chosen(rows), len(images) - len(rows)
    if in_hand:
        kept, views, groups = numbered(kept, views, viewing.groups)
        viewing = replace(viewing, groups=groups)
    labels = pose_labels(len(poses.poses))
    machines = viewing.machines[: len(machines)]
    return ImagedMachine(
        truth, poses, labels, machines, views, kept, left_out, viewing.board, viewing.groups
    )


def _cameras(
    settings: SimulationSettings,
) -> tuple[dict[str, Camera], dict[str, RigidTransform]]:
    """Return the camera of each view, and where each stands if that is given."""
    camera = mild_lens() if settings.camera is None else read_lens(settings.camera)
    if isinstance(settings.views, int):
        return {f"c{v + 1}": camera for v in range(settings.views)}, {}
    given = read_cameras(settings.views, camera)
    cameras = {name: lens for name, (lens, _) in given.items()}
    return cameras, {name: T for name, (_, T) in given.items()}


def _encoding(views: tuple[Viewpoint, ...], gamma: float, is_told: bool) -> tuple[Viewpoint, ...]:
    """Return views whose cameras encode light in their grey levels, as their makers say or not."""
    cameras = {
        id(view.camera): replace(view.camera, gamma=gamma, gamma_is_given=is_told) for view in views
    }
    return tuple(replace(view, camera=cameras[id(view.camera)]) for view in views)
