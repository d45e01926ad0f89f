"""Kinematics of every class: mobility, forward and inverse, closed forms against the closures."""

from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegLayout, write_machine
from machines import MACHINES, of_types
from mechanisms import ROOT, displaced
from scipy.spatial.transform import RigidTransform, Rotation
from thinned import thinned

from legcal.errors import NotIdentifiable, UsageError
from legcal.machine import (
    Follower,
    LegKind,
    Machine,
    forward_kinematics,
    forward_kinematics_many,
    inverse_kinematics,
    leg_vectors,
    load_mechanism,
    random_configurations,
    slider_columns,
)
from legcal.machine.equations import constraints_at, equations_at
from legcal.machine.mobility import determinant_sign, free_motions, generic_configurations, mobility
from legcal.machine.mobility import freedoms_at as freedoms

MOBILITY = {
    "3-rpr": 3,
    "3-rps": 3,
    "3-spr": 3,
    "3-upu": 3,
    "3-upu-tilted": 3,
    "6-sps": 6,
    "hexapod": 6,
    "hexapod-rod": 5,
    "hexapod-strut": 6,
    "nategh-agheli": 6,
    "tricept": 3,
}
OF_EACH_KIND = ("6-UPS", "3-RPR, tilted plane", "3-UPU", "Tricept")
SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
LAYOUTS = {
    "hung from the platform": Layout((LegLayout(hung="platform"),)),
    "cut before the slider": Layout((LegLayout(cut="slider", flip_slider=True),)),
    "carried by leg 1": Layout(
        (LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0, seed=k) for k in range(1, 7)])
    ),
    "idle spins": Layout((LegLayout(spin="S", flip_axes=True),)),
}


@pytest.fixture(scope="module", params=SHIPPED)
def shipped(request: pytest.FixtureRequest) -> Machine:
    return load_mechanism(str(request.param))


def test_mobility_of_the_shipped_models(shipped: Machine) -> None:
    assert mobility(shipped) == MOBILITY[shipped.yaml_path.stem]
    assert shipped.mobility == len(shipped.motors)


def test_what_is_free_beyond_the_platform_are_idle_spins(shipped: Machine) -> None:
    spins = sum(leg.idle_spins for leg in shipped.legs)
    for configuration in generic_configurations(shipped, 3):
        every, of_platform = freedoms(shipped, configuration)
        assert every - of_platform == spins


def test_generic_configurations_are_closed_and_differ(shipped: Machine) -> None:
    found = list(generic_configurations(shipped, 3))
    assert len(found) == 3
    for configuration in found:
        assert np.abs(shipped.chain.residual(configuration)).max() < 1e-12
    for one, two in pairwise(found):
        assert np.abs(one - two).max() > 1e-3


def test_random_configurations_are_closed_inside_unflipped_and_in_one_mode(
    shipped: Machine,
) -> None:
    drawn = random_configurations(shipped, 12, 5)
    sides = {determinant_sign(shipped, shipped.home)}
    lower, upper = np.array([leg.travel for leg in shipped.legs]).T
    for configuration, q, T in zip(*drawn, strict=True):
        assert np.abs(shipped.chain.residual(configuration)).max() < 1e-12
        assert np.abs(constraints_at(shipped, T).values).max(initial=0.0) < 1e-11
        assert np.all((q >= lower - 1e-9) & (q <= upper + 1e-9))
        np.testing.assert_allclose(inverse_kinematics(shipped, T), q, atol=1e-11)
        sides.add(determinant_sign(shipped, T))
    assert len(sides) == 1
    assert np.ptp(drawn.readings[:, list(shipped.motors)], axis=0).min() > 1e-3


def test_forward_kinematics_inverts_inverse_kinematics_in_every_class(shipped: Machine) -> None:
    drawn = random_configurations(shipped, 8, 6)
    for T, found in zip(drawn.poses, forward_kinematics_many(shipped, drawn.readings), strict=True):
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


def test_legs_point_from_base_to_platform_along_their_sliders(shipped: Machine) -> None:
    sliding = tuple(j for j, leg in enumerate(shipped.legs) if leg.prismatic is not None)
    for configuration, _, T in zip(*random_configurations(shipped, 4, 7), strict=True):
        lengths = np.linalg.norm(leg_vectors(shipped, T), axis=1)
        q = configuration[slider_columns(shipped, sliding)[0]]
        signed = shipped.sign[list(sliding)] * q + shipped.q0[list(sliding)]
        np.testing.assert_allclose(signed, lengths[list(sliding)], atol=1e-11)
        for leg, u in zip(shipped.legs, leg_vectors(shipped, T), strict=True):
            if leg.platform_joint == "" and leg.platform_axis is not None:
                assert T.rotation.apply(leg.platform_axis) @ u > 0.0


