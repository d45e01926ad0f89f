"""Home: settled on what legs demand, found where none is given, refused where it is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, Machine, write_machine
from machines import HOME, MACHINES, of_types
from mechanisms import ROOT, displaced
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.errors import DidNotConverge, ModelError
from legcal.machine import (
    LegKind,
    Mechanism,
    leg_scale,
    load_mechanism,
    platform_pose,
    readings_at,
    settle,
)
from legcal.machine.equations import constraints_at, demands_at, is_constrained
from legcal.machine.home import closed_home, find_home, settle_home
from legcal.machine.kinematics import close_at

SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
CARRIED = Layout((LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0) for k in range(6)]))


def _gap(mechanism: Mechanism, configuration: object) -> float:
    return float(np.abs(mechanism.chain.residual(np.asarray(configuration))).max())


@pytest.mark.parametrize("name", SHIPPED)
def test_a_slightly_wrong_home_settles_on_all_demands(name: str) -> None:
    mechanism = load_mechanism(name)
    rng = np.random.default_rng(3)
    for _ in range(5):
        off = displaced(mechanism.home, rng.normal(0.0, 5e-4, 6))
        home, configuration = closed_home(mechanism, off)
        assert _gap(mechanism, configuration) < 1e-12
        assert np.abs(constraints_at(mechanism, home).values).max(initial=0.0) < 2e-13
        np.testing.assert_allclose(
            platform_pose(mechanism, configuration).as_matrix(), home.as_matrix(), atol=1e-12
        )
        distance = np.abs(home.as_matrix() - off.as_matrix()).max()
        assert distance == 0.0 if not is_constrained(mechanism) else distance < 5e-3


@pytest.mark.parametrize("layout", [Layout(), CARRIED], ids=["virtual joint", "carried"])
@pytest.mark.parametrize("machine", MACHINES)
def test_a_rounded_home_closes_in_every_class(machine: str, layout: Layout, tmp_path: Path) -> None:
    mechanism = load_mechanism(write_machine(tmp_path, MACHINES[machine](), layout))
    rounded = RigidTransform.from_matrix(np.round(mechanism.home.as_matrix(), 4))
    home, configuration = closed_home(mechanism, rounded)
    assert _gap(mechanism, configuration) < 1e-12
    again = close_at(mechanism, home, configuration)
    np.testing.assert_allclose(
        platform_pose(mechanism, again).as_matrix(), home.as_matrix(), atol=1e-11
    )


def test_settling_moves_the_platform_only_across_the_constraint() -> None:
    mechanism = load_mechanism("hexapod-rod")
    start = displaced(mechanism.home, [0.0, 0.0, 0.0, 0.0, 0.0, 1e-4])
    settled, problem = settle(mechanism, start)
    assert problem is None
    constraint = constraints_at(mechanism, settled)
    assert abs(constraint.values[0, 0]) < 1e-13
    turn = (settled.rotation * start.rotation.inv()).as_rotvec()
    scale = leg_scale(mechanism, start)  # rotations count as displacements of a leg's end
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
    mechanism = load_mechanism(name)
    with pytest.raises(ModelError, match=f"legcal.home could not be used: found {found}"):
        settle_home(mechanism, displaced(mechanism.home, [*turn, *shift]))


@pytest.mark.parametrize("name", thinned(SHIPPED, ["hexapod", "3-rpr", "3-upu", "tricept"]))
def test_without_a_home_one_at_mid_travel_is_found(name: str) -> None:
    mechanism = load_mechanism(name)
    home, configuration = closed_home(mechanism, None)
    assert _gap(mechanism, configuration) < 1e-12
    motors = list(mechanism.motors)
    q = readings_at(mechanism, home)
    middle = np.array([0.5 * sum(leg.travel) for leg in mechanism.legs])
    np.testing.assert_allclose(q[motors], middle[motors], atol=1e-9)
    for leg, value in zip(mechanism.legs, q, strict=True):
        if leg.kind is LegKind.PASSIVE:
            assert leg.travel[0] <= value <= leg.travel[1]
    assert home.apply(mechanism.B_platform)[:, 2].mean() > -1e-9  # not below the base


@pytest.mark.parametrize("machine", ["3-RPR, tilted plane", "Tricept", "hexapod with a rod"])
def test_a_home_is_found_for_general_machines(machine: str, tmp_path: Path) -> None:
    mechanism = load_mechanism(write_machine(tmp_path, MACHINES[machine](), Layout()))
    home, configuration = closed_home(mechanism, None)
    assert _gap(mechanism, configuration) < 1e-12
    values = demands_at(mechanism, home)
    middle = [leg.sign * 0.5 * sum(leg.travel) for leg in mechanism.legs]
    wanted = np.array([middle[j] for j in mechanism.motors])
    np.testing.assert_allclose(values.values[0, values.measured], wanted, atol=1e-9)


@pytest.mark.parametrize("types", [["SU"] * 6, ["US"] * 3 + ["UR"]])
def test_small_machines_close_from_far_joint_angles(types: list[str], tmp_path: Path) -> None:
    large = of_types(types)
    legs = tuple(replace(leg, A=0.05 * leg.A, B_home=0.05 * leg.B_home) for leg in large.legs)
    home = RigidTransform.from_components(0.05 * HOME.translation, HOME.rotation)
    mechanism = load_mechanism(write_machine(tmp_path, Machine(legs, home), CARRIED))
    rng = np.random.default_rng(5)
    for _ in range(30):
        turned = rng.uniform(-2.0, 2.0, mechanism.chain.nv)
        start = mechanism.chain.integrate(mechanism.chain.neutral(), turned)
        assert _gap(mechanism, close_at(mechanism, mechanism.home, start, hold=False)) < 1e-12


def test_no_home_at_all_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("legcal.machine.home.TRIALS", 8)
    machine = of_types(["US"] * 6 + ["SS"])  # seven motors: their middles contradict each other
    mechanism = load_mechanism(write_machine(tmp_path, machine, Layout()))
    with pytest.raises(DidNotConverge, match=r"no home pose was found.*write legcal\.home"):
        find_home(mechanism)


def test_a_pose_out_of_the_plane_does_not_close(tmp_path: Path) -> None:
    layout = Layout(virtual="planar")
    mechanism = load_mechanism(write_machine(tmp_path, MACHINES["3-RPR"](), layout))
    above = displaced(mechanism.home, [0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    for hold in (True, False):
        with pytest.raises(DidNotConverge, match=r"'platform_free' leaves it 10 mm away"):
            close_at(mechanism, above, hold=hold)
