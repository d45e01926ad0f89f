"""What the poses leave open in step 4: refused where it moves the platform, else held at nominal.

The axes of a 3-UPU that only translates are an example: the poses show the difference of its axes
on base and platform and not both, and the platform does not move with what they do not
show. Steps hold such directions where the nominal model has them, and name them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import combinations

import casadi as ca
import numpy as np

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.machine import (
    N_LOCAL,
    SHOWN,
    Demand,
    LegGeometry,
    Parametrization,
    describe_direction,
    parametrize,
    pose_sensitivity,
    sparse_basis,
    split_by_motion,
    tied_twist,
)
from legcal.paper.joints_in_base import JointsInBase, distance_of_ends_and_joints
from legcal.paper.joints_in_camera import JointsInCamera
from legcal.paper.leg_directions import LegDirections
from legcal.paper.nominal import NominalMechanism
from legcal.paper.offsets import (
    base_spread,
    distance_sigma,
    leg_end_covariance,
    leg_ends,
    observed_legs,
    spread_of_demands,
)
from legcal.paper.platform_pose import (
    PlatformPoses,
    Transformation,
    direction_of_leg,
    fixed_on_platform,
    length_of_leg,
    locate_platform,
    revolute_on_platform,
    twist_of_leg,
)
from legcal.paper.solver import LeastSquares, Term, whitener

B_COLUMNS, LENGTH, BASE_TURNS, PLATFORM_TURNS, TWIST = slice(3, 6), 6, slice(7, 9), slice(9, 11), 11


@dataclass(frozen=True, eq=False)
class PlatformUnknowns:
    """Where the numbers of each leg stand among the shared unknowns of step 4.

    Attributes
    ----------
    parametrization : Parametrization
        All parameters of the mechanism.
    parameters : (n,) array of int
        Which of them are unknowns of step 4, rising: free coordinates of B [m], offsets and
        lengths [m], turns of universal axes at the base and of axes at the platform, changes
        of twists [rad].
    nominal : tuple of LegGeometry
        What turns of axes and changes of twists count from.
    """

    parametrization: Parametrization
    parameters: IntArray
    nominal: tuple[LegGeometry, ...]

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def place(self) -> IntArray:
        """Place of each leg's twelve numbers among the unknowns, (n_legs, 12); -1 if known."""
        place = np.full(len(self.parametrization) + 1, -1, dtype=np.intp)
        place[self.parameters] = np.arange(len(self))
        return np.asarray(place[self.parametrization.place])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.parametrization.names[i] for i in self.parameters)

    @property
    def is_angle(self) -> BoolArray:
        """Which unknowns are angles [rad] and no lengths [m], (n,)."""
        return np.array([self.parametrization.units[i] == "rad" for i in self.parameters])

    @property
    def held(self) -> Array:
        """Coordinates of B that are no unknowns, at nominal, (n_legs, 3) [m]; zero the others."""
        B = np.array([leg.B for leg in self.nominal])
        return np.where(self.place[:, B_COLUMNS] < 0, B, 0.0)

    def vector(self, legs: Sequence[LegGeometry]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = np.zeros(self.place.shape)
        for row, leg, nominal in zip(local, legs, self.nominal, strict=True):
            row[B_COLUMNS], row[LENGTH] = leg.B, leg.q0
            row[BASE_TURNS] = turns_of(leg.base_axis, nominal.base_axis)
            row[PLATFORM_TURNS] = turns_of(leg.platform_axis, nominal.platform_axis)
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[LegGeometry]) -> tuple[LegGeometry, ...]:
        """Return legs with the unknowns at values x (n,)."""
        padded = np.append(x, 0.0)
        found = []
        for leg, nominal, place, B in zip(legs, self.nominal, self.place, self.held, strict=True):
            local = padded[place]
            moved = replace(
                leg,
                B=local[B_COLUMNS] + B,
                q0=float(local[LENGTH]) if place[LENGTH] >= 0 else leg.q0,
                base_axis=leg.base_axis
                if place[BASE_TURNS.start] < 0
                else turned_axis(nominal.base_axis, local[BASE_TURNS]),
                platform_axis=turned_axis(nominal.platform_axis, local[PLATFORM_TURNS]),
            )
            if nominal.twist is not None:
                moved = replace(
                    moved, twist=tied_twist(moved, nominal, nominal.twist + float(local[TWIST]))
                )
            found.append(moved)
        return tuple(found)