def test_closed_forms_have_the_derivatives_of_the_closures(shipped: Machine) -> None:
    drawn = random_configurations(shipped, 3, 8)
    step = 1e-6
    for configuration, T in zip(drawn.configurations, drawn.poses, strict=True):
        motions = free_motions(shipped, configuration)
        shipped.chain.linearize(configuration)
        local = shipped.chain.twist(shipped.base, shipped.platform) @ motions
        R = T.rotation.as_matrix()
        twist = np.concatenate([R @ local[3:], R @ local[:3]])  # as the legs' equations have it
        rates = equations_at(shipped, T).by_pose[0] @ twist
        measured = equations_at(shipped, T).measured
        assert np.abs(rates[~measured]).max(initial=0.0) < 1e-9  # no demand is broken
        columns = slider_columns(shipped, shipped.motors)[1]
        signs = shipped.sign[list(shipped.motors)]
        np.testing.assert_allclose(rates[measured], signs[:, None] * motions[columns], atol=1e-9)
        for numeric in np.eye(6):
            ahead, behind = (
                equations_at(shipped, displaced(T, s * numeric)).values[0] for s in (step, -step)
            )
            np.testing.assert_allclose(
                (ahead - behind) / (2.0 * step),
                equations_at(shipped, T).by_pose[0] @ numeric,
                atol=1e-7,
            )


@pytest.mark.parametrize(
    ("description", "layout"),
    thinned(
        product(MACHINES, LAYOUTS),
        lambda description, layout: description in OF_EACH_KIND or layout == "carried by leg 1",
    ),
)
def test_every_layout_has_the_same_kinematics(
    description: str, layout: str, tmp_path: Path
) -> None:
    drawn = MACHINES[description]()
    plain = load_mechanism(write_machine(tmp_path / "plain", drawn, Layout()))
    other = load_mechanism(write_machine(tmp_path / "other", drawn, LAYOUTS[layout]))
    home = inverse_kinematics(plain, plain.home)
    motors = list(plain.motors)
    lengthening = np.zeros(len(home))
    lengthening[motors] = np.linspace(-0.0007, 0.001, len(motors))
    T = forward_kinematics(plain, home + lengthening)
    q = inverse_kinematics(other, other.home) + other.sign * lengthening
    np.testing.assert_allclose(forward_kinematics(other, q).as_matrix(), T.as_matrix(), atol=1e-9)
    assert np.abs(T.as_matrix() - plain.home.as_matrix()).max() > 1e-4


@pytest.mark.parametrize("name", ["3-RPR", "3-RPR, tilted plane"])
@pytest.mark.parametrize("virtual", ["floating", "planar"])
def test_a_planar_platform_is_where_three_distances_put_it(
    name: str, virtual: str, tmp_path: Path
) -> None:
    description = MACHINES[name]()
    machine = load_mechanism(write_machine(tmp_path, description, Layout(virtual=virtual)))
    assert not machine.spatial
    drawn = random_configurations(machine, 5, 2)
    n = description.normal
    assert n is not None
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        motion = T * machine.home.inv()
        axis = motion.rotation.as_rotvec()
        assert np.abs(np.cross(axis, n)).max() < 1e-12
        assert abs((T.translation - machine.home.translation) @ n) < 1e-12
        found = np.linalg.norm(leg_vectors(machine, T), axis=1)
        np.testing.assert_allclose(found, machine.sign * q + machine.q0, atol=1e-12)


def test_a_3_rpr_agrees_with_its_distance_equations() -> None:
    machine = load_mechanism("3-rpr")
    drawn = random_configurations(machine, 10, 4)
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        x, y, _ = T.translation
        angle = T.rotation.as_rotvec()[2]
        c, s = np.cos(angle), np.sin(angle)
        for j in range(3):
            bx, by, _ = machine.B_platform[j]
            ax, ay, _ = machine.A_base[j]
            square = (x + c * bx - s * by - ax) ** 2 + (y + s * bx + c * by - ay) ** 2
            assert np.sqrt(square) == pytest.approx(q[j] + machine.q0[j], abs=1e-12)


def test_a_translating_3_upu_only_translates() -> None:
    machine = load_mechanism("3-upu")
    for T in random_configurations(machine, 10, 4).poses:
        turn = (T.rotation * machine.home.rotation.inv()).magnitude()
        assert turn < 1e-9


