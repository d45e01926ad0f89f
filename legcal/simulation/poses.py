"""Poses that a controller could command: both the true machine and its nominal model reach them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import reading_columns, readings_in
from legcal.errors import DatasetError, DidNotConverge, ModelError, UsageError
from legcal.files import read_table
from legcal.geometry import Array, BoolArray, IntArray, segment_distance
from legcal.machine import (
    INSIDE,
    REGULAR,
    Configurations,
    Machine,
    beyond_travel,
    follow,
    forward_kinematics,
    joint_values,
    leg_vectors,
    platform_pose,
    singularity,
    slider_columns,
    strolled,
)
from legcal.progress import Report, no_progress
from legcal.simulation.request import Sampling

JITTER = 0.12  # of the travel, by which extreme lengths stay away from its ends at most

ROUNDING = 1e-9  # [rad]

TRIES = 60  # draws for each pose
FULL_EXTREME, FULL = 12, 2  # of them over all of the travel; the next nearer to home
NEARER = 0.85  # each
LEARNED = 6  # draws before those that reached the last pose; extremes are tried first always
WAY = (0.25, 0.5, 0.75, 1.0)  # parts of the way from home: no leg goes through another before
SHORTEST = 0.25  # of such a part; what is harder to reach is drawn again

STAGE = "Poses"
HOPELESS = 5  # poses in vain, one after the other

_REGULAR = 0.05  # of the nominal model's singularity measure at home
_ROUNDS = 20  # of draws for those that were left out


@dataclass(frozen=True, eq=False)
class GivenReadings:
    """Readings of the motors."""

    where: tuple[str, ...]  # the place of each row, for messages
    readings: Array  # (n_poses, n_motors) in the order of ``mechanism.motors`` [m]


def read_readings(path: Path, machine: Machine) -> GivenReadings:
    """Read a CSV of poses."""
    table = read_table(
        path,
        "file of poses",
        "row",
        reading_columns(machine.legs),
        needed="one row for each pose; write the readings of the motors",
    )
    readings, _ = readings_in(table, machine.legs)
    table.check()
    return GivenReadings(tuple(table.where), readings)


def near_ends(end: IntArray, chance: Array) -> Array:
    """Return places in the travel, 0 the shortest and 1 the longest, near given ends of it."""
    return np.asarray(np.abs(end - JITTER * chance))


def are_extreme(machine: Machine, readings: Array) -> BoolArray:
    """Say in which poses every motor is near an end of its travel, (n_poses,)."""
    motors = list(machine.motors)
    lower, upper = np.array([machine.legs[j].travel for j in motors]).reshape(-1, 2).T
    part = (readings[:, motors] - lower) / (upper - lower)
    return np.asarray(np.all(np.minimum(part, 1.0 - part) <= JITTER, axis=1))


class Clearance:
    """The cylinders of a machine, two by two."""

    def __init__(self, machine: Machine) -> None:
        self._mechanism = machine
        found = [(j, c) for j, leg in enumerate(machine.legs) for c in leg.cylinders]
        self._leg = np.array([j for j, _ in found], dtype=np.intp)
        self._ends = np.array([(c.start, c.end) for _, c in found]).reshape(-1, 2)
        self._from_platform = np.array([c.side == "platform" for _, c in found], dtype=np.bool_)
        radius = np.array([c.radius for _, c in found])
        first, second = np.triu_indices(len(found), 1)
        other = self._leg[first] != self._leg[second]
        self._pairs = np.stack([first[other], second[other]])
        self._needed = radius[self._pairs].sum(axis=0)
        judged = ~self._touching(machine.home)
        self._pairs, self._needed = self._pairs[:, judged], self._needed[judged]

    def touching(self, T_base_platform: RigidTransform) -> tuple[str, str] | None:
        """Return the first two legs that run through each other at a pose, None if none do."""
        touching = np.flatnonzero(self._touching(T_base_platform))
        if not len(touching):
            return None
        one, two = self._leg[self._pairs[:, touching[0]]]
        names = self._mechanism.leg_names
        return names[one], names[two]

    def _touching(self, T_base_platform: RigidTransform) -> BoolArray:
        """Return which pairs of cylinders are nearer than the sum of their radii."""
        vectors = leg_vectors(self._mechanism, T_base_platform)
        lengths = np.linalg.norm(vectors, axis=1)
        u = (vectors / lengths[:, None])[self._leg]
        along = self._ends + np.where(self._from_platform, lengths[self._leg], 0.0)[:, None]
        start = self._mechanism.A_base[self._leg] + along[:, :1] * u
        one, two = self._pairs
        span = np.diff(along, axis=1) * u
        distance = segment_distance(start[one], span[one], start[two], span[two])
        return np.asarray(distance < self._needed)


class Admission:
    """What a configuration is held against: travel, joint limits, singularities, other legs."""

    def __init__(self, machine: Machine) -> None:
        self._mechanism = machine
        self._clearance = Clearance(machine)
        limited = [
            (joint, joint.limits)
            for joint in machine.urdf.joints.values()
            if joint.type == "revolute" and joint.limits is not None
        ]
        self._revolutes = [joint.name for joint, _ in limited]
        self._columns = [machine.chain.q_index(name) for name in self._revolutes]
        self._limits = np.array([limits for _, limits in limited]).reshape(-1, 2)
        self._least = REGULAR * singularity(machine, machine.home)
        problem = self.beyond_limits(machine.home_configuration)
        if problem is not None:
            raise ModelError(
                f"{machine.yaml_path}: no pose could be drawn: found {problem} at home, needed "
                "every joint inside its limits there; correct legcal.home or the limits of the "
                "URDF."
            )

    def problem(self, configuration: Array, *, of_motors: bool = True) -> str | None:
        """Return what stands against a closed configuration, None if nothing does.

        The travel of motors is left out where their readings have been judged already.
        """
        machine = self._mechanism
        outside = beyond_travel(machine, configuration)
        if not of_motors:
            outside[list(machine.motors)] = False
        beyond = np.flatnonzero(outside)
        if len(beyond):
            return f"leg '{machine.leg_names[beyond[0]]}' outside its travel"
        problem = self.beyond_limits(configuration)
        if problem is not None:
            return problem
        T = platform_pose(machine, configuration)
        if singularity(machine, T) < self._least:
            return "the mechanism near a singularity"
        touching = self._clearance.touching(T)
        if touching is not None:
            return f"legs '{touching[0]}' and '{touching[1]}' run through each other"
        return None

    def beyond_limits(self, configuration: Array) -> str | None:
        """Return which revolute joint is outside its limits, whole turns not counted."""
        lower, upper = self._limits.T
        angles = configuration[self._columns]
        above = np.mod(angles - lower + ROUNDING, 2.0 * np.pi) - ROUNDING
        beyond = np.flatnonzero(above > upper - lower + ROUNDING)
        if not len(beyond):
            return None
        i = int(beyond[0])
        limits = f"{np.degrees(lower[i]):.1f} to {np.degrees(upper[i]):.1f} deg"
        return f"joint '{self._revolutes[i]}' outside its limits of {limits}"


class Draws:
    """Draws of configurations, and what stood against those that were none."""

    def __init__(self, machine: Machine, rng: np.random.Generator, *, extreme: bool) -> None:
        self._mechanism, self._rng, self._extreme = machine, rng, extreme
        self._admission = Admission(machine)
        self._here = machine.home_configuration
        self._home = self._here[slider_columns(machine, machine.motors)[0]]
        travel = np.array([machine.legs[j].travel for j in machine.motors]).reshape(-1, 2)
        self._lower, self._upper = travel.T
        self._tried = 0  # draws until the last pose was reached
        self.problems: Counter[str] = Counter()

    def next(self) -> Array | None:
        """Return the next configuration, None if many draws were in vain."""
        return self._followed() if self._mechanism.is_determined else self._walked()

    def said(self) -> str:
        """Return what stood in the way most often, in words."""
        found = [f"{count} times {what}" for what, count in self.problems.most_common(3)]
        return ", ".join(found)

    def _followed(self) -> Array | None:
        """Return what is followed from home to drawn readings of the motors."""
        start = 0 if self._extreme else max(0, self._tried - LEARNED)
        full = FULL_EXTREME if self._extreme else FULL
        for tried in range(start, start + TRIES):
            found = self._reached(self._readings(NEARER ** max(0, tried + 1 - full)))
            if not isinstance(found, str):
                self._tried = tried
                return found
            self.problems[found] += 1
        return None

    def _reached(self, readings: Array) -> Array | str:
        """Return the configuration at readings, or what stands in the way, there or before."""
        configuration = self._mechanism.home_configuration
        for part in WAY:
            q = readings if part == 1.0 else self._home + part * (readings - self._home)
            try:
                configuration = follow(
                    self._mechanism, configuration, q, shortest=SHORTEST, on_the_chain=True
                )
            except DidNotConverge:
                return "legs that cannot have such lengths at the same time"
            problem = self._admission.problem(configuration, of_motors=part == 1.0)
            if problem is not None:
                return problem
        return configuration

    def _walked(self) -> Array | None:
        """Return where a random walk on the closed configurations comes to."""
        for _ in range(TRIES):
            there = strolled(self._mechanism, self._here, self._rng)
            problem = self._admission.problem(there)
            if problem is None or beyond_travel(self._mechanism, there).any():
                self._here = there  # walks never lead further out of the travel
            if problem is None:
                return there
            self.problems[problem] += 1
        return None

    def _readings(self, nearer: float) -> Array:
        """Return drawn readings of the motors, taken nearer to home by a factor [m]."""
        part = self._rng.random(len(self._home))
        if self._extreme:
            part = near_ends(self._rng.integers(0, 2, len(self._home)), part)
        q = self._lower + part * (self._upper - self._lower)
        if nearer < 1.0:
            q = np.clip(self._home + nearer * (q - self._home), self._lower, self._upper)
        return np.asarray(q)


def draw_poses(
    machine: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling | str = Sampling.EXTREME,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine."""
    if n_poses < 1 or sampling not in list(Sampling):
        raise UsageError(
            f"Poses could not be drawn: found {n_poses} poses and the sampling '{sampling}', "
            f"needed at least one pose and {' or '.join(Sampling)}; choose them."
        )
    draws = Draws(machine, rng, extreme=Sampling(sampling) is Sampling.EXTREME)
    found: list[Array] = []
    in_vain = 0
    progress(STAGE, 0, n_poses)
    while len(found) < n_poses and in_vain < HOPELESS:
        configuration = draws.next()
        in_vain = in_vain + 1 if configuration is None else 0
        if configuration is not None:
            found.append(configuration)
            progress(STAGE, len(found), n_poses)
    if len(found) < n_poses:
        raise DidNotConverge(
            f"{machine.yaml_path}: {n_poses} poses could not be drawn: found {len(found)} that "
            f"the machine reaches in {draws.problems.total() + len(found)} draws "
            f"({draws.said()}), needed all; check legcal.home and the limits of the joints, or "
            "give poses."
        )
    return _poses(machine, found)