def platform_unknowns(
    mechanism: NominalMechanism, *, free_twists: bool = False
) -> PlatformUnknowns:
    """Return the unknowns of step 4 of a mechanism; twists are held unless they are freed."""
    legs = mechanism.legs
    everything = parametrize(mechanism.leg_names, legs, mechanism.frame_legs, twists=free_twists)
    wanted = np.ones((len(legs), N_LOCAL), dtype=np.bool_)
    wanted[:, :3] = False
    wanted[:, BASE_TURNS] = np.array([[leg.base_joint != "R"] for leg in legs])
    place = everything.place[wanted & (everything.place >= 0)]
    return PlatformUnknowns(everything, np.sort(place), legs)


def turns_of(axis: Array | None, nominal: Array | None) -> Array:
    """Return the two turns that take a nominal axis to an axis, both as lines, (2,).

    They are twice the Gibbs vector of the smallest rotation, along the :func:`normal_basis` of
    the nominal axis: its rotation vector but for the cube of the angle, without a root.
    """
    if axis is None or nominal is None:
        return np.zeros(2)
    axis = axis if axis @ nominal > 0.0 else -axis
    gibbs = np.cross(nominal, axis) / (1.0 + float(nominal @ axis))
    return np.asarray(2.0 * normal_basis(nominal) @ gibbs)


def turned_axis(nominal: Array | None, turns: Array) -> Array | None:
    """Return the axis to which two turns take the nominal one; see :func:`turns_of`."""
    if nominal is None or not turns.any():
        return nominal
    gibbs = 0.5 * turns @ normal_basis(nominal)
    across = np.cross(gibbs, nominal)
    axis = nominal + 2.0 / (1.0 + gibbs @ gibbs) * (across + np.cross(gibbs, across))
    return np.asarray(axis / np.linalg.norm(axis))


IN_PLANE = np.array([0, 1, -1, -1, -1, 2])  # of displacement and turn of a planar platform


@dataclass(frozen=True, eq=False)
class RigidProblem:
    """What the rigid criterion is built of.

    Attributes
    ----------
    mechanism : NominalMechanism
        The legs with what steps 2 and 3 found of them: A and revolute axes of the base in R_b,
        offsets and lengths.
    unknowns : PlatformUnknowns
        Where the unknowns stand.
    directions : LegDirections
        Legs of each pose.
    poses : PlatformPoses
        Platform poses to start from.
    in_base : (n,) array of bool
        Which of the legs stand in R_b: twists count for these.
    spread : (n, 3, 3) array
        Covariance of A of each [m^2].
    sigma_q : float
        Standard deviation of a reading [m].
    """

    mechanism: NominalMechanism
    unknowns: PlatformUnknowns
    directions: LegDirections
    poses: PlatformPoses
    in_base: BoolArray
    spread: Array
    sigma_q: float

    def index(self, rows: IntArray) -> IntArray:
        """Return the places of B and of the step of the pose of some of the legs, (k, 9)."""
        own = np.arange(6) if self.mechanism.spatial else IN_PLANE
        first = len(self.unknowns) + (own.max() + 1) * self.poses.pose[rows, None]
        steps = np.where(own >= 0, first + own, -1)
        return np.hstack([self.unknowns.place[self.directions.leg[rows], B_COLUMNS], steps])

    def known(self, rows: IntArray) -> tuple[Array, Array, Array, Array]:
        """Return what is known of some of the legs: B in part, the pose at step zero, and A."""
        pose, held = self.poses.pose[rows], self.unknowns.held[self.directions.leg[rows]]
        return held, self.poses.R[pose], self.poses.t[pose], self.directions.A[rows]

    def sigma(self, rows: IntArray, demand: Demand, least: float) -> Array:
        """Return standard deviations of a demand: at least one, and what A is wrong by."""
        of_A = spread_of_demands(
            self.mechanism.legs, self.directions, self.poses, self.spread, rows, demand
        )
        return np.asarray(np.sqrt(least**2 + of_A))

    def poses_in_base(self, x: Array) -> tuple[Array, Array]:
        """Return R and t of the poses of groups in R_b, from the unknowns of all poses."""
        steps = np.zeros((len(self.poses.R), 6))
        own = np.arange(6) if self.mechanism.spatial else IN_PLANE
        steps[:, own >= 0] = x.reshape(len(steps), own.max() + 1)
        numbers = np.unique(self.poses.pose[self.in_base])
        return self.poses.stepped(steps, numbers[numbers >= 0])


