"""One estimation problem: blocks of variables, factors that touch them, and exact constraints.

The unknowns x of a problem are a tangent step of a state: kept variables first, block by block,
then the eliminated variables (platform poses, say), element by element. A measurement touches few
kept variables and at most one eliminated element: the normal equations of measurements that touch
the same variables are summed by one matrix product, and the coupling to eliminated elements by
constant sparse matrices that are built once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csc_array
from scipy.spatial.transform import RigidTransform

from legcal.geometry.motions import components, motions_of, turned
from legcal.geometry.types import Array, IntArray

S = TypeVar("S")  # the state: a dataclass with one field for each block of variables
P = TypeVar("P", bound="EstimationProblem[Any]")


def _added(value: Array, change: Array) -> Array:
    """Default retraction: a sum, for elements of any shape."""
    return np.asarray(value + change.reshape(value.shape))


class Frames(NamedTuple):
    """Rigid motions T_to_from as rotations and translations.

    The tangent step of each has six coordinates: a rotation vector, applied from the left by
    Cayley's map [rad], then a displacement [m].
    """

    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)

    @classmethod
    def of(cls, motions: Sequence[RigidTransform]) -> Frames:
        """Convert from ``RigidTransform`` objects."""
        return cls(*components(motions))

    @property
    def motions(self) -> tuple[RigidTransform, ...]:
        """As ``RigidTransform`` objects."""
        return motions_of(self.R, self.t)

    def moved(self, change: Array) -> Frames:
        """Apply tangent steps (n, 6)."""
        return Frames(turned(self.R, change[:, :3]), self.t + change[:, 3:])


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """A Gaussian prior on coordinates of a block of variables."""

    unknown: IntArray  # (n,) indices of the block's unknowns
    mean: Array  # (n,)
    sigma: Array  # (n,)
    # (n, n) T with T C T^T = 1 for the correlations C; None where they are independent
    whitening: Array | None = None

    @classmethod
    def from_covariance(cls, unknown: IntArray, mean: Array, covariance: Array) -> GaussianPrior:
        """Build a prior from a covariance (n, n) with positive variances.

        The covariance may be singular: eigenvalues of the correlations have a floor of 1e-10.
        """
        sigma = np.sqrt(np.diagonal(covariance))
        eigenvalue, eigenvector = np.linalg.eigh(covariance / np.outer(sigma, sigma))
        return cls(
            unknown, mean, sigma, (eigenvector / np.sqrt(np.maximum(eigenvalue, _EXACT**2))).T
        )

    def whitened(self, errors: Array) -> Array:
        """Whiten errors (n,) or (n, c) of these coordinates."""
        over_sigma = (errors.T / self.sigma).T
        return over_sigma if self.whitening is None else self.whitening @ over_sigma

    def __add__(self, other: GaussianPrior) -> GaussianPrior:
        priors, whitening = (self, other), None
        if self.whitening is not None or other.whitening is not None:
            whitening = block_diag(
                *(np.eye(len(p.mean)) if p.whitening is None else p.whitening for p in priors)
            )
        return GaussianPrior(
            np.concatenate([self.unknown, other.unknown]),
            np.concatenate([self.mean, other.mean]),
            np.concatenate([self.sigma, other.sigma]),
            whitening,
        )


_EXACT = 1e-5  # floor of the standard deviation along an eigenvector of correlations
_MAX_KEY = 2**40  # largest group key; above, keys are renumbered against overflow
NO_PRIOR = GaussianPrior(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Variables:
    """A block of variables: elements of one manifold with d tangent coordinates each.

    The value of the block is the field ``name`` of the state, of any type. Coordinates are the
    values that are reported, one for each unknown; their derivative by x is the identity unless
    ``jacobian`` is given.
    """

    name: str
    unknown: IntArray  # (n, d) index of the unknown of each coordinate; -1 fixed, equal: shared
    retract: Callable[[Any, Array], Any] = _added  # (value, change (n, d)) -> value
    labels: tuple[str, ...] = ()  # names of the unknowns; blocks with labels come first
    units: tuple[str, ...] = ()
    coordinates: Callable[[Any], Array] | None = None  # value -> (n_unknowns,)
    jacobian: Callable[[Any], Array] | None = None  # value -> (n_unknowns, n_unknowns)
    prior: GaussianPrior = NO_PRIOR
    max_step: tuple[float, ...] = ()  # (d,) step limit of each coordinate

    @cached_property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return int(self.unknown.max(initial=-1)) + 1

    def read(self, value: Any) -> Array:
        """Return the coordinates (n_unknowns,) of a value of the block."""
        if self.coordinates is not None:
            return self.coordinates(value)
        unknown, first = np.unique(self.unknown, return_index=True)
        return np.asarray(np.ravel(value)[first[unknown >= 0]])


def all_free(n: int, d: int) -> IntArray:
    """Return ``unknown`` (n, d) of a block without fixed or shared coordinates."""
    return np.arange(n * d, dtype=np.intp).reshape(n, d)


def fixed_at_start(n: int, d: int) -> IntArray:
    """Return ``unknown`` (n, d) of a fixed block."""
    return np.full((n, d), -1, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals r (n, q) of n measurements with derivatives (n, q, l) by intermediate quantities.

    ``chain`` applies the chain rule: it turns these slopes into derivatives by kept and by
    eliminated variables, and is called only when they are needed. Arrays are fastest with the
    measurements contiguous in memory.
    """

    r: Array
    unwhitened: Array  # slopes before ``whitening``, which is applied lazily
    chain: Callable[[Array], tuple[Array, Array]]
    whitening: Array | None = None  # (q, q, n)

    @classmethod
    def of(cls, r: Array, J: Array, J_element: Array | None = None) -> Residuals:
        """Build from derivatives by the kept and by the eliminated variables."""
        by_element, m = np.zeros((*r.shape, 0)) if J_element is None else J_element, J.shape[-1]
        return cls(
            r,
            np.concatenate([J, by_element], axis=-1),
            lambda slope: (slope[..., :m], slope[..., m:]),
        )

    @cached_property
    def slope(self) -> Array:
        """Whitened slopes (n, q, l)."""
        if self.whitening is None:
            return self.unwhitened
        return np.asarray(np.einsum("ijn,ljn->lin", self.whitening, self.unwhitened.T).T)

    @cached_property
    def _derivatives(self) -> tuple[Array, Array]:
        return self.chain(self.slope)

    @property
    def J(self) -> Array:
        """Derivatives (n, q, m) by the kept variables in the order of ``Factor.touches``."""
        return self._derivatives[0]

    @property
    def J_element(self) -> Array:
        """Derivatives (n, q, d) by the eliminated element of each measurement."""
        return self._derivatives[1]

    @cached_property
    def squared_norms(self) -> Array:
        """Squared norms of the residuals, (n,)."""
        return np.asarray(np.einsum("nq,nq->n", self.r, self.r))

    def whitened(self, T: Array) -> Residuals:
        """Multiply the rows by T (n, q, q), (n, 1, 1) or a scalar."""
        if T.ndim == 0:
            return Residuals(float(T) * self.r, float(T) * self.slope, self.chain)
        if T.shape[1:] == (1, 1):
            return Residuals(T[:, 0] * self.r, T * self.slope, self.chain)
        by_row = np.ascontiguousarray(T.transpose(1, 2, 0))
        r = np.einsum("ijn,jn->in", by_row, self.r.T)
        return Residuals(r.T, self.slope, self.chain, by_row)

    def stacked(self, order: IntArray | None) -> Array:
        """Return [J, r, J_element] of each measurement (n, q, m + 1 + d), reordered."""
        J, J_element = self._derivatives
        m = J.shape[-1]
        rows = np.empty((*self.r.shape, m + 1 + J_element.shape[-1]))
        rows[..., :m], rows[..., m], rows[..., m + 1 :] = J, self.r, J_element
        return rows if order is None else rows[order]


