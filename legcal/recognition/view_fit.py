"""The camera of a view and its legs, fitted to outlines that were measured once.

Bars place a camera to some millimetres and leave out legs that have none. Outlines are far better
known: a fit of the camera, of where the view sees the joints, and of what each image adds to the
platform joints says where all legs are, how well that is known, and which legs do not fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotVisible
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.observations.outlines import Outlines
from legcal.recognition.fitted_lines import Lines, lines_of
from legcal.recognition.groups import Group
from legcal.recognition.searching import Search
from legcal.recognition.view_steps import (
    IMAGE_SIGMA,
    JOINT_SIGMA,
    Spread,
    State,
    equations_of,
    moved,
    normal_equations,
    spread_of,
    squared_distances,
)

STEPS, FIXED_STEPS = 8, 2  # of Gauss-Newton, and those before standard deviations are estimated
ROBUST = 2.0  # standard deviations from which on a leg of an image counts less
WORTH, MOST_OUTLINES = 2.0, 4  # of an outline as evidence: half a square, of a leg in an image
MISFIT = 3.5  # standard deviations from the fit, of a leg in an image
LARGEST_SHIFT = 4.0  # of a leg, in standard deviations
LONE_SHIFT = 2.5  # the same of a leg of which only single outlines were found
MOST_TURN_SIGMA = np.deg2rad(10.0)  # of a pose; before any outline it is TURN_SIGMA
SUITS = 0.85  # of the most evidence that outlines can give
SHIFT_COST = 0.25  # of shifts, less than half a square: some are the pose's
LEAST_EVIDENCE = 8.0, 1.2  # and for each image


@dataclass(frozen=True, eq=False)
class ViewFit:
    """Where a group of views sees the legs, by outlines.

    Attributes
    ----------
    T_base_group : RigidTransform
        The camera pose.
    shift : (n_legs, 2, 3) array
        Where A and B of the legs are, against the model, in the base link [m].
    covariance : (6 + 6 n_legs, 6 + 6 n_legs) array
        Of the motion of the machine about its middle in the frame of the group, rotation vector
        and displacement, and of the shifts [rad, m].
    joint_sigma : float
        Standard deviation of the joint centres of the model, as the legs show it [m].
    image_sigma : float
        Standard deviation of the platform joints in an image besides [m].
    row, leg : (n,) array of int
        Legs in images that have outlines.
    n_outlines : (n,) array of int
        How many of each.
    own : (n, 3) array
        What their images add to B [m].
    distance : (n,) array
        How far their outlines are from the fit, in standard deviations.
    middle : (3,) array
        The middle of the machine in the base link [m].
    evidence : float
        How much its outlines speak for the fit: what it is worth that each was found near where the
        fit has it, less half of the squares of how far they are off and of the shifts.
    """

    T_base_group: RigidTransform
    shift: Array
    covariance: Array
    joint_sigma: float
    image_sigma: float
    row: IntArray
    leg: IntArray
    n_outlines: IntArray
    own: Array
    distance: Array
    middle: Array
    evidence: float

    @property
    def suits(self) -> bool:
        """Whether nearly all outlines suit the fit as well as they can."""
        most = WORTH * np.minimum(self.n_outlines, MOST_OUTLINES).sum()
        return self.evidence >= SUITS * float(most)

    @property
    def misfits(self) -> BoolArray:
        """Legs in images that are too far from where the other legs have them, (n,)."""
        shift = np.abs(self.shift).max(axis=(1, 2)) / self.joint_sigma
        alone = np.ones(len(self.shift), dtype=np.bool_)
        alone[self.leg[self.n_outlines > 1]] = False
        far = shift > np.where(alone, LONE_SHIFT, LARGEST_SHIFT)
        return np.asarray((self.distance > MISFIT) | far[self.leg])

    def joints(self, A_base: Array, B_base: Array) -> tuple[Array, Array]:
        """Return joint centres (n_rows, n_legs, 3) where the images of the group see them [m]."""
        B = B_base + self.shift[:, 1]
        B[self.row, self.leg] += self.own
        return A_base + self.shift[:, 0], B

    @property
    def is_determined(self) -> bool:
        """Whether the outlines tell the pose from those around it: else legs may be others."""
        return bool(self.turn_sigma <= MOST_TURN_SIGMA)

    @property
    def turn_sigma(self) -> float:
        """Standard deviation of the rotation about the axis that is known worst [rad]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


def fit_view(
    search: Search,
    group: Group,
    T_base_group: RigidTransform,
    shift: Array,
    outlines: Outlines,
) -> ViewFit | None:
    """Fit the camera and the joints of a group of views to its used outlines.

    Parameters
    ----------
    search : Search
        The images and the model.
    group : Group
        Views that are placed together.
    T_base_group : RigidTransform
        Where they were recognised.
    shift : (n_legs, 2, 3) array
        Where A and B of the legs are, against the model, in the base link [m].
    outlines : Outlines
        Of these and other views.

    Returns
    -------
    ViewFit or None
        None without any outline.
    """
    lines = lines_of(search, group, outlines)
    if lines is None:
        return None
    middle = np.concatenate([lines.A, lines.B]).mean(axis=0)
    T = T_base_group.inv()
    begin = State(T.rotation.as_matrix(), T.translation, shift, np.zeros((lines.n_items, 3)))
    state, spread, weight = begin, Spread(JOINT_SIGMA, IMAGE_SIGMA), np.ones(lines.n_items)
    try:
        equations = equations_of(group, lines, state, middle)
        for step in range(STEPS):
            normal = normal_equations(lines, equations, state, begin, weight, spread, middle)
            state = moved(state, normal, lines, middle)
            equations = equations_of(group, lines, state, middle)
            square, own_square = squared_distances(lines, equations, state, spread.image)
            weight = 1.0 / (1.0 + square / (lines.size * ROBUST**2))
            if step >= FIXED_STEPS:
                spread = spread_of(lines, normal, state, weight, own_square)
    except NotVisible:
        return None
    normal = normal_equations(lines, equations, state, begin, weight, spread, middle)
    pose = RigidTransform.from_components(state.t, Rotation.from_matrix(state.R)).inv()
    return ViewFit(
        pose,
        state.shift,
        np.asarray(np.linalg.inv(normal.H), dtype=np.float64),
        spread.joint,
        spread.image,
        lines.item_row,
        lines.item_leg,
        lines.size // 2,
        state.own,
        np.sqrt(square / lines.size),
        middle,
        _evidence(lines, equations, state, spread),
    )


def least_evidence(group: Group) -> float:
    """Return how much evidence outlines must give: more images show more that suits by chance."""
    return LEAST_EVIDENCE[0] + LEAST_EVIDENCE[1] * len(group.rows)


def _evidence(lines: Lines, equations: tuple[Array, Array], state: State, spread: Spread) -> float:
    """Return how much outlines speak for a state, each leg of an image by itself."""
    square, _ = squared_distances(lines, equations, state, IMAGE_SIGMA)
    found = np.minimum(0.5 * lines.size, MOST_OUTLINES)
    of_legs = np.maximum(WORTH * found - 0.5 * square, 0.0).sum()
    joint = max(JOINT_SIGMA, spread.joint)
    return float(of_legs - SHIFT_COST * np.sum(state.shift**2) / joint**2)