def rigid_problem(
    known: NominalMechanism,
    joints: JointsInCamera,
    base: JointsInBase,
    directions: LegDirections,
    sigma_q: float,
    *,
    transformation: Transformation = "points",
    free_twists: bool = False,
) -> RigidProblem:
    """Gather what the rigid criterion is built of, platform poses to start from among it.

    Parameters
    ----------
    known : NominalMechanism
        The mechanism with what steps 2 and 3 found of it.
    joints : JointsInCamera
        The result of step 1: how exactly A is known.
    base : JointsInBase
        The result of step 2: where the cameras stand.
    directions : LegDirections
        Legs of each pose.
    sigma_q : float
        Standard deviation of a reading [m].
    transformation : {"points", "cross_product"}
        How the poses to start from are computed, see
        :func:`legcal.paper.platform_pose.locate_platform`.
    free_twists : bool
        Count twists among the unknowns.

    Raises
    ------
    DidNotConverge
        If IPOPT does not.
    """
    placed = np.array([T is not None for T in base.T_Rb_camera])
    centre = np.zeros((len(directions), 3))
    for v, T in enumerate(base.T_Rb_camera):
        if T is not None:
            centre[directions.view == v] = T.translation
    q0, spread = known.parameters.offsets, base_spread(directions, joints, base)
    covariance = leg_end_covariance(directions, q0, sigma_q) + spread
    poses = locate_platform(
        directions,
        leg_ends(directions, q0),
        known.parameters.platform_joints,
        centre=centre,
        transformation=transformation,
        spatial=known.spatial,
        on_a_line=True,
        weight=1.0 / np.einsum("nii->n", covariance),
    )
    unknowns = platform_unknowns(known, free_twists=free_twists)
    in_base = placed[directions.view]
    return RigidProblem(known, unknowns, directions, poses, in_base, spread, sigma_q)


_EXACT = 1e-5  # [rad] floor of the sigma of a demand: keeps exact base joints well conditioned


