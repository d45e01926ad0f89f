"""One estimation problem: blocks of variables, factors that touch them, and exact constraints.

The unknowns x of a problem are small changes of a state: those of the kept variables first, block
by block, then those of the eliminated ones (platform poses, say), one element after the other. A
measurement touches few kept variables and one eliminated element at most, so that measurements
which touch the same variables are summed by one matrix product, and what couples them to
eliminated elements by constant sparse matrices that are built once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import csc_array
from scipy.spatial.transform import RigidTransform

from legcal.geometry.motions import components, motions_of
from legcal.geometry.rotations import turned
from legcal.geometry.types import Array, IntArray

S = TypeVar("S")  # the state: a dataclass with one field for each block of variables


def _added(value: Array, change: Array) -> Array:
    """Return numbers after a change, whatever shape their elements have."""
    return np.asarray(value + change.reshape(value.shape))


class Frames(NamedTuple):
    """Rigid motions T_to_from as rotations and translations.

    They move by six numbers each: a rotation vector from the left (Cayley's map) [rad], then a
    displacement [m].
    """

    R: Array  # (n, 3, 3)
    t: Array  # (n, 3)

    @classmethod
    def of(cls, motions: Sequence[RigidTransform]) -> Frames:
        """Return the frames of rigid motions."""
        return cls(*components(motions))

    @property
    def motions(self) -> tuple[RigidTransform, ...]:
        """The same as rigid motions."""
        return motions_of(self.R, self.t)

    def moved(self, change: Array) -> Frames:
        """Return frames after changes (n, 6)."""
        return Frames(turned(self.R, change[:, :3]), self.t + change[:, 3:])


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Gaussian knowledge of coordinates of a block of variables."""

    unknown: IntArray  # (n,) which of the block's unknowns
    mean: Array  # (n,)
    sigma: Array  # (n,)
    # (n, n) T with T C T^T = 1 of their correlations C; None where they are independent
    whitening: Array | None = None

    @classmethod
    def of_covariance(cls, unknown: IntArray, mean: Array, covariance: Array) -> GaussianPrior:
        """Return the prior of a covariance (n, n) of positive variances.

        Combinations without any variance are known to a hundred-thousandth of their parts.
        """
        sigma = np.sqrt(np.diagonal(covariance))
        value, vector = np.linalg.eigh(covariance / np.outer(sigma, sigma))
        return cls(unknown, mean, sigma, (vector / np.sqrt(np.maximum(value, _EXACT**2))).T)

    def whitened(self, errors: Array) -> Array:
        """Return errors (n,) or (n, c) of these coordinates with unit covariance."""
        over_sigma = (errors.T / self.sigma).T
        return over_sigma if self.whitening is None else self.whitening @ over_sigma

    def __add__(self, other: GaussianPrior) -> GaussianPrior:
        both, whitening = (self, other), None
        if self.whitening is not None or other.whitening is not None:
            whitening = block_diag(
                *(np.eye(len(p.mean)) if p.whitening is None else p.whitening for p in both)
            )
        return GaussianPrior(
            np.concatenate([self.unknown, other.unknown]),
            np.concatenate([self.mean, other.mean]),
            np.concatenate([self.sigma, other.sigma]),
            whitening,
        )


_EXACT = 1e-5  # least standard deviation along an eigenvector of correlations
_MAX_KEY = 2**40  # of numbers of groups: above, they are counted anew
NO_PRIOR = GaussianPrior(np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Variables:
    """A block of variables: elements of one manifold, each moved by d numbers.

    Its value is the field ``name`` of the state, whatever its type. Coordinates are what people
    read of it, one number for each unknown; their derivative by x is one unless ``jacobian`` says
    otherwise.
    """

    name: str
    unknown: IntArray  # (n, d) the unknown that moves each number; -1 fixed, equal ones move as one
    retract: Callable[[Any, Array], Any] = _added  # (value, change (n, d)) -> value
    labels: tuple[str, ...] = ()  # of the unknowns; blocks with labels come first
    units: tuple[str, ...] = ()
    coordinates: Callable[[Any], Array] | None = None  # value -> (n_unknowns,)
    jacobian: Callable[[Any], Array] | None = None  # value -> (n_unknowns, n_unknowns)
    prior: GaussianPrior = NO_PRIOR
    max_step: tuple[float, ...] = ()  # (d,) of each number

    @cached_property
    def n_unknowns(self) -> int:
        """Number of unknowns."""
        return int(self.unknown.max(initial=-1)) + 1

    def read(self, value: Any) -> Array:
        """Return the coordinates (n_unknowns,) of a value."""
        if self.coordinates is not None:
            return self.coordinates(value)
        unknown, first = np.unique(self.unknown, return_index=True)
        return np.asarray(np.ravel(value)[first[unknown >= 0]])


def all_free(n: int, d: int) -> IntArray:
    """Return the unknowns (n, d) of elements that all move freely."""
    return np.arange(n * d, dtype=np.intp).reshape(n, d)


def fixed_at_start(n: int, d: int) -> IntArray:
    """Return the unknowns (n, d) of elements that do not move."""
    return np.full((n, d), -1, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals r (n, q) of n measurements, and slopes (n, q, l) by what they depend on directly.

    ``chain`` turns slopes into derivatives by kept variables and by eliminated ones; it is called
    only where these are needed. All is fastest where measurements lie next to each other in memory.
    """

    r: Array
    unwhitened: Array  # slopes before ``whitening``, which is applied where they are needed
    chain: Callable[[Array], tuple[Array, Array]]
    whitening: Array | None = None  # (q, q, n)

    @classmethod
    def of(cls, r: Array, J: Array, J_element: Array | None = None) -> Residuals:
        """Return rows whose derivatives by kept and by eliminated variables are known."""
        own, m = np.zeros((*r.shape, 0)) if J_element is None else J_element, J.shape[-1]
        return cls(
            r, np.concatenate([J, own], axis=-1), lambda slope: (slope[..., :m], slope[..., m:])
        )

    @cached_property
    def slope(self) -> Array:
        """Slopes (n, q, l) of these residuals."""
        if self.whitening is None:
            return self.unwhitened
        return np.asarray(np.einsum("ijn,ljn->lin", self.whitening, self.unwhitened.T).T)

    @cached_property
    def _derivatives(self) -> tuple[Array, Array]:
        return self.chain(self.slope)

    @property
    def J(self) -> Array:
        """Derivatives by the kept variables in the order of ``Factor.touches``, (n, q, m)."""
        return self._derivatives[0]

    @property
    def J_element(self) -> Array:
        """Derivatives by the eliminated element of each measurement, (n, q, d)."""
        return self._derivatives[1]

    @cached_property
    def squared_norms(self) -> Array:
        """Squared norms of the residuals, (n,)."""
        return np.asarray(np.einsum("nq,nq->n", self.r, self.r))

    def whitened(self, T: Array) -> Residuals:
        """Return the rows times T (n, q, q), or (n, 1, 1), or one number."""
        if T.ndim == 0:
            return Residuals(float(T) * self.r, float(T) * self.slope, self.chain)
        if T.shape[1:] == (1, 1):
            return Residuals(T[:, 0] * self.r, T * self.slope, self.chain)
        by_row = np.ascontiguousarray(T.transpose(1, 2, 0))
        r = np.einsum("ijn,jn->in", by_row, self.r.T)
        return Residuals(r.T, self.slope, self.chain, by_row)

    def stacked(self, order: IntArray | None) -> Array:
        """Return [J, r, J_element] of each measurement (n, q, m + 1 + d), in an order."""
        J, J_element = self._derivatives
        m = J.shape[-1]
        rows = np.empty((*self.r.shape, m + 1 + J_element.shape[-1]))
        rows[..., :m], rows[..., m], rows[..., m + 1 :] = J, self.r, J_element
        return rows if order is None else rows[order]


Touch = tuple[str, IntArray, slice]  # block, element(s) of each measurement, numbers of these


@dataclass(frozen=True, eq=False)
class Factor(Generic[S]):
    """Measurements of one kind: residuals of the variables that they touch."""

    name: str
    rows: Callable[[S], Residuals]  # residuals with derivatives, not whitened
    touches: tuple[Touch, ...]  # kept variables, in the order of the columns of J
    n: int  # measurements
    n_rows: int  # residuals of each
    element: IntArray | None = None  # (n,) the eliminated element of each; None where there is none
    whitening: Array | float = 1.0  # (n, q, q) T with T C T^T = 1; zero leaves one out
    robust: bool = False  # whether the loss is on it, or plain squares
    _nothing: list[Residuals] = field(default_factory=list, repr=False)  # rows without any

    def linearize(self, state: S) -> Residuals:
        """Return whitened rows at a state."""
        if self._nothing:
            return self._nothing[0]
        rows = self.rows(state).whitened(np.asarray(self.whitening))
        if self.n == 0:
            self._nothing.append(rows)
        return rows


@dataclass(frozen=True, eq=False)
class _Groups:
    """Measurements of a factor that touch the same kept variables, and cells of these.

    A cell has the measurements of a group that touch the same eliminated element; all cells
    of a factor are of one size, of single measurements where they would not be.
    """

    order: IntArray | None  # (n,) measurements sorted by group and element; None if they are
    group: IntArray  # (n,) of each
    first: IntArray  # (n_groups,) a measurement of each group
    bounds: tuple[tuple[int, int], ...]  # of each group in that order
    cell: int  # measurements in each cell

    @classmethod
    def of(cls, touched: Sequence[IntArray], element: IntArray | None, n: int) -> _Groups:
        """Return the groups of measurements with the elements of blocks that each touches."""
        key = np.zeros(n, dtype=np.intp)
        for column in (c for part in touched for c in part.reshape(n, part.size // max(n, 1)).T):
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
            found = np.flatnonzero(starts)
            cell = int(found[1]) if len(found) > 1 else n
            cell = cell if np.array_equal(found, np.arange(0, n, cell)) and n % cell == 0 else 1
        is_sorted = np.array_equal(order, np.arange(n))
        bounds = tuple(pairwise([0, *ends]))
        return cls(None if is_sorted else order, group, first, bounds, cell)


@dataclass(frozen=True, eq=False)
class Places:
    """Which unknowns the measurements of a factor depend on, and the matrix that sums them up."""

    groups: _Groups
    columns: IntArray  # (n_groups, m) positions in x; n_kept for what is no unknown
    element: IntArray | None  # (n,)
    n_kept: int
    # ((n_kept + 2 + d) * n_elements, n_cells * (m + 1 + d)) adds [J, r, J_element]^T J_element of
    # cells to rows of kept unknowns, of no unknown, of the gradient, and of elements
    to_elements: csc_array | None

    @cached_property
    def index(self) -> IntArray:
        """Positions in x of each measurement, (n, m)."""
        return np.asarray(self.columns[self.groups.group])

    @property
    def members(self) -> list[tuple[IntArray | slice, IntArray]]:
        """The measurements of each group and its unknowns."""
        order = self.groups.order
        spans = [slice(start, end) for start, end in self.groups.bounds]
        return list(
            zip([s if order is None else order[s] for s in spans], self.columns, strict=True)
        )


def _places(
    groups: _Groups,
    columns: IntArray,
    element: IntArray | None,
    n_kept: int,
    sizes: tuple[int, int],  # number of elements, and of the unknowns of each
) -> Places:
    """Return the places of measurements."""
    if element is None:
        return Places(groups, columns, None, n_kept, None)
    (n_elements, d), n_groups = sizes, len(columns)
    of_cell = slice(None, None, groups.cell)
    order = slice(None) if groups.order is None else groups.order
    group, cell = groups.group[order][of_cell], element[order][of_cell]
    following = np.broadcast_to(n_kept + 1 + np.arange(1 + d), (n_groups, 1 + d))
    row = np.concatenate([columns, following], axis=1)[group] * n_elements + cell[:, None]
    n = row.size
    shape = ((n_kept + 2 + d) * n_elements, n)
    added = csc_array((np.ones(n), row.ravel(), np.arange(n + 1)), shape=shape)
    return Places(groups, columns, element, n_kept, added)


@dataclass(frozen=True, eq=False)
class Tangent:
    """The motions of eliminated elements that exact constraints leave."""

    Z: Array  # (n_elements, d, f) basis with kept variables fixed, zero columns where fewer
    Q: Array  # (n_kept, n_elements, d) motion with each kept unknown
    ties: Array = field(  # (w, n_kept) directions of the kept unknowns that constraints forbid
        default_factory=lambda: np.zeros((0, 0))
    )


class Constraint(Protocol[S]):
    """Equations of eliminated elements that hold exactly."""

    def project(self, state: S) -> S:
        """Return the state with every element put back; DidNotConverge where that fails."""

    def tangent(self, problem: Any, state: S) -> Tangent | None:
        """Return the motions that are left; None where all elements are free."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where unknowns stand in x, for the variables and touches that it was made for."""

    variables: tuple[Variables, ...]
    eliminated: Variables | None
    touches: tuple[tuple[tuple[Touch, ...], IntArray | None], ...]
    place: Mapping[str, IntArray]  # (n, d) positions in x of each kept block; n_kept for none
    n_kept: int
    places: tuple[Places, ...]

    def is_of(
        self,
        variables: tuple[Variables, ...],
        eliminated: Variables | None,
        touches: tuple[tuple[tuple[Touch, ...], IntArray | None], ...],
    ) -> bool:
        """Say whether it was made for these very objects."""
        return (
            self.eliminated is eliminated
            and len(self.variables) == len(variables)
            and len(self.touches) == len(touches)
            and all(a is b for a, b in zip(self.variables, variables, strict=True))
            and all(
                a is b and one is other
                for (a, one), (b, other) in zip(self.touches, touches, strict=True)
            )
        )


def _same_unknowns(old: _Layout, problem: Problem[Any]) -> bool:
    """Say whether the unknowns of a problem stand where those of a layout do."""
    return (
        old.eliminated is problem.eliminated
        and len(old.variables) == len(problem.variables)
        and all(
            a is b or (a.name == b.name and np.array_equal(a.unknown, b.unknown))
            for a, b in zip(old.variables, problem.variables, strict=True)
        )
    )


def _same_touches(
    factor: Factor[Any], touches: tuple[Touch, ...], element: IntArray | None
) -> bool:
    """Say whether the measurements of a factor touch what others did."""
    return (
        factor.element is element
        and len(factor.touches) == len(touches)
        and all(
            a[0] == b[0] and a[1] is b[1] and a[2] == b[2]
            for a, b in zip(factor.touches, touches, strict=True)
        )
    )


@dataclass(frozen=True, eq=False)
class Problem(Generic[S]):
    """Variables, factors and constraints; see :mod:`legcal.estimation`."""

    variables: tuple[Variables, ...]  # kept, those with labels first
    eliminated: Variables | None
    factors: tuple[Factor[S], ...]
    constraint: Constraint[S] | None = None
    held_directions: Array = field(
        default_factory=lambda: np.zeros((0, 0))
    )  # (w, m <= n_kept) fixed gauge
    name: str = "fit"  # in messages, with what to do where it fails
    remedy: str = "check the starting values and the measurements"
    _layout: _Layout | None = field(default=None, repr=False)  # made here

    def __post_init__(self) -> None:
        object.__setattr__(self, "_layout", self._laid_out(self._layout))

    def _laid_out(self, old: _Layout | None) -> _Layout:
        """Return the layout, with what is left of an old one."""
        touches = tuple((factor.touches, factor.element) for factor in self.factors)
        if old is not None and old.is_of(self.variables, self.eliminated, touches):
            return old
        same = old is not None and _same_unknowns(old, self)
        if old is not None and same:
            place, n_kept = old.place, old.n_kept
        else:
            counts = [block.n_unknowns for block in self.variables]
            first = np.cumsum([0, *counts]).tolist()
            n_kept = first[-1]
            place = {
                block.name: np.where(block.unknown < 0, n_kept, start + block.unknown)
                for block, start in zip(self.variables, first, strict=False)
            }
        known = [] if old is None else list(zip(old.touches, old.places, strict=True))
        places = []
        for factor in self.factors:
            alike = next((p for (t, e), p in known if _same_touches(factor, t, e)), None)
            if alike is not None and same:
                places.append(alike)
                continue
            touched = [element for _, element, _ in factor.touches]
            groups = None if alike is None else alike.groups
            if groups is None:
                groups = _Groups.of(touched, factor.element, factor.n)
            parts = [place[name][e[groups.first]][..., d] for name, e, d in factor.touches]
            flat = [part.reshape(len(part), int(np.prod(part.shape[1:]))) for part in parts]
            none = np.zeros((len(groups.first), 0), dtype=np.intp)
            columns = np.concatenate([none, *flat], axis=1)
            sizes = self.n_elements, self.d_element
            places.append(_places(groups, columns, factor.element, n_kept, sizes))
        return _Layout(self.variables, self.eliminated, touches, place, n_kept, tuple(places))

    @property
    def _laid(self) -> _Layout:
        return self._laid_out(None) if self._layout is None else self._layout

    @property
    def place(self) -> Mapping[str, IntArray]:
        """Positions in x of each kept block, (n, d); ``n_kept`` for what is no unknown."""
        return self._laid.place

    @cached_property
    def places(self) -> Mapping[str, Places]:
        """What the measurements of each factor depend on."""
        return dict(zip((f.name for f in self.factors), self._laid.places, strict=True))

    @property
    def n_kept(self) -> int:
        """Number of unknowns that are not eliminated."""
        return self._laid.n_kept

    @property
    def n_elements(self) -> int:
        """Number of eliminated elements."""
        return 0 if self.eliminated is None else len(self.eliminated.unknown)

    @property
    def d_element(self) -> int:
        """Number of unknowns of each."""
        return 0 if self.eliminated is None else self.eliminated.unknown.shape[1]

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.n_kept + self.n_elements * self.d_element

    @cached_property
    def named(self) -> tuple[str, ...]:
        """Names of the first unknowns: those of blocks with labels."""
        return tuple(label for block in self.variables for label in block.labels)

    @property
    def units(self) -> tuple[str, ...]:
        """Their units."""
        return tuple(unit for block in self.variables for unit in block.units)

    @cached_property
    def n_named(self) -> int:
        """Number of unknowns with a name."""
        return len(self.named)

    @cached_property
    def priors(self) -> GaussianPrior:
        """All priors, by positions in x."""
        found, first = NO_PRIOR, 0
        for block in self.variables:
            prior = block.prior
            found = found + replace(prior, unknown=first + prior.unknown)
            first += block.n_unknowns
        return found

    def where(self, name: str) -> IntArray:
        """Return the positions in x of a block's unknowns."""
        first = 0
        for block in self.variables:
            if block.name == name:
                return np.arange(first, first + block.n_unknowns, dtype=np.intp)
            first += block.n_unknowns
        raise KeyError(name)

    def block(self, name: str) -> Variables:
        """Return the kept block of a name."""
        return next(block for block in self.variables if block.name == name)

    def factor(self, name: str) -> Factor[S]:
        """Return the factor of a name."""
        return next(factor for factor in self.factors if factor.name == name)

    def with_parts(self, blocks: Sequence[Variables], factors: Sequence[Factor[S]]) -> Self:
        """Return the problem with other blocks and factors in place of those of the same names."""
        b, f = {block.name: block for block in blocks}, {factor.name: factor for factor in factors}
        return replace(
            self,
            variables=tuple(b.get(block.name, block) for block in self.variables),
            factors=tuple(f.get(factor.name, factor) for factor in self.factors),
        )

    def with_factors(self, *factors: Factor[S]) -> Self:
        """Return the problem with other factors in place of those of the same names."""
        return self.with_parts((), factors)

    def moved(self, state: S, x: Array) -> S:
        """Return the state after a change of its unknowns, whatever constraints say."""
        change = np.append(x[: self.n_kept], 0.0)
        values: dict[str, Any] = {
            block.name: block.retract(getattr(state, block.name), change[self.place[block.name]])
            for block in self.variables
            if block.n_unknowns
        }
        if self.eliminated is not None:
            own = x[self.n_kept :].reshape(-1, self.d_element)
            block = self.eliminated
            values[block.name] = block.retract(getattr(state, block.name), own)
        return replace(state, **values)  # type: ignore[type-var]

    def projected(self, state: S) -> S:
        """Return the state with eliminated elements put back on their constraints."""
        return state if self.constraint is None else self.constraint.project(state)

    def overshoot(self, x: Array) -> float:
        """Return by which factor a step exceeds the largest changes that blocks allow."""
        change, parts = np.append(x[: self.n_kept], 0.0), [0.0]
        for block in self.variables:
            if block.max_step and block.n_unknowns:
                by = np.abs(change[self.place[block.name]]) / np.array(block.max_step)
                parts.append(float(by.max(initial=0.0)))
        if self.eliminated is not None and self.eliminated.max_step:
            moved = np.abs(x[self.n_kept :].reshape(-1, self.d_element))
            parts.append(float((moved / np.array(self.eliminated.max_step)).max(initial=0.0)))
        return max(parts)

    def coordinates(self, state: S) -> Array:
        """Return the values (n_named,) of the named unknowns."""
        parts = [b.read(getattr(state, b.name)) for b in self.variables if b.labels]
        return np.concatenate([np.zeros(0), *parts])

    @property
    def is_read_directly(self) -> bool:
        """Whether these values change as x does: :meth:`jacobian` is one."""
        return all(not block.labels or block.jacobian is None for block in self.variables)

    def jacobian(self, state: S) -> Array:
        """Return the derivative (n_named, n_named) of these values by x."""
        J = np.eye(self.n_named)
        for block in self.variables:
            if block.labels and block.jacobian is not None:
                where = self.where(block.name)
                J[np.ix_(where, where)] = block.jacobian(getattr(state, block.name))
        return J


class PriorRows(NamedTuple):
    """Whitened priors of a block at a state."""

    r: Array  # (n,)
    # Derivatives by the unknowns of the block (n, n_unknowns), or by one unknown each (n,).
    slope: Array
    unknown: IntArray  # (n,) which, in x
    first: int  # of the block's unknowns, in x


@dataclass(frozen=True, eq=False)
class Linearization:
    """Whitened residuals with derivatives of all factors and priors at a state."""

    rows: Mapping[str, Residuals]
    priors: tuple[PriorRows, ...]  # of blocks that have any
    n_kept: int

    def __getitem__(self, name: str) -> Residuals:
        return self.rows[name]

    @cached_property
    def prior_r(self) -> Array:
        """Residuals of all priors, (n_priors,)."""
        return np.concatenate([np.zeros(0), *(prior.r for prior in self.priors)])

    @property
    def prior_J(self) -> Array:
        """Their derivatives, (n_priors, n_kept)."""
        parts = [np.zeros((0, self.n_kept))]
        for r, slope, unknown, first in self.priors:
            part = np.zeros((len(r), self.n_kept))
            if slope.ndim == 1:
                part[np.arange(len(r)), unknown] = slope
            else:
                part[:, first : first + slope.shape[1]] = slope
            parts.append(part)
        return np.concatenate(parts)

    def add_priors(self, U: Array, g: Array) -> None:
        """Add the normal equations of all priors to sums (n_kept, n_kept) and (n_kept,)."""
        for r, slope, unknown, first in self.priors:
            if slope.ndim == 1:
                np.add.at(U, (unknown, unknown), slope * slope)
                np.add.at(g, unknown, slope * r)
            else:
                block = slice(first, first + slope.shape[1])
                U[block, block] += slope.T @ slope
                g[block] += slope.T @ r


def linearize(
    problem: Problem[S], state: S, known: Mapping[str, Residuals] | None = None
) -> Linearization:
    """Return whitened residuals and derivatives of a problem at a state.

    *known* are rows of factors that were computed there already.
    """
    priors, first = [], 0
    for block in problem.variables:
        prior, size = block.prior, block.n_unknowns
        if len(prior.mean):
            value = getattr(state, block.name)
            r = prior.whitened(block.read(value)[prior.unknown] - prior.mean)
            slope = 1.0 / prior.sigma
            if block.jacobian is not None:
                slope = prior.whitened(block.jacobian(value)[prior.unknown])
            elif prior.whitening is not None:
                slope = prior.whitened(np.eye(size)[prior.unknown])
            priors.append(PriorRows(r, slope, first + prior.unknown, first))
        first += size
    known = {} if known is None else known
    rows = {f.name: known.get(f.name) or f.linearize(state) for f in problem.factors}
    return Linearization(rows, tuple(priors), problem.n_kept)
