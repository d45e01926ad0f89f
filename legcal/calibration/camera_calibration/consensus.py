"""Which images of a board agree on a camera, and what is the matter with the others.

An image says little of a camera alone; it contradicts a group of images by its score and
information (``Clusters``), along all numbers of the camera and of the sheet,
along the focal length, the principal point, and along the sheet. The group begins as the half of
the images that is cheapest together (least trimmed squares from many random starts, on the
quadratic costs of all images), takes in whatever does not contradict it, and is fitted again until
it stays. Images that are wrong alike, as a third that was taken at another zoom, cannot move it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.special import chdtri

from legcal.calibration.camera_calibration.starts import again, from_scratch, part_of
from legcal.estimation.clusters import Clusters
from legcal.estimation.solver import COST_TOLERANCE
from legcal.geometry.types import Array, BoolArray
from legcal.perception.board_adjustment import (
    LOSS,
    SHEET,
    AdjustedBoard,
    BoardImages,
    Sheet,
    adjust_board,
)
from legcal.vision.camera import intrinsic_names, intrinsic_values
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

_SIGNIFICANCE = 1e-5  # of a contradiction
_FEW = 5  # images of which none can be outvoted
_STARTS, _OF_START = 100, 4  # random groups, and the images of each
_ROUNDS = 8
_FIRST_RATIO = 3.0  # by which errors of the cheapest half are smaller than those of all
_CLEAR = 0.6  # part of the images, from which a group is not searched further
_MORE_STARTS = 4  # fits of random images, then
_EXPLAINED = 0.6  # part of what is wrong with an image, from which it is the reason
_NEGLIGIBLE = 1e-3  # part of what is wrong with an image that is not searched for
_ALMOST = 0.9  # part of the best explanation, from which a simpler one is the reason
_ALIKE = 0.2  # part by which changes of both focal lengths, or in images, may differ from a mean
_PAIR = 2  # images that have a change in common by chance
_TWO = 0.85  # part of the scatter between two values, of a normal distribution 0.64
_RIVAL = 4  # images that make another group


@dataclass(frozen=True, eq=False)
class Agreement:
    """Images that agree on a camera."""

    adjusted: AdjustedBoard  # to these; poses and residuals of all images before this camera
    left_out: dict[int, str]  # images that contradict it, and how
    rival: tuple[int, ...]  # those of them that agree among themselves


def agreeing_images(seen: BoardImages, size: ImageSize, model: DistortionModel) -> Agreement | None:
    """Return the largest group of images that agree on a camera; None if nothing can be fitted."""
    n = int(seen.image[-1]) + 1
    found = _largest(seen, size, model)
    if found is None:
        return None
    adjusted, group = found
    others = np.flatnonzero(~group)
    if not len(others):
        return Agreement(adjusted, {}, ())
    rival: tuple[int, ...] = ()
    if len(others) >= _RIVAL:
        part, numbers = part_of(seen, np.isin(seen.image, others), n)
        second = _largest(part, size, model)
        if second is not None and np.count_nonzero(second[1]) >= _RIVAL:
            rival = tuple(np.array(numbers)[second[1]].tolist())
    return Agreement(adjusted, _reasons(adjusted, seen, group), rival)


def _largest(
    seen: BoardImages, size: ImageSize, model: DistortionModel
) -> tuple[AdjustedBoard, BoolArray] | None:
    """Return the largest group of images that agree, and the adjustment to it."""
    n = int(seen.image[-1]) + 1
    rng = np.random.default_rng(0)
    best: tuple[AdjustedBoard, BoolArray] | None = None
    first = from_scratch(seen, size, model)
    if first is not None:
        every = np.ones(n, dtype=np.bool_)
        if n < _FEW:
            return first, every
        group = _grown(first, _cheapest(first, seen, rng))
        if group.all():
            return first, group
        if np.count_nonzero(group) >= _OF_START:
            best = _settled(first, first, group, seen)
    for _ in range(_MORE_STARTS if n >= _FEW else 0):
        if best is not None and np.count_nonzero(best[1]) >= _CLEAR * n:
            break
        some = rng.choice(n, _OF_START, replace=False)
        part, _ = part_of(seen, np.isin(seen.image, some), n)
        rough = from_scratch(part, size, model)
        if rough is None:
            continue
        start = first or rough
        found = _settled(rough, start, None, seen)
        if found is not None and (
            best is None or np.count_nonzero(found[1]) > np.count_nonzero(best[1])
        ):
            best = found
    return best


def _settled(
    near: AdjustedBoard, start: AdjustedBoard, group: BoolArray | None, seen: BoardImages
) -> tuple[AdjustedBoard, BoolArray] | None:
    """Return the group that stays when it is fitted, and the adjustment to it."""
    n = int(seen.image[-1]) + 1
    poses = list(start.T_camera_board)
    settled: tuple[AdjustedBoard, BoolArray] | None = None
    for _ in range(_ROUNDS):
        if group is not None:
            part, images = part_of(seen, group[seen.image], n)
            fitted = again(near, [poses[k] for k in images], part)
            if fitted is None:
                return None
            near = fitted
            for k, T in zip(images, fitted.T_camera_board, strict=True):
                poses[k] = T
        names = intrinsic_names(near.camera)
        held = adjust_board(near.camera, poses, seen, names, near.sheet, held=True)
        if held is None:
            return None
        poses = list(held.T_camera_board)
        before = group
        if group is None:
            cost = _costs(held, seen)
            group = cost <= np.sort(cost)[n // 2]
        group = _grown(held, group)
        if np.count_nonzero(group) < _OF_START:
            return None
        settled = held, group
        if before is not None and np.array_equal(before, group):
            break
    return settled


def _costs(adjusted: AdjustedBoard, seen: BoardImages) -> Array:
    """Return squared residuals of images by their degrees of freedom, (n_images,)."""
    square = np.sum((adjusted.residual / seen.sigma_px[:, None]) ** 2, axis=1)
    n = len(adjusted.T_camera_board)
    corners = np.bincount(seen.image, minlength=n)
    return np.bincount(seen.image, square, n) / np.maximum(2 * corners - 6, 1)


def _cheapest(adjusted: AdjustedBoard, seen: BoardImages, rng: np.random.Generator) -> BoolArray:
    """Return the half of the images that is cheapest together, on quadratic costs."""
    clusters = adjusted.clusters
    n = len(clusters.score)
    dof = np.maximum(2 * np.bincount(seen.image, minlength=n) - 6, 1)
    base = _costs(adjusted, seen) * dof
    half = n // 2 + 1
    best, least = np.ones(n, dtype=np.bool_), np.inf
    for _ in range(_STARTS):
        group = np.isin(np.arange(n), rng.choice(n, _OF_START, replace=False))
        for _ in range(_ROUNDS):
            step = clusters.choose(group).best()
            added = 2.0 * clusters.score @ step + clusters.information @ step @ step
            cost = np.maximum(base + added, 0.0) / dof
            before, group = group, np.isin(np.arange(n), np.argsort(cost)[:half])
            if np.array_equal(before, group):
                break
        total = float(cost[group].sum())
        if total < least:
            best, least = group, total
    return best


def _grown(adjusted: AdjustedBoard, group: BoolArray) -> BoolArray:
    """Return a group with all images that do not contradict it, to first order."""
    clusters, first = adjusted.clusters, _FIRST_RATIO
    for _ in range(_ROUNDS):
        before = group
        moved = clusters.moved(clusters.choose(group).best())
        for direction in _whole_picture(adjusted).T:
            group = group & ~_of_two_kinds(direction, moved, group)
        moved = clusters.moved(clusters.choose(group).best())
        ratio = max(first * moved.choose(group).ratio(), 1.0)
        group, first = ~_contradicting(adjusted, moved, group, ratio), 1.0
        if np.array_equal(before, group) or np.count_nonzero(group) < _OF_START:
            break
    return group


def _contradicting(
    adjusted: AdjustedBoard, clusters: Clusters, group: BoolArray, ratio: float
) -> BoolArray:
    """Return which images contradict a group at its minimum."""
    k = clusters.score.shape[1]
    whole = _whole_picture(adjusted)
    limits = [
        (None, k),
        (whole[:, :1], 1),
        (whole[:, 1:], 2),
        (np.eye(k)[:, k - len(SHEET) :], len(SHEET)),
    ]
    wrong = np.zeros(len(group), dtype=np.bool_)
    for directions, dof in limits:
        limit = float(chdtri(dof, _SIGNIFICANCE))
        wrong |= clusters.contradiction(group, ratio, directions) > limit
    return wrong


def _of_two_kinds(direction: Array, clusters: Clusters, group: BoolArray) -> BoolArray:
    """Return which images of a group are the fewer ones of two kinds along a change (k,).

    Errors are judged with that change free in each image, so that these do not hide it.
    """
    others, n = np.zeros(len(group), dtype=np.bool_), int(np.count_nonzero(group))
    if n < _FEW:
        return others
    left, change, own = clusters.choose(group).freed(direction)
    weight = own / max(left.ratio(), 1.0)
    order = np.argsort(change)
    w, z = weight[order], change[order]
    mean = float(w @ z) / float(w.sum())
    spread = float(w @ (z - mean) ** 2)
    if spread < chdtri(n - 1, _SIGNIFICANCE):
        return others
    low = np.cumsum(w)[:-1]
    between = np.cumsum(w * (z - mean))[:-1] ** 2 * (1.0 / low + 1.0 / (w.sum() - low))
    if between.max() < _TWO * spread:
        return others
    cut = int(np.argmax(between)) + 1
    fewer = order[:cut] if cut <= n - cut else order[cut:]
    others[np.flatnonzero(group)[fewer]] = True
    return others


def _whole_picture(adjusted: AdjustedBoard) -> Array:
    """Return changes (k, 3) of kept unknowns: the picture larger, moved along x and along y."""
    k = adjusted.clusters.score.shape[1]
    zoom = np.concatenate([intrinsic_values(adjusted.camera)[:2], np.zeros(k - 2)])
    return np.column_stack([zoom, np.eye(k)[:, 2:4]])


@dataclass(frozen=True, eq=False)
class _Fault:
    """What may be the matter with an image."""

    n_unknowns: int
    gain: float  # part of what is wrong with the image that it explains
    change: Array  # (2,) of both focal lengths, as parts, or (shift) of the principal point [px]


def _reasons(adjusted: AdjustedBoard, seen: BoardImages, group: BoolArray) -> dict[int, str]:
    """Return what is the matter with images outside of a group, before the camera of the group."""
    usual = float(np.median(_costs(adjusted, seen)[group]))
    likely: dict[int, dict[str, _Fault]] = {}
    for i in np.flatnonzero(~group).tolist():
        faults = _faults(adjusted, seen, i, usual)
        most = max(fault.gain for fault in faults.values())
        likely[i] = {
            name: fault
            for name, fault in faults.items()
            if fault.gain > max(_EXPLAINED, _ALMOST * most)
        }
    # The simplest; of equally simple ones that which would explain most images. What most images
    # have in common is no unknown of each.
    names = [name for faults in likely.values() for name in faults]
    shared = {
        name: _shared([f[name].change for f in likely.values() if name in f]) for name in names
    }

    def complexity(i: int, name: str) -> tuple[int, int]:
        fault = likely[i][name]
        n_known = len(fault.change) if _near(fault.change, shared[name]) else 0
        return fault.n_unknowns - n_known, -names.count(name)

    found = {i: min(faults, key=partial(complexity, i)) for i, faults in likely.items() if faults}
    reasons = {}
    for i in likely:
        name = found.get(i, "")
        alike = [likely[k][name].change for k, other in found.items() if other == name]
        if name == "zoom":
            longer = likely[i][name].change.mean() > 0.0
            zooms = [change.mean() for change in alike if (change.mean() > 0.0) == longer]
            reasons[i] = (
                f"another zoom or focus, with a focal length about "
                f"{100.0 * abs(np.median(zooms)):.2g} % {'longer' if longer else 'shorter'} than "
                "in the others"
            )
        elif name == "stretch":
            wider, higher = np.median(alike, axis=0)
            reasons[i] = (
                f"its picture is stretched, {100.0 * abs(wider - higher):.2g} % more "
                f"{'along x' if wider > higher else 'along y'} than those of the others"
            )
        elif name == "shift":
            x, y = np.rint(np.median(alike, axis=0)).astype(np.intp)
            reasons[i] = (
                f"its picture lies about ({x}, {y}) px beside that of the others, as with "
                "stabilisation or another crop"
            )
        elif name:
            reasons[i] = _IN_WORDS[name]
        else:
            rms = [adjusted.rms_px(which) for which in (seen.image == i, group[seen.image])]
            reasons[i] = (
                f"its corners are {rms[0]:.2f} px off (rms) before the camera of the others, whose "
                f"own are {rms[1]:.2f} px off"
            )
    return reasons


def _shared(changes: Sequence[Array]) -> Array:
    """Return the change (2,) that most of some images have in common; zero if there is none."""
    middle = np.median(changes, axis=0)
    alike = sum(_near(change, middle) for change in changes)
    return np.asarray(middle if alike > max(_PAIR, len(changes) // 2) else np.zeros(2))


def _near(change: Array, other: Array) -> bool:
    """Say whether a change is another one, which is none if it is zero."""
    return bool(np.linalg.norm(change - other) < _ALIKE * np.linalg.norm(other))


_FREE = {
    "zoom": ("fx", "fy"),
    "shift": ("cx", "cy"),
    "lens": ("k1", "k2"),
    "crop": ("fx", "fy", "cx", "cy"),
}
_IN_WORDS = {
    "turned": "turned by half a turn after it was taken",
    "mirrored": "mirrored",
    "crop": "a part of the picture that was cut out and scaled",
    "lens": "another distortion of the lens than in the others, as where a program corrects it",
    "sheet": "the board is bent otherwise in it than in the others",
    "motion": "camera or board moved while its rows were read out, or stabilisation bent it",
}


def _faults(adjusted: AdjustedBoard, seen: BoardImages, i: int, usual: float) -> dict[str, _Fault]:
    """Return what each fault explains of an image, of the usual cost of a degree of freedom."""
    camera, T, own = adjusted.camera, adjusted.T_camera_board[i], seen.image == i
    points, sheet = seen.points[own], adjusted.sheet or Sheet.flat(seen.points)
    only = np.zeros(len(points), dtype=np.intp)
    image = BoardImages(only, sheet.placed(points)[0], seen.px[own], seen.sigma_px[own])
    plain = adjust_board(camera, [T], image)
    if plain is None:
        return {"motion": _Fault(0, 0.0, np.zeros(2))}
    wrong = max(plain.cost - 0.5 * usual * max(2 * len(points) - 6, 1), 1e-300)
    fine = max(_NEGLIGIBLE * wrong, COST_TOLERANCE)

    def fault(n_unknowns: int, found: AdjustedBoard | None, change: Array | None = None) -> _Fault:
        gain = 0.0 if found is None else (plain.cost - found.cost) / wrong
        return _Fault(n_unknowns, gain, np.zeros(2) if change is None else change)

    faults = {}
    # The image turned or mirrored back shows the board so, numbered as if it were mirrored.
    far = np.array([camera.width - 1.0, camera.height - 1.0])
    for name, sides in (("turned", [-1.0, -1.0, 1.0]), ("mirrored", [-1.0, 1.0, 1.0])):
        side = np.array(sides)
        flip = np.array([side.prod(), 1.0, 1.0])
        to_there = sheet.middle[0] * (1.0 - flip)
        R = T.rotation.as_matrix()
        t = side * (T.translation + R @ to_there)
        pose = RigidTransform.from_components(t, Rotation.from_matrix(side[:, None] * R * flip))
        px = np.where(side[:2] < 0.0, far - image.px, image.px)
        back = replace(image, points=sheet.placed(points * flip + to_there)[0], px=px)
        faults[name] = fault(0, adjust_board(camera, [pose], back, tolerance=fine))
    for name, free in _FREE.items():
        found = adjust_board(camera, [T], image, free, tolerance=fine)
        change = np.zeros(2)
        if found is not None and name == "shift":
            change = found.camera.K[:2, 2] - camera.K[:2, 2]
        elif found is not None:
            change = np.diag(found.camera.K)[:2] / np.diag(camera.K)[:2] - 1.0
        both = abs(change[0] - change[1]) < _ALIKE * abs(change.sum())
        if name == "crop" and not both:
            continue
        faults["stretch" if name == "zoom" and not both else name] = fault(len(free), found, change)
    bent = adjust_board(camera, [T], image, (), Sheet.flat(seen.points), tolerance=fine)
    faults["sheet"] = fault(4, bent)
    faults["motion"] = _Fault(6, _gain_of_motion(plain, image) / wrong, np.zeros(2))
    return faults


def _gain_of_motion(adjusted: AdjustedBoard, seen: BoardImages) -> float:
    """Return by how much a motion of the board from row to row lowers the cost of one image."""
    T = adjusted.T_camera_board[0]
    arm = T.rotation.apply(seen.points)
    _, by_point = adjusted.camera.project_with_derivative(arm + T.translation)
    by_pose = np.concatenate([np.cross(arm[:, None, :], by_point), by_point], axis=-1)
    row = seen.px[:, 1] - seen.px[:, 1].mean()
    J = np.concatenate([by_pose, by_pose * row[:, None, None]], axis=-1)
    J = J / seen.sigma_px[:, None, None]
    J = J / np.maximum(np.linalg.norm(J, axis=(0, 1)), 1e-300)
    r = left = adjusted.residual / seen.sigma_px[:, None]
    for _ in range(_ROUNDS):
        _, weighted = LOSS.softened(left, np.concatenate([J, r[..., None]], axis=-1))
        rows = weighted.reshape(-1, weighted.shape[-1])
        left = r - J @ np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    return LOSS.cost(np.sum(r * r, axis=1)) - LOSS.cost(np.sum(left * left, axis=1))
