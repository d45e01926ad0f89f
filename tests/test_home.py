"""Home: projected onto what rods and axes allow, found where none is given, refused if wrong."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, write_machine
from machines import (
    MACHINES,
    displaced,
    of_types,
    write_home,
)
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError
from legcal.geometry.types import Array
from legcal.machine.equations import pose_equations
from legcal.machine.kinematics import forward_kinematics, inverse_kinematics
from legcal.machine.leg import LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine, platform_pose, readings_at

machine_of = cache(load_mechanism)
CARRIED = Layout((LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0) for k in range(6)]))


def constraints(machine: Machine, T: RigidTransform) -> tuple[Array, Array]:
    """Return values and derivatives of the legs' equations that hold whatever the readings are."""
    found = pose_equations(machine.legs, T.rotation.as_matrix()[None], T.translation[None])
    return found.values[0, ~found.measured], found.by_pose[0, ~found.measured]


def check_closed(machine: Machine) -> None:
    configuration = machine.home_configuration
    assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
    np.testing.assert_allclose(
        platform_pose(machine, configuration).as_matrix(), machine.home.as_matrix(), atol=1e-12
    )
    assert np.abs(constraints(machine, machine.home)[0]).max(initial=0.0) < 2e-13


@pytest.mark.parametrize("name", ["hexapod", "3-rpr", "3-upu", "tricept", "delta"])
def test_a_slightly_wrong_home_is_projected_onto_all_constraints(name: str, tmp_path: Path) -> None:
    nominal = machine_of(name)
    off = displaced(nominal.home, np.random.default_rng(3).normal(0.0, 5e-4, 6))
    machine = load_mechanism(write_home(tmp_path, name, off))
    check_closed(machine)
    moved = np.abs(machine.home.as_matrix() - off.as_matrix()).max()
    free = nominal.spatial and not len(constraints(nominal, nominal.home)[0])
    assert moved < 1e-15 if free else 0.0 < moved < 5e-3


@pytest.mark.parametrize(
    ("description", "carried"),
    [("6-UPS", True), ("3-RPR, tilted plane", False), ("3-UPU", True), ("Tricept", False)],
)
def test_a_rounded_home_closes(description: str, carried: bool, tmp_path: Path) -> None:
    drawn = MACHINES[description]()
    rounded = RigidTransform.from_matrix(np.round(drawn.home.as_matrix(), 4))
    path = write_machine(tmp_path, drawn, CARRIED if carried else Layout())
    text = path.read_text()
    for exact, few in (
        (drawn.home.translation, rounded.translation),
        (drawn.home.rotation.as_quat(), rounded.rotation.as_quat()),
    ):
        for old, new in zip(exact.tolist(), few.tolist(), strict=True):
            assert f"- {old!r}\n" in text
            text = text.replace(f"- {old!r}\n", f"- {new!r}\n")
    path.write_text(text)
    machine = load_mechanism(path)
    check_closed(machine)
    T = forward_kinematics(machine, inverse_kinematics(machine, machine.home))
    np.testing.assert_allclose(T.as_matrix(), machine.home.as_matrix(), atol=1e-11)


# --- without a home -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hexapod", "3-rpr", "3-upu", "tricept"])
def test_without_a_home_one_at_mid_travel_above_the_base_is_found(
    name: str, tmp_path: Path
) -> None:
    machine = load_mechanism(write_home(tmp_path, name, None))
    check_closed(machine)
    assert any("legcal.home is not given" in note for note in machine.diagnostics)
    motors, q = list(machine.motors), readings_at(machine, machine.home)
    middle = np.array([0.5 * sum(leg.travel) for leg in machine.legs])
    np.testing.assert_allclose(q[motors], middle[motors], atol=1e-9)
    for leg, value in zip(machine.legs, q, strict=True):
        if leg.kind is LegKind.PASSIVE:
            assert leg.travel[0] <= value <= leg.travel[1]
    assert machine.home.apply(machine.B_platform)[:, 2].mean() > -1e-9
    assert machine.home.rotation.magnitude() < np.deg2rad(60.0)


@pytest.mark.parametrize("description", ["3-RPR, tilted plane", "hexapod with a rod"])
def test_a_home_is_found_for_general_machines(description: str, tmp_path: Path) -> None:
    path = write_machine(tmp_path, MACHINES[description](), Layout(home=False))
    machine = load_mechanism(path)
    check_closed(machine)
    motors = list(machine.motors)
    middle = np.array([0.5 * sum(leg.travel) for leg in machine.legs])
    q = readings_at(machine, machine.home)
    np.testing.assert_allclose(q[motors], middle[motors], atol=1e-9)


def test_that_there_is_no_home_at_all_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("legcal.machine.home.TRIALS", 8)
    path = write_machine(tmp_path, of_types(["US"] * 6 + ["SS"]), Layout(home=False))
    urdf = path.with_suffix(".urdf")
    limits = r'(<joint name="leg4_slider".*?)<limit lower="\S+" upper="\S+"'
    longer = re.sub(limits, r'\1<limit lower="3.0" upper="3.1"', urdf.read_text())
    urdf.write_text(longer)
    with pytest.raises(DidNotConverge, match=r"no home pose was found.*write legcal\.home"):
        load_mechanism(path)


# --- a wrong home -------------------------------------------------------------------------------

AXIS = r"leg 'leg\d' .* mm off the plane normal to its axis"


@pytest.mark.parametrize(
    ("name", "step", "found"),
    [
        ("hexapod-rod", (0, 0, 0, 0, 0, 0.05), r"leg '\w+' \d.* mm off its constant length"),
        ("3-rps", (0, 0, 0.2, 0, 0, 0), AXIS),
        ("3-upu", (0, 0, 0.2, 0, 0, 0), r"leg 'leg\d' .* mm twisted at its end"),
        ("tricept", (0.2, 0, 0, 0, 0, 0), r"leg '\w+' .* mm off the direction that it has in"),
        ("3-rpr", (0, 0, 0, 0, 0, 0.05), r"the platform 50 mm out of its plane"),
    ],
)
def test_a_home_far_from_closed_is_refused_by_leg_and_amount(
    name: str, step: tuple[float, ...], found: str, tmp_path: Path
) -> None:
    path = write_home(tmp_path, name, displaced(machine_of(name).home, step))
    with pytest.raises(ModelError, match=rf"legcal\.home could not be used: found {found}"):
        load_mechanism(path)


@pytest.mark.parametrize(("z", "reading"), [(5.0, r"46\d\d"), (0.75, r"4\d\d"), (0.02, r"-2\d\d")])
def test_a_home_further_out_than_the_travel_is_refused_with_both_numbers(
    z: float, reading: str, tmp_path: Path
) -> None:
    path = write_home(tmp_path, "hexapod", RigidTransform.from_translation([0.0, 0.0, z]))
    found = rf"legcal\.home could not be used: found leg 'leg\d' at {reading}\."
    with pytest.raises(
        ModelError, match=rf"{found}.*[25] more legs.*travel of .* to .* mm"
    ) as caught:
        load_mechanism(path)
    assert len(caught.value.problems) == 1
