"""Comparison of two models: platform errors of eq (20), and every parameter.

Both models are evaluated at the same encoder readings. The difference of the poses of R_e in R_b is
the displacement of the platform joint of the first frame leg (the origin of R_e) and the angle of
the rotation between the two orientations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.documents import (
    ComparedLink,
    ComparedParameter,
    EvaluationDocument,
    ReadingResiduals,
    UnreachedRow,
)
from legcal.calibration.link_joints import compared_joints
from legcal.data.dataset import Dataset, load_dataset
from legcal.data.measurements import few, row_names
from legcal.errors import DidNotConverge, ModelError
from legcal.geometry.motions import components, motions_of, product
from legcal.geometry.types import Array
from legcal.machine.closing import solve_poses
from legcal.machine.configurations import WORKSPACE_POSES, WORKSPACE_SEED, random_poses
from legcal.machine.kinematics import followed_poses, platforms_in_base, pose_differences
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, parametrization_of, vector_of
from legcal.machine.redundancy import reading_residuals
from legcal.vision.board import Link

WHO: tuple[Literal["model", "reference"], ...] = ("model", "reference")
MAX_DRAWS = 20  # largest number of draws to replace poses that the reference does not reach
FIRST_POSES = 10  # poses of the first draw; the only one if the reference reaches none of them


@brief
@dataclass(frozen=True, eq=False)
class Evaluation:
    """The distance of a model from a reference.

    Attributes
    ----------
    displacement : (n_poses,) array
        Delta X of eq (20) at every pose [m].
    rotation : (n_poses,) array
        Delta E of eq (20), the angle of the rotation between both platforms [rad].
    names, units : tuple of str
        Names of the parameters, and ``m`` or ``rad``.
    values, references : (n_parameters,) array
        The parameters of the model and of the reference. Axes are turns of the reference's axis,
        so that the reference has zero there.
    links : dict
        By ``base`` and ``platform`` the joint centres in the links of the model, with R_b and R_e
        of both models aligned [m], and the original distance of the frames.
    n_left_out : int
        Number of poses of the dataset left out, since one of the models does not reach them.
    unreached : tuple of UnreachedRow
        The rows of the dataset with these poses, and the models that do not reach them.
    redundant_readings : dict or None
        By ``model`` and ``reference`` the residuals of redundant readings at the compared poses;
        None without a dataset or without redundant readings.
    joints_move : bool
        Whether motors move joints of the base; these are compared at zero readings.
    """

    displacement: Array
    rotation: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    references: Array
    links: dict[Link, ComparedLink]
    n_left_out: int = 0
    unreached: tuple[UnreachedRow, ...] = ()
    redundant_readings: dict[Literal["model", "reference"], ReadingResiduals] | None = None
    joints_move: bool = False

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal evaluate --json`` prints."""
        dX, dE = self.displacement, self.rotation
        numbers = zip(self.names, self.values.tolist(), self.references.tolist(), strict=True)
        return EvaluationDocument(
            dX_m=float(dX.mean()) if len(dX) else None,
            dE_rad=float(dE.mean()) if len(dX) else None,
            dX_max_m=float(dX.max()) if len(dX) else None,
            poses=len(dX),
            left_out=self.n_left_out,
            unreached=list(self.unreached),
            redundant_readings=self.redundant_readings,
            parameters=[
                ComparedParameter(name=name, value=v, reference=r, difference=v - r)
                for name, v, r in numbers
            ],
            links=self.links,
        ).document()