def demand_terms(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return what joints demand of legs whose poses are unknown, in standard deviations."""
    legs, leg = rigid.mechanism.legs, rigid.directions.leg[rows]
    revolute = np.array([g.platform_joint == "R" and g.platform_axis is not None for g in legs])
    fixed = np.array([g.platform_joint == "" and g.platform_axis is not None for g in legs])
    kinds = {
        (g.base_joint, g.platform_joint): np.array(
            [
                h.twist is not None
                and (h.base_joint, h.platform_joint) == (g.base_joint, g.platform_joint)
                for h in legs
            ]
        )
        for g in legs
        if g.twist is not None
    }
    terms = [
        _platform_axis_term(rigid, rows[revolute[leg]], revolute_on_platform()),
        _platform_axis_term(rigid, rows[fixed[leg]], fixed_on_platform()),
    ]
    for joints, of_kind in kinds.items():
        here = rows[of_kind[leg] & rigid.in_base[rows]]
        terms.append(_twist_term(rigid, here, twist_of_leg(*joints)))
    return [term for term in terms if len(term.index)]


def _platform_axis_term(rigid: RigidProblem, rows: IntArray, function: ca.Function) -> Term:
    """Return the residuals of axes, or of fixed directions, on the platform."""
    leg = rigid.directions.leg[rows]
    place = rigid.unknowns.place[leg, PLATFORM_TURNS]
    axis, basis = axes_with_bases(rigid.unknowns.nominal, leg, "platform_axis")
    kind = Demand.PLATFORM_AXIS if function is revolute_on_platform() else Demand.ALONG_1
    sigma = rigid.sigma(rows, kind, _EXACT)
    index = np.hstack([rigid.index(rows), place])
    return Term(function, index, (*rigid.known(rows), axis, basis, sigma))


def _twist_term(rigid: RigidProblem, rows: IntArray, function: ca.Function) -> Term:
    """Return the residuals of twists."""
    leg, legs = rigid.directions.leg[rows], rigid.unknowns.nominal
    place = rigid.unknowns.place[leg]
    turns = (place[:, PLATFORM_TURNS], place[:, BASE_TURNS], place[:, TWIST, None])
    return Term(
        function,
        np.hstack([rigid.index(rows), *turns]),
        (
            *rigid.known(rows),
            *axes_with_bases(legs, leg, "base_axis"),
            *axes_with_bases(legs, leg, "platform_axis"),
            np.array([float(legs[j].twist or 0.0) for j in leg]),
            rigid.sigma(rows, Demand.TWIST, _EXACT),
        ),
    )


def axes_with_bases(
    legs: tuple[LegGeometry, ...], leg: IntArray, which: str
) -> tuple[Array, Array]:
    """Return ``base_axis`` or ``platform_axis`` of legs and what turns of it are about.

    Parameters
    ----------
    legs : tuple of LegGeometry
        The legs.
    leg : (n,) array of int
        Which of them.
    which : str
        Name of the attribute.

    Returns
    -------
    (n, 3) array, (n, 2, 3) array
    """
    axes = np.array([getattr(legs[j], which) for j in leg]).reshape(-1, 3)
    return axes, normal_basis(axes)


_RELATIVE = 1e-5  # of the mean length: floor of the sigma of a length, keeps it well conditioned
APART = 1e-3  # mean leg lengths: nearer joints count as one, whose distance has no direction


def build_rigid(rigid: RigidProblem) -> LeastSquares:
    """Build the rigid criterion.

    Parameters
    ----------
    rigid : RigidProblem
        What it is built of; its legs are the start.

    Returns
    -------
    LeastSquares
        Residuals in standard deviations.

    Raises
    ------
    NotIdentifiable
        If no pose shows two legs at once.
    """
    posed = np.flatnonzero(rigid.poses.pose >= 0)
    pairs = _pairs_without_pose(rigid)
    if not len(posed) and not len(pairs):
        raise NotIdentifiable(
            "The platform joints could not be located: no pose shows two legs at once; needed "
            "images of three or more; add images that show several legs at once."
        )
    terms = [_pairs_term(rigid, pairs), *_leg_terms(rigid, posed)]
    terms += demand_terms(rigid, posed)
    x = rigid.unknowns.vector(rigid.mechanism.legs)
    n_own = 6 if rigid.mechanism.spatial else 3
    return LeastSquares(
        "The platform joints (step 4)",
        tuple(terms),
        np.concatenate([x, np.zeros(n_own * len(rigid.poses.R))]),
        n_shared=len(x),
    )


def _pairs_without_pose(rigid: RigidProblem) -> IntArray:
    """Return the pairs of legs (n, 2) of groups without a pose: distances are all they tell."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    without = np.isfinite(q0[directions.leg]) & (rigid.poses.pose < 0)
    B = rigid.mechanism.parameters.platform_joints[directions.leg]
    apart = APART * float(np.mean(q0[np.isfinite(q0)]))
    pairs = [
        (a, b)
        for rows in directions.groups()
        for a, b in combinations(rows[without[rows]].tolist(), 2)
        if np.linalg.norm(B[a] - B[b]) > apart
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _pairs_term(rigid: RigidProblem, pairs: IntArray) -> Term:
    """Return the residuals of pairs of legs (n_pairs, 2), whose distance is all they tell."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    ends = leg_ends(directions, q0)
    covariance = leg_end_covariance(directions, q0, rigid.sigma_q)
    place = rigid.unknowns.place[directions.leg[pairs]]
    index = np.hstack([place[:, :, LENGTH], place[:, :, B_COLUMNS].reshape(-1, 6)])
    observed = (observed_legs(directions, pairs), distance_sigma(ends, covariance, pairs))
    return Term(distance_of_ends_and_joints(), index, observed, robust=True)


def _leg_terms(rigid: RigidProblem, rows: IntArray) -> list[Term]:
    """Return the residuals of directions and of lengths of the legs whose poses are unknown."""
    directions, q0 = rigid.directions, rigid.mechanism.parameters.offsets
    index, known = rigid.index(rows), rigid.known(rows)
    seen = (directions.u[rows], directions.basis[rows], whitener(directions.covariance[rows]))
    end = np.isfinite(q0[directions.leg[rows]])
    sigma = float(np.hypot(rigid.sigma_q, _RELATIVE * np.mean(q0[np.isfinite(q0)])))
    place = rigid.unknowns.place[directions.leg[rows], LENGTH]
    return [
        Term(direction_of_leg(), index, (*known, *seen), robust=True),
        Term(
            length_of_leg(),
            np.hstack([index, place[:, None]])[end],
            (
                *(values[end] for values in known),
                directions.reading[rows[end]],
                rigid.sigma(rows[end], Demand.LENGTH, sigma),
            ),
        ),
    ]


_OPEN = 10.0  # mean leg lengths, or [rad]: what is known worse is not determined at all
_POOR = 0.1  # the same: nominal models know it better, and the platform does not ask for it
_NEAR = 0.03  # [rad], how far axes may be from the nominal ones, about
_HARMLESS = 0.01  # of the change of the parameters: the platform hardly moves
_TURNS = slice(7, 12)  # of both axes, and the twist: places among the numbers of a leg
_STEP = 1e-6  # [rad], of differences
_EXACT_open_directions = 1e-6  # of the mean leg length: how exactly what is open is held


@dataclass(frozen=True, eq=False)
class OpenDirections:
    """Directions of unknowns that the poses leave open and with which the platform stays.

    Attributes
    ----------
    basis : (w, n) array
        In the unknowns in metres, angles at the mean leg length, orthonormal.
    length : float
        Mean leg length [m].
    sentences : tuple of str
        What is held, in words.
    """

    basis: Array
    length: float
    sentences: tuple[str, ...] = ()

    def holding(self, unit: Array, nominal: Array) -> Term:
        """Return the residuals that hold these directions of the first unknowns at nominal.

        Parameters
        ----------
        unit : (n,) array
            A metre of each unknown in its own unit.
        nominal : (n,) array
            The nominal values.
        """
        n = len(unit)
        rows = self.basis / unit / (_EXACT_open_directions * self.length)
        index = np.tile(np.arange(n), (len(rows), 1))
        return Term(_projection(n), index, (rows, rows @ nominal))


def open_directions(
    mechanism: NominalMechanism,
    unknowns: PlatformUnknowns,
    information: Array,
    legs: tuple[LegGeometry, ...],
    poses: tuple[Array, Array],
    wanted: IntArray | None = None,
) -> OpenDirections:
    """Return the open directions that do no harm.

    Parameters
    ----------
    mechanism : NominalMechanism
        The mechanism.
    unknowns : PlatformUnknowns
        The unknowns of step 4.
    information : (m, n) array
        Whitened rows by the unknowns: derivatives of residuals in standard deviations.
    legs : tuple of LegGeometry
        Where the information was taken.
    poses : (k, 3, 3) and (k, 3) array
        Platform poses in R_b that were seen; without any every direction counts as moving it.
    wanted : (n,) array of int, optional
        Which unknowns the information is about; all without it.

    Returns
    -------
    OpenDirections

    Raises
    ------
    NotIdentifiable
        If an open direction moves the platform.
    """
    wanted = np.arange(len(unknowns)) if wanted is None else wanted
    length = mean_length(legs, poses)
    unit = metres(unknowns, length)[wanted]
    _, singular, vectors = np.linalg.svd(
        np.vstack([information * unit, np.zeros((len(unit),) * 2)])
    )
    poor, unseen = (vectors[singular * sigma * length < 1.0] for sigma in (_POOR, _OPEN))
    if not len(poor):
        return OpenDirections(poor, length)
    motion = _motion(mechanism, unknowns, legs, poses, length)
    motion = None if motion is None else motion[:, :, wanted]
    moving, _ = split_by_motion(motion, unseen, length, _HARMLESS)
    if len(moving):
        _refuse(mechanism, unknowns, sparse_basis(moving), wanted)
    _, still = split_by_motion(motion, poor, length, _HARMLESS)
    sentences = tuple(
        f"Step 4 left {_in_words(mechanism, unknowns, row, wanted)} at nominal: the poses hardly "
        "show it, and the platform does not move with it."
        for row in sparse_basis(still)
    )
    return OpenDirections(still, length, sentences)


def closure_turns(unknowns: PlatformUnknowns) -> IntArray:
    """Return which unknowns turn axes of legs without an S joint, or change their twists."""
    closed = [j for j, leg in enumerate(unknowns.nominal) if leg.twist is not None]
    index = np.unique(unknowns.place[closed][:, _TURNS])
    return np.asarray(index[index >= 0])


def near_nominal(index: IntArray) -> tuple[Term, ...]:
    """Return residuals that keep turns from nominal axes, by their places, near zero.

    Poses that leave them open let them go anywhere, to where the platform moves otherwise.
    """
    if not len(index):
        return ()
    rows = np.full((len(index), 1), 1.0 / _NEAR)
    return (Term(_projection(1), index[:, None], (rows, np.zeros(len(index)))),)


def metres(unknowns: PlatformUnknowns, length: float) -> Array:
    """Return a metre of every unknown in its own unit, (n,): angles at the mean leg length."""
    return np.where(unknowns.is_angle, 1.0 / length, 1.0)


def mean_length(legs: Sequence[LegGeometry], poses: tuple[Array, Array]) -> float:
    """Return the mean leg length [m] over poses in R_b, that of the offsets without any."""
    R, t = poses
    if not len(R):
        return float(np.mean([leg.q0 for leg in legs if np.isfinite(leg.q0)]))
    A, B = np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])
    ends = np.einsum("kij,lj->kli", R, B) + t[:, None]
    return float(np.linalg.norm(ends - A, axis=2).mean())


def _motion(
    mechanism: NominalMechanism,
    unknowns: PlatformUnknowns,
    legs: tuple[LegGeometry, ...],
    poses: tuple[Array, Array],
    length: float,
) -> Array | None:
    """Return how the platform moves with each unknown in metres, (k, 6, n); None if unknown."""
    if not len(poses[0]):
        return None
    everything = unknowns.parametrization
    try:
        moved = pose_sensitivity(legs, everything, mechanism.frame_legs, *poses)
    except NotIdentifiable:
        return None
    for place, leg, nominal in zip(everything.place, legs, unknowns.nominal, strict=True):
        for columns, axis, start in (
            (BASE_TURNS, leg.base_axis, nominal.base_axis),
            (PLATFORM_TURNS, leg.platform_axis, nominal.platform_axis),
        ):
            if axis is not None and start is not None and place[columns].min() >= 0:
                moved[:, :, place[columns]] @= _other_basis(axis, start)
    return np.asarray(moved[:, :, unknowns.parameters] * metres(unknowns, length))


def _other_basis(axis: Array, nominal: Array) -> Array:
    """Return turns about the basis of an axis by turns from the nominal one, (2, 2)."""
    here = turns_of(axis, nominal)
    ends = [turned_axis(nominal, here + step) for step in _STEP * np.eye(2)]
    slopes = [(np.asarray(end) - axis) / _STEP for end in ends]
    e1, e2 = normal_basis(axis)
    return np.array([[-e2 @ slope, e1 @ slope] for slope in slopes]).T


def _refuse(
    mechanism: NominalMechanism, unknowns: PlatformUnknowns, rows: Array, wanted: IntArray
) -> None:
    """Raise NotIdentifiable in geometric words."""
    shown = np.abs(rows) > SHOWN * np.abs(rows).max(axis=1, keepdims=True)
    names = [unknowns.names[wanted[i]] for i in np.flatnonzero(shown.any(axis=0))]
    joints = [n for n in names if n.rpartition(".")[0].endswith(".platform")]
    if len(joints) == len(names):
        legs = [leg for leg in mechanism.leg_names if any(n.startswith(f"{leg}.") for n in names)]
        raise NotIdentifiable(
            f"The platform joints could not be tied together: those of {', '.join(legs)} can "
            "move without any image noticing; needed images of three or more legs at once that "
            "share legs with each other; add images that show several legs at once."
        )
    first = _in_words(mechanism, unknowns, rows[0], wanted)
    more = f", and {len(rows) - 1} more such directions" if len(rows) > 1 else ""
    raise NotIdentifiable(
        f"The platform could not be identified: found that {first} can change without any image "
        f"noticing{more}, although the platform moves with it; needed each such leg at poses that "
        "differ more, together with three legs of known length; add such images."
    )


def _in_words(
    mechanism: NominalMechanism, unknowns: PlatformUnknowns, row: Array, wanted: IntArray
) -> str:
    """Return a direction in words."""
    shown = np.flatnonzero(np.abs(row) > SHOWN * np.abs(row).max())
    shown = shown[np.argsort(-np.abs(row[shown]).round(3), kind="stable")]
    return describe_direction([unknowns.names[wanted[i]] for i in shown], mechanism.leg_names)


@cache
def _projection(n: int) -> ca.Function:
    """Return (x; row, target) -> row . x - target."""
    x, row, target = ca.SX.sym("x", n), ca.SX.sym("row", n), ca.SX.sym("target")
    return ca.Function("projection", [x, row, target], [ca.dot(row, x) - target])