def given_poses(machine: Machine, path: Path) -> Configurations:
    """Return the poses at the readings of a CSV: actuated joints in its header, [m] below.

    Each is followed from the nearest one that is reached already, or from home.
    """
    if not machine.is_determined:
        raise UsageError(
            f"{path}: poses could not be given: found a machine of {machine.mobility} freedoms "
            f"and {len(machine.motors)} motors, needed one whose readings tell its pose; let "
            "poses be drawn."
        )
    given = read_readings(path, machine)
    admission, problems = Admission(machine), []
    known = [machine.home_configuration[slider_columns(machine, machine.motors)[0]]]
    reached = [machine.home_configuration]
    for where, row in zip(given.where, given.readings, strict=True):
        nearest = int(np.argmin(np.abs(np.array(known) - row).max(axis=1)))
        problem = _outside_travel(machine, row)
        if problem is None:
            try:
                configuration = follow(machine, reached[nearest], row)
            except DidNotConverge:
                problem = "legs that cannot have these lengths at the same time"
            else:
                problem = admission.problem(configuration, of_motors=False)
                known.append(row)
                reached.append(configuration)
        if problem is not None:
            problems.append(
                f"{where}: the pose could not be used: found {problem} there, needed a pose that "
                "the machine reaches from home; correct or remove the row."
            )
    if problems:
        raise DatasetError(problems)
    return _poses(machine, reached[1:])


