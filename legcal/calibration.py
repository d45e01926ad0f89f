"""What a calibration gives: parameters with their uncertainty, and whether to believe them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.dataset.folder import Dataset
from legcal.geometry.types import IntArray
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.leg_geometry import LegGeometry
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameters import KinematicParameters, parameter_names, radius_name
from legcal.mechanism.parametrization import geometries, parametrization_of
from legcal.mechanism.platform import platform_in_base, pose_differences
from legcal.observations.canonical_order import (
    Order,
    inverse,
    reorder_measurements,
    restore_outlines,
)
from legcal.refinement.held_out import HeldOut
from legcal.refinement.platform_error import PlatformError, predict_platform_error
from legcal.refinement.solution import Solution

TRUSTED_SIGMAS = 2.0  # the predicted improvement must exceed so many of its standard deviations


@dataclass(frozen=True, eq=False)
class Steps:
    """What the four steps give by themselves.

    Attributes
    ----------
    parameters : KinematicParameters or None
        None if the steps could not be run to the end.
    T_Rb_camera : tuple of RigidTransform or None
        The cameras that step 2 places; None as a whole if the steps failed.
    failure : str
        Why they failed; "" if they did not.
    diagnostics : tuple of str
        What they left out, and why.
    """

    parameters: KinematicParameters | None
    T_Rb_camera: tuple[RigidTransform | None, ...] | None
    failure: str
    diagnostics: tuple[str, ...] = ()

    def in_file_order(self, order: Order) -> Steps:
        """Return the same with legs and views in the order of the files."""
        legs, views = inverse(order.legs), inverse(order.views)
        return replace(
            self,
            parameters=None if self.parameters is None else permuted(self.parameters, legs),
            T_Rb_camera=None
            if self.T_Rb_camera is None
            else tuple(self.T_Rb_camera[v] for v in views.tolist()),
        )


@dataclass(frozen=True)
class Verdict:
    """Whether the calibrated model should replace the nominal one.

    Attributes
    ----------
    trustworthy : bool
        The predicted improvement exceeds two of its standard deviations.
    sentence : str
        The same, for people.
    """

    trustworthy: bool
    sentence: str


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of :func:`legcal.calibrate`, in the order of the files.

    Attributes
    ----------
    dataset : Dataset
        What it was computed from; its ``mechanism`` is the nominal model.
    solution : Solution
        The fit of everything: parameters, covariance, cameras, platform poses, radii.
    steps : Steps
        What the four steps gave.
    change : PlatformError
        How far the platform of the calibrated model is from that of the nominal one, at the
        readings of the dataset [m, rad].
    sigma : PlatformError
        Predicted error of the calibrated platform there, one standard deviation [m, rad].
    verdict : Verdict
        Whether to use it.
    notes : tuple of str
        What else a reader should know.
    held_out : HeldOut or None
        What images that were kept aside say of the fit; None where there are none.
    """

    dataset: Dataset
    solution: Solution
    steps: Steps
    change: PlatformError
    sigma: PlatformError
    verdict: Verdict
    notes: tuple[str, ...]
    held_out: HeldOut | None = None


def permuted(parameters: KinematicParameters, legs: IntArray) -> KinematicParameters:
    """Return parameters whose leg k is leg ``legs[k]`` of the given ones."""
    return KinematicParameters(
        parameters.base_joints[legs], parameters.platform_joints[legs], parameters.offsets[legs]
    )


def in_file_order(solution: Solution, order: Order, dataset: Dataset) -> Solution:
    """Return a solution found in the order of work, in the order of the dataset's files."""
    mechanism = dataset.mechanism
    legs, views = inverse(order.legs), inverse(order.views)
    estimated = set(solution.names)
    by_leg = {int(leg): k for k, leg in enumerate(legs)}
    radii = {(by_leg[leg], part): value for (leg, part), value in solution.radii.items()}
    radii = dict(sorted(radii.items()))
    names = tuple(
        name
        for name in (
            *parameter_names(mechanism.leg_names, mechanism.frame_legs),
            *(radius_name(mechanism.leg_names[leg], part) for leg, part in radii),
        )
        if name in estimated
    )
    where = np.array([solution.names.index(name) for name in names], dtype=np.intp)
    poses = _poses_in_file_order(order, dataset)
    return replace(
        solution,
        parameters=permuted(solution.parameters, legs),
        T_camera_Rb=tuple(solution.T_camera_Rb[v] for v in views.tolist()),
        T_Rb_Re=tuple(solution.T_Rb_Re[p] for p in poses.tolist()),
        radii=radii,
        names=names,
        covariance=solution.covariance[np.ix_(where, where)],
        sigma=solution.sigma[where],
        outlines=restore_outlines(solution.outlines, order),
    )


def judge(dataset: Dataset, solution: Solution, steps: Steps, notes: Sequence[str]) -> Calibration:
    """Return the calibration with its verdict.

    The improvement that the fit predicts is the distance between the nominal and the
    calibrated platform at the readings of the dataset; it counts where it exceeds two of its
    standard deviations.
    """
    mechanism = dataset.mechanism
    q = dataset.measurements.q[dataset.measurements.first_rows]
    nominal = [platform_in_base(mechanism, T) for T in forward_kinematics_many(mechanism, q)]
    displacement, rotation = pose_differences(solution.T_Rb_Re, nominal)
    change = PlatformError(displacement, rotation)
    sigma = predict_platform_error(
        _legs(mechanism, solution.parameters),
        parametrization_of(mechanism),
        solution.kinematic_covariance,
        mechanism.frame_legs,
        solution.T_Rb_Re,
    )
    return Calibration(
        dataset, solution, steps, change, sigma, _verdict(change, sigma), tuple(notes)
    )


def _legs(mechanism: Mechanism, parameters: KinematicParameters) -> list[LegGeometry]:
    """Return the legs of a mechanism with calibrated joints and offsets."""
    found = zip(
        geometries(mechanism),
        parameters.base_joints,
        parameters.platform_joints,
        parameters.offsets,
        strict=True,
    )
    return [replace(leg, A=A, B=B, q0=float(q0)) for leg, A, B, q0 in found]


def _verdict(change: PlatformError, sigma: PlatformError) -> Verdict:
    """Compare the change of the platform with its uncertainty, in displacement."""
    improvement, one_sigma = change.mean_displacement, sigma.mean_displacement
    found = (
        f"the platform moves by {1e3 * improvement:.3f} mm / "
        f"{np.degrees(change.mean_rotation):.4f} deg against the nominal model, known to "
        f"{1e3 * one_sigma:.3f} mm / {np.degrees(sigma.mean_rotation):.4f} deg (1 sigma)"
    )
    if improvement > TRUSTED_SIGMAS * one_sigma:
        return Verdict(True, f"Calibrated: {found}.")
    return Verdict(
        False,
        f"Do not load this into the controller: {found}, and a predicted improvement below two "
        "sigma is no improvement; take more images or better ones.",
    )


def _poses_in_file_order(order: Order, dataset: Dataset) -> IntArray:
    """Return for every pose of the dataset its number in the order of work."""
    pose = dataset.measurements.pose
    worked = reorder_measurements(dataset.measurements, order).pose[inverse(order.rows)]
    found = np.empty(dataset.measurements.n_poses, dtype=np.intp)
    found[pose] = worked
    return found