Touch = tuple[str, IntArray, slice]  # block, element(s) of each measurement, their coordinates


@dataclass(frozen=True, eq=False)
class Factor(Generic[S]):
    """Measurements of one kind, as residuals of the variables that they touch."""

    name: str
    rows: Callable[[S], Residuals]  # residuals with derivatives, not whitened
    touches: tuple[Touch, ...]  # kept variables, in the column order of J
    n: int  # measurements
    n_rows: int  # residuals of each
    element: IntArray | None = None  # (n,) eliminated element of each measurement, if any
    whitening: Array | float = 1.0  # (n, q, q) T with T C T^T = 1; zero: rejected
    robust: bool = False  # under the robust loss, or plain squares

    def linearize(self, state: S) -> Residuals:
        """Return whitened residuals and derivatives at a state."""
        return self.rows(state).whitened(np.asarray(self.whitening))


@dataclass(frozen=True, eq=False)
class _Groups:
    """Groups of measurements that touch the same kept variables, and cells of the groups.

    A cell holds the measurements of a group that touch the same eliminated element. All cells of
    a factor have one size; where sizes differ, each measurement is a cell.
    """

    order: IntArray | None  # (n,) sort by group and element; None if sorted already
    group: IntArray  # (n,) group of each measurement
    first: IntArray  # (n_groups,) one measurement of each group
    bounds: tuple[tuple[int, int], ...]  # slice of each group in the sorted order
    cell: int  # measurements in each cell

    @classmethod
    def of(cls, touched_elements: Sequence[IntArray], element: IntArray | None, n: int) -> _Groups:
        """Group n measurements by the elements of the blocks that they touch."""
        key = np.zeros(n, dtype=np.intp)
        for column in (
            c for part in touched_elements for c in part.reshape(n, part.size // max(n, 1)).T
        ):
            key = key * (int(column.max(initial=0)) + 1) + column
            if key.max(initial=0) > _MAX_KEY:
                key = np.unique(key, return_inverse=True)[1].ravel()
        _, first, group = np.unique(key, return_index=True, return_inverse=True)
        group = group.ravel()
        ends = np.cumsum(np.bincount(group)).tolist()
        order = np.lexsort((np.zeros(n) if element is None else element, group))
        cell = 1
        if element is not None and n:
            starts = np.ones(n, dtype=np.bool_)
            starts[1:] = (np.diff(group[order]) != 0) | (np.diff(element[order]) != 0)
            starts_of_cells = np.flatnonzero(starts)
            cell = int(starts_of_cells[1]) if len(starts_of_cells) > 1 else n
            cell = (
                cell
                if np.array_equal(starts_of_cells, np.arange(0, n, cell)) and n % cell == 0
                else 1
            )
        is_sorted = np.array_equal(order, np.arange(n))
        bounds = tuple(pairwise([0, *ends]))
        return cls(None if is_sorted else order, group, first, bounds, cell)


@dataclass(frozen=True, eq=False)
class Sparsity:
    """Jacobian columns of the measurements of a factor, and the matrix that sums their products."""

    groups: _Groups
    columns: IntArray  # (n_groups, m) columns in x; n_kept for fixed coordinates
    element: IntArray | None  # (n,)
    # ((n_kept + 2 + d) * n_elements, n_cells * (m + 1 + d)) adds [J, r, J_element]^T J_element of
    # cells to the rows of kept unknowns, of fixed coordinates, of the gradient, and of elements
    to_elements: csc_array | None

    @cached_property
    def index(self) -> IntArray:
        """Columns in x of each measurement, (n, m)."""
        return np.asarray(self.columns[self.groups.group])

    @property
    def members(self) -> list[tuple[IntArray | slice, IntArray]]:
        """Measurements and columns in x of each group."""
        order = self.groups.order
        spans = [slice(start, end) for start, end in self.groups.bounds]
        return list(
            zip([s if order is None else order[s] for s in spans], self.columns, strict=True)
        )


def _sparsity(
    groups: _Groups,
    columns: IntArray,
    element: IntArray | None,
    n_kept: int,
    sizes: tuple[int, int],  # number of elements and of unknowns of each
) -> Sparsity:
    """Build the matrix that sums the products of cells."""
    if element is None:
        return Sparsity(groups, columns, None, None)
    (n_elements, d), n_groups = sizes, len(columns)
    first_of_cell = slice(None, None, groups.cell)
    order = slice(None) if groups.order is None else groups.order
    group, cell = groups.group[order][first_of_cell], element[order][first_of_cell]
    element_rows = np.broadcast_to(n_kept + 1 + np.arange(1 + d), (n_groups, 1 + d))
    target = np.concatenate([columns, element_rows], axis=1)[group] * n_elements + cell[:, None]
    n_products = target.size
    shape = ((n_kept + 2 + d) * n_elements, n_products)
    summing = csc_array(
        (np.ones(n_products), target.ravel(), np.arange(n_products + 1)), shape=shape
    )
    return Sparsity(groups, columns, element, summing)


@dataclass(frozen=True, eq=False)
class Tangent:
    """Tangent space of the eliminated elements under exact constraints."""

    Z: Array  # (n_elements, d, f) basis at fixed kept variables, padded with zero columns
    Q: Array  # (n_kept, n_elements, d) derivative by each kept unknown
    ties: Array = field(  # (w, n_kept) directions of the kept unknowns that constraints forbid
        default_factory=lambda: np.zeros((0, 0))
    )


class Constraint(Protocol[S]):
    """Equations of eliminated elements that hold exactly."""

    def project(self, state: S) -> S:
        """Project every element onto its constraint; DidNotConverge where that fails."""

    def tangent(self, problem: Any, state: S) -> Tangent | None:
        """Return the tangent space; None where all elements are free."""


@dataclass(frozen=True, eq=False)
class EstimationProblem(Generic[S]):
    """Variables, factors and constraints; see :mod:`legcal.estimation`."""

    variables: tuple[Variables, ...]  # kept, those with labels first
    eliminated: Variables | None
    factors: tuple[Factor[S], ...]
    constraint: Constraint[S] | None = None
    held_directions: Array = field(
        default_factory=lambda: np.zeros((0, 0))
    )  # (w, m <= n_kept) fixed gauge
    name: str = "fit"  # for messages, with the remedy if it fails
    remedy: str = "check the starting values and the measurements"

    @cached_property
    def n_kept(self) -> int:
        """Number of kept unknowns."""
        return sum(block.n_unknowns for block in self.variables)

    @cached_property
    def first(self) -> Mapping[str, int]:
        """Column in x of the first unknown of each kept block."""
        counts = (block.n_unknowns for block in self.variables)
        names = (block.name for block in self.variables)
        return dict(zip(names, accumulate(counts, initial=0), strict=False))

    @cached_property
    def columns(self) -> Mapping[str, IntArray]:
        """Columns in x of each kept block, (n, d); ``n_kept`` for fixed coordinates."""
        return {
            block.name: np.where(
                block.unknown < 0, self.n_kept, self.first[block.name] + block.unknown
            )
            for block in self.variables
        }

    @cached_property
    def sparsity(self) -> Mapping[str, Sparsity]:
        """Columns of the Jacobian of each factor, by its name."""
        return {factor.name: self._sparsity_of(factor) for factor in self.factors}

    def _sparsity_of(self, factor: Factor[S]) -> Sparsity:
        groups = _Groups.of([e for _, e, _ in factor.touches], factor.element, factor.n)
        unknowns = [np.zeros((len(groups.first), 0), dtype=np.intp)]
        for name, element, numbers in factor.touches:
            part = self.columns[name][element[groups.first]][..., numbers]
            unknowns.append(part.reshape(len(part), int(np.prod(part.shape[1:]))))
        sizes = self.n_elements, self.d_element
        columns = np.concatenate(unknowns, axis=1)
        return _sparsity(groups, columns, factor.element, self.n_kept, sizes)

    @property
    def n_elements(self) -> int:
        """Number of eliminated elements."""
        return 0 if self.eliminated is None else len(self.eliminated.unknown)

    @property
    def d_element(self) -> int:
        """Number of unknowns of an eliminated element."""
        return 0 if self.eliminated is None else self.eliminated.unknown.shape[1]

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.n_kept + self.n_elements * self.d_element

    @cached_property
    def named(self) -> tuple[str, ...]:
        """Names of the leading unknowns, from the blocks with labels."""
        return tuple(label for block in self.variables for label in block.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the named unknowns."""
        return tuple(unit for block in self.variables for unit in block.units)

    @cached_property
    def n_named(self) -> int:
        """Number of named unknowns."""
        return len(self.named)

    @cached_property
    def priors(self) -> GaussianPrior:
        """All priors, by column in x."""
        priors = NO_PRIOR
        for block in self.variables:
            prior = block.prior
            priors += replace(prior, unknown=self.first[block.name] + prior.unknown)
        return priors

    def where(self, name: str) -> IntArray:
        """Return the columns in x of a block's unknowns."""
        return self.first[name] + np.arange(self.block(name).n_unknowns, dtype=np.intp)

    def block(self, name: str) -> Variables:
        """Return a kept block by its name."""
        return next(block for block in self.variables if block.name == name)

    def factor(self, name: str) -> Factor[S]:
        """Return a factor by its name."""
        return next(factor for factor in self.factors if factor.name == name)

    def with_parts(self, blocks: Sequence[Variables], factors: Sequence[Factor[S]]) -> Self:
        """Replace blocks and factors by others of the same names."""
        b, f = {block.name: block for block in blocks}, {factor.name: factor for factor in factors}
        return replace(
            self,
            variables=tuple(b.get(block.name, block) for block in self.variables),
            factors=tuple(f.get(factor.name, factor) for factor in self.factors),
        )

    def with_factors(self, *factors: Factor[S]) -> Self:
        """Replace factors by others of the same names."""
        return self.with_parts((), factors)

    def moved(self, state: S, x: Array) -> S:
        """Apply a step x of all unknowns; constraints are not enforced."""
        change = np.append(x[: self.n_kept], 0.0)
        values: dict[str, Any] = {
            block.name: block.retract(getattr(state, block.name), change[self.columns[block.name]])
            for block in self.variables
            if block.n_unknowns
        }
        if self.eliminated is not None:
            element_change = x[self.n_kept :].reshape(-1, self.d_element)
            block = self.eliminated
            values[block.name] = block.retract(getattr(state, block.name), element_change)
        return replace(state, **values)  # type: ignore[type-var]

    def projected(self, state: S) -> S:
        """Project the eliminated elements onto their constraints."""
        return state if self.constraint is None else self.constraint.project(state)

    def overshoot(self, x: Array) -> float:
        """Largest ratio of a step to the step limits of the blocks."""
        change, ratios = np.append(x[: self.n_kept], 0.0), [0.0]
        for block in self.variables:
            if block.max_step and block.n_unknowns:
                ratio = np.abs(change[self.columns[block.name]]) / np.array(block.max_step)
                ratios.append(float(ratio.max(initial=0.0)))
        if self.eliminated is not None and self.eliminated.max_step:
            moved = np.abs(x[self.n_kept :].reshape(-1, self.d_element))
            ratios.append(float((moved / np.array(self.eliminated.max_step)).max(initial=0.0)))
        return max(ratios)

    def coordinates(self, state: S) -> Array:
        """Return the values (n_named,) of the named unknowns."""
        parts = [b.read(getattr(state, b.name)) for b in self.variables if b.labels]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def is_read_directly(self) -> bool:
        """Whether coordinates change like x: :meth:`jacobian` is the identity."""
        return all(not block.labels or block.jacobian is None for block in self.variables)

    def jacobian(self, state: S) -> Array:
        """Return the derivative (n_named, n_named) of the coordinates by x."""
        J = np.eye(self.n_named)
        for block in self.variables:
            if block.labels and block.jacobian is not None:
                unknowns = self.where(block.name)
                J[np.ix_(unknowns, unknowns)] = block.jacobian(getattr(state, block.name))
        return J


class PriorRows(NamedTuple):
    """Whitened priors of a block at a state."""

    r: Array  # (n,)
    # Derivatives by the unknowns of the block (n, n_unknowns), or by one unknown each (n,).
    slope: Array
    unknown: IntArray  # (n,) columns in x
    first: int  # column in x of the block's first unknown


@dataclass(frozen=True, eq=False)
class Linearization(Generic[P, S]):
    """A problem at a state: whitened residuals and derivatives of all factors and priors."""

    problem: P
    state: S
    rows: Mapping[str, Residuals]
    priors: tuple[PriorRows, ...]  # of blocks with a prior

    def __getitem__(self, name: str) -> Residuals:
        return self.rows[name]

    @cached_property
    def prior_r(self) -> Array:
        """Residuals of all priors, (n_priors,)."""
        return np.concatenate([np.zeros(0), *(prior.r for prior in self.priors)])

    @property
    def prior_J(self) -> Array:
        """Derivatives of the residuals of all priors, (n_priors, n_kept)."""
        n_kept = self.problem.n_kept
        parts = [np.zeros((0, n_kept))]
        for r, slope, unknown, first in self.priors:
            part = np.zeros((len(r), n_kept))
            if slope.ndim == 1:
                part[np.arange(len(r)), unknown] = slope
            else:
                part[:, first : first + slope.shape[1]] = slope
            parts.append(part)
        return np.concatenate(parts)

    def add_priors(self, U: Array, g: Array) -> None:
        """Add the normal equations of all priors to U (n_kept, n_kept) and g (n_kept,)."""
        for r, slope, unknown, first in self.priors:
            if slope.ndim == 1:
                np.add.at(U, (unknown, unknown), slope * slope)
                np.add.at(g, unknown, slope * r)
            else:
                block = slice(first, first + slope.shape[1])
                U[block, block] += slope.T @ slope
                g[block] += slope.T @ r


def linearize(problem: P, state: S) -> Linearization[P, S]:
    """Linearise a problem at a state."""
    priors = []
    for block in problem.variables:
        prior, value = block.prior, getattr(state, block.name)
        if len(prior.mean):
            r = prior.whitened(block.read(value)[prior.unknown] - prior.mean)
            slope = 1.0 / prior.sigma
            if block.jacobian is not None:
                slope = prior.whitened(block.jacobian(value)[prior.unknown])
            elif prior.whitening is not None:
                slope = prior.whitened(np.eye(block.n_unknowns)[prior.unknown])
            first = problem.first[block.name]
            priors.append(PriorRows(r, slope, first + prior.unknown, first))
    rows = {factor.name: factor.linearize(state) for factor in problem.factors}
    return Linearization(problem, state, rows, tuple(priors))
