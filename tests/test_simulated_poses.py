"""Poses of simulated machines, drawn, given or commanded: reached and inside all limits."""

import re
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from machines import copied_model
from scipy.spatial.transform import RigidTransform

from legcal import Machine, forward_kinematics, inverse_kinematics, load_mechanism, singularity
from legcal.errors import DatasetError, DidNotConverge, ModelError
from legcal.geometry.types import Array
from legcal.machine.closing import dimensionless, is_on_same_side
from legcal.machine.configurations import JITTER, MIN_SINGULARITY, Configurations
from legcal.machine.leg import LegKind
from legcal.machine.model import vectors_A_to_B
from legcal.simulation import session as module
from legcal.simulation.session import commanded_poses, draw_poses, given_poses
from legcal.simulation.settings import DEFAULT_ERRORS, Sampling
from legcal.simulation.truth import write_true_model

LONG_TRAVEL = "nategh-agheli"  # whose legs cannot all be near the ends of their travel


def _drawn(machine: Machine, n: int) -> Configurations:
    return draw_poses(machine, n, np.random.default_rng(0), "extreme")


def _parts(machine: Machine, poses: Configurations) -> Array:
    """Return where the motors are in their travel, from 0 to 1, (n_poses, n_motors)."""
    motors = list(machine.motors)
    lower, upper = np.array([machine.legs[j].travel for j in motors]).T
    return np.asarray((poses.readings[:, motors] - lower) / (upper - lower))


@pytest.mark.parametrize("name", ["3-rpr", "tricept", "delta"])
def test_extreme_poses_of_shipped_machines_are_poses_of_theirs(name: str) -> None:
    machine = load_mechanism(name)
    poses = _drawn(machine, 4)
    assert len(poses.poses) == 4
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    least = MIN_SINGULARITY * singularity(machine, machine.home)
    (at_home,) = dimensionless(machine, machine.home.as_matrix()[None])
    for configuration, readings, T in zip(
        poses.configurations, poses.readings, poses.poses, strict=True
    ):
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-11
        np.testing.assert_allclose(readings, inverse_kinematics(machine, T), atol=1e-10)
        assert np.all((readings >= lower - 1e-9) & (readings <= upper + 1e-9))
        assert singularity(machine, T) >= least
        assert is_on_same_side(at_home, dimensionless(machine, T.as_matrix()[None])[0])
    part = _parts(machine, poses)
    assert np.ptp(part, axis=0).max() > 0.4
    assert np.all((part <= JITTER) | (part >= 1.0 - JITTER))


def test_without_enough_motors_the_machine_wanders() -> None:
    machine = load_mechanism("tricept")
    passive = replace(machine.legs[1], kind=LegKind.PASSIVE)
    free = replace(machine, legs=(machine.legs[0], passive, *machine.legs[2:]))
    poses = _drawn(free, 8)
    lower, upper = np.array([leg.travel for leg in free.legs]).T
    assert np.all((poses.readings >= lower - 1e-9) & (poses.readings <= upper + 1e-9))
    assert np.ptp(poses.readings, axis=0).min() > 1e-3
    for configuration in poses.configurations:
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-11


def _limited(name: str, joint: str, limits: tuple[float, float], folder: Path) -> Machine:
    """Load a copy of a shipped model with other limits of some revolutes."""
    lower, upper = limits
    pattern = re.compile(rf'(<joint name="{joint}".*?<limit )lower="\S*" upper="\S*"')

    def narrow(text: str) -> str:
        changed, n = pattern.subn(rf'\1lower="{lower}" upper="{upper}"', text)
        assert n > 0
        return changed

    return load_mechanism(copied_model(folder, name, narrow))


def test_joint_limits_of_revolutes_are_kept(tmp_path: Path) -> None:
    joints = [f"leg{j}_b{i}" for j in range(1, 7) for i in (1, 2)]
    free = load_mechanism("hexapod")
    columns = [free.chain.q_index(joint) for joint in joints]
    wide = _drawn(free, 12).configurations[:, columns]
    assert np.abs(wide).max() > 0.35
    narrow = _limited("hexapod", r"leg\d_b\d", (-0.35, 0.35), tmp_path)
    poses = _drawn(narrow, 12)
    assert np.abs(poses.configurations[:, columns]).max() <= 0.35
    part = _parts(narrow, poses)
    assert np.any(part < JITTER)
    assert np.any(part > 1.0 - JITTER)


def test_a_machine_that_cannot_move_inside_its_limits_says_what_stands_in_the_way(
    tmp_path: Path,
) -> None:
    stiff = _limited("hexapod", r"leg3_b\d", (-1e-9, 1e-9), tmp_path)
    with pytest.raises(DidNotConverge) as caught:
        _drawn(stiff, 8)
    (problem,) = caught.value.problems
    assert "8 poses could not be drawn: found 0 that the machine reaches in 300 draws" in problem
    assert "300 times by the limits of joints" in problem
    assert "times joint 'leg3_b" in problem
    assert "outside its limits of -0.0 to 0.0 deg" in problem


