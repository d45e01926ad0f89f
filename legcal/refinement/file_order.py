"""A solution found in the order of work, in the order of the dataset's files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from legcal.dataset.folder import Dataset
from legcal.geometry.types import IntArray
from legcal.mechanism.leg_steps import footed
from legcal.mechanism.parametrization import parametrize
from legcal.observations.canonical_order import (
    Order,
    inverse,
    reorder_measurements,
    restore_outlines,
)
from legcal.refinement.known_parameters import known_parameters
from legcal.refinement.solution import Solution


def in_file_order(solution: Solution, order: Order, dataset: Dataset) -> Solution:
    """Return a solution found in the order of work, in the order of the dataset's files.

    Parameters
    ----------
    solution : Solution
        In the order of work.
    order : Order
        What that order is.
    dataset : Dataset
        In the order of the files.

    Returns
    -------
    Solution
        B of legs that are fixed to the platform is where models put it.
    """
    mechanism, measurements = dataset.mechanism, dataset.measurements
    legs, views = inverse(order.legs).tolist(), inverse(order.views).tolist()
    origin = np.asarray(mechanism.T_platform_Re.inv().translation)
    geometry = footed([solution.legs[j] for j in legs], origin)
    by_leg = {leg: j for j, leg in enumerate(legs)}
    radii = {(by_leg[leg], part): value for (leg, part), value in solution.radii.items()}
    with_board = dataset.board is not None
    known = known_parameters(mechanism, measurements.views, with_board=with_board).by_name
    ordered = [name for name in known if name in solution.values]
    names = tuple(name for name in ordered if name in solution.names)
    names_of_legs, frame_legs = mechanism.leg_names, mechanism.frame_legs
    parametrization = parametrize(names_of_legs, geometry, frame_legs, twists=True)
    where = _places(names, solution.names)
    steps = _places(parametrization.names, solution.parametrization.names)
    return replace(
        solution,
        legs=geometry,
        T_camera_Rb=tuple(solution.T_camera_Rb[v] for v in views),
        cameras=tuple(solution.cameras[v] for v in views),
        T_Rb_Re=tuple(solution.T_Rb_Re[p] for p in _poses(order, dataset).tolist()),
        radii=dict(sorted(radii.items())),
        parametrization=parametrization,
        values={name: solution.values[name] for name in ordered},
        units={name: solution.units[name] for name in ordered},
        status={name: solution.status[name] for name in ordered},
        names=names,
        covariance=solution.covariance[np.ix_(where, where)],
        sigma=solution.sigma[where],
        kinematic_covariance=solution.kinematic_covariance[np.ix_(steps, steps)],
        held_covariance=solution.held_covariance[np.ix_(steps, steps)],
        value_covariance=solution.value_covariance[np.ix_(steps, steps)],
        held_basis=solution.held_basis[:, steps],
        sensitivities=tuple(replace(s, steps=s.steps[steps]) for s in solution.sensitivities),
        outlines=restore_outlines(solution.outlines, order),
    )


def _places(names: tuple[str, ...], among: tuple[str, ...]) -> IntArray:
    """Return where names stand among the same ones in another order."""
    return np.array([among.index(name) for name in names], dtype=np.intp)


def _poses(order: Order, dataset: Dataset) -> IntArray:
    """Return for every pose of the dataset its number in the order of work."""
    pose = dataset.measurements.pose
    worked = reorder_measurements(dataset.measurements, order).pose[inverse(order.rows)]
    found = np.empty(dataset.measurements.n_poses, dtype=np.intp)
    found[pose] = worked
    return found
