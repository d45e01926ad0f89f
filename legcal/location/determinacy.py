"""What the poses determine: frames with covariance, the open part held or a refusal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array
from legcal.location.convention import covariance_with, hold_tool, is_resolved_by_the_tool
from legcal.location.fit import Fit, finished, frame_design, system
from legcal.location.open_directions import (
    BLOCKS,
    beyond_the_machine,
    needed_words,
    open_directions,
    open_parts,
    variety,
)
from legcal.location.open_part import OpenPart, direction_of, direction_words, joined
from legcal.location.pose_pairs import N_FRAME, Frames, PosePairs, jacobian
from legcal.location.problem import Problem
from legcal.mechanism.configurations import random_configurations

WORKSPACE = 30  # poses
SEED = 1
WEAK = 25.0  # times worse known than one measured pose would tell


@dataclass(frozen=True, eq=False)
class Determinacy:
    """Frames at rest, and how well each part of them is known.

    Attributes
    ----------
    fit : Fit
        At the frames, the open part held.
    covariance : (12, 12) array
        Of a step: displacement and rotation of the base about world axes, of the tool about
        platform axes [m, rad]; zero along what is held.
    held : tuple of OpenPart
        What no pose of the machine tells.
    words : str
        The same for people; "" where everything is determined.
    weak : tuple of str
        What is known badly, one sentence each.
    """

    fit: Fit
    covariance: Array
    held: tuple[OpenPart, ...]
    words: str
    weak: tuple[str, ...]


def determine(problem: Problem, found: Fit, tool_position: Array, name: str) -> Determinacy:
    """Return what a fit determines.

    Parameters
    ----------
    problem : Problem
        Of the rows used.
    found : Fit
        Its most likely frames.
    tool_position : (3,) array
        Where the tool is taken in the platform where the machine leaves that open [m].
    name : str
        What the poses are called in messages.

    Raises
    ------
    NotIdentifiable
        If other poses of the machine would tell what these leave open, or if more than the tool
        would have to be held.
    """
    pairs, oriented = problem.pairs, problem.is_oriented
    basis = open_directions(found.frame_design, oriented=oriented)
    parts: list[OpenPart] = []
    words = ""
    if basis.shape[1]:
        workspace = _workspace(problem)
        _check_machine(problem, found, basis, workspace, name)
        found = hold(problem, found, tool_position)
        basis = _open_at(problem, found, basis.shape[1], found.frames)
        parts = open_parts(basis, found.frames)
        words = _held_words(parts, workspace, tool_position)
    scale = pairs.scale
    unit = covariance_with(found.information, basis, oriented=oriented)
    covariance = unit * np.outer(scale, scale)
    return Determinacy(
        found, covariance, tuple(parts), words, _weak(covariance, found, pairs, oriented=oriented)
    )


def hold(problem: Problem, found: Fit, tool_position: Array) -> Fit:
    """Return a fit moved along what it leaves open until the tool is where it is held."""
    k = open_directions(found.frame_design, oriented=problem.is_oriented).shape[1]
    if k == 0:
        return found
    frames = hold_tool(
        found.frames,
        problem.pairs,
        lambda frames: _open_at(problem, found, k, frames),
        lambda frames: system(problem.pairs, frames, found.noise, problem.by_model),
        tool_position,
    )
    return finished(problem.pairs, frames, found.noise, problem.by_model)


def _open_at(problem: Problem, found: Fit, k: int, frames: Frames) -> Array:
    """Return the k directions (12, k) that are known least at some frames."""
    n = 12 if problem.is_oriented else 9
    design = system(problem.pairs, frames, found.noise, problem.by_model)[1]
    _, _, Vt = np.linalg.svd(frame_design(design)[:, :n], full_matrices=True)
    basis = np.zeros((12, k))
    basis[:n] = Vt[n - k :].T
    return basis


def _workspace(problem: Problem) -> PosePairs:
    """Return poses all over the workspace, as if each had been measured."""
    drawn = random_configurations(problem.mechanism, WORKSPACE, SEED)
    matrices = np.array([T.as_matrix() for T in drawn.poses])
    return PosePairs(
        R=matrices[:, :3, :3],
        t=matrices[:, :3, 3],
        M=np.tile(np.eye(3), (WORKSPACE, 1, 1)),
        p=np.zeros((WORKSPACE, 3)),
        oriented=np.full(WORKSPACE, problem.is_oriented),
        length=problem.pairs.length,
    )


def _check_machine(
    problem: Problem, found: Fit, basis: Array, workspace: PosePairs, name: str
) -> None:
    """Refuse what other poses would tell, and what holding the tool does not close."""
    pairs = problem.pairs
    units = np.repeat([1.0 / pairs.length, 1.0], 3)[:, None]
    seen = (jacobian(found.frames, workspace) * units * pairs.scale).reshape(-1, N_FRAME)
    beyond = beyond_the_machine(basis, seen, oriented=problem.is_oriented)
    here = variety(pairs.R, pairs.t, pairs.length)
    there = variety(workspace.R, workspace.t, pairs.length)
    start = f"{name}: base and tool could not be located, because"
    if beyond.shape[1]:
        raise NotIdentifiable(
            f"{start} {joined(open_parts(beyond, found.frames))} cannot be told from the poses: "
            f"found {len(pairs)} poses that {here.words}"
            f"{needed_words(here, there, _scatter(problem, found))}."
        )
    if not is_resolved_by_the_tool(basis):
        raise NotIdentifiable(
            f"{start} no pose of this machine tells {joined(open_parts(basis, found.frames))}: "
            f"found a platform whose poses {there.words}, needed a part that holding the tool in "
            "the platform closes; measure orientations too, or the base itself."
        )


def _scatter(problem: Problem, found: Fit) -> str:
    """Return the standard deviations of a measured component."""
    sigma = found.noise.factor * np.sqrt((found.noise.sigma**2).mean(axis=0))
    turn = f" and {np.degrees(sigma[1]):.2g} deg" if problem.is_oriented else ""
    return f"{1e3 * sigma[0]:.2g} mm{turn}"


def _held_words(parts: list[OpenPart], workspace: PosePairs, tool_position: Array) -> str:
    """Return what is held and why."""
    tool = [part for part in parts if part.frame == "tool"]
    base = [part for part in parts if part.frame == "base"]
    machine = variety(workspace.R, workspace.t, workspace.length)
    if len(machine.axes) == 0:
        why = "the platform of this machine does not turn"
    elif len(machine.axes) == 1:
        axis = direction_words(machine.axes[0])
        why = f"the platform of this machine turns about one axis only, {axis} of the base"
    else:
        why = f"the platform of this machine takes poses that {machine.words}"
    at = ", ".join(f"{x:g}" for x in tool_position)
    with_it = f" from {joined(base)}" if base else ""
    taken = [
        f"the tool is taken at ({at}) m in the platform"
        if part.kind == "position"
        else "the tool is taken along the axes of the platform"
        for part in tool
    ]
    return (
        f"No pose tells {joined(tool)} apart{with_it}, because {why}: {' and '.join(taken)} there, "
        "and the base follows; where the tool is in the world does not depend on it."
    )


def _weak(covariance: Array, found: Fit, pairs: PosePairs, *, oriented: bool) -> tuple[str, ...]:
    """Return which directions are known badly, one sentence for each part of the frames."""
    position, angle = found.noise.factor * np.sqrt((found.noise.sigma**2).mean(axis=0))
    one = max(float(position), float(angle) * pairs.length if oriented else 0.0)
    sentences = []
    for block, frame, kind in BLOCKS:
        values, vectors = np.linalg.eigh(covariance[block, block])
        sigma = float(np.sqrt(max(values[-1], 0.0)))
        limit = WEAK * (one if kind == "position" else one / pairs.length)
        if sigma <= limit:
            continue
        v = vectors[:, -1] if frame == "tool" else found.frames.R_base.T @ vectors[:, -1]
        part = OpenPart(frame, kind, (direction_of(v),))
        known = f"{1e3 * sigma:.2g} mm" if kind == "position" else f"{np.degrees(sigma):.2g} deg"
        sentences.append(
            f"Known badly is {part.words}: {known} (1 sigma); poses that differ more, above all in "
            "rotations about several axes, would tell it better."
        )
    return tuple(sentences)
