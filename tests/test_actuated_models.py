"""Machines whose rods hang on carriages and arms: written, loaded, and by closed forms."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from machines import ROOT, delta_with_round_arms, read_table
from scipy.spatial.transform import RigidTransform

from legcal import Machine, export, forward_kinematics, inverse_kinematics, load_mechanism
from legcal.descriptions.new_model import Dimensions, create_model, description_of
from legcal.descriptions.table import described_machine
from legcal.errors import ModelError
from legcal.exports.subject import Subject
from legcal.geometry.types import Array
from legcal.machine.home import home_of_legs
from legcal.machine.leg import ARMS as ARM_KINDS
from legcal.machine.leg import ParameterId
from legcal.machine.model import readings_at
from legcal.machine.model_writer import write_model
from legcal.machine.parameters import geometries, moved_legs, parametrization_of, vector_of
from legcal.simulation.truth import write_model_with

TABLES = ROOT / "models" / "tables"
# --- what is shipped ----------------------------------------------------------------------------


def test_an_arm_that_is_a_cylinder_is_a_line_of_the_first_rod_on_it(tmp_path: Path) -> None:
    machine = create_model(delta_with_round_arms(4.0), tmp_path).machine
    bare = load_mechanism("delta")
    assert parametrization_of(machine).names == parametrization_of(bare).names
    arms = [leg.arm for leg in machine.legs if leg.arm is not None]
    assert tuple(arm.leg for arm in arms) == ("leg1", "leg3", "leg5")
    for actuator, arm in zip(machine.actuators, arms, strict=True):
        assert actuator.arm is arm
        assert arm.radius == 0.004
        joints = [leg.A for leg in machine.legs if leg.prismatic == actuator.joint]
        near, far = arm.ends
        np.testing.assert_allclose(far, np.mean(joints, axis=0), atol=1e-6)
        np.testing.assert_allclose(np.cross(near - actuator.point, actuator.axis), 0.0, atol=1e-6)

    legs, found = geometries(machine), parametrization_of(machine, twists=True)
    step = np.random.default_rng(1).uniform(-1e-3, 1e-3, len(found))
    step[[n.endswith(".gain") for n in found.names]] = 0.0
    moved = moved_legs(legs, found.place, step)
    home = home_of_legs(machine, moved, 0.2)
    assert home is not None
    again = load_mechanism(write_model_with(machine, moved, home, tmp_path / "moved", {}))
    apart = vector_of(found, geometries(again), legs) - vector_of(found, moved, legs)
    np.testing.assert_allclose(apart, 0.0, atol=1e-12)
    of_arms = [i for i, n in enumerate(found.names) if ParameterId.parse(n).kind in ARM_KINDS]
    assert len(of_arms) == 4 * len(arms)
    assert np.abs(vector_of(found, moved, legs)[of_arms]).min() > 1e-7


# --- closed forms -------------------------------------------------------------------------------


def trilaterated(centres: Array, length: float) -> Array:
    """Return the point at one distance from three, below their plane."""
    x = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    to_third = centres[2] - centres[0]
    y = to_third - (to_third @ x) * x
    y /= np.linalg.norm(y)
    d = float(np.linalg.norm(centres[1] - centres[0]))
    u = 0.5 * d
    v = (to_third @ to_third - 2.0 * u * (to_third @ x)) / (2.0 * (to_third @ y))
    z = np.cross(x, y)
    w = np.sqrt(length**2 - u**2 - v**2) * -np.sign(z[2])
    return np.asarray(centres[0] + u * x + v * y + w * z)


def outwards(k: int) -> Array:
    """Return the direction in which motor k stands."""
    return np.array([np.cos(2.0 * np.pi * k / 3.0), np.sin(2.0 * np.pi * k / 3.0), 0.0])


def test_a_delta_moves_by_its_closed_forms(tmp_path: Path) -> None:
    """Compare with three spheres, and with the equation of one arm in its plane.

    Both are those of R. Clavel, Conception d'un robot parallele rapide a 4 degres de liberte
    (1991), and R. L. Williams II, The Delta Parallel Robot (2016).
    """
    R, r, arm, rod = 0.14, 0.045, 0.2, 0.4
    size = Dimensions(family="delta", unit="mm", base_radius=140.0, platform_radius=45.0)
    machine = create_model(description_of(None, size), tmp_path).machine
    z = np.array([0.0, 0.0, 1.0])
    for q in np.radians([[20.0, 20.0, 20.0], [5.0, 40.0, 25.0], [-20.0, 30.0, 60.0]]):
        elbows = [
            (R - r + arm * np.cos(a)) * outwards(k) - arm * np.sin(a) * z for k, a in enumerate(q)
        ]
        wanted = trilaterated(np.array(elbows), rod)
        T = forward_kinematics(machine, np.repeat(q, 2))
        np.testing.assert_allclose(T.translation, wanted, atol=1e-9)
        assert T.rotation.magnitude() < 1e-9
        for k in range(3):
            x, height = R - r - wanted @ outwards(k), wanted[2]
            beside = wanted @ np.cross(z, outwards(k))
            K = (rod**2 - arm**2 - x**2 - beside**2 - height**2) / (2.0 * arm)
            both = np.arctan2(height, x) + np.array([1.0, -1.0]) * np.arccos(
                K / np.hypot(x, height)
            )
            turned = (both - q[k] + np.pi) % (2.0 * np.pi) - np.pi
            assert np.abs(turned).min() < 1e-9
        found = inverse_kinematics(machine, RigidTransform.from_translation(wanted))
        np.testing.assert_allclose(found, np.repeat(q, 2), atol=1e-9)


def test_linear_deltas_and_orthoglides_move_by_three_spheres() -> None:
    machine = load_mechanism("linear-delta")
    q, z = np.array([0.02, 0.11, 0.16]), np.array([0.0, 0.0, 1.0])
    down = np.sqrt(0.4**2 - 0.19**2)
    carriages = [0.19 * outwards(k) + (0.15 + down + a - 0.1) * z for k, a in enumerate(q)]
    T = forward_kinematics(machine, np.repeat(q, 2))
    np.testing.assert_allclose(T.translation, trilaterated(np.array(carriages), 0.4), atol=1e-9)
    machine = load_mechanism("orthoglide")
    p = np.array([0.03, -0.04, 0.05])
    across = np.sqrt(0.4**2 - (p @ p - p**2))
    wanted = p - across + 0.4 + 0.1  # of the carriages, at mid-travel at home
    found = inverse_kinematics(machine, RigidTransform.from_translation(p))
    np.testing.assert_allclose(found, np.repeat(wanted, 2), atol=1e-9)
    T = forward_kinematics(machine, np.repeat(wanted, 2))
    np.testing.assert_allclose(T.translation, p, atol=1e-9)
    assert T.rotation.magnitude() < 1e-9


# --- tables -------------------------------------------------------------------------------------


def test_a_table_says_at_which_of_two_readings_a_motor_stands_at_home(tmp_path: Path) -> None:
    table = yaml.safe_load((TABLES / "linear-delta.yaml").read_text())
    for entry in table["actuators"].values():
        entry["travel"] = [-800, 200]  # the carriages may stand below the platform too
    path, shipped = tmp_path / "table.yaml", load_mechanism("linear-delta")

    def at(reading: float) -> Machine:
        stated = {"home_readings": dict.fromkeys(table["actuators"], float(1e3 * reading))}
        path.write_text(yaml.safe_dump(table | stated))
        return create_model(read_table(path), tmp_path / f"{reading:g}").machine

    above = float(inverse_kinematics(shipped, shipped.home)[0])
    below = above - 2.0 * float(np.sqrt(0.4**2 - (0.25 - 0.06) ** 2))
    for reading, sign in ((above, 1), (below, -1)):
        machine = at(reading)
        np.testing.assert_allclose(inverse_kinematics(machine, machine.home), reading, atol=1e-9)
        again = load_mechanism(write_model(machine, tmp_path / f"again{sign}")[0])
        modes = {leg.mode for leg in (*machine.legs, *again.legs)}
        assert modes == {sign * shipped.legs[0].mode}
    with pytest.raises(ModelError, match=r"'rail1'.* correct home or home_readings"):
        at(above - 0.05)


def test_rods_of_other_joints_are_loaded_as_they_were_stated(tmp_path: Path) -> None:
    """Build each kind of rod once, on an arm and on a carriage, and write it as a model again."""
    table = yaml.safe_load((TABLES / "servo-hexapod.yaml").read_text())
    del table["type"]
    table["types"] = ["RSU", "RUS", "RSS", "PUS", "PSU", "PSS"]
    for name in ("servo4", "servo5", "servo6"):
        table["actuators"][name] = {"direction": [0, 0.1, 1], "travel": [-20, 30]}
    path = tmp_path / "mixed.yaml"
    path.write_text(yaml.safe_dump(table | {"name": "mixed", "home": None}, sort_keys=False))
    machine = create_model(read_table(path), tmp_path).machine
    assert [leg.type for leg in machine.legs] == table["types"]
    assert machine.mobility == len(machine.motors) == 6
    again = load_mechanism(write_model(machine, tmp_path / "again")[0])
    assert [leg.actuator.joint for leg in again.legs if leg.actuator] == list(machine.motor_names)
    np.testing.assert_array_equal(again.A_base, machine.A_base)


def test_of_two_readings_at_home_the_one_that_a_file_draws_is_taken(tmp_path: Path) -> None:
    arms = yaml.safe_load((TABLES / "delta.yaml").read_text())
    motors = arms["actuators"]
    wide = {name: arm | {"travel_deg": [-175, 175]} for name, arm in motors.items()}
    table = arms | {"actuators": wide, "home_readings_deg": dict.fromkeys(motors, 20)}
    machine = create_model(described_machine(table, Path("wide")), tmp_path).machine
    export(Subject(machine, "wide"), "mjcf", tmp_path / "wide.xml")
    back = load_mechanism(tmp_path / "wide.xml")
    assert [leg.mode for leg in back.legs] == [leg.mode for leg in machine.legs]
    np.testing.assert_allclose(readings_at(back, back.home), np.radians(20.0), atol=1e-9)
