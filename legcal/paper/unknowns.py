"""The machine of the steps, the unknowns of a step, and the directions that it hardly determines.

Every step takes a :class:`NominalMachine` and returns it with its estimates. The unknowns of a
step are joint centres and lengths [m], two rotations of each axis from the start
(:func:`~legcal.paper.equations.gibbs_of` the angles), and changes of twists [rad].

Weak directions are combinations of the unknowns that an equation hardly determines. Nominal models
are accurate to some per cent. Directions with less information in an equation keep their nominal
value and are named: z of coplanar joints in (9) and (16), or the common rotation of the axes on
base and platform of a 3-UPU, which only translates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import (
    EquationKind,
    Leg,
    LegColumns,
    LegKind,
)
from legcal.machine.model import Machine
from legcal.machine.parameters import (
    SHOWN,
    Parametrization,
    describe_direction,
    geometries,
    is_spatial,
    numbers_of,
    parametrize,
    with_numbers,
)
from legcal.paper.equations import angles_of, axis_frames, gibbs_of, nominal_value
from legcal.paper.least_squares import LeastSquares, Term

_SIGMA_LENGTH = 0.01  # nominal standard deviation of joint centres and lengths [mean leg lengths]
_SIGMA_AXIS = 0.03  # nominal standard deviation of axes [rad]
_HELD = 3e-5  # standard deviation of a held direction, in units of these
_AXES = (LegColumns.BASE_AXIS, LegColumns.PLATFORM_AXIS)


@dataclass(frozen=True, eq=False)
class NominalMachine:
    """The legs of a machine at the start of a step, and their unknowns."""

    leg_names: tuple[str, ...]
    legs: tuple[Leg, ...]  # geometry of the base in R_b, of the platform in R_e
    frame_legs: tuple[int, ...]  # their joints define R_b and R_e: three in space, two in a plane

    @property
    def n_legs(self) -> int:
        """Number of legs."""
        return len(self.legs)

    @cached_property
    def sign(self) -> Array:
        """Whether each leg grows (+1) or shrinks (-1) with its reading, (n_legs,)."""
        return np.array([float(leg.sign) for leg in self.legs])

    @property
    def spatial(self) -> bool:
        """Whether the platform moves in space and not in a plane."""
        return is_spatial(self.frame_legs)

    @cached_property
    def A(self) -> Array:
        """Joint centres of the base in R_b, (n_legs, 3) [m]."""
        return np.array([leg.A for leg in self.legs])

    @cached_property
    def B(self) -> Array:
        """Joint centres of the platform in R_e, (n_legs, 3) [m]."""
        return np.array([leg.B for leg in self.legs])

    @cached_property
    def lengths(self) -> Array:
        """Offsets, or the length of constant legs, (n_legs,) [m]."""
        return np.array([leg.q0 for leg in self.legs])

    @cached_property
    def offsets(self) -> Array:
        """Offsets, (n_legs,) [m]; NaN for passive legs, like their readings."""
        passive = np.array([leg.kind is LegKind.PASSIVE for leg in self.legs])
        return np.where(passive, np.nan, self.lengths)

    @cached_property
    def constant(self) -> BoolArray:
        """Mask of the legs with a constant length and no reading, (n_legs,)."""
        return np.array([leg.kind is LegKind.CONSTANT for leg in self.legs], dtype=np.bool_)

    @cached_property
    def on_platform(self) -> BoolArray:
        """Mask of the legs that are fixed to the platform, (n_legs,)."""
        return np.array([leg.is_fixed_to_platform for leg in self.legs], dtype=np.bool_)

    @cached_property
    def revolute(self) -> BoolArray:
        """Mask of the legs with a revolute axis at the base as a parameter, (n_legs,)."""
        constrained = [EquationKind.BASE_AXIS in leg.equations for leg in self.legs]
        return np.array(constrained, dtype=np.bool_)

    @cached_property
    def base_axes(self) -> Array:
        """Revolute axes in R_b, (n_legs, 3); NaN where :attr:`revolute` is not."""
        axes = np.full((self.n_legs, 3), np.nan)
        for j in np.flatnonzero(self.revolute):
            axes[j] = self.legs[j].base_axis
        return axes

    @cached_property
    def base_normals(self) -> Array:
        """:attr:`base_axes`; in a planar machine z for all, where it is no parameter."""
        return self.base_axes if self.spatial else np.tile([0.0, 0.0, 1.0], (self.n_legs, 1))


def nominal_machine(machine: Machine) -> NominalMachine:
    """Return the nominal machine of the steps."""
    return NominalMachine(machine.leg_names, geometries(machine), machine.frame_legs)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The parameters that a step estimates, with the indices of each leg among them."""

    parametrization: Parametrization  # of all parameters of the machine
    parameters: IntArray  # (n,), ascending: indices of the unknown parameters
    start: tuple[Leg, ...]  # reference of rotations of axes and changes of twists

    @classmethod
    def of_base(cls, machine: NominalMachine) -> Unknowns:
        """Return the unknowns of step 2: base joints and revolute axes at the base."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.A] = True
        columns[:, LegColumns.BASE_AXIS] = machine.revolute[:, None]
        return cls._among(machine, columns)

    @classmethod
    def of_lengths(cls, machine: NominalMachine) -> Unknowns:
        """Return the unknowns of step 3: offsets and constant lengths."""
        columns = np.zeros((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.LENGTH] = True
        return cls._among(machine, columns)

    @classmethod
    def of_platform(cls, machine: NominalMachine, *, free_twists: bool = False) -> Unknowns:
        """Return the unknowns of step 4: all but those of step 2; twists only if freed."""
        columns = np.ones((machine.n_legs, LegColumns.COUNT), dtype=np.bool_)
        columns[:, LegColumns.A] = False
        columns[:, LegColumns.OWN :] = False
        columns[:, LegColumns.BASE_AXIS] = ~machine.revolute[:, None]
        return cls._among(machine, columns, free_twists=free_twists)

    @classmethod
    def _among(
        cls, machine: NominalMachine, columns: BoolArray, *, free_twists: bool = False
    ) -> Unknowns:
        legs = machine.legs
        parametrization = parametrize(
            machine.leg_names, legs, machine.frame_legs, twists=free_twists
        )
        return cls(
            parametrization,
            np.sort(parametrization.place[columns & (parametrization.place >= 0)]),
            legs,
        )

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def place(self) -> IntArray:
        """Indices of each leg's numbers (LegColumns) among the unknowns, (n_legs, 21), or -1."""
        place = np.full(len(self.parametrization) + 1, -1, dtype=np.intp)
        place[self.parameters] = np.arange(len(self))
        return np.asarray(place[self.parametrization.place])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(self.parametrization.names[i] for i in self.parameters)

    @property
    def is_angle(self) -> BoolArray:
        """Mask (n,) of the unknowns that are angles [rad] rather than lengths [m]."""
        return np.array([self.parametrization.units[i] == "rad" for i in self.parameters])

    @property
    def known_A(self) -> Array:
        """Known coordinates of A, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.place[:, LegColumns.A] < 0, [leg.A for leg in self.start], 0.0)

    @property
    def known_B(self) -> Array:
        """Known coordinates of B, zero for unknown ones, (n_legs, 3) [m]."""
        return np.where(self.place[:, LegColumns.B] < 0, [leg.B for leg in self.start], 0.0)

    @cached_property
    def base_frames(self) -> Array:
        """Start of axes at the base and their normal bases as columns, (n_legs, 3, 3).

        Zero for legs without an axis.
        """
        frames = np.zeros((len(self.start), 3, 3))
        for j, leg in enumerate(self.start):
            if leg.base_axis is not None:
                frames[j] = axis_frames(leg.base_axis[None])[0]
        return frames

    def vector(self, legs: Sequence[Leg]) -> Array:
        """Return the unknowns of legs, (n,)."""
        local = numbers_of(legs, self.start)
        for columns in _AXES:
            local[:, columns] = gibbs_of(local[:, columns])
        local[:, LegColumns.TWIST] -= [leg.twist or 0.0 for leg in self.start]
        x = np.zeros(len(self))
        x[self.place[self.place >= 0]] = local[self.place >= 0]
        return x

    def legs(self, x: Array, legs: Sequence[Leg]) -> tuple[Leg, ...]:
        """Return legs with the unknowns at the first values of x."""
        local = np.append(x[: len(self)], 0.0)[self.place]
        for columns in _AXES:
            local[:, columns] = angles_of(local[:, columns])
        local[:, LegColumns.TWIST] += [leg.twist or 0.0 for leg in self.start]
        return with_numbers(legs, self.start, local, self.place >= 0)


# Weak directions


def with_prior(problem: LeastSquares, place: IntArray) -> LeastSquares:
    """Return a problem with a prior of axes at their nominal values, by their indices."""
    rows = np.full((len(place), 1), 1.0 / _SIGMA_AXIS)
    term = Term(nominal_value(1), place[:, None], (rows, np.zeros(len(place))))
    return replace(problem, terms=(*problem.terms, term))


def hold_at_nominal(
    problem: LeastSquares,
    machine: NominalMachine,
    unknowns: Unknowns,
    *,
    weighted: bool,
    wanted: IntArray | None = None,  # indices of the problem's unknowns; by default the first
    nominal: Array | None = None,  # (n,) values; by default the start
) -> tuple[LeastSquares, IntArray]:
    """Return a problem with weak directions held at nominal, and the unknowns that are held.

    Weak are directions with less information in the problem than in the nominal model;
    :func:`left_near_nominal` names them. The unknowns of the problem may be followed by steps of
    poses, six each.
    """
    wanted = np.arange(min(len(problem.start), len(unknowns))) if wanted is None else wanted
    n = len(wanted)
    nominal = problem.start[:n] if nominal is None else nominal
    x = problem.start
    weights = [term.weights(x, robust=False) for term in problem.terms] if weighted else None
    information = _without_poses(problem.jacobian(x, weights), n)
    lengths = machine.offsets[np.isfinite(machine.offsets)]
    if not len(lengths):  # a machine that is moved by hand
        lengths = machine.lengths
    sigma_length = _SIGMA_LENGTH * float(np.mean(np.abs(lengths)))
    sigma = np.where(unknowns.is_angle, _SIGMA_AXIS, sigma_length)[wanted]
    in_it = np.zeros(len(problem.start), dtype=np.bool_)
    for term in problem.terms:
        in_it[term.index[term.index >= 0]] = True
    part = np.flatnonzero(in_it[:n])
    rows = np.vstack([information[:, part] * sigma[part], np.zeros((len(part), len(part)))])
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    held = np.zeros((np.count_nonzero(singular < 1.0), n))
    held[:, part] = vectors[singular < 1.0]
    if not len(held):
        return problem, wanted[:0]
    shown: IntArray = wanted[np.any(np.abs(held) > SHOWN, axis=0)]
    rows = held / (_HELD * sigma)
    index = np.tile(np.arange(n), (len(rows), 1))
    term = Term(nominal_value(n), index, (rows, rows @ nominal))
    return replace(problem, terms=(*problem.terms, term)), shown


def left_near_nominal(
    step: str,  # with its equation: "Step 3 (14)"
    machine: NominalMachine,
    unknowns: Unknowns,
    held: IntArray,
) -> tuple[str, ...]:
    """Return the unknowns that are held, in words; () for none."""
    if not len(held):
        return ()
    words = describe_direction([unknowns.names[i] for i in held], machine.leg_names)
    return (f"{step} hardly shows {words}: it was left near nominal.",)


def _without_poses(jacobian: csc_array[np.float64], n: int) -> Array:
    """Return the Jacobian by the first n unknowns, with the poses after these projected out."""
    left = jacobian[:, :n].toarray()
    for first in range(n, jacobian.shape[1], 6):
        of_pose = jacobian[:, first : first + 6]
        rows = np.unique(of_pose.indices)
        by_pose, _ = np.linalg.qr(of_pose[rows].toarray())
        left[rows] -= by_pose @ (by_pose.T @ left[rows])
    return np.asarray(left)
