"""Weak directions: combinations of the unknowns of a step that its equation hardly determines.

Nominal models are accurate to some per cent. Directions with less information in an equation keep
their nominal value and are named: z of coplanar joints in (9) and (16), or the common rotation of
the axes on base and platform of a 3-UPU, which only translates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csc_array

from legcal.geometry.types import Array, IntArray
from legcal.machine.directions import SHOWN, describe_direction
from legcal.paper.equations import nominal_value
from legcal.paper.least_squares import LeastSquares, Term
from legcal.paper.nominal import NominalMachine
from legcal.paper.unknowns import Unknowns

_SIGMA_LENGTH = 0.01  # nominal standard deviation of joint centres and lengths [mean leg lengths]
_SIGMA_AXIS = 0.03  # nominal standard deviation of axes [rad]
_HELD = 3e-5  # standard deviation of a held direction, in units of these


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
    information = _without_poses(problem.derivative_at_start(weighted=weighted), n)
    lengths = machine.offsets[np.isfinite(machine.offsets)]
    if not len(lengths):  # a machine that is moved by hand
        lengths = machine.parameters.offsets
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
