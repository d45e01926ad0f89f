"""Equal machines give equal analyses and poses, whatever tree they are written in."""

import pickle
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from edits import GONE, keyed
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st
from layouts import PASSED, Layout, LegLayout, LegSpec, MachineSpec, borne, write_machine
from machines import MACHINES, SHIPPED_URDF, SHIPPED_YAML, of_types

from legcal import Machine, forward_kinematics, inverse_kinematics, load_mechanism
from legcal.errors import OutOfClass, UsageError
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.leg import Leg

LAYOUTS = {
    "hung from the base": Layout(),
    "hung from the platform": Layout((LegLayout(hung="platform"),)),
    "S as revolutes": Layout((LegLayout(sphere=False),)),
    "S as revolutes, hung from the platform": Layout(
        (LegLayout(hung="platform", sphere=False, flip_axes=True),)
    ),
    "cut behind the slider": Layout((LegLayout(cut="mid", slid=0.02),)),
    "cut before the slider": Layout((LegLayout(cut="slider", mount=True, flip_slider=True),)),
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
MOBILITY = {"6": 6, "3": 3, "2": 2, "T": 3, "h": 6}


def _line(axis: Array) -> Array:
    """Return a unit vector whose last component that is not zero is positive."""
    axis = axis / np.linalg.norm(axis)
    return np.asarray(axis * np.sign(axis[np.abs(axis) > 1e-9][-1]))


def expected_axes(
    description: MachineSpec, j: int
) -> tuple[Array | None, Array | None, float | None]:
    """Return base axis, platform axis and twist of a leg, from how it is drawn at home."""
    leg = description.legs[j]
    base, platform = leg.ends
    if description.normal is not None:
        return None, None, None
    without_s = "S" not in leg.type
    a = leg.base_axis if base == "R" or (base == "U" and without_s) else None
    b = leg.platform_axis if platform == "R" or (platform == "U" and without_s) else None
    back = description.home.rotation.inv()
    b_platform = back.apply(leg.u) if platform == "" else None
    if b is not None:
        b_platform = _line(np.asarray(back.apply(b)))
    if not without_s:
        return (None if a is None else _line(a)), b_platform, None
    assert a is not None
    assert b_platform is not None
    p = a if base == "R" else np.cross(a, leg.u)
    if platform == "":
        w = description.home.rotation.apply(normal_basis(np.asarray(b_platform))[0])
    else:
        assert b is not None
        w = b if platform == "R" else np.cross(b, leg.u)
    angle = float(np.arctan2(leg.u @ np.cross(p, w), p @ w))
    return _line(a), b_platform, angle - np.pi * np.ceil(angle / np.pi - 0.5 - 1e-10)


def expected_B(description: MachineSpec, j: int) -> Array:
    """Return the platform joint centre of a leg in the platform link."""
    leg = description.legs[j]
    B = leg.B_home
    if leg.ends[1] == "":
        B = leg.A + ((np.asarray(description.home.translation) - leg.A) @ leg.u) * leg.u
    return np.asarray(description.home.inv().apply(B))


def _close(found: object, wanted: object) -> None:
    if wanted is None:
        assert found is None
        return
    assert found is not None
    one, other = np.asarray(found, dtype=float), np.asarray(wanted, dtype=float)
    np.testing.assert_allclose(one, other, atol=1e-9)


def _check(machine: Machine, description: MachineSpec, layout: Layout) -> None:
    """Check that a loaded machine is the one that was drawn, to 1e-9."""
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
        _close(leg.q0, length - (0.0 if spec.kind == "constant" else PASSED))
        spins = machine.legs[j].idle_spins
        assert spins == (spec.type == "SS") + (layout.of(j).spin == "S" and "S" in spec.type)


def _check_leg(leg: Leg, spec: LegSpec, layout: LegLayout) -> None:
    assert (leg.base_joint, leg.platform_joint, leg.kind) == (*spec.ends, spec.kind)
    assert leg.sign == (-1 if layout.flip_slider and spec.kind != "constant" else 1)
    if spec.kind != "constant":
        assert leg.travel == ((-0.5, 0.2) if layout.flip_slider else (-0.2, 0.5))
    ends = {c.side: (c.start, c.end) for c in leg.cylinders}
    _close(ends.pop("base"), (0.0, 0.2))
    if spec.kind != "constant" and spec.ends[1] != "":
        _close(ends.pop("platform"), (-0.15, 0.0))
    assert not ends
    for cylinder in leg.cylinders:  # along a leg of 0.7 m, from A
        _close(cylinder.span(0.7), (0.0, 0.2) if cylinder.side == "base" else (0.55, 0.7))


def _same_poses(one: Machine, other: Machine) -> None:
    """Check that equal lengthenings of the motors lead to equal poses."""
    lengthening = np.zeros(one.n_legs)
    lengthening[list(one.motors)] = np.linspace(-0.0007, 0.001, len(one.motors))
    T = forward_kinematics(one, inverse_kinematics(one, one.home) + one.sign * lengthening)
    q = inverse_kinematics(other, other.home) + other.sign * lengthening
    np.testing.assert_allclose(forward_kinematics(other, q).as_matrix(), T.as_matrix(), atol=1e-9)
    assert np.abs(T.as_matrix() - one.home.as_matrix()).max() > 1e-4


def _usual(description: str, name: str) -> bool:
    """Say whether a machine is tried in a layout: all layouts, one or two machines each."""
    if name == "every leg otherwise":
        return description in ("6-UPS", "Tricept", "hexapod with a strut")
    return description in OF_EACH_KIND and (
        (OF_EACH_KIND.index(description) + list(LAYOUTS).index(name)) % len(OF_EACH_KIND) == 0
    )


@pytest.mark.parametrize(
    ("description", "name"), [pair for pair in product(MACHINES, LAYOUTS) if _usual(*pair)]
)
def test_every_layout_of_a_machine_gives_the_same_analysis_and_poses(
    description: str, name: str, tmp_path: Path
) -> None:
    drawn, layout = MACHINES[description](), LAYOUTS[name]
    machine = load_mechanism(write_machine(tmp_path, drawn, layout))
    _check(machine, drawn, layout)
    assert machine.mobility == (
        5 if "hexapod with a rod" in description else MOBILITY[description[0]]
    )
    if name != "every leg otherwise":  # whose revolutes do not turn anywhere
        _same_poses(load_mechanism(write_machine(tmp_path / "plain", drawn, Layout())), machine)


def test_a_platform_that_is_the_child_of_a_last_joint_changes_nothing(tmp_path: Path) -> None:
    drawn, layout = borne(MACHINES["Tricept"](), 3, sphere=False)
    path = write_machine(tmp_path, drawn, layout)
    machine = load_mechanism(path)
    assert machine.platform_joint is None
    _check(machine, drawn, layout)
    assert machine.mobility == MOBILITY["T"]
    _same_poses(load_mechanism(write_machine(tmp_path / "plain", drawn, Layout())), machine)
    # Its home, where none is given, is as level as that of the machine in our layout.
    level = [
        load_mechanism(write_machine(tmp_path / name, drawn, replace(written, home=False))).home
        for name, written in (("a", layout), ("b", Layout()))
    ]
    np.testing.assert_allclose(level[0].as_matrix(), level[1].as_matrix(), atol=1e-9)


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
LEGS = st.tuples(
    st.sampled_from(["US", "SU", "SS", "RS", "SR", "UU", "RU", "UR", "RR", "U", "S"]),
    st.sampled_from(["actuated", "passive", "constant"]),
).filter(lambda leg: leg not in (("U", "constant"), ("S", "constant")))


@settings(
    max_examples=4, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
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
    try:
        machine = load_mechanism(write_machine(tmp_path, description, layout))
    except OutOfClass:  # drawn almost, or wrongly, overconstrained
        reject()
    _check(machine, description, layout)


@pytest.mark.parametrize(
    ("drawn", "side", "found", "idle"),
    [
        ("UU", "base", "SPU", 0),
        ("UR", "platform", "SPR", 0),
        ("U", "base", "SP", 0),
        ("US", "base", "SPS", 1),
        ("SS", "platform", "SPS", 2),
    ],
)
def test_a_revolute_along_the_leg_is_part_of_an_s_or_idle(
    drawn: str, side: str, found: str, idle: int, tmp_path: Path
) -> None:
    description = of_types([drawn] * 3)
    layouts = LegLayout(spin=side, sphere=False), LegLayout(spin=side, cut="mid", slid=0.03)
    machine = load_mechanism(write_machine(tmp_path, description, Layout(layouts)))
    assert [leg.type for leg in machine.legs] == [found] * 3
    assert [leg.idle_spins for leg in machine.legs] == [idle] * 3
    assert all(leg.twist is None for leg in machine.legs)
    for j, leg in enumerate(machine.legs):
        _close(leg.A, description.legs[j].A)
        _close(leg.B, expected_B(description, j))


# --- what a file does not name ------------------------------------------------------------------

UNNAMED = {
    "welded": Layout((LegLayout(cut="mid", sphere=False),)),
    "carried": LAYOUTS["carried by leg 1"],
}


@pytest.mark.parametrize(
    ("machine", "layout"),
    [
        ("3-RPR", "welded"),
        ("Tricept", "carried"),
    ],
)
def test_base_platform_and_legs_are_taken_from_the_bodies(
    machine: str, layout: str, tmp_path: Path
) -> None:
    path = write_machine(tmp_path, MACHINES[machine](), UNNAMED[layout])
    named = load_mechanism(path)
    keyed(path.name, legcal=GONE)(tmp_path)
    found = load_mechanism(path)
    assert (found.base, found.platform_joint) == ("base", named.platform_joint)
    assert found.leg_names == named.leg_names
    assert any("no block legcal" in note for note in found.diagnostics)
    np.testing.assert_allclose(found.A_base, named.A_base, atol=1e-9)
    assert [leg.type for leg in found.legs] == [leg.type for leg in named.legs]
    assert found.mobility == named.mobility


# --- the loaded machine -------------------------------------------------------------------------


def test_legs_may_be_reordered_and_a_machine_pickled() -> None:
    machine = load_mechanism("hexapod")
    names = ("leg3", "leg1", "leg2", "leg6", "leg5", "leg4")
    other = machine.with_leg_order(names)
    assert other.leg_names == names
    assert [names[j] for j in other.frame_legs] == ["leg1", "leg3", "leg5"]
    q = inverse_kinematics(machine, machine.home) + np.linspace(0.0, 0.02, 6)
    expected = forward_kinematics(machine, q).as_matrix()
    reordered = q[[machine.leg_names.index(name) for name in names]]
    np.testing.assert_allclose(
        forward_kinematics(other, reordered).as_matrix(), expected, atol=1e-12
    )
    copy = pickle.loads(pickle.dumps(machine))
    np.testing.assert_allclose(forward_kinematics(copy, q).as_matrix(), expected, atol=1e-13)
    with pytest.raises(UsageError, match="each of leg1"):
        machine.with_leg_order(["leg1"])


def test_the_urdf_is_found_beside_or_in_the_neighbour_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("models", "urdf", "hexapod"):
        (tmp_path / name).mkdir()
    path, urdf = tmp_path / "models" / "hexapod.yaml", tmp_path / "urdf" / "hexapod.urdf"
    path.write_text(SHIPPED_YAML.read_text().replace("  urdf: ../urdf/hexapod.urdf\n", ""))
    urdf.write_bytes(SHIPPED_URDF.read_bytes())
    assert load_mechanism(path).urdf_path == urdf
    urdf.rename(path.with_suffix(".urdf"))
    assert load_mechanism(path).urdf_path == path.with_suffix(".urdf")
    monkeypatch.chdir(tmp_path)  # where a folder has the name of a shipped model
    assert load_mechanism("hexapod").yaml_path == SHIPPED_YAML
