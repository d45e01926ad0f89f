"""How far apart two models are: platform errors of eq (20), and every parameter.

Both models are given the same encoder readings. Each answers with the pose of R_e in R_b;
the difference is the displacement of the platform joint of the first frame leg (the origin of
R_e) and the angle of the rotation between the two orientations.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.documents import ComparedParameter, EvaluationDocument
from legcal.data import Dataset, load_dataset
from legcal.errors import DidNotConverge, ModelError
from legcal.geometry import Array
from legcal.machine import (
    WORKSPACE_POSES,
    WORKSPACE_SEED,
    Machine,
    forward_kinematics,
    forward_kinematics_many,
    geometries,
    load_mechanism,
    parametrization_of,
    platforms_in_base,
    pose_differences,
    random_poses,
    vector_of,
)

MAX_DRAWS = 20  # of poses in place of those that the reference does not reach
FIRST_POSES = 10  # of the first draw: if the reference reaches none of them, there is no other


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
    """

    displacement: Array
    rotation: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    references: Array

    def document(self) -> dict[str, Any]:
        """Return the document that ``legcal evaluate --json`` prints."""
        dX, dE = self.displacement, self.rotation
        numbers = zip(self.names, self.values.tolist(), self.references.tolist(), strict=True)
        return EvaluationDocument(
            dX_m=float(dX.mean()) if len(dX) else None,
            dE_rad=float(dE.mean()) if len(dX) else None,
            dX_max_m=float(dX.max()) if len(dX) else None,
            poses=len(dX),
            parameters=[
                ComparedParameter(name=name, value=v, reference=r, difference=v - r)
                for name, v, r in numbers
            ],
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
        Take the readings of this dataset; else those of 100 poses of the workspace, which are
        the same at every call.

    Returns
    -------
    Evaluation

    Raises
    ------
    ModelError
        If the two models are not of the same machine.
    DidNotConverge
        If a model cannot reach a reading.

    Notes
    -----
    Where the motors do not determine the pose only parameters are compared: both arrays of
    platform errors are empty then.
    """
    machine = model if isinstance(model, Machine) else load_mechanism(model)
    truth = reference if isinstance(reference, Machine) else load_mechanism(reference)
    truth = _in_the_order_of(truth, machine)
    poses: list[RigidTransform] = []
    reference_poses: list[RigidTransform] = []
    if not (machine.is_determined and truth.is_determined):
        pass  # no reading says where the platform is
    elif dataset is None:
        poses, reference_poses = _random_poses(machine, truth)
    else:
        q = _readings_of(load_dataset(dataset, check_images=False), machine)
        poses = forward_kinematics_many(machine, q)
        reference_poses = forward_kinematics_many(truth, q)
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
    )


def _in_the_order_of(reference: Machine, model: Machine) -> Machine:
    """Return the reference with legs and frame legs in the model's order."""
    if set(reference.leg_names) != set(model.leg_names):
        raise ModelError(
            f"The models could not be compared: {model.name} has the legs "
            f"{', '.join(model.leg_names)} and {reference.name} has "
            f"{', '.join(reference.leg_names)}; both must describe the same machine; "
            "check the two paths."
        )
    reference = reference.with_leg_order(model.leg_names)
    if reference.frame_legs != model.frame_legs:
        found = " and ".join(
            ", ".join(m.leg_names[leg] for leg in m.frame_legs) for m in (model, reference)
        )
        raise ModelError(
            f"The models could not be compared: their base_frame legs differ ({found}); "
            "coordinates mean the same only in the same frame; give both the same base_frame."
        )
    different = [
        f"{one.name} is {one.kind} {one.type} and {other.kind} {other.type}"
        for one, other in zip(model.legs, reference.legs, strict=True)
        if (one.type, one.kind) != (other.type, other.kind)
    ]
    if different or model.spatial != reference.spatial:
        found = "; ".join(different) or "one is spatial and the other planar"
        raise ModelError(
            f"The models could not be compared: {found}; both must describe the same machine; "
            "check the two paths."
        )
    return reference


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
    return dataset.measurements.q[dataset.measurements.first_rows][:, legs]


def _random_poses(
    machine: Machine, reference: Machine
) -> tuple[list[RigidTransform], list[RigidTransform]]:
    """Return platform poses of both models at the same random readings inside the travel."""
    names = sorted(machine.leg_names)
    machine, reference = machine.with_leg_order(names), reference.with_leg_order(names)
    rng = np.random.default_rng(WORKSPACE_SEED)
    poses: list[RigidTransform] = []
    reference_poses: list[RigidTransform] = []
    for turn in range(MAX_DRAWS):
        if turn > 0 and not poses:
            break
        count = WORKSPACE_POSES - len(poses) if turn > 0 else FIRST_POSES
        for q, T in zip(*random_poses(machine, count, rng), strict=True):
            try:
                reference_poses.append(forward_kinematics(reference, q))
            except DidNotConverge:  # the reference cannot have these lengths at the same time
                continue
            poses.append(T)
        if len(poses) == WORKSPACE_POSES:
            return poses, reference_poses
    raise DidNotConverge(
        f"The models could not be compared: only {len(poses)} of {WORKSPACE_POSES} random poses "
        "inside the travel could be reached by both; compare at the readings of a dataset with "
        "--dataset."
    )
