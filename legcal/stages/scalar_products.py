"""The criterion C_1 of (9): scalar products of the vectors V of (8) do not depend on the frame.

V holds the vectors A_j A_g between the joints of a view and its revolute axes. In a planar
mechanism the axes are the normal of the plane: their products say nothing of the unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, combinations_with_replacement
from typing import Any

import casadi as ca
import numpy as np

from legcal.stages.base_unknowns import BaseUnknowns, turned_axis
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.nominal import NominalMechanism

Legs = tuple[tuple[int, ...], ...]


def build_scalar_products(mechanism: NominalMechanism, joints: JointsInCamera) -> LeastSquares:
    """Build C_1 of (9), with all products of all pairs of vectors, squares included.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints and axes are the start.
    joints : JointsInCamera
        The result of step 1, its axes with the signs of the nominal ones.

    Returns
    -------
    LeastSquares
        Residuals as printed [m^2, m, -]; the squares v . v = 1 are left out.
    """
    unknowns = BaseUnknowns.of(mechanism)
    legs = tuple(tuple(np.flatnonzero(located).tolist()) for located in joints.located)
    revolute = joints.axis_located & mechanism.revolute
    axes = tuple(tuple(np.flatnonzero(located).tolist()) for located in revolute)
    seen = [
        product
        for v in range(len(legs))
        for product in _products(
            _vectors(joints.A_camera[v], joints.v_camera[v], legs[v], axes[v]), len(axes[v])
        )
    ]
    x = tuple(unknowns.joints.ravel().tolist()), tuple(unknowns.axes.ravel().tolist())
    function = _differences(x, legs, axes)
    n_legs = mechanism.n_legs
    observed = (
        np.array(seen)[None, :],
        unknowns.known.T.reshape(1, 3, n_legs),
        np.hstack(list(unknowns.frames)).reshape(1, 3, 3 * n_legs),
    )
    return LeastSquares(
        "The base joints in the base frame (eq 9)",
        (Term(function, np.arange(len(unknowns))[None, :], observed),),
        unknowns.start,
        exact_hessian=True,
    )


@lru_cache(maxsize=4)
def _differences(
    places: tuple[tuple[int, ...], tuple[int, ...]], legs: Legs, axes: Legs
) -> ca.Function:
    """Return (A, turns of v; products seen, known, frames) -> products of all views, less seen."""
    n_legs = len(places[0]) // 3
    x = ca.SX.sym("x", max(*places[0], *places[1]) + 1)
    known, frames = ca.SX.sym("known", 3, n_legs), ca.SX.sym("frames", 3, 3 * n_legs)
    padded = ca.vertcat(x, 0.0)
    A = ca.reshape(padded[list(places[0])], 3, n_legs) + known
    turns = ca.reshape(padded[list(places[1])], 2, n_legs)
    joints = [A[:, j] for j in range(n_legs)]
    turned = [turned_axis(turns[:, j], frames[:, 3 * j : 3 * j + 3]) for j in range(n_legs)]
    products = [
        product
        for of_view, with_axis in zip(legs, axes, strict=True)
        for product in _products(_vectors(joints, turned, of_view, with_axis), len(with_axis))
    ]
    seen = ca.SX.sym("seen", len(products))
    return ca.Function("products", [x, seen, known, frames], [ca.vertcat(*products) - seen])


def _vectors(A: Any, v: Any, legs: Sequence[int], axes: Sequence[int]) -> list[Any]:
    """Return the set V of (8) in one view, axes last."""
    return [A[g] - A[j] for j, g in combinations(legs, 2)] + [v[j] for j in axes]


def _products(vectors: list[Any], n_axes: int) -> list[Any]:
    """Return the products of all pairs of vectors, and the squares of those that are no axes."""
    last = len(vectors) - n_axes
    return [
        vectors[p].T @ vectors[q]
        for p, q in combinations_with_replacement(range(len(vectors)), 2)
        if p != q or p < last
    ]
