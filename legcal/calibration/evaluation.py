"""Comparison of two models: platform errors of eq (20), and every parameter.

Both models are evaluated at the same encoder readings. The difference of the poses of R_e in R_b is
the displacement of the platform joint of the first frame leg (the origin of R_e) and the angle of
the rotation between the two orientations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.documents import ComparedParameter, EvaluationDocument
from legcal.data.dataset import Dataset, load_dataset
from legcal.errors import DidNotConverge, ModelError
from legcal.geometry.motions import components, motions_of, product
from legcal.geometry.types import Array
from legcal.machine.closing import solve_poses
from legcal.machine.configurations import WORKSPACE_POSES, WORKSPACE_SEED, random_poses
from legcal.machine.kinematics import followed_poses, platforms_in_base, pose_differences
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, parametrization_of, vector_of

if TYPE_CHECKING:
    from legcal.calibration.result_folder import EarlierResult

MAX_DRAWS = 20  # largest number of draws to replace poses that the reference does not reach
FIRST_POSES = 10  # poses of the first draw; the only one if the reference reaches none of them


@brief
@dataclass(frozen=True, eq=False)
class Evaluation:
    """The distance of a model from a reference."""

    displacement: Array  # (n_poses,): Delta X of eq (20) at every pose [m]
    # (n_poses,): Delta E of eq (20), the angle of the rotation between both platforms [rad]
    rotation: Array
    names: tuple[str, ...]  # names, units: names of the parameters, and ``m`` or ``rad``
    units: tuple[str, ...]
    # values, references: (n_parameters,): the parameters of the model and of the reference. Axes
    # are turns of the reference's axis, so that the reference has zero there
    values: Array
    references: Array
    # number of poses of the dataset left out, since one of the models does not reach them
    n_left_out: int = 0
    unreached: tuple[int, ...] = ()  # the rows of these, from 1

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
            parameters=[
                ComparedParameter(name=name, value=v, reference=r, difference=v - r)
                for name, v, r in numbers
            ],
        ).document()


def evaluate(
    model: str | Path | Machine | EarlierResult,
    reference: str | Path | Machine | EarlierResult,
    *,
    dataset: str | Path | None = None,
) -> Evaluation:
    """Compare a model with a reference, eq (20).

    Parameters
    ----------
    model, reference : path, name, Machine or EarlierResult
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
    given = (x if isinstance(x, str | Path | Machine) else x.machine for x in (model, reference))
    machine, truth = (x if isinstance(x, Machine) else load_mechanism(x) for x in given)
    if different := machine_difference(truth, machine):
        raise ModelError(
            f"The models could not be compared: found {truth.name} with {different} of "
            f"{machine.name}, needed two models of one machine in the same frame; check the two "
            "paths, and legcal.base_frame."
        )
    truth = truth.with_leg_order(machine.leg_names)
    poses: list[RigidTransform] = []
    reference_poses: list[RigidTransform] = []
    n_left_out = 0
    unreached: tuple[int, ...] = ()
    if not (machine.is_determined and truth.is_determined):
        pass  # readings do not determine the platform
    elif dataset is None:
        poses, reference_poses = _random_poses(machine, truth)
    else:
        session = load_dataset(dataset, check_images=False)
        q = _readings_of(session, machine)
        poses_of_models = [_poses_at(model, q) for model in (machine, truth)]
        missed = [[T is None for T in poses_of_model] for poses_of_model in poses_of_models]
        is_left_out = np.any(missed, axis=0)
        n_left_out = int(is_left_out.sum())
        unreached = tuple((1 + np.flatnonzero(is_left_out[session.measurements.pose])).tolist())
        if n_left_out == len(q):
            raise DidNotConverge(
                f"{session.table_path}: the models could not be compared: found no row whose "
                "readings both reach, needed one; check that readings and models belong to the "
                "same machine, and legcal.home, or leave out --dataset."
            )
        poses, reference_poses = (
            [
                T
                for T, *off in zip(poses_of_model, *missed, strict=True)
                if T is not None and not any(off)
            ]
            for poses_of_model in poses_of_models
        )
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
        n_left_out,
        unreached,
    )


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


def _poses_at(machine: Machine, q: Array) -> list[RigidTransform | None]:
    """Return T_base_platform at rows of readings; None for rows that the machine cannot reach."""
    lengths = machine.lengths_at(q[:, list(machine.motors)], machine.motors)
    possible = np.flatnonzero(np.all(lengths > 0.0, axis=1)).tolist()
    poses: list[RigidTransform | None] = [None] * len(q)
    followed = followed_poses(machine, q[possible], on_the_chain=False)
    for k, (T, failure) in zip(possible, followed, strict=True):
        poses[k] = T if failure is None else None
    return poses


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
