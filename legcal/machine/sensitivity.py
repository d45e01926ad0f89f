"""How errors of the parameters move the platform while the motors stand at their readings.

The equations of all legs hold before and after: F_pose d_pose + F_xi d_xi = 0. Where
there are more equations than freedoms (a 3-UPU that only translates) the platform goes where
they are met best, and the joints take up the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine.equations import demanded
from legcal.machine.leg import Demand, LegGeometry, LegKind
from legcal.machine.parameters import Parametrization

IN_SPACE = (0, 1, 2, 3, 4, 5)
IN_PLANE = (2, 3, 4)  # rotation about z of R_b and displacement along x and y
_SINGULAR = 1e-9  # of the largest singular value


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """What readings and legs demand of poses, linearised; all rows are lengths [m].

    Attributes
    ----------
    by_pose : (k, m, 6) array
        Derivative by rotation [rad] and displacement [m] of R_e in R_b.
    by_parameters : (k, m, p) array
        Derivative by the parameters.
    measured : (m,) array of bool
        The rows that hold by a reading; the others hold by the mechanism alone.
    leg : (m,) array of int
        The leg of each row.
    """

    by_pose: Array
    by_parameters: Array
    measured: BoolArray
    leg: IntArray


def freedoms(frame_legs: Sequence[int]) -> tuple[int, ...]:
    """Return which of the six components of a platform's motion in R_b are possible at all."""
    return IN_SPACE if len(frame_legs) == 3 else IN_PLANE


def pose_equations(
    legs: Sequence[LegGeometry], parametrization: Parametrization, R: Array, t: Array
) -> PoseEquations:
    """Return the equations of all legs at poses; rows without a unit count at the leg's end.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    parametrization : Parametrization
        The parameters to differentiate by.
    R, t : (k, 3, 3) and (k, 3) array
        Rotations and positions [m] of R_e in R_b.

    Returns
    -------
    PoseEquations
    """
    by_pose = [np.zeros((len(t), 0, 6))]
    by_parameters = [np.zeros((len(t), 0, len(parametrization)))]
    measured, of_leg = list[bool](), list[int]()
    for j, leg in enumerate(legs):
        found = demanded(leg, R, t)
        by_pose.append(found.by_pose)
        by_parameters.append(parametrization.scatter(found.by_local, j))
        actuated = leg.kind is LegKind.ACTUATED
        measured += [actuated and demand is Demand.LENGTH for demand in found.demands]
        of_leg += [j] * len(found.demands)
    return PoseEquations(
        np.concatenate(by_pose, axis=1),
        np.concatenate(by_parameters, axis=1),
        np.array(measured, dtype=np.bool_),
        np.array(of_leg, dtype=np.intp),
    )


def pose_sensitivity(
    legs: Sequence[LegGeometry],
    parametrization: Parametrization,
    frame_legs: Sequence[int],
    R: Array,
    t: Array,
) -> Array:
    """Return the derivative of platform poses with respect to the parameters, readings given.

    Parameters
    ----------
    legs : sequence of LegGeometry
        The legs in R_b and R_e.
    parametrization : Parametrization
        The parameters.
    frame_legs : sequence of int
        The legs that define R_b and R_e.
    R, t : (k, 3, 3) and (k, 3) array
        Rotations and positions [m] of R_e in R_b.

    Returns
    -------
    (k, 6, p) array
        Rotation vector in R_b and displacement of the origin of R_e, by each parameter.

    Raises
    ------
    NotIdentifiable
        If readings and legs do not determine a pose.
    """
    equations = pose_equations(legs, parametrization, R, t)
    columns = list(freedoms(frame_legs))
    F = equations.by_pose[:, :, columns]
    singular = np.linalg.svd(F, compute_uv=False)
    n_columns = len(columns)
    bad = np.flatnonzero(
        (singular[:, -1] < _SINGULAR * singular[:, 0]) | (singular.shape[1] < n_columns)
    )
    if len(bad):
        raise NotIdentifiable(
            f"The platform error could not be predicted: the {int(equations.measured.sum())} "
            f"readings do not determine platform pose {bad[0] + 1}, where the machine is singular "
            f"or has too few motors; {n_columns} independent equations are needed; leave this "
            "pose out."
        )
    moved = np.zeros((len(t), 6, len(parametrization)))
    moved[:, columns] = -np.linalg.pinv(F) @ equations.by_parameters
    return moved