def test_a_joint_outside_its_limits_at_home_is_named(tmp_path: Path) -> None:
    wrong = _limited("hexapod", "leg2_b1", (0.5, 1.0), tmp_path)
    with pytest.raises(ModelError, match=r"joint 'leg2_b1' outside its limits of 28\.6 to 57\.3"):
        _drawn(wrong, 2)


def _along(machine: Machine, T: RigidTransform, j: int) -> list[tuple[Array, float]]:
    """Return points of the axes of a leg's cylinders, and their radii."""
    vector = vectors_A_to_B(machine, T)[j]
    length = float(np.linalg.norm(vector))
    return [
        (machine.A_base[j] + np.linspace(*c.span(length), 40)[:, None] * vector / length, c.radius)
        for c in machine.legs[j].cylinders
    ]


def _penetration(machine: Machine, T: RigidTransform) -> float:
    """Return by how much the cylinders of any two legs overlap, from sampled points [m]."""
    legs = [_along(machine, T, j) for j in range(machine.n_legs)]
    return max(
        r + s - float(np.linalg.norm(P[:, None] - Q[None], axis=-1).min())
        for one, other in combinations(legs, 2)
        for P, r in one
        for Q, s in other
    )


def _csv(folder: Path, machine: Machine, rows: Array) -> Path:
    """Write readings of all motors as a CSV."""
    header = [str(machine.legs[j].prismatic) for j in machine.motors]
    path = folder / "poses.csv"
    lines = [",".join(header), *[",".join(repr(float(q)) for q in row) for row in rows]]
    path.write_text("\n".join([*lines, ""]))
    return path


def test_given_readings_that_are_not_reached_are_named_by_row(tmp_path: Path) -> None:
    machine = load_mechanism(LONG_TRAVEL)
    home = inverse_kinematics(machine, machine.home)
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    rows = np.array([home, np.where(np.arange(6) % 2 == 0, lower, upper), home + 1e-3, home])
    rows[3, 2] = upper[2] + 0.01 * (upper - lower)[2]
    with pytest.raises(DatasetError) as caught:
        given_poses(machine, _csv(tmp_path, machine, rows))
    one, two = caught.value.problems
    assert "row 2 (line 3): the pose could not be used: found legs that cannot have" in one
    assert f"row 4 (line 5): the pose could not be used: found {machine.legs[2].prismatic}" in two
    assert f"outside its travel of {lower[2]:.9g} to {upper[2]:.9g} m" in two


def test_given_poses_with_legs_through_each_other_are_refused(tmp_path: Path) -> None:
    radius = partial(re.sub, r'radius="[^"]*"', 'radius="0.037"')
    thick = load_mechanism(copied_model(tmp_path, "hexapod", radius))
    poses = _drawn(load_mechanism("hexapod"), 12)
    overlaps = [_penetration(thick, T) for T in poses.poses]
    with pytest.raises(DatasetError, match="collide there, needed") as caught:
        given_poses(thick, _csv(tmp_path, thick, poses.readings))
    rows = {int(re.findall(r"row (\d+)", problem)[0]) - 1 for problem in caught.value.problems}
    assert rows == {i for i, overlap in enumerate(overlaps) if overlap > 0.0}


# --- poses that a controller with the nominal model could have commanded


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Machine, Machine]:
    nominal = load_mechanism(LONG_TRAVEL)
    folder: Path = tmp_path_factory.mktemp("truth")
    return nominal, write_true_model(nominal, DEFAULT_ERRORS, np.random.default_rng(3), folder)


def test_the_nominal_model_reaches_every_pose_at_its_readings(
    pair: tuple[Machine, Machine],
) -> None:
    nominal, truth = pair
    home = singularity(nominal, nominal.home)
    poses = commanded_poses(truth, nominal, 5, np.random.default_rng(0), Sampling.EXTREME)
    assert len(poses.configurations) == len(poses.poses) == len(poses.readings) == 5
    for T, q in zip(poses.poses, poses.readings, strict=True):
        near = forward_kinematics(nominal, q)
        assert singularity(nominal, near) >= 0.05 * home
        assert np.linalg.norm(near.translation - T.translation) < 0.1


def test_a_machine_far_from_its_model_is_refused(
    pair: tuple[Machine, Machine], monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal, truth = pair
    monkeypatch.setattr(module, "_reached", lambda _, q: np.zeros(len(q), dtype=np.bool_))
    monkeypatch.setattr(module, "_MAX_ROUNDS", 2)
    with pytest.raises(DidNotConverge, match="found 0 that the true machine and the nominal"):
        commanded_poses(truth, nominal, 1, np.random.default_rng(0), Sampling.EXTREME)