def test_a_tilted_3_upu_turns_too() -> None:
    machine = load_mechanism("3-upu-tilted")
    turns = [T.rotation.magnitude() for T in random_configurations(machine, 10, 4).poses]
    assert max(turns) > 1e-3


def test_a_follower_goes_where_forward_kinematics_goes(shipped: Machine) -> None:
    q = random_configurations(shipped, 1, 3).readings[0]
    home = inverse_kinematics(shipped, shipped.home)
    follower = Follower(shipped)
    poses = [follower.move_to(home + s * (q - home)) for s in np.linspace(0.0, 1.0, 15)]
    np.testing.assert_allclose(poses[0].as_matrix(), shipped.home.as_matrix(), atol=1e-12)
    cold = forward_kinematics(shipped, q)
    np.testing.assert_allclose(poses[-1].as_matrix(), cold.as_matrix(), atol=1e-9)
    warm = forward_kinematics(shipped, q, start=poses[-2])
    np.testing.assert_allclose(warm.as_matrix(), cold.as_matrix(), atol=1e-9)
    rounded = RigidTransform.from_matrix(np.round(poses[-2].as_matrix(), 4))
    near = forward_kinematics(shipped, q, start=rounded)
    np.testing.assert_allclose(near.as_matrix(), cold.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("name", ["hexapod", "6-sps", "3-rpr", "3-rps"])
def test_without_a_determinant_a_path_is_followed_in_small_changes(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = load_mechanism(name)
    drawn = random_configurations(machine, 3, 9)
    monkeypatch.setattr("legcal.machine.kinematics.determinant_sign", lambda *_: 0.0)
    for q, T in zip(drawn.readings, drawn.poses, strict=True):
        found = forward_kinematics(machine, q)
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("name", "step", "found"),
    [
        ("hexapod-rod", (0, 0, 0, 0, 0, 0.02), r"leg '\w+' would be .* mm off its constant length"),
        ("3-rps", (0, 0, 0.1, 0, 0, 0), r"would be .* mm off the plane normal to its axis"),
        ("3-upu", (0, 0, 0.1, 0, 0, 0), r"would be .* mm twisted at its end"),
        ("3-rpr", (0, 0, 0, 0, 0, 0.002), r"the platform would be 2 mm out of its plane"),
        ("tricept", (0, 0.1, 0, 0, 0, 0), r"would be .* mm off the direction that it has in the"),
    ],
)
def test_poses_that_legs_forbid_are_refused(name: str, step: tuple[float, ...], found: str) -> None:
    machine = load_mechanism(name)
    with pytest.raises(UsageError, match=f"The platform cannot stand there: .*{found}"):
        inverse_kinematics(machine, displaced(machine.home, step))


def test_a_start_that_legs_forbid_is_refused() -> None:
    machine = load_mechanism("3-rps")
    q = inverse_kinematics(machine, machine.home)
    start = displaced(machine.home, [0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    with pytest.raises(UsageError, match=r"followed from its start: found leg .* mm off"):
        forward_kinematics(machine, q, start=start)


def test_too_few_motors_are_refused_with_both_numbers() -> None:
    machine = load_mechanism("3-rps")
    passive = replace(machine.legs[0], kind=LegKind.PASSIVE)
    loose = replace(machine, legs=(passive, *machine.legs[1:]))
    with pytest.raises(NotIdentifiable, match="mobility 3 and 2 motors"):
        Follower(loose)


def test_axes_that_are_a_little_off_still_close_and_are_not_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["RS"] * 3), Layout())
    urdf = path.with_suffix(".urdf")
    machine = load_mechanism(path)
    axis = machine.legs[0].base_axis
    assert axis is not None
    turned = Rotation.from_rotvec([0.0, 2e-4, 0.0])
    text = urdf.read_text()
    joint = text.index('name="leg1_slider"')
    origin = text.index('rpy="', joint) + 5
    end = text.index('"', origin)
    rpy = Rotation.from_euler("xyz", [float(x) for x in text[origin:end].split()]) * turned
    numbers = " ".join(repr(float(x)) for x in rpy.as_euler("xyz"))
    urdf.write_text(text[:origin] + numbers + text[end:])
    crooked = load_mechanism(path)
    assert np.abs(crooked.chain.residual(crooked.home_configuration)).max() < 1e-12
    q = inverse_kinematics(crooked, crooked.home) + 0.003
    T = forward_kinematics(crooked, q)
    np.testing.assert_allclose(inverse_kinematics(crooked, T), q, atol=1e-4)
