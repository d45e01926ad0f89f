"""Random closed configurations inside the travel, in the assembly mode of home.

Where the motors determine the pose their readings are drawn and followed from home. Not all legs
can be at the ends of a long travel at the same time: what is not reached is drawn again, and
nearer to home after two draws in vain. Where motors do not determine the pose, home wanders on the
manifold of closed configurations.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge
from legcal.geometry import Array, BoolArray
from legcal.machine.kinematics import follow, joint_values, platform_pose, slider_columns
from legcal.machine.mobility import free_motions, project, singularity
from legcal.machine.model import Mechanism

TRIES = 40  # draws for each configuration
NEARER = 1.3 * 0.8 ** np.arange(TRIES)  # how far from home draws go, at most all of the way
REGULAR = 0.1  # of the singularity measure at home: nobody works nearer to a singularity
SHORTEST = 1.0 / 16.0  # of the way from home; what is harder to reach is drawn again
WALK = 6  # steps of a random walk between two configurations
ON_THE_CHAIN = 7  # draws of eight, where following is quick
HOPELESS = 20  # configurations in vain, if they are the first
STRIDE = 0.15  # [rad], and of a leg length
INSIDE = 1e-12  # [m]
WORKSPACE_POSES = 100  # that stand for the workspace wherever errors over it are told
WORKSPACE_SEED = 20020721


class Configurations(NamedTuple):
    """Closed configurations, their readings and poses.

    Attributes
    ----------
    configurations : (count, nq) array
        Of the closed chain.
    readings : (count, n_legs) array
        Joint value of every leg [m], passive ones too; zero for legs of constant length.
    poses : list of RigidTransform
        T_base_platform.
    """

    configurations: Array
    readings: Array
    poses: list[RigidTransform]


def random_configurations(
    mechanism: Mechanism, count: int, rng: np.random.Generator | int
) -> Configurations:
    """Return random closed configurations with every slider inside its travel.

    Readings of motors are uniform in the travel and followed from home without crossing a
    singularity or ending beside one; those that cannot be reached are drawn again, nearer and
    nearer to home. Where motors do not determine the pose, the mechanism takes a random walk.

    Parameters
    ----------
    mechanism : Mechanism
        The machine.
    count : int
        How many.
    rng : Generator or int
        Source of chance, or its seed.

    Returns
    -------
    Configurations
        Arrays of configurations and readings, and a list of poses.

    Raises
    ------
    DidNotConverge
        If too few are reached.
    """
    chance = np.random.default_rng(rng)
    draw = _drawn if mechanism.is_determined else _wandered
    found = list(draw(mechanism, count, chance))
    if len(found) < count:
        raise DidNotConverge(
            f"{mechanism.yaml_path}: random poses could not be drawn: found {len(found)} of "
            f"{count} inside the travel in {TRIES} tries for each, needed all; check legcal.home "
            "and the limits of the sliders."
        )
    return Configurations(
        np.array(found).reshape(count, mechanism.chain.nq),
        np.array([joint_values(mechanism, c) for c in found]).reshape(count, mechanism.n_legs),
        [platform_pose(mechanism, c) for c in found],
    )


def workspace(mechanism: Mechanism) -> Configurations:
    """Return the configurations that stand for the workspace, the same at every call.

    Errors over the workspace are those at these poses, whether they are predicted or found by
    comparing two models. The order of the legs does not matter.

    Raises
    ------
    DidNotConverge
        As :func:`random_configurations`.
    """
    names = sorted(mechanism.leg_names)
    ordered = mechanism.with_leg_order(names)
    drawn = random_configurations(ordered, WORKSPACE_POSES, WORKSPACE_SEED)
    legs = [names.index(name) for name in mechanism.leg_names]
    return drawn._replace(readings=drawn.readings[:, legs])


def _drawn(mechanism: Mechanism, count: int, chance: np.random.Generator) -> Iterator[Array]:
    """Yield what is reached from home at random readings of the motors."""
    motors = [mechanism.legs[j] for j in mechanism.motors]
    lower, upper = np.array([leg.travel for leg in motors]).T
    home = mechanism.home_configuration[slider_columns(mechanism, mechanism.motors)[0]]
    least = REGULAR * singularity(mechanism, mechanism.home)
    drawn = 0
    for turn in range(count):
        if turn == HOPELESS and not drawn:
            return
        for tries, nearer in enumerate(NEARER):
            q = chance.uniform(lower, upper)
            if nearer < 1.0:
                q = np.clip(home + nearer * (q - home), lower, upper)
            try:
                reached = follow(
                    mechanism,
                    mechanism.home_configuration,
                    q,
                    shortest=SHORTEST,
                    on_the_chain=tries % (ON_THE_CHAIN + 1) < ON_THE_CHAIN,
                )
            except DidNotConverge:  # the legs cannot have these lengths at the same time
                continue
            if beyond_travel(mechanism, reached).any():
                continue
            if singularity(mechanism, platform_pose(mechanism, reached)) >= least:
                drawn += 1
                yield reached
                break


def _wandered(mechanism: Mechanism, count: int, chance: np.random.Generator) -> Iterator[Array]:
    """Yield every few steps of a random walk whose sliders stay inside their travel."""
    here = mechanism.home_configuration
    for _ in range(count):
        for _ in range(TRIES):
            here = strolled(mechanism, here, chance)
            if not beyond_travel(mechanism, here).any():
                yield here
                break


def strolled(mechanism: Mechanism, here: Array, chance: np.random.Generator) -> Array:
    """Return a closed configuration a few steps away, no further outside the travel."""
    for _ in range(WALK):
        motions = free_motions(mechanism, here)
        weights = chance.normal(size=motions.shape[1]) / np.sqrt(max(motions.shape[1], 1))
        there = project(mechanism, mechanism.chain.integrate(here, STRIDE * motions @ weights))
        if there is None:
            continue
        if not np.any(beyond_travel(mechanism, there) & ~beyond_travel(mechanism, here)):
            here = there
    return here


def beyond_travel(mechanism: Mechanism, configuration: Array) -> BoolArray:
    """Return which legs are outside their travel, or flipped, (n_legs,)."""
    values = joint_values(mechanism, configuration)
    lower, upper = np.array([leg.travel for leg in mechanism.legs]).T
    outside = (values < lower - INSIDE) | (values > upper + INSIDE)
    return np.asarray(outside | (mechanism.sign * values + mechanism.q0 <= 0.0))
