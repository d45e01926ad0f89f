"""The verdict: frames, residuals and their spread, put into words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.location.fit import (
    SINGULAR,
    Agreement,
    Fit,
    covariance_with,
    finished,
    frame_design,
    hold_tool,
    is_resolved_by_the_tool,
    search,
    system,
)
from legcal.calibration.location.model import (
    N_FRAME,
    Frame,
    Frames,
    Kind,
    Location,
    MeasurementNoise,
    OpenPart,
    PosePairs,
    RowResidual,
    Status,
    direction_of,
    direction_words,
    jacobian,
    joined,
    residuals,
)
from legcal.calibration.location.problem import Problem
from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray
from legcal.machine import random_configurations

OPEN = 0.1  # [rad], and of the length of the machine
HARDLY = 2e-3  # of the best seen direction: what no pose of a machine shows better is its own
_PART = 0.03  # of a unit direction: what is less is not named
_SAME_AXIS = 0.02  # of the largest rotations: what is less is about the same axis

BLOCKS: tuple[tuple[slice, Frame, Kind], ...] = (
    (slice(0, 3), "base", "position"),
    (slice(3, 6), "base", "orientation"),
    (slice(6, 9), "tool", "position"),
    (slice(9, 12), "tool", "orientation"),
)  # of a step


def open_directions(design: Array, *, oriented: bool) -> Array:
    """Return an orthonormal basis (12, k) of the directions that a design leaves open.

    Parameters
    ----------
    design : (m, 12) array
        Whitened derivatives by a step in units of the machine's length and radians.
    oriented : bool
        Whether orientations of the tool were measured at all; without, that of the tool in the
        platform is not looked for.
    """
    return _unseen(design, oriented, lambda s: (s < SINGULAR * s[0]) | (s * OPEN < 1.0))


def beyond_the_machine(basis: Array, jacobian: Array, *, oriented: bool) -> Array:
    """Return those open directions (12, k) of some poses that the machine's workspace would tell.

    Parameters
    ----------
    basis : (12, k) array
        What the measured poses leave open.
    jacobian : (m, 12) array
        Derivatives of poses all over the workspace by a step, both in units of the machine's
        length and radians: geometry alone, whatever the noise.
    oriented : bool
        As for :func:`open_directions`.
    """
    own = _unseen(jacobian, oriented, lambda s: s < HARDLY * s[0])
    U, s, _ = np.linalg.svd(basis - own @ (own.T @ basis), full_matrices=False)
    return np.asarray(U[:, s > 0.5])


def _unseen(design: Array, oriented: bool, is_open: Callable[[Array], BoolArray]) -> Array:
    """Return the right singular vectors (12, k) whose singular values are too small."""
    n = 12 if oriented else 9
    _, s, Vt = np.linalg.svd(design[:, :n], full_matrices=True)
    s = np.concatenate([s, np.zeros(n - len(s))])
    chosen = is_open(s)
    basis = np.zeros((12, int(chosen.sum())))
    basis[:n] = Vt[chosen].T
    return basis


def open_parts(basis: Array, frames: Frames) -> list[OpenPart]:
    """Return which parts of the frames some open directions (12, k) move."""
    parts = []
    for block, frame, kind in BLOCKS:
        rows = basis[block]
        if frame == "base":
            rows = frames.R_base.T @ rows
        U, s, _ = np.linalg.svd(rows, full_matrices=False)
        found = [direction_of(u) for u in U[:, s > _PART].T]
        if found:
            parts.append(OpenPart(frame, kind, tuple(found)))
    return parts


@dataclass(frozen=True, eq=False)
class Variety:
    """How platform poses differ.

    Attributes
    ----------
    axes : (r, 3) array
        Independent axes that they are turned about, in the base link, the first ones first.
    n_shifts : int
        Independent directions in which they are displaced.
    """

    axes: Array
    n_shifts: int

    @property
    def words(self) -> str:
        """How they differ, after "poses that"."""
        turns = (
            "do not turn",
            f"all turn about one axis, {direction_words(self.axes[0])} of the base"
            if len(self.axes)
            else "",
            "turn about two axes",
            "turn about all axes",
        )[len(self.axes)]
        shifts = ("stay in place", "move along a line", "move in a plane", "move in space")
        return f"{turns} and {shifts[self.n_shifts]}"


def variety(R: Array, t: Array, length: float) -> Variety:
    """Return how poses R (n, 3, 3), t (n, 3) [m] differ; a length makes rotations comparable."""
    turns = (Rotation.from_matrix(R) * Rotation.from_matrix(R).mean().inv()).as_rotvec()
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    size = np.sqrt(len(t))
    axes = Vt[(s > _SAME_AXIS * s[0]) & (s / size > 1e-6)]
    moves = np.linalg.svd(t - t.mean(axis=0), compute_uv=False)
    n_shifts = int(np.sum((moves > _SAME_AXIS * moves[0]) & (moves / size > 1e-6 * length)))
    return Variety(axes, n_shifts)


def needed_words(found: Variety, possible: Variety, scatter: str) -> str:
    """Return how the poses scatter if that matters, what they need and what to do."""
    if len(found.axes) < min(2, len(possible.axes)):
        several = "two axes" if len(possible.axes) > 1 else "an axis"
        more = "tilted about another axis too" if len(found.axes) else "turned against each other"
        return f", needed rotations about {several}; add poses that are {more}"
    if found.n_shifts < possible.n_shifts:
        return (
            f", needed displacements in {possible.n_shifts} directions; add poses that are "
            "displaced in another direction too"
        )
    return (
        f", with a scatter of {scatter}, needed more or better ones, further apart; add some from "
        "all over the workspace"
    )


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


BETTER = 10.0  # times
CLEAR = 0.01  # of the spread of positions: what is left then asks for no other mistake
ROWS, SUBSETS = 12, 8  # that mistakes are tried on, and starts from a few of them

_LENGTHS = (
    (1e-3, "millimetres", "divide x, y and z by 1000"),
    (1e-2, "centimetres", "divide x, y and z by 100"),
    (0.0254, "inches", "multiply x, y and z by 0.0254"),
)
_MIRRORS = (
    ("x reversed", np.diag([-1.0, 1.0, 1.0])),
    ("y reversed", np.diag([1.0, -1.0, 1.0])),
    ("z reversed", np.diag([1.0, 1.0, -1.0])),
    ("x and y swapped", np.eye(3)[[1, 0, 2]]),
    ("y and z swapped", np.eye(3)[[0, 2, 1]]),
    ("x and z swapped", np.eye(3)[[2, 1, 0]]),
)


def likely_mistake(pairs: PosePairs, cost: float, fewest: int) -> tuple[str, str] | None:
    """Return what the poses look like and what to do, or None.

    Parameters
    ----------
    pairs : PosePairs
        What was measured.
    cost : float
        Of the best candidate for them.
    fewest : int
        Rows that determine the frames.
    """
    best, found = cost / _spread(pairs) / BETTER**2, None
    few = pairs.of(np.linspace(0, len(pairs) - 1, min(len(pairs), ROWS)).astype(np.intp))
    for changed, looks_like, remedy in _alternatives(few):
        other = float(search(changed, fewest, subsets=SUBSETS).cost[0]) / _spread(changed)
        if other < best:
            best, found = other / BETTER**2, (looks_like, remedy)
            if other < CLEAR**2:
                break
    return found


def _spread(pairs: PosePairs) -> float:
    """Return how far positions are apart, squared, in units of ``pairs.length``."""
    return float(pairs.p.var(axis=0).sum()) / pairs.length**2 + 1e-300


def _alternatives(pairs: PosePairs) -> Iterator[tuple[PosePairs, str, str]]:
    """Yield the poses with each mistake undone, what they look like with it, and what to do."""
    has_orientations = bool(pairs.oriented.any())
    reordered = _reordered(pairs.M)
    wrong_order = "quaternions in the order w, x, y, z", "write qx, qy, qz, qw under their names"
    for size, unit, remedy in _LENGTHS:
        metres = replace(pairs, p=size * pairs.p)
        yield metres, f"positions in {unit}", remedy
        if has_orientations:
            both = replace(metres, M=reordered)
            yield (
                both,
                f"positions in {unit} and {wrong_order[0]}",
                f"{remedy}, and {wrong_order[1]}",
            )
    mirror = _MIRRORS[2][1]
    name = "left-handed axes, a mirror image", "give poses in right-handed axes"
    yield replace(pairs, p=pairs.p @ mirror, M=mirror @ pairs.M @ mirror), *name
    if not has_orientations:
        return
    yield replace(pairs, M=reordered), *wrong_order
    back = np.swapaxes(pairs.M, 1, 2)
    inverse = "the orientation of the world in the tool", "invert the quaternions"
    yield replace(pairs, M=back), *inverse
    world = replace(pairs, M=back, p=-np.einsum("nij,nj->ni", back, pairs.p))
    yield world, "poses of the world in the tool", "give those of the tool in the world"
    for words, S in _MIRRORS:
        yield (
            replace(pairs, p=pairs.p @ S.T),
            f"positions along left-handed axes ({words})",
            "give positions and orientations along the same right-handed axes",
        )


def _reordered(M: Array) -> Array:
    """Return orientations whose quaternions were read as x, y, z, w and are w, x, y, z."""
    quaternions = Rotation.from_matrix(M).as_quat()
    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()


DOUBTFUL = 1e-3  # probability of residuals as large as these
TOO_GOOD = 1e-4  # probability of residuals as small as these
_NONE = 1e-12  # [m, rad]: held
_KINDS = ("positions", "orientations")


def judge(
    problem: Problem,
    name: str,
    agreement: Agreement,
    determined: Determinacy,
    at: Array,
    *,
    is_given: bool,
) -> Location:
    """Return the location with its verdict.

    Parameters
    ----------
    problem : Problem
        Of all rows.
    name : str
        What the poses are called.
    agreement : Agreement
        The rows that the frames rest on.
    determined : Determinacy
        The frames.
    at : (3,) array
        The tool position in the platform that was held where it is open [m].
    is_given : bool
        Whether somebody gave it.
    """
    found = determined.fit
    p_value, too_large, too_small = _judged(found)
    base, tool = found.frames.transforms()
    if not problem.is_oriented:
        tool = RigidTransform.from_translation(tool.translation)
    tool_position, tool_angle = _at_the_tool(problem, determined)
    left_out = problem.poses.numbers[~agreement.agrees].tolist()
    status: Status = "located in part" if determined.held else "located"
    if too_large:
        status = "doubtful"
    return Location(
        model=str(problem.mechanism.yaml_path),
        poses=name,
        T_world_base=base,
        T_platform_tool=tool,
        has_tool_orientation=problem.is_oriented,
        covariance=0.5 * (determined.covariance + determined.covariance.T),
        held=determined.held,
        held_at=(float(at[0]), float(at[1]), float(at[2])),
        held_words=determined.words,
        noise=_noise(problem, found),
        rows=tuple(_rows(problem, agreement, found)),
        chi2=found.chi2,
        dof=found.dof,
        p_value=p_value,
        tool_position_sigma=tool_position,
        tool_angle_sigma=tool_angle,
        status=status,
        sentence=_sentence(problem, determined, left_out, too_large),
        notes=tuple(_notes(problem, determined, agreement, too_small, is_given=is_given)),
    )


def _judged(found: Fit) -> tuple[float | None, str, str]:
    """Return the probability of larger residuals, and what is too large or too small in words."""
    noise = found.noise
    kinds = [k for k in range(2) if noise.stated[k] and found.kind_dof[k] > 0.5]
    if not kinds:
        return None, "", ""
    squares = (found.whitened**2).reshape(-1, 2, 3).sum(axis=(0, 2))
    if len(kinds) == 2 or found.kind_dof.min() <= 0.5:
        total, dof = found.chi2, float(found.dof)
    else:
        total, dof = float(squares[kinds[0]]), float(found.kind_dof[kinds[0]])
    p_value = float(stats.chi2.sf(total, dof))
    large, small = list[str](), list[str]()
    for k in kinds:
        ratio = float(np.sqrt(squares[k] / found.kind_dof[k]))
        words = f"{_KINDS[k]} scatter {ratio:.2g} times as much as was stated of them"
        (large if ratio > 1.0 else small).append(words)
    too_small = " and ".join(small) if stats.chi2.cdf(total, dof) < TOO_GOOD else ""
    return p_value, " and ".join(large) if p_value < DOUBTFUL else "", too_small


def _noise(problem: Problem, found: Fit) -> MeasurementNoise:
    """Return what was stated or found of the measurement."""
    rms = found.noise.factor * np.sqrt((found.noise.sigma**2).mean(axis=0))
    oriented = problem.is_oriented
    return MeasurementNoise(
        position=float(rms[0]),
        angle=float(rms[1]) if oriented else None,
        position_stated=problem.noise.stated[0],
        angle_stated=problem.noise.stated[1] and oriented,
        reading=problem.encoder_sigma,
        model=problem.by_model is not None,
    )


def _rows(problem: Problem, agreement: Agreement, found: Fit) -> list[RowResidual]:
    """Return the residuals of all rows; errors of the model are not taken out of them."""
    pairs = problem.pairs
    r = residuals(found.frames, pairs)
    rows = []
    for i, number in enumerate(problem.poses.numbers.tolist()):
        reason = "" if agreement.agrees[i] else _off(problem, agreement, i)
        rows.append(
            RowResidual(
                number,
                (float(r[i, 0]), float(r[i, 1]), float(r[i, 2])),
                (float(r[i, 3]), float(r[i, 4]), float(r[i, 5])) if pairs.oriented[i] else None,
                reason,
            )
        )
    return rows


def _off(problem: Problem, agreement: Agreement, i: int) -> str:
    """Return how far a row is from where the others foretell it."""
    sigma = agreement.factor * problem.noise.sigma[i]
    found = f"{1e3 * agreement.distance[i]:.3g} mm"
    scatter = f"{1e3 * sigma[0]:.2g} mm"
    if problem.pairs.oriented[i]:
        found += f" and {np.degrees(agreement.angle[i]):.3g} deg"
        scatter += f" and {np.degrees(sigma[1]):.2g} deg"
    return f"{found} from where the other rows foretell it, which scatter {scatter}"


def _at_the_tool(problem: Problem, determined: Determinacy) -> tuple[float, float | None]:
    """Return how well the frames put the tool in the world, rms over the poses [m], [rad]."""
    J = jacobian(determined.fit.frames, problem.pairs)
    variance = np.einsum("nij,jk,nik->ni", J, determined.covariance, J)
    position = float(np.sqrt(variance[:, :3].sum(axis=1).mean()))
    oriented = problem.pairs.oriented
    if not oriented.any():
        return position, None
    return position, float(np.sqrt(variance[oriented, 3:].sum(axis=1).mean()))


def _sentence(
    problem: Problem, determined: Determinacy, left_out: Sequence[int], too_large: str
) -> str:
    """Return the verdict."""
    used = len(problem.poses) - len(left_out)
    sigma = np.sqrt(np.maximum(np.diagonal(determined.covariance), 0.0)).reshape(4, 3)
    size = np.linalg.norm(sigma, axis=1)
    base = f"{1e3 * size[0]:.2g} mm and {np.degrees(size[1]):.2g} deg"
    known = [
        f"{1e3 * size[2]:.2g} mm" * bool(size[2] > _NONE),
        f"{np.degrees(size[3]):.2g} deg" * bool(problem.is_oriented and size[3] > _NONE),
    ]
    tool = " and ".join(words for words in known if words)
    tool = f", the tool in the platform to {tool}" if tool else ""
    tool += "" if problem.is_oriented else " (its position only)"
    rows = f"{used} of {len(problem.poses)} poses" if left_out else f"{used} poses"
    out = ""
    if left_out:
        several = len(left_out) > 1
        out = (
            f" Row{'s' * several} {', '.join(map(str, left_out))} disagree{'s' * (not several)} "
            f"with the others and {'were' if several else 'was'} left out."
        )
    if too_large:
        return (
            f"Doubtful: {too_large}, so that the standard deviations are too small; errors of the "
            "model or of the readings may be the reason, or readings and poses that do not belong "
            "together." + out
        )
    start = "Base and tool are located" + " in part" * bool(determined.held)
    return (
        f"{start} from {rows}: the base in the world to {base}{tool} "
        f"(1 sigma{'' if problem.by_model is not None else ', if the model is right'})."
        f"{' ' * bool(determined.words)}{determined.words}{out}"
    )


def _notes(
    problem: Problem,
    determined: Determinacy,
    agreement: Agreement,
    too_small: str,
    *,
    is_given: bool,
) -> list[str]:
    """Return what else a reader should know."""
    notes = [*problem.poses.notes, *determined.weak]
    if problem.by_model is None:
        notes.append(
            "Nothing is known of the errors of the model, which move all poses at once: the "
            "standard deviations hold for a model without errors; locate the model in the folder "
            "of its calibration, or state how precise the measurement is to have it tested."
        )
    if int(agreement.agrees.sum()) == problem.fewest:
        notes.append(
            f"A wrong row among the {problem.fewest} poses could not have been noticed; measure "
            "more."
        )
    if too_small:
        notes.append(f"The stated standard deviations look too large: {too_small}.")
    if is_given and not determined.held:
        notes.append("The given position of the tool was not needed: the poses determine it.")
    return notes
