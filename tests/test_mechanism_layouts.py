"""Equal mechanisms give equal analyses, whatever tree they are written in."""

import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from layouts import (
    PASSED,
    Layout,
    LegLayout,
    LegSpec,
    MachineSpec,
    expected_axes,
    expected_B,
    write_machine,
)
from machines import MACHINES, of_types
from thinned import thinned

from legcal.errors import OutOfClass
from legcal.machine import (
    Leg,
    Machine,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
    readings_at,
)

LAYOUTS = {
    "hung from the base": Layout(),
    "hung from the platform": Layout((LegLayout(hung="platform"),)),
    "S as revolutes": Layout((LegLayout(sphere=False),)),
    "S as revolutes, hung from the platform": Layout(
        (LegLayout(hung="platform", sphere=False, flip_axes=True),)
    ),
    "cut behind the slider": Layout((LegLayout(cut="mid", slid=0.02),)),
    "cut before the slider": Layout((LegLayout(cut="slider", mount=True),)),
    "flipped sliders and axes": Layout((LegLayout(flip_slider=True, flip_axes=True, slid=0.03),)),
    "mounts and idle spins": Layout((LegLayout(hung="platform", mount=True, spin="S"),)),
    "carried by leg 2": Layout(
        (LegLayout(), LegLayout(cut="carry"), *[LegLayout(slid=0.01, seed=k) for k in range(5)])
    ),
    "carried by leg 1": Layout(
        (LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0, seed=k) for k in range(1, 7)])
    ),
    "every leg otherwise": Layout(
        (
            LegLayout(hung="platform", slid=0.01, seed=4),
            LegLayout(cut="mid", flip_slider=True, seed=5),
            LegLayout(sphere=False, spin="S", mount=True, seed=6),
            LegLayout(cut="slider", flip_axes=True, slid=0.04, seed=7),
        )
    ),
}

OF_EACH_KIND = ("6-UPS", "3-RPR, tilted plane", "3-UPU", "Tricept")


def _check(machine: Machine, description: MachineSpec, layout: Layout) -> None:
    """Check that a mechanism is the machine that was drawn, to 1e-9."""
    assert machine.spatial == (description.normal is None)
    assert machine.frame_legs == description.frame_legs
    for j, (leg, spec) in enumerate(zip(machine.legs, description.legs, strict=True)):
        _check_leg(leg, spec, layout.of(j))
        base_axis, platform_axis, twist = expected_axes(description, j)
        A, B = spec.A, expected_B(description, j)
        _close(leg.A, A)
        _close(leg.B, B)
        _close(leg.base_axis, base_axis)
        _close(leg.platform_axis, platform_axis)
        _close(leg.twist, twist)
        length = np.linalg.norm(description.home.apply(B) - A)
        out = 0.0 if spec.kind == "constant" else PASSED
        _close(leg.q0, length - out)
        spins = machine.leg_chains[j].idle_spins
        added = layout.of(j).spin == "S" and "S" in spec.type
        assert spins == (spec.type == "SS") + added


def _check_leg(leg: Leg, spec: LegSpec, layout: LegLayout) -> None:
    assert (leg.base_joint, leg.platform_joint, leg.kind) == (*spec.ends, spec.kind)
    assert leg.sign == (-1 if layout.flip_slider and spec.kind != "constant" else 1)
    assert {c.side for c in leg.cylinders} == (
        {"base"} if spec.kind == "constant" or spec.ends[1] == "" else {"base", "platform"}
    )
    ends = {c.side: (c.start, c.end) for c in leg.cylinders}
    np.testing.assert_allclose(ends["base"], (0.0, 0.2), atol=1e-9)
    if "platform" in ends:
        np.testing.assert_allclose(ends["platform"], (-0.15, 0.0), atol=1e-9)


def _close(found: object, wanted: object) -> None:
    if wanted is None:
        assert found is None
    else:
        assert found is not None
        np.testing.assert_allclose(
            np.asarray(found, dtype=float), np.asarray(wanted, dtype=float), atol=1e-9
        )


@pytest.mark.parametrize(
    ("description", "name"),
    thinned(
        product(MACHINES, LAYOUTS),
        lambda description, name: description in OF_EACH_KIND or name == "every leg otherwise",
    ),
)
def test_every_layout_of_a_machine_gives_the_same_analysis(
    description: str, name: str, tmp_path: Path
) -> None:
    drawn, layout = MACHINES[description](), LAYOUTS[name]
    machine = load_mechanism(write_machine(tmp_path, drawn, layout))
    _check(machine, drawn, layout)
    freedoms = {"6": 6, "3": 3, "2": 2, "T": 3, "h": 5 if "rod" in description else 6}
    assert machine.mobility == freedoms[description[0]]


@pytest.mark.parametrize("description", ["3-RPR", "3-RPR, tilted plane"])
@pytest.mark.parametrize("hung", ["base", "platform"])
def test_a_planar_virtual_joint_changes_nothing(
    description: str, hung: str, tmp_path: Path
) -> None:
    drawn, layout = MACHINES[description](), Layout((LegLayout(hung=hung),), virtual="planar")
    machine = load_mechanism(write_machine(tmp_path, drawn, layout))
    _check(machine, drawn, layout)
    assert machine.mobility == 3
    assert drawn.normal is not None
    _close(machine.T_base_Rb.rotation.apply([0.0, 0.0, 1.0]), drawn.normal)
    z_e = (machine.home * machine.T_platform_Re).rotation.apply([0.0, 0.0, 1.0])
    _close(z_e, drawn.normal)


