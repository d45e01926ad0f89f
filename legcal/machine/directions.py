"""Directions in parameter space: their platform motion, a sparse basis, and names in words."""

import re
from collections.abc import Sequence

import numpy as np
from scipy.linalg import qr

from legcal.geometry.types import Array
from legcal.machine.parameter_id import ParameterId

SHOWN = 0.02  # least component named in words, relative to the largest


def split_by_motion(
    motion: Array | None, basis: Array, length: float, harmless: float
) -> tuple[Array, Array]:
    """Return bases (a, p), (b, p) of the directions that move the platform, and the others.

    *motion* (k, 6, p) is rotation [rad] and displacement [m] of the platform at k poses by each
    parameter, all in metres; None if the motors do not determine the pose: then all directions
    count. *basis* (w, p) is orthonormal; rotations are converted to displacements by the mean leg
    *length* [m]; motion below *harmless*, relative to the change of the parameters, counts as none.
    """
    if motion is None or len(basis) == 0:
        return basis, basis[:0]
    moved = motion @ basis.T
    moved[:, :3] *= length
    flat = moved.reshape(-1, len(basis)) / np.sqrt(len(moved))
    singular, turn = np.linalg.eigh(flat.T @ flat)
    still = singular < harmless**2
    return turn.T[~still] @ basis, turn.T[still] @ basis


def sparse_basis(basis: Array) -> Array:
    """Return a basis of the same space in which each direction has a parameter of its own."""
    if len(basis) == 0:
        return basis
    _, upper, order = qr(basis, mode="economic", pivoting=True)
    w = len(basis)
    sparse = np.zeros_like(basis)
    sparse[:, order] = np.linalg.solve(upper[:, :w], upper)
    sparse[np.abs(sparse) < 1e-9] = 0.0
    first = np.argmax(np.abs(sparse) > SHOWN * np.abs(sparse).max(axis=1, keepdims=True), axis=1)
    return np.asarray(sparse[np.argsort(first, kind="stable")])


_MAX_GROUPS = 4  # groups of joints named in one direction
_NOUN = {
    "base": ("base joint", "base joints"),
    "platform": ("platform joint", "platform joints"),
    "offset": ("offset of leg", "offsets of legs"),
    "length": ("length of leg", "lengths of legs"),
    "base_axis": ("base axis of leg", "base axes of legs"),
    "platform_axis": ("platform axis of leg", "platform axes of legs"),
    "twist": ("twist of leg", "twists of legs"),
    "radius": ("radius of leg", "radii of legs"),
    "board": ("size of the board on", "sizes of the boards on"),
    "": ("camera", "cameras"),
}
_BOARDS = {"board.scale": "the base", "platform_board.scale": "the platform"}
_NOUN_OF_ACTUATOR = {
    "direction": ("direction of", "directions of"),
    "axis": ("axis of", "axes of"),
    "axis_point": ("place of the axis of", "places of the axes of"),
    "arm_axis": ("direction of the arm of", "directions of the arms of"),
    "arm_point": ("place of the arm of", "places of the arms of"),
    "gain": ("gain of", "gains of"),
}


def list_in_words(words: Sequence[str]) -> str:
    """Return words joined as a list in a sentence."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def leg_labels(leg_names: Sequence[str]) -> dict[str, str]:
    """Return the label of each leg after the word "leg": its number if its name is one."""
    numbers = [re.fullmatch(r"[Ll]eg[_-]?(\d+)", name) for name in leg_names]
    labels = {
        name: match.group(1) if match else name
        for name, match in zip(leg_names, numbers, strict=True)
    }
    return labels if len(set(labels.values())) == len(labels) else {name: name for name in labels}


def legs_in_words(legs: Sequence[int], leg_names: Sequence[str]) -> str:
    """Return legs as a sentence names them: ``legs 1, 2 and 5``."""
    labels = leg_labels(leg_names)
    return f"leg{'s' * (len(legs) > 1)} {list_in_words([labels[leg_names[j]] for j in legs])}"


def describe_direction(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return the parameters of a direction in words: ``z of platform joints 2 and 4 together``.

    Others are ``offset of leg 3``, ``direction of rail1`` and ``fx of camera c1``.
    """
    several = {_split(name, leg_names)[:2] for name in parameters}
    return parameters_in_words(parameters, leg_names) + " together" * (len(several) > 1)


def parameters_in_words(parameters: Sequence[str], leg_names: Sequence[str]) -> str:
    """Return parameters in words, grouped by kind: ``z of platform joints 2 and 4``."""
    coordinates: dict[tuple[str, str], list[str]] = {}
    for name in parameters:
        owner, kind, which = _split(name, leg_names)
        coordinates.setdefault((kind, owner), []).append(which)
    groups: dict[tuple[str, str], list[str]] = {}
    for (kind, owner), letters in coordinates.items():
        axes = list_in_words(sorted(letters))
        if kind == "radius" or kind in _NOUN_OF_ACTUATOR:  # tube and rod, two angles
            axes = ""
        elif kind.endswith("_axis"):
            axes = f"angle{'s' * (len(letters) > 1)} {axes}"
        groups.setdefault((kind, axes), []).append(owner)
    phrases = []
    for (kind, axes), owners in groups.items():
        noun = (_NOUN | _NOUN_OF_ACTUATOR)[kind][len(owners) > 1]
        ordered = _labelled(owners, leg_names)
        phrases.append(f"{axes + ' of ' if axes else ''}{noun} {list_in_words(ordered)}")
    if len(phrases) > _MAX_GROUPS:
        more = len(phrases) - _MAX_GROUPS + 1
        phrases = [*phrases[: _MAX_GROUPS - 1], f"{more} more such changes"]
    return list_in_words(phrases)


def _labelled(owners: Sequence[str], leg_names: Sequence[str]) -> list[str]:
    """Return the labels of legs, in their order, or of cameras."""
    labels = leg_labels(leg_names)
    legs = [labels[name] for name in leg_names if name in owners]
    return [*legs, *(owner for owner in owners if owner not in leg_names)]


def _split(name: str, leg_names: Sequence[str]) -> tuple[str, str, str]:
    """Return owner, kind and component of a parameter, for words.

    The owner of the size of a board is its link; an intrinsic parameter is a component of a camera,
    without kind.
    """
    if name in _BOARDS:
        return _BOARDS[name], "board", ""
    parameter = ParameterId.parse(name)
    if parameter.owner in leg_names and parameter.kind in _NOUN:
        return parameter.owner, parameter.kind, parameter.component
    if parameter.kind in _NOUN_OF_ACTUATOR:
        return parameter.owner, parameter.kind, ""
    return parameter.owner, "", parameter.kind
