"""More motors than freedoms: ranks, poses of least squares, errors of parameters, refusals."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from csv_rows import read_rows, write_rows
from fit_sessions import machine_session
from layouts import Layout, LegSpec, MachineSpec, write_machine
from machines import displaced, of_types, planar, ring
from outline_sessions import made
from scipy.spatial.transform import RigidTransform
from simulated import settings

import legcal
from legcal import (
    Follower,
    Machine,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
    random_configurations,
    simulate,
)
from legcal.calibration.session_changes import session_tests
from legcal.data.image_choice import image_sequences
from legcal.data.measurements import row_names
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable
from legcal.geometry.types import Array
from legcal.machine.closing import solve_poses
from legcal.machine.kinematics import platform_in_base
from legcal.machine.model import readings_at
from legcal.machine.parameters import geometries
from legcal.simulation.session import given_poses


def reading_residuals(machine: Machine, T_base_platform: RigidTransform, q: Array) -> Array:
    """Return the residuals of readings q (n_legs,) at a pose [m], zero for legs without motor.

    Without redundant motors they vanish at the pose of forward kinematics, up to rounding.
    """
    motors, residuals = list(machine.motors), np.zeros(machine.n_legs)
    residuals[motors] = np.asarray(q)[motors] - readings_at(machine, T_base_platform)[motors]
    return residuals


def _concurrent() -> MachineSpec:
    """Return a planar platform whose three motors turn about one point; a fourth leg is passive."""
    B, z = ring([0, 100, 220, 300], 0.12), np.array([0.0, 0.0, 1.0])
    A = np.array([[-0.4, 0.1, 0.0]] * 3 + [[0.1, -0.5, 0.0]])
    kinds = ["actuated"] * 3 + ["passive"]
    legs = [LegSpec("RR", a, b, k, z, z) for a, b, k in zip(A, B, kinds, strict=True)]
    return MachineSpec(tuple(legs), RigidTransform.identity(), frame_legs=(0, 3), normal=z)


MACHINES: dict[str, Callable[[], MachineSpec]] = {
    "4-RPR": lambda: planar(kinds=("actuated",) * 4),
    "2-RPS + 2-SPS + rod": lambda: of_types(
        ["RS", "RS", "SS", "SS", "SS"], ["actuated"] * 4 + ["constant"]
    ),
    "three motors about a point": _concurrent,
}


@cache
def machine_of(name: str) -> Machine:
    """Return a machine that is written and loaded once."""
    return load_mechanism(write_machine(Path(mkdtemp()), MACHINES[name](), Layout()))


def test_motors_as_many_as_freedoms_that_hold_fewer_do_not_determine_the_pose() -> None:
    machine = machine_of("three motors about a point")
    assert machine.mobility == len(machine.motors) == 3
    assert any("motors 3, which hold only 2" in note for note in machine.diagnostics)
    with pytest.raises(NotIdentifiable, match="3 motors that hold 2 of these freedoms"):
        Follower(machine)


@pytest.mark.parametrize("name", ["4-RPR", "2-RPS + 2-SPS + rod"])
def test_poses_are_those_of_least_squares(name: str) -> None:
    machine = machine_of(name)
    rng, motors = np.random.default_rng(1), list(machine.motors)
    drawn = random_configurations(machine, 1, rng)
    lower, upper = np.array([machine.legs[j].travel for j in motors]).T
    assert np.all((drawn.readings[:, motors] >= lower) & (drawn.readings[:, motors] <= upper))
    for T, q in zip(drawn.poses, drawn.readings, strict=True):
        found = forward_kinematics(machine, q)  # all readings agree
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-10)
        assert np.abs(reading_residuals(machine, found, q)).max() < 1e-11
        q[motors] += 2e-3 * rng.normal(size=len(motors))
        follower = Follower(machine)
        found = follower.move_to(q)
        inverse_kinematics(machine, found)  # the legs allow it
        residual = reading_residuals(machine, found, q)
        assert 1e-5 < np.abs(residual).max() < 0.01
        assert np.abs(machine.chain.linearize(follower.configuration)[0]).max() < 1e-11

        def cost(step: Array, T: RigidTransform = found, q: Array = q) -> float:
            """Return the sum of squares where the legs allow a pose near a displaced one."""
            near = platform_in_base(machine, displaced(T, step))
            legs, R, t = geometries(machine), near.rotation.as_matrix(), near.translation
            allowed = solve_poses(legs, machine.frame_legs, R[None], t[None])
            B = allowed.R[0] @ np.array([leg.B for leg in legs]).T + allowed.t.T
            A = np.array([leg.A for leg in legs])
            lengths = np.linalg.norm(B.T - A, axis=1)[motors]
            missed = machine.lengths_at(q[motors], motors) - lengths
            return float(missed @ missed)

        steps = 1e-4 * np.eye(6) if machine.spatial else 1e-4 * np.eye(6)[2:5]
        slope = [cost(step) - cost(-step) for step in steps]
        change = [cost(step) + cost(-step) - 2.0 * cost(0.0 * step) for step in steps]
        assert np.abs(slope).max() < 1e-3 * max(change)
        assert min(change) > -1e-12


def test_readings_that_contradict_each_other_are_refused_with_the_motor(tmp_path: Path) -> None:
    machine = machine_of("4-RPR")
    q = inverse_kinematics(machine, machine.home)
    wrong = q.copy()
    wrong[1] += 0.1
    # one motor too many says by how much, and that any of them may be meant
    found = r"of leg '(\S+)' \(or, equally likely, of .*leg\d.*\) (\S+) mm from the value given by"
    with pytest.raises(DidNotConverge, match=found):
        forward_kinematics(machine, wrong)
    follower = Follower(machine)
    with pytest.raises(DidNotConverge, match=found):
        follower.move_to(wrong)
    np.testing.assert_array_equal(follower.configuration, machine.home_configuration)
    header = ",".join(str(leg.prismatic) for leg in machine.legs)
    path = tmp_path / "poses.csv"
    path.write_text(f"{header}\n{','.join(map(str, q))}\n{','.join(map(str, wrong))}\n")
    with pytest.raises(DatasetError, match=rf"row 2 \(line 3\).*{found}"):
        given_poses(machine, path)


def test_a_wrong_reading_is_named_with_its_amount_and_does_no_harm(tmp_path: Path) -> None:
    session = machine_session(str(made("7-ups", tmp_path).yaml_path), n_poses=8)
    m, leg, row, off = session.measurements, 3, 5, 1e-3
    q = m.q.copy()
    q[row, leg] += off
    found = session.with_readings(q).fit()
    assert found.quality.redundant_readings is not None
    (one,) = found.quality.redundant_readings.wrong
    assert (one.leg, one.pose, one.image) == (leg, row, m.image[row])
    assert one.off == pytest.approx(off, abs=1e-6)
    assert found.quality.redundant_readings.doubts == ()
    assert session.off(found.legs) < 1e-6


def test_a_slip_of_a_redundant_machine_is_named_with_its_moment(tmp_path: Path) -> None:
    slip = 3e-4
    session = machine_session(str(made("7-ups", tmp_path).yaml_path), n_poses=8)
    m = session.measurements
    later = m.pose >= 4
    wrong = session.with_readings(m.q + slip * np.outer(later, np.arange(7) == 3))
    found, slipped = wrong.fit(), wrong.measurements
    first = session_tests(found.posterior, slipped, image_sequences(slipped, {})).findings[0]
    assert (first.kind, first.subject) == ("encoder", "leg4")
    assert first.amount == pytest.approx(slip, rel=0.05)
    names = np.array(row_names(slipped))
    assert first.between == (names[~later][-1], names[later][0])


@pytest.mark.system
def test_a_redundant_machine_calibrates_and_a_wrong_reading_is_refused(tmp_path: Path) -> None:
    machine, folder = made("4-rpr", tmp_path), tmp_path / "dataset"
    simulate(machine.yaml_path, folder, settings(poses=6, shared_poses=True))
    calibration = legcal.calibrate(folder, output=tmp_path / "result")
    judged = calibration.solution.quality.redundant_readings
    assert judged is not None
    assert 0.0 < judged.rms_expected < 1.0
    assert judged.rms == pytest.approx(judged.rms_expected, rel=0.5)
    truth = next((folder / "truth/models").glob("*.yaml"))
    before, after = (
        legcal.evaluate(path, truth, dataset=folder).displacement
        for path in (machine.yaml_path, tmp_path / "result/calibrated.yaml")
    )
    assert calibration.platform is not None
    assert calibration.platform.workspace is not None
    sigma = calibration.platform.sigma.mean_displacement
    assert after.mean() < 3.0 * sigma < 0.1 * before.mean()
    table = folder / "measurements.csv"
    rows, column = read_rows(table), str(machine.legs[1].prismatic)
    wrong = "0.12" if float(rows[0][column]) < 0.06 else "0.0"
    of_pose = [row | {column: wrong} if row["pose"] == rows[0]["pose"] else row for row in rows]
    write_rows(table, of_pose)
    with pytest.raises(
        DatasetError, match=r"readings of view .* from the value given by the other motors"
    ):
        legcal.calibrate(folder, output=tmp_path / "refused")
