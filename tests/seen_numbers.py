"""How many numbers of a machine show in its lines at readings, by moving each of them."""

import numpy as np

from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg, LegColumns, LegKind
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, moved_legs
from legcal.machine.solved_poses import solve_poses


def lines_of(legs: tuple[Leg, ...], machine: Machine, R: Array, t: Array, q: Array) -> Array:
    """Return the lines of all legs at readings q, seen from the base."""
    poses = solve_poses(legs, machine.frame_legs, R, t, q)
    ends = np.stack([poses.R @ leg.B + poses.t for leg in legs], axis=1)
    bases = np.array([leg.A for leg in legs])
    along = (ends - bases) / np.linalg.norm(ends - bases, axis=2)[..., None]
    return np.concatenate([along, cross(bases, along)], axis=2)


def n_seen(machine: Machine) -> int:
    """Return how many numbers of a machine show in its lines, beside where its base stands.

    Every number of every leg is moved, twists apart, which count as known; in a plane those in it.
    """
    legs, home = geometries(machine), platform_in_base(machine, machine.home)
    rng, n = np.random.default_rng(1), 6
    shape = n, len(legs)
    q = np.full(shape, np.nan)
    lengths = np.linalg.norm([home.apply(leg.B) - leg.A for leg in legs], axis=1)
    for j, leg in enumerate(legs):
        if leg.kind is LegKind.ACTUATED:
            q[:, j] = lengths[j] - leg.q0 + rng.uniform(-0.01, 0.01, n)
    R, t = np.repeat(home.as_matrix()[None, :3], n, 0)[:, :, :3], np.tile(home.translation, (n, 1))
    reached = solve_poses(legs, machine.frame_legs, R, t, q)
    for j in machine.motors:  # those of redundant motors agree then
        ends = reached.R @ legs[j].B + reached.t
        q[:, j] = np.linalg.norm(ends - legs[j].A, axis=1) - legs[j].q0
    moves = np.ones((len(legs), LegColumns.COUNT), dtype=np.bool_)
    if not machine.spatial:
        moves[:] = False
        for end in (LegColumns.A, LegColumns.B):
            moves[:, end.start : end.start + 2] = True
        moves[:, LegColumns.LENGTH] = [leg.kind is not LegKind.PASSIVE for leg in legs]
    place = np.where(moves, np.cumsum(moves.ravel()).reshape(moves.shape) - 1, -1)
    columns = []
    for step in 1e-6 * np.eye(int(np.count_nonzero(moves))):
        lines = [
            lines_of(moved_legs(legs, place, s), machine, reached.R, reached.t, q)
            for s in (step, -step)
        ]
        columns.append((lines[0] - lines[1]).ravel() / 2e-6)
    singular = np.linalg.svd(np.column_stack(columns), compute_uv=False)
    n_twists = sum(leg.twist is not None for leg in legs)
    return int(np.sum(singular > 1e-6 * singular[0])) - (6 if machine.spatial else 3) - n_twists
