"""Home: settled on what legs demand, found where none is given, refused where it is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, MachineSpec, write_machine
from machines import HOME, MACHINES, of_types
from mechanisms import ROOT, displaced
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.errors import DidNotConverge, ModelError
from legcal.machine import (
    LegKind,
    Machine,
    leg_scale,
    load_mechanism,
    platform_pose,
    project_pose,
    readings_at,
)
from legcal.machine.equations import constraints_at, equations_at, is_constrained
from legcal.machine.home import closed_home, find_home, project_home
from legcal.machine.kinematics import close_at

SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
CARRIED = Layout((LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0) for k in range(6)]))


def _gap(machine: Machine, configuration: object) -> float:
    return float(np.abs(machine.chain.residual(np.asarray(configuration))).max())


@pytest.mark.parametrize("name", SHIPPED)
def test_a_slightly_wrong_home_settles_on_all_demands(name: str) -> None:
    machine = load_mechanism(name)
    rng = np.random.default_rng(3)
    for _ in range(5):
        off = displaced(machine.home, rng.normal(0.0, 5e-4, 6))
        home, configuration = closed_home(machine, off)
        assert _gap(machine, configuration) < 1e-12
        assert np.abs(constraints_at(machine, home).values).max(initial=0.0) < 2e-13
        np.testing.assert_allclose(
            platform_pose(machine, configuration).as_matrix(), home.as_matrix(), atol=1e-12
        )
        distance = np.abs(home.as_matrix() - off.as_matrix()).max()
        assert distance == 0.0 if not is_constrained(machine) else distance < 5e-3


@pytest.mark.parametrize("layout", [Layout(), CARRIED], ids=["virtual joint", "carried"])
@pytest.mark.parametrize("description", MACHINES)
def test_a_rounded_home_closes_in_every_class(
    description: str, layout: Layout, tmp_path: Path
) -> None:
    machine = load_mechanism(write_machine(tmp_path, MACHINES[description](), layout))
    rounded = RigidTransform.from_matrix(np.round(machine.home.as_matrix(), 4))
    home, configuration = closed_home(machine, rounded)
    assert _gap(machine, configuration) < 1e-12
    again = close_at(machine, home, configuration)
    np.testing.assert_allclose(
        platform_pose(machine, again).as_matrix(), home.as_matrix(), atol=1e-11
    )


def test_settling_moves_the_platform_only_across_the_constraint() -> None:
    machine = load_mechanism("hexapod-rod")
    start = displaced(machine.home, [0.0, 0.0, 0.0, 0.0, 0.0, 1e-4])
    settled, problem = project_pose(machine, start)
    assert problem is None
    constraint = constraints_at(machine, settled)
    assert abs(constraint.values[0, 0]) < 1e-13
    turn = (settled.rotation * start.rotation.inv()).as_rotvec()
    scale = leg_scale(machine, start)  # rotations count as displacements of a leg's end
    way = np.concatenate([turn * scale, settled.translation - start.translation])
    normal = constraint.by_pose[0, 0] / [scale, scale, scale, 1.0, 1.0, 1.0]
    cosine = abs(way @ normal) / np.linalg.norm(way) / np.linalg.norm(normal)
    assert cosine == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "turn", "shift", "found"),
    [
        ("hexapod-rod", (0, 0, 0), (0, 0, 0.05), r"leg '\w+' \d.* mm off its constant length"),
        ("3-rps", (0, 0, 0.2), (0, 0, 0), r"leg 'leg\d' .* mm off the plane normal to its axis"),
        ("3-spr", (0, 0, 0.2), (0, 0, 0), r"leg 'leg\d' .* mm off the plane normal to its axis"),
        ("3-upu", (0, 0, 0.2), (0, 0, 0), r"leg 'leg\d' .* mm twisted at its end"),
        ("tricept", (0.2, 0, 0), (0, 0, 0), r"leg '\w+' .* mm off the direction that it has in"),
        ("3-rpr", (0, 0, 0), (0, 0, 0.05), r"the platform 50 mm out of its plane"),
        ("3-rpr", (0.2, 0, 0), (0, 0, 0), r"the platform .* mm out of its plane"),
    ],
)
def test_a_home_far_from_closed_is_refused_by_leg_and_amount(
    name: str, turn: tuple[float, ...], shift: tuple[float, ...], found: str
) -> None:
    machine = load_mechanism(name)
    with pytest.raises(ModelError, match=f"legcal.home could not be used: found {found}"):
        project_home(machine, displaced(machine.home, [*turn, *shift]))


@pytest.mark.parametrize("name", thinned(SHIPPED, ["hexapod", "3-rpr", "3-upu", "tricept"]))
def test_without_a_home_one_at_mid_travel_is_found(name: str) -> None:
    machine = load_mechanism(name)
    home, configuration = closed_home(machine, None)
    assert _gap(machine, configuration) < 1e-12
    motors = list(machine.motors)
    q = readings_at(machine, home)
    middle = np.array([0.5 * sum(leg.travel) for leg in machine.legs])
    np.testing.assert_allclose(q[motors], middle[motors], atol=1e-9)
    for leg, value in zip(machine.legs, q, strict=True):
        if leg.kind is LegKind.PASSIVE:
            assert leg.travel[0] <= value <= leg.travel[1]
    assert home.apply(machine.B_platform)[:, 2].mean() > -1e-9  # not below the base


@pytest.mark.parametrize("description", ["3-RPR, tilted plane", "Tricept", "hexapod with a rod"])
def test_a_home_is_found_for_general_machines(description: str, tmp_path: Path) -> None:
    machine = load_mechanism(write_machine(tmp_path, MACHINES[description](), Layout()))
    home, configuration = closed_home(machine, None)
    assert _gap(machine, configuration) < 1e-12
    values = equations_at(machine, home)
    middle = [leg.sign * 0.5 * sum(leg.travel) for leg in machine.legs]
    wanted = np.array([middle[j] for j in machine.motors])
    np.testing.assert_allclose(values.values[0, values.measured], wanted, atol=1e-9)


@pytest.mark.parametrize("types", [["SU"] * 6, ["US"] * 3 + ["UR"]])
def test_small_machines_close_from_far_joint_angles(types: list[str], tmp_path: Path) -> None:
    large = of_types(types)
    legs = tuple(replace(leg, A=0.05 * leg.A, B_home=0.05 * leg.B_home) for leg in large.legs)
    home = RigidTransform.from_components(0.05 * HOME.translation, HOME.rotation)
    machine = load_mechanism(write_machine(tmp_path, MachineSpec(legs, home), CARRIED))
    rng = np.random.default_rng(5)
    for _ in range(30):
        turned = rng.uniform(-2.0, 2.0, machine.chain.nv)
        start = machine.chain.integrate(machine.chain.neutral(), turned)
        assert _gap(machine, close_at(machine, machine.home, start, hold=False)) < 1e-12


def test_no_home_at_all_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("legcal.machine.home.TRIALS", 8)
    description = of_types(["US"] * 6 + ["SS"])  # seven motors: their middles contradict each other
    machine = load_mechanism(write_machine(tmp_path, description, Layout()))
    with pytest.raises(DidNotConverge, match=r"no home pose was found.*write legcal\.home"):
        find_home(machine)


def test_a_pose_out_of_the_plane_does_not_close(tmp_path: Path) -> None:
    layout = Layout(virtual="planar")
    machine = load_mechanism(write_machine(tmp_path, MACHINES["3-RPR"](), layout))
    above = displaced(machine.home, [0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    for hold in (True, False):
        with pytest.raises(DidNotConverge, match=r"'platform_free' leaves it 10 mm away"):
            close_at(machine, above, hold=hold)