def evaluate(
    model: str | Path | Machine,
    reference: str | Path | Machine,
    *,
    dataset: str | Path | None = None,
) -> Evaluation:
    """Compare a model with a reference, eq (20).

    Parameters
    ----------
    model, reference : path, name or Machine
        The two mechanisms; they must have the same legs and frames.
    dataset : path, optional
        Compare at the readings of this dataset that both models reach; by default at 100 poses of
        the workspace, the same in every call.

    Returns
    -------
    Evaluation

    Raises
    ------
    ModelError
        If the two models are not of the same machine.
    DidNotConverge
        If the models reach no readings together.

    Notes
    -----
    If the motors do not determine the pose, only parameters are compared and both arrays of
    platform errors are empty.
    """
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    truth = reference if isinstance(reference, Machine) else load_mechanism(reference)
    truth = _in_the_order_of(truth, machine)
    poses: list[RigidTransform] = []
    reference_poses: list[RigidTransform] = []
    n_left_out = 0
    unreached: tuple[UnreachedRow, ...] = ()
    redundant: dict[Literal["model", "reference"], ReadingResiduals] | None = None
    if not (machine.is_determined and truth.is_determined):
        pass  # readings do not determine the platform
    elif dataset is None:
        poses, reference_poses = _random_poses(machine, truth)
    else:
        session = load_dataset(dataset, check_images=False)
        q = _readings_of(session, machine)
        poses_of_models = [_poses_at(model, q) for model in (machine, truth)]
        missed = [[T is None for T in poses_of_model] for poses_of_model in poses_of_models]
        unreached = _unreached(session, missed)
        n_left_out = sum(map(max, zip(*missed, strict=True)))
        if n_left_out == len(q):
            raise DidNotConverge(_why_none(session, unreached))
        poses, reference_poses = (
            [
                T
                for T, *off in zip(poses_of_model, *missed, strict=True)
                if T is not None and not any(off)
            ]
            for poses_of_model in poses_of_models
        )
        if machine.is_redundant:
            reached = np.flatnonzero(~np.any(missed, axis=0))
            models = zip(WHO, (machine, truth), (poses, reference_poses), strict=True)
            redundant = {who: _residuals(session, model, T, q[reached]) for who, model, T in models}
    displacement, rotation = pose_differences(
        platforms_in_base(machine, poses),
        platforms_in_base(truth, reference_poses),
    )
    parametrization = parametrization_of(truth, twists=True)
    origin = geometries(truth)
    return Evaluation(
        displacement,
        rotation,
        parametrization.names,
        parametrization.units,
        vector_of(parametrization, geometries(machine), origin),
        vector_of(parametrization, origin, origin),
        compared_joints(machine, truth),
        n_left_out,
        unreached,
        redundant,
        bool(machine.actuators),
    )


def _in_the_order_of(reference: Machine, model: Machine) -> Machine:
    if different := machine_difference(reference, model):
        raise ModelError(
            f"The models could not be compared: found {reference.name} with {different} of "
            f"{model.name}, needed two models of one machine in the same frame; check the two "
            "paths, and legcal.base_frame."
        )
    return reference.with_leg_order(model.leg_names)


def machine_difference(machine: Machine, other: Machine) -> str:
    """Return how a model differs from another one of the same machine in words; "" if it may be."""
    if set(machine.leg_names) != set(other.leg_names):
        return f"the legs {', '.join(machine.leg_names)}, not {', '.join(other.leg_names)}"
    machine = machine.with_leg_order(other.leg_names)
    for leg, other_leg in zip(machine.legs, other.legs, strict=True):
        words, other_words = (f"{x.name} ({x.kind}, {x.type})" for x in (leg, other_leg))
        if words != other_words:
            return f"the leg {words}, not {other_words}"
    frames = [[m.leg_names[j] for j in m.frame_legs] for m in (machine, other)]
    if frames[0] != frames[1]:
        return f"base_frame {', '.join(frames[0])}, not {', '.join(frames[1])}"
    return ""


def _readings_of(dataset: Dataset, machine: Machine) -> Array:
    """Return one row of readings for each pose of a dataset, in the mechanism's leg order [m]."""
    names = list(dataset.machine.leg_names)
    missing = [name for name in machine.leg_names if name not in names]
    if missing:
        raise ModelError(
            f"The models could not be compared at the readings of {dataset.folder}: its mechanism "
            f"has no {', '.join(missing)}; the dataset must belong to the same machine."
        )
    legs = [names.index(name) for name in machine.leg_names]
    return dataset.measurements.q_of_poses[:, legs]


