"""Base in the world and tool in the platform from measured tool poses: ``legcal locate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtrc

from legcal.calibration.location.document import (
    Location,
    LocationStatus,
    MeasurementNoise,
    RowResidual,
)
from legcal.calibration.location.fit import (
    Determinacy,
    FrameFit,
    Inliers,
    determine,
    find_inliers,
    fit,
    hold_open_part,
)
from legcal.calibration.location.frames import (
    FrameCandidates,
    jacobian,
    likely_mistake,
    residuals,
    search,
    transforms,
)
from legcal.calibration.location.tool_poses import (
    MAX_ANGLE_SIGMA,
    MIN_SIGMA,
    ToolMeasurements,
    ToolPoses,
    read_tool_poses,
    tool_measurements,
)
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.files.schema import describe
from legcal.geometry.motions import pose_distance
from legcal.geometry.types import Array
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine

_MAX_OUTLIERS = 4  # rows per outlier at least; one outlier is always allowed
# residuals that suggest a mistake, and that are refused [spreads of positions, rad]
_LARGE_RESIDUAL, _MAX_RESIDUAL = 0.05, 0.2
_MIN_DOF = 1.0  # smallest degrees of freedom for an estimated scatter
_MAX_SIGMA, _MAX_TOOL = 2.5, 250.0  # mean leg lengths
_SAME_CHI2 = 30.0  # largest difference in chi2 of two answers that explain the poses equally well
_SAME_COST = 25.0  # largest cost of another answer, relative to the best
_ROUNDING = 1e-20
_SAME_FRAMES = 0.02  # largest difference of frames that are the same [rad, machine lengths]
_MIN_P = 1e-3  # least probability of larger residuals without a remark
_FIXED_TOLERANCE = 2.5e-12  # mean leg lengths, [rad]
_KINDS = ("positions", "orientations")


def locate(
    model: str | Path | Machine,
    poses: str | Path | ToolPoses,
    *,
    position_sigma: float | None = None,
    angle_sigma: float | None = None,
    tool_position: Sequence[float] | None = None,
) -> Location:
    """Estimate the base in the world and the tool in the platform from measured tool poses.

    The frames make the measured poses T_world_tool = T_world_base T_base_platform(q)
    T_platform_tool most likely. Rows that disagree with the others are left out and named.

    Parameters
    ----------
    model : str, Path or Machine
        The machine, as for :func:`legcal.load_mechanism`. If the file is in the result folder of a
        calibration, the covariance of its parameters is included.
    poses : str, Path or ToolPoses
        The table of measured tool poses.
    position_sigma, angle_sigma : float, optional
        Standard deviations of the measurement, a component [m], [rad]; estimated from the residuals
        if not given.
    tool_position : (3,) sequence of float, optional
        Position of the tool in the platform [m], used where the machine does not determine it; the
        origin by default.

    Returns
    -------
    Location

    Raises
    ------
    DatasetError
        If the table is malformed, or contradicts the machine.
    NotIdentifiable
        If the poses do not determine the frames but other poses of the machine would.
    """
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    _check_numbers(position_sigma, angle_sigma, tool_position, machine.size)
    measured = poses if isinstance(poses, ToolPoses) else read_tool_poses(Path(poses), machine)
    name = measured.source
    measurements = tool_measurements(
        machine,
        measured,
        name,
        position_sigma=position_sigma,
        angle_sigma=angle_sigma,
    )
    candidates = search(measurements.pairs, measurements.fewest)
    _check_plausible(measurements, candidates, name)
    inliers = find_inliers(measurements, candidates.frames[0])
    _check_outliers(measurements, inliers, name)
    used = measurements.of(inliers.is_inlier)
    frame_fit = fit(used.pairs, inliers.frames, used.noise, used.by_model)
    _check_scatter(used, frame_fit, name)
    tool = np.zeros(3) if tool_position is None else np.asarray(tool_position, dtype=np.float64)
    determined = determine(used, frame_fit, tool, name)
    _check_unique(used, determined, candidates, tool, name)
    return _judge(measurements, name, inliers, determined, tool)


def _check_numbers(
    position_sigma: float | None,
    angle_sigma: float | None,
    tool_position: Sequence[float] | None,
    size: float,  # size of the machine [m]
) -> None:
    most_sigma, most_tool = _MAX_SIGMA * size, _MAX_TOOL * size
    for name, value, lower, upper, unit in (
        ("position sigma", position_sigma, MIN_SIGMA, most_sigma, "m"),
        ("angle sigma", angle_sigma, MIN_SIGMA, MAX_ANGLE_SIGMA, "rad"),
    ):
        if value is not None and not lower <= value <= upper:
            raise UsageError(
                f"The {name} could not be used: found {value:g} {unit}, needed {lower:g} to "
                f"{upper:.3g} {unit}; correct it."
            )
    if tool_position is not None and not (
        len(tool_position) == 3 and bool(np.all(np.abs(tool_position) <= most_tool))
    ):
        raise UsageError(
            f"The tool position could not be used: found {describe(list(tool_position))}, needed "
            f"three numbers within {most_tool:.3g} m; give x, y, z in the platform."
        )


def _check_plausible(
    measurements: ToolMeasurements, candidates: FrameCandidates, name: str
) -> None:
    """Refuse poses that no frames explain, naming the likeliest mistake.

    Only the rows that agree best are considered: most rows are right, or all share one mistake.
    """
    pairs = measurements.pairs
    spread = float(np.sqrt(pairs.p.var(axis=0).sum()))
    rms = float(np.sqrt(candidates.cost[0]))  # [machine lengths, rad]
    relative = rms / min(1.0, spread / pairs.length + 1e-12)
    if relative <= _LARGE_RESIDUAL:
        return
    mistake = likely_mistake(
        pairs,
        float(candidates.cost[0]),
        measurements.fewest,
        measurements.with_columns_exchanged,
    )
    if mistake is not None:
        raise DatasetError(
            f"{name}: base and tool could not be located: found poses that look like {mistake[0]}, "
            "needed positions in metres and quaternions x, y, z, w of the tool in right-handed "
            f"axes of the world; {mistake[1]}."
        )
    if relative > _MAX_RESIDUAL:
        size = f"{1e3 * rms * pairs.length:.3g} mm"
        turn = f" or {np.degrees(rms):.3g} deg" * measurements.is_oriented
        raise DatasetError(
            f"{name}: base and tool could not be located: found poses about {size}{turn} from "
            "where the readings put them, whatever the frames, needed positions in metres and "
            "quaternions x, y, z, w of the tool in right-handed axes of the world, measured at "
            "these readings; check units, order and axes, that rows belong together, and the model."
        )


def _check_outliers(measurements: ToolMeasurements, inliers: Inliers, name: str) -> None:
    n, n_out = len(measurements.pairs), int(np.sum(~inliers.is_inlier))
    max_outliers = max(1, n // _MAX_OUTLIERS)
    if n_out <= max_outliers:
        return
    rows = ", ".join(str(i) for i in measurements.poses.numbers[~inliers.is_inlier])
    raise DatasetError(
        f"{name}: base and tool could not be located: found {n_out} of {n} rows that disagree with "
        f"the others ({rows}), needed at most {max_outliers}; check that readings and poses of "
        "these rows belong together."
    )


def _check_scatter(measurements: ToolMeasurements, frame_fit: FrameFit, name: str) -> None:
    for kind, (kind_name, option) in enumerate(
        (("positions", "--position-sigma"), ("orientations", "--angle-sigma"))
    ):
        if not measurements.noise.stated[kind] and frame_fit.kind_dof[kind] < _MIN_DOF:
            raise NotIdentifiable(
                f"{name}: the uncertainty could not be estimated: found {kind_name} of "
                f"{len(measurements.pairs)} rows that leave {frame_fit.kind_dof[kind]:.2g} degrees "
                f"of freedom, needed at least {_MIN_DOF:g}; measure more poses, or state how "
                f"precise they are with {option}."
            )


def _check_unique(
    measurements: ToolMeasurements,
    determined: Determinacy,
    candidates: FrameCandidates,
    tool: Array,
    name: str,
) -> None:
    """Refuse poses that other frames explain equally well."""
    best = determined.fit
    noise = replace(best.noise, stated=(True, True))
    for i in range(1, len(candidates.cost)):
        start = candidates.frames[i]
        if candidates.cost[i] > _SAME_COST * candidates.cost[0] + _ROUNDING:
            break
        if not determined.held and _are_one(best.frames, start, measurements.pairs.length):
            continue
        try:
            other = fit(measurements.pairs, start, noise, measurements.by_model)
            other = hold_open_part(measurements, other, tool)
        except (DidNotConverge, np.linalg.LinAlgError):
            continue
        is_other = not _are_one(best.frames, other.frames, measurements.pairs.length)
        if is_other and other.chi2 < best.chi2 + _SAME_CHI2:
            shift, turn = _apart(best.frames, other.frames)
            raise NotIdentifiable(
                f"{name}: base and tool could not be located: found two answers, "
                f"{1e3 * shift:.3g} mm and {np.degrees(turn):.3g} deg apart, that explain the "
                f"{len(measurements.pairs)} poses equally well, needed one; add poses from all "
                "over the workspace."
            )


def _are_one(frames: Array, other: Array, length: float) -> bool:
    """Return whether two answers agree up to noise."""
    shift, turn = _apart(frames, other)
    return shift <= _SAME_FRAMES * length and turn <= _SAME_FRAMES


def _apart(frames: Array, other: Array) -> tuple[float, float]:
    """Return the distance of two answers, the larger one of base and tool [m, rad]."""
    pairs = zip(transforms(frames), transforms(other), strict=True)
    shifts, turns = zip(*(pose_distance(a, b) for a, b in pairs), strict=True)
    return max(shifts), max(turns)


def _judge(
    measurements: ToolMeasurements,
    name: str,  # name of the poses in messages
    inliers: Inliers,
    determined: Determinacy,
    held_at: Array,  # (3,): position of the tool in the platform where it is not determined [m]
) -> Location:
    frame_fit, oriented = determined.fit, measurements.is_oriented
    p_value, too_large = _tested(frame_fit)
    base, tool = transforms(frame_fit.frames)
    if not oriented:
        tool = RigidTransform.from_translation(tool.translation)
    tool_position, tool_angle = _at_the_tool(measurements, determined)
    left_out = measurements.poses.numbers[~inliers.is_inlier].tolist()
    status: LocationStatus = "located in part" if determined.held else "located"
    if too_large:
        status = "doubtful"
    return Location(
        model=str(measurements.machine.yaml_path),
        poses=name,
        T_world_base=base,
        T_platform_tool=tool,
        has_tool_orientation=oriented,
        covariance=0.5 * (determined.covariance + determined.covariance.T),
        held=determined.held,
        held_at=(float(held_at[0]), float(held_at[1]), float(held_at[2])),
        held_words=determined.words,
        noise=MeasurementNoise(
            position=float(frame_fit.noise.sigma[0]),
            angle=float(frame_fit.noise.sigma[1]) if oriented else None,
            position_stated=measurements.noise.stated[0],
            angle_stated=measurements.noise.stated[1] and oriented,
            model=measurements.by_model is not None,
        ),
        rows=tuple(_rows(measurements, inliers, frame_fit)),
        chi2=frame_fit.chi2,
        dof=frame_fit.dof,
        p_value=p_value,
        tool_position_sigma=tool_position,
        tool_angle_sigma=tool_angle,
        status=status,
        sentence=_sentence(measurements, determined, left_out, too_large),
        notes=tuple(_notes(measurements, inliers, base)),
    )


def _tested(frame_fit: FrameFit) -> tuple[float | None, str]:
    """Return the probability of larger residuals, and a phrase for too large a scatter."""
    noise = frame_fit.noise
    kinds = [k for k in range(2) if noise.stated[k] and frame_fit.kind_dof[k] > 0.5]
    if not kinds:
        return None, ""
    squares = (frame_fit.whitened**2).reshape(-1, 2, 3).sum(axis=(0, 2))
    if len(kinds) == 2 or frame_fit.kind_dof.min() <= 0.5:
        total, dof = frame_fit.chi2, float(frame_fit.dof)
    else:
        total, dof = float(squares[kinds[0]]), float(frame_fit.kind_dof[kinds[0]])
    p_value = float(chdtrc(dof, total))
    ratios = np.sqrt(squares / np.maximum(frame_fit.kind_dof, 1e-300))
    large = [
        f"{_KINDS[k]} scatter {ratios[k]:.2g} times as much as was stated of them"
        for k in kinds
        if ratios[k] > 1.0
    ]
    return p_value, " and ".join(large) if p_value < _MIN_P else ""


def _rows(
    measurements: ToolMeasurements, inliers: Inliers, frame_fit: FrameFit
) -> list[RowResidual]:
    """Return the residuals of all rows; errors of the model are not subtracted."""
    pairs = measurements.pairs
    r = residuals(frame_fit.frames, pairs)
    rows = []
    for i, number in enumerate(measurements.poses.numbers.tolist()):
        reason = "" if inliers.is_inlier[i] else _off(measurements, inliers, i)
        rows.append(
            RowResidual(
                row=number,
                position=r[i, :3].tolist(),
                rotation=r[i, 3:6].tolist() if pairs.oriented[i] else None,
                left_out=reason,
            )
        )
    return rows


def _off(measurements: ToolMeasurements, inliers: Inliers, i: int) -> str:
    """Return the distance of a row from its prediction by the others, in words."""
    sigma = inliers.sigma
    distance = f"{1e3 * inliers.distance[i]:.3g} mm"
    scatter = f"{1e3 * sigma[0]:.2g} mm"
    if measurements.pairs.oriented[i]:
        distance += f" and {np.degrees(inliers.angle[i]):.3g} deg"
        scatter += f" and {np.degrees(sigma[1]):.2g} deg"
    return f"{distance} from where the other rows predict it, which scatter {scatter}"


def _at_the_tool(
    measurements: ToolMeasurements, determined: Determinacy
) -> tuple[float, float | None]:
    """Return the standard deviations of the tool in the world, rms over the poses [m], [rad]."""
    J = jacobian(determined.fit.frames, measurements.pairs)
    variance = np.einsum("nij,jk,nik->ni", J, determined.covariance, J)
    position = float(np.sqrt(variance[:, :3].sum(axis=1).mean()))
    oriented = measurements.pairs.oriented
    if not oriented.any():
        return position, None
    return position, float(np.sqrt(variance[oriented, 3:].sum(axis=1).mean()))


def _sentence(
    measurements: ToolMeasurements, determined: Determinacy, left_out: Sequence[int], too_large: str
) -> str:
    used = len(measurements.poses) - len(left_out)
    sigma = np.sqrt(np.maximum(np.diagonal(determined.covariance), 0.0)).reshape(4, 3)
    size = np.linalg.norm(sigma, axis=1)
    base = f"{1e3 * size[0]:.2g} mm and {np.degrees(size[1]):.2g} deg"
    uncertainties = [
        f"{1e3 * size[2]:.2g} mm" * bool(size[2] > _FIXED_TOLERANCE * measurements.machine.size),
        f"{np.degrees(size[3]):.2g} deg"
        * bool(measurements.is_oriented and size[3] > _FIXED_TOLERANCE),
    ]
    tool = " and ".join(words for words in uncertainties if words)
    tool = f", the tool in the platform to {tool}" if tool else ""
    tool += "" if measurements.is_oriented else " (its position only)"
    rows = f"{used} of {len(measurements.poses)} poses" if left_out else f"{used} poses"
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
        f"(1 sigma{'' if measurements.by_model is not None else ', if the model is right'})."
        f"{' ' * bool(determined.words)}{determined.words}{out}"
    )


def _notes(
    measurements: ToolMeasurements, inliers: Inliers, T_world_base: RigidTransform
) -> list[str]:
    notes = list(measurements.poses.notes)
    if not measurements.machine.spatial and T_world_base.rotation.as_matrix()[2, 2] < 0.0:
        notes.append(
            "The base lies upside down in the world, its z axis down. If it does not, the poses "
            "are mirrored, which a machine that moves in a plane cannot show: change the sign of "
            "one of their coordinates, x or y."
        )
    if measurements.by_model is None:
        notes.append(
            "Nothing is known of the errors of the model, which move all poses at once: the "
            "standard deviations hold for a model without errors; locate the model in the folder "
            "of its calibration, or state how precise the measurement is to have it tested."
        )
    if int(inliers.is_inlier.sum()) == measurements.fewest:
        notes.append(
            f"A wrong row among the {measurements.fewest} poses could not have been noticed; "
            "measure more."
        )
    return notes