@pytest.mark.parametrize(
    ("description", "name"),
    thinned(
        product(["3-RPR", "3-RPR, tilted plane"], [*LAYOUTS, "planar joint"]),
        lambda description, name: description != "3-RPR" or name == "planar joint",
    ),
)
def test_a_planar_machine_may_be_written_with_few_digits(
    description: str, name: str, tmp_path: Path
) -> None:
    drawn = MACHINES[description]()
    layout = LAYOUTS.get(name, Layout((LegLayout(slid=0.01),), virtual="planar"))
    path = write_machine(tmp_path, drawn, layout)
    _round(path.with_suffix(".urdf"), 6)
    machine = load_mechanism(path)
    assert (machine.spatial, machine.mobility) == (False, 3)
    for j, leg in enumerate(machine.legs):
        np.testing.assert_allclose(leg.A, drawn.legs[j].A, atol=1e-5)
    step = machine.sign * np.array([0.01, -0.02, 0.03])
    q = inverse_kinematics(machine, machine.home) + step
    T = forward_kinematics(machine, q)
    np.testing.assert_allclose(readings_at(machine, T), q, atol=1e-5)


def _round(path: Path, digits: int) -> None:
    """Write all numbers of a file with few digits."""
    text = re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda x: f"{float(x[0]):.{digits}f}", path.read_text())
    path.write_text(text)


@pytest.mark.parametrize("virtual", ["floating", "planar"])
def test_a_planar_loop_that_is_open_across_its_plane_is_refused(
    virtual: str, tmp_path: Path
) -> None:
    path = write_machine(tmp_path, MACHINES["3-RPR"](), Layout(virtual=virtual))
    urdf = path.with_suffix(".urdf")
    seat = '<child link="leg2_seat"/><origin xyz="'
    start = urdf.read_text().index(seat) + len(seat)
    x, y, z, rest = re.split('[ "]', urdf.read_text()[start:], maxsplit=3)
    urdf.write_text(f'{urdf.read_text()[:start]}{x} {y} {float(z) + 1e-3}"{rest}')
    with pytest.raises(OutOfClass, match=r"'leg2_end' and 'leg2_seat' 1 mm and 0\.000 deg apart"):
        load_mechanism(path)


LEG_LAYOUTS = st.builds(
    LegLayout,
    hung=st.sampled_from(["base", "platform"]),
    cut=st.sampled_from(["far", "mid", "slider"]),
    sphere=st.booleans(),
    flip_slider=st.booleans(),
    flip_axes=st.booleans(),
    slid=st.sampled_from([0.0, 0.01, 0.05]),
    mount=st.booleans(),
    spin=st.sampled_from(["", "S"]),
    seed=st.integers(0, 9),
)
LEG_TYPES = st.sampled_from(["US", "SU", "SS", "RS", "SR", "UU", "RU", "UR", "RR", "U", "S"])


LEGS = st.tuples(LEG_TYPES, st.sampled_from(["actuated", "passive", "constant"])).filter(
    lambda leg: leg not in (("U", "constant"), ("S", "constant"))
)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    legs=st.lists(LEGS, min_size=3, max_size=6),
    layouts=st.lists(LEG_LAYOUTS, min_size=1, max_size=6),
    seed=st.integers(0, 99),
)
def test_any_legs_in_any_layout_are_found_as_drawn(
    legs: list[tuple[str, str]], layouts: list[LegLayout], seed: int, tmp_path: Path
) -> None:
    types, kinds = [leg[0] for leg in legs], [leg[1] for leg in legs]
    description, layout = of_types(types, kinds, seed), Layout(tuple(layouts))
    machine = load_mechanism(write_machine(tmp_path, description, layout))
    _check(machine, description, layout)


@pytest.mark.parametrize(
    ("drawn", "side", "found", "idle"),
    [
        ("UU", "base", "SPU", 0),
        ("UU", "platform", "UPS", 0),
        ("RU", "base", "RPS", 0),
        ("UR", "platform", "SPR", 0),
        ("U", "base", "SP", 0),
        ("U", "platform", "SP", 0),
        ("RS", "base", "RPS", 1),
        ("US", "base", "SPS", 1),
        ("SS", "platform", "SPS", 2),
    ],
)
def test_a_revolute_along_the_leg_is_part_of_an_s_or_idle(
    drawn: str, side: str, found: str, idle: int, tmp_path: Path
) -> None:
    description = of_types([drawn] * 3)
    for layout in (LegLayout(spin=side, sphere=False), LegLayout(spin=side, cut="mid", slid=0.03)):
        machine = load_mechanism(write_machine(tmp_path, description, Layout((layout,))))
        assert [leg.type for leg in machine.legs] == [found] * 3
        assert [chain.idle_spins for chain in machine.leg_chains] == [idle] * 3
        assert all(leg.twist is None for leg in machine.legs)
        for j, leg in enumerate(machine.legs):
            _close(leg.A, description.legs[j].A)
            _close(leg.B, expected_B(description, j))


@pytest.mark.parametrize("drawn", ["RR", "R"])
def test_a_revolute_along_a_leg_between_revolutes_is_refused(drawn: str, tmp_path: Path) -> None:
    description = of_types([drawn] * 3)
    path = write_machine(tmp_path, description, Layout((LegLayout(spin="base"),)))
    with pytest.raises(OutOfClass, match="'leg1_spin' along the leg, and no S joint"):
        load_mechanism(path)