def _residuals(
    dataset: Dataset, machine: Machine, poses: Sequence[RigidTransform], q: Array
) -> ReadingResiduals:
    """Return the residuals of redundant readings (n_poses, n_legs) at poses T_base_platform."""
    motors = list(machine.motors)
    legs = [machine.legs[j] for j in motors]
    rows = zip(poses, q, strict=True)
    residuals = np.array([reading_residuals(machine, T, row)[motors] for T, row in rows])
    sigma = dataset.measurements.sigma_of(legs)
    moved = residuals / [leg.reading_of(1.0) for leg in legs]
    rms, rms_m = (float(np.sqrt(np.mean(x**2))) for x in (residuals / sigma, moved))
    expected = float(np.sqrt(1.0 - machine.mobility / len(motors)))
    return ReadingResiduals(rms=rms, rms_expected=expected, rms_m=rms_m)


def _poses_at(machine: Machine, q: Array) -> list[RigidTransform | None]:
    """Return T_base_platform at rows of readings; None for rows that the machine cannot reach."""
    lengths = machine.lengths_at(q[:, list(machine.motors)], machine.motors)
    possible = np.flatnonzero(np.all(lengths > 0.0, axis=1)).tolist()
    poses: list[RigidTransform | None] = [None] * len(q)
    followed = followed_poses(machine, q[possible], on_the_chain=False)
    for k, (T, failure) in zip(possible, followed, strict=True):
        poses[k] = T if failure is None else None
    return poses


def _unreached(dataset: Dataset, missed: Sequence[Sequence[bool]]) -> tuple[UnreachedRow, ...]:
    m = dataset.measurements
    names = row_names(m)
    return tuple(
        UnreachedRow(row=row + 1, view=m.views[m.view[row]].name, image=names[row], by=by)
        for row, pose in enumerate(m.pose.tolist())
        if (by := [who for who, off in zip(WHO, missed, strict=True) if off[pose]])
    )


def _why_none(dataset: Dataset, unreached: Sequence[UnreachedRow]) -> str:
    """Return the error of two models that share no reachable reading of a dataset."""
    by = [
        f"the {who} does not reach row{'s' * (len(rows) > 1)} {few(rows)}"
        for who in WHO
        if (rows := [str(row.row) for row in unreached if who in row.by])
    ]
    return (
        f"{dataset.table_path}: the models could not be compared: found that {' and '.join(by)}, "
        "needed a row whose readings both reach; check that readings and models belong to the "
        "same machine, and legcal.home, or leave out --dataset."
    )


def _near(
    reference: Machine, machine: Machine, q: Array, poses: Sequence[RigidTransform]
) -> list[RigidTransform]:
    """Return the poses of a redundant model at readings, nearest to those of another model."""
    R, t = components(platforms_in_base(machine, poses))
    solved = solve_poses(geometries(reference), reference.frame_legs, R, t, reference.sign * q)
    to_link = reference.T_platform_Re.inv()
    return [product(reference.T_base_Rb, T, to_link) for T in motions_of(solved.R, solved.t)]


def _random_poses(
    machine: Machine, reference: Machine
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """Return platform poses of both models at the same random readings inside the travel."""
    names = sorted(machine.leg_names)
    machine, reference = machine.with_leg_order(names), reference.with_leg_order(names)
    rng = np.random.default_rng(WORKSPACE_SEED)
    poses: list[RigidTransform] = []
    reference_poses: list[RigidTransform] = []
    for draw in range(MAX_DRAWS):
        if draw > 0 and not poses:
            break
        count = WORKSPACE_POSES - len(poses) if draw > 0 else FIRST_POSES
        q, drawn = random_poses(machine, count, rng)
        reference_poses_drawn = list(followed_poses(reference, q, on_the_chain=False))
        if reference.is_redundant:  # followed from home it may be another pose of these readings
            reference_poses_drawn = [(T, None) for T in _near(reference, machine, q, drawn)]
        for T, (reference_T, failure) in zip(drawn, reference_poses_drawn, strict=True):
            if failure is None:  # else the reference cannot have these lengths at the same time
                poses.append(T)
                reference_poses.append(reference_T)
        if len(poses) == WORKSPACE_POSES:
            return poses, reference_poses
    raise DidNotConverge(
        f"The models could not be compared: only {len(poses)} of {WORKSPACE_POSES} random poses "
        "inside the travel could be reached by both; compare at the readings of a dataset with "
        "--dataset."
    )