def _outside_travel(machine: Machine, row: Array) -> str | None:
    """Return which reading of the motors, (n_motors,) [m], is outside its travel."""
    for j, q in zip(machine.motors, row, strict=True):
        leg = machine.legs[j]
        lower, upper = leg.travel
        if not lower - INSIDE <= q <= upper + INSIDE:
            travel = f"{lower:.9g} to {upper:.9g} m"
            return f"{leg.prismatic} at {q:.9g} m, outside its travel of {travel},"
    return None


def _poses(machine: Machine, configurations: list[Array]) -> Configurations:
    """Return closed configurations as poses."""
    return Configurations(
        np.array(configurations),
        np.array([joint_values(machine, c) for c in configurations]),
        [platform_pose(machine, c) for c in configurations],
    )


def commanded_poses(
    truth: Machine,
    nominal: Machine,
    n_poses: int,
    rng: np.random.Generator,
    sampling: Sampling,
    progress: Report = no_progress,
) -> Configurations:
    """Return random poses of a machine that its nominal model reaches at the same readings.

    A controller plans with the nominal model. Beside a singularity small errors decide whether
    legs of some lengths meet at all, and poses there are drawn again. Where motors do not
    determine the pose, nothing is asked of the nominal model.
    """
    kept: list[Configurations] = []
    missing = n_poses
    for _ in range(_ROUNDS):
        report = partial(_report, progress, n_poses - missing)
        drawn = draw_poses(truth, missing, rng, sampling, report)
        reached = [i for i, q in enumerate(drawn.readings) if _reaches(nominal, q)]
        kept.append(_chosen(drawn, reached))
        missing -= len(reached)
        if missing == 0:
            return _joined(kept)
    raise DidNotConverge(
        f"{nominal.yaml_path}: {n_poses} poses could not be drawn: found {n_poses - missing} that "
        f"the true machine and the nominal model reach at the same readings in {_ROUNDS} rounds, "
        "needed all; make the errors of the true machine smaller, or give poses."
    )


def _report(progress: Report, kept: int, stage: str, done: int, total: int) -> None:
    """Report poses beside those that are kept already."""
    progress(stage, kept + done, kept + total)


def _reaches(nominal: Machine, q: Array) -> bool:
    """Say whether the nominal model reaches readings, away from its singularities."""
    if not nominal.is_determined:
        return True
    try:
        T = forward_kinematics(nominal, q)
    except DidNotConverge:
        return False
    return singularity(nominal, T) >= _REGULAR * singularity(nominal, nominal.home)


def _chosen(poses: Configurations, index: list[int]) -> Configurations:
    """Return some of the poses."""
    return Configurations(
        poses.configurations[index],
        poses.readings[index],
        [poses.poses[i] for i in index],
    )


def _joined(poses: list[Configurations]) -> Configurations:
    """Return the poses of several sets."""
    return Configurations(
        np.concatenate([p.configurations for p in poses]),
        np.concatenate([p.readings for p in poses]),
        [T for p in poses for T in p.poses],
    )
