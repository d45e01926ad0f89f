"""Where the nominal model puts the platform at the readings: the poses from which a fit starts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DatasetError
from legcal.geometry.types import Array
from legcal.mechanism.kinematics import followed_poses
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameter_words import joined
from legcal.mechanism.parametrization import geometries
from legcal.mechanism.platform import platform_in_base
from legcal.observations.measurements import Measurements
from legcal.observations.table import row_names
from legcal.refinement.constraints import pose_rows
from legcal.refinement.start import platform_poses
from legcal.refinement.state import components

MOST_MISSED = 0.03  # of the mean leg length: errors of a nominal model, but not of readings
_SAID = 3  # images that a note names


@dataclass(frozen=True, eq=False)
class NominalPoses:
    """Poses of the nominal model at readings.

    Attributes
    ----------
    T_Rb_Re : tuple of RigidTransform
        One a pose.
    missed : (n_poses,) array
        By how much legs miss what the readings and the mechanism demand, the worst of them [m];
        zero where the model reaches the readings.
    """

    T_Rb_Re: tuple[RigidTransform, ...]
    missed: Array

    def notes(self, measurements: Measurements) -> tuple[str, ...]:
        """Return what a reader should know of poses that the nominal model does not reach."""
        off = np.flatnonzero(self.missed > 0.0).tolist()
        if not off:
            return ()
        names = [_image_of(measurements, pose) for pose in off[:_SAID]]
        if len(off) > _SAID:
            names.append(f"{len(off) - _SAID} more")
        return (
            f"The nominal model does not reach the readings of {joined(names)}: its legs "
            f"miss them by up to {1e3 * float(self.missed.max()):.2f} mm at the nearest pose, from "
            "which the fit started.",
        )


def nominal_poses(mechanism: Mechanism, measurements: Measurements) -> NominalPoses:
    """Return the platform poses of a nominal model at the readings of a dataset.

    Errors of the model can put a pose out of its reach that the machine took, near a singular one
    or where its legs are stretched out. The pose with the least squares of what the legs miss
    stands for it.

    Parameters
    ----------
    mechanism : Mechanism
        The machine. Where its motors do not determine its pose, all poses are those of least
        squares from home.
    measurements : Measurements
        The readings.

    Raises
    ------
    DatasetError
        With one sentence for each image whose readings the legs would miss by more than 3 % of the
        mean leg length.
    """
    q = measurements.q[measurements.first_rows]
    if not mechanism.is_determined:
        home = [platform_in_base(mechanism, mechanism.home)] * len(q)
        return NominalPoses(_least_squares(mechanism, q, home)[0], np.zeros(len(q)))
    followed = list(followed_poses(mechanism, q))
    T = [platform_in_base(mechanism, pose) for pose, _ in followed]
    failures = [failure for _, failure in followed]
    off = [k for k, failure in enumerate(failures) if failure is not None]
    missed = np.zeros(len(q))
    if not off:
        return NominalPoses(tuple(T), missed)
    nearest, missed[off] = _least_squares(mechanism, q[off], [T[k] for k in off])
    for k, pose in zip(off, nearest, strict=True):
        T[k] = pose
    length = _mean_length(mechanism)
    problems = [
        f"The readings of {_image_of(measurements, k)} could not be used: found that the legs of "
        f"the nominal model miss them by {1e3 * missed[k]:.1f} mm at the nearest pose, needed at "
        f"most {1e3 * MOST_MISSED * length:.1f} mm; check these readings and legcal.home, or take "
        "the image out."
        for k in off
        if not missed[k] <= MOST_MISSED * length
    ]
    if problems:
        raise DatasetError(problems)
    return NominalPoses(tuple(T), missed)


def _least_squares(
    mechanism: Mechanism, q: Array, nearby: list[RigidTransform]
) -> tuple[tuple[RigidTransform, ...], Array]:
    """Return the poses at which the legs miss least, and the largest miss of each [m]."""
    legs = geometries(mechanism)
    lengths = mechanism.sign * q + mechanism.q0
    poses = platform_poses(legs, lengths, nearby, mechanism.frame_legs)
    rows = pose_rows(legs, *components(poses))
    wanted = np.where(rows.measured, (mechanism.sign * q)[:, rows.leg], 0.0)
    return poses, np.nanmax(np.abs(rows.values - wanted), axis=1, initial=0.0)


def _mean_length(mechanism: Mechanism) -> float:
    """Return the mean length of the legs at home [m]."""
    B = mechanism.home.apply(mechanism.B_platform)
    return float(np.linalg.norm(B - mechanism.A_base, axis=1).mean())


def _image_of(measurements: Measurements, pose: int) -> str:
    """Return the first image of a pose as messages name it."""
    row = int(measurements.first_rows[pose])
    view = measurements.views[measurements.view[row]]
    return f"view {view.name}, {row_names(measurements)[row]}"
