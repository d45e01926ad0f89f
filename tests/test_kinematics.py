"""Kinematics of closed chains, their homes, and how far they are from singular poses."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from edits import keyed
from layouts import Layout, LegLayout, MachineSpec, write_machine
from machines import MACHINES, displaced, of_types, write_home
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import (
    Follower,
    Machine,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
    random_configurations,
    singularity,
)
from legcal.errors import DidNotConverge, ModelError, NotIdentifiable, UsageError
from legcal.files.motions import motion_to_xyz_quat
from legcal.geometry.types import Array
from legcal.machine.configurations import Configurations
from legcal.machine.equations import pose_equations
from legcal.machine.kinematics import forward_kinematics_many
from legcal.machine.leg import LegKind
from legcal.machine.model import platform_pose, readings_at, slider_columns, vectors_A_to_B

machine_of = cache(load_mechanism)
DRAWN = 5
OF_EACH_KIND = ("hexapod-rod", "3-rpr", "3-rps", "3-upu", "tricept", "delta", "hexaglide")


@cache
def drawn_of(name: str) -> Configurations:
    return random_configurations(machine_of(name), DRAWN, 5)


@pytest.fixture(scope="module", params=OF_EACH_KIND)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


# A shipped machine of each kind


def test_random_configurations_are_closed_inside_the_travel_and_unflipped(name: str) -> None:
    machine, drawn = machine_of(name), drawn_of(name)
    lower, upper = np.array([leg.travel for leg in machine.legs]).T
    sliding = [j for j, leg in enumerate(machine.legs) if leg.prismatic is not None]
    columns = slider_columns(machine, sliding)[0]
    for configuration, q, T in zip(*drawn, strict=True):
        assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
        assert np.all((q >= lower - 1e-9) & (q <= upper + 1e-9))
        np.testing.assert_allclose(configuration[columns], q[sliding], atol=1e-12)
        np.testing.assert_allclose(inverse_kinematics(machine, T), q, atol=1e-11)
        vectors = vectors_A_to_B(machine, T)
        lengths = machine.lengths_at(q)[sliding]
        assert lengths.min() > 0.0
        np.testing.assert_allclose(lengths, np.linalg.norm(vectors, axis=1)[sliding], atol=1e-11)
        for leg, u in zip(machine.legs, vectors, strict=True):
            if leg.platform_axis is not None and leg.type == "UP":
                assert T.rotation.apply(leg.platform_axis) @ u > 0.0
    assert np.ptp(drawn.readings[:, list(machine.motors)], axis=0).min() > 1e-3


def test_forward_kinematics_inverts_inverse_kinematics_from_any_start(name: str) -> None:
    machine, drawn = machine_of(name), drawn_of(name)
    backwards = forward_kinematics_many(machine, drawn.readings[::-1])[::-1]
    for T, found in zip(drawn.poses, backwards, strict=True):
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)
    q, T = drawn.readings[0], drawn.poses[0]
    home = inverse_kinematics(machine, machine.home)
    follower = Follower(machine)
    poses = [follower.move_to(home + s * (q - home)) for s in np.linspace(0.0, 1.0, 12)]
    np.testing.assert_allclose(poses[0].as_matrix(), machine.home.as_matrix(), atol=1e-12)
    rounded = RigidTransform.from_matrix(np.round(poses[-2].as_matrix(), 4))
    for found in (
        poses[-1],
        forward_kinematics(machine, q),
        forward_kinematics(machine, q, start=poses[-2]),
        forward_kinematics(machine, q, start=rounded),
    ):
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("name", ["hexapod", "3-upu"])  # closed by points, and by frames
def test_the_jacobian_of_the_closures_is_the_derivative_of_their_residual(name: str) -> None:
    chain = machine_of(name).chain
    turned = np.random.default_rng(2).uniform(-0.5, 0.5, chain.nv)
    configuration = chain.integrate(chain.neutral(), turned)  # far from closed
    residual, jacobian = chain.linearize(configuration)
    np.testing.assert_allclose(residual, chain.residual(configuration), atol=1e-15)
    assert np.abs(residual).max() > 0.1
    h = 1e-6
    ends = [
        [chain.residual(chain.integrate(configuration, s * h * e)) for e in np.eye(chain.nv)]
        for s in (1.0, -1.0)
    ]
    numeric = (np.array(ends[0]) - np.array(ends[1])).T / (2 * h)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)


# The same machine in other trees, far from home


def test_revolutes_that_do_not_turn_so_far_are_refused(tmp_path: Path) -> None:
    machine = of_types(["US"] * 6, seed=1)
    cut = load_mechanism(write_machine(tmp_path / "cut", machine, Layout()))
    skew = Layout(tuple(LegLayout(sphere=False, seed=10 + j) for j in range(6)))
    other = load_mechanism(write_machine(tmp_path / "other", machine, skew))
    readings = random_configurations(cut, 8, 1).readings
    with pytest.raises(DidNotConverge, match=r"joints that were not closed there, .* right angles"):
        forward_kinematics_many(other, readings)


# Refusals


def _with_reading(q: object) -> Array:
    return np.array([0.07, 0.07, 0.07, q, 0.07, 0.07])


@pytest.mark.parametrize(
    ("rows", "kind", "named"),
    [
        (np.zeros(5), UsageError, r"needed \(6,\)"),
        (_with_reading(np.nan), UsageError, "reading nan of leg 'leg4'"),
        (np.stack([np.full(6, 0.07), _with_reading(-0.4)]), UsageError, r"-0\.4 of leg 'leg4'"),
        (np.stack([np.full(6, 0.07), _with_reading(3.0)]), DidNotConverge, r"row 2 .*: at .* %"),
    ],
)
def test_readings_that_no_pose_has_are_refused(
    rows: Array, kind: type[Exception], named: str
) -> None:
    hexapod = machine_of("hexapod")
    with pytest.raises(kind, match=named):
        (forward_kinematics if rows.ndim == 1 else forward_kinematics_many)(hexapod, rows)


@pytest.mark.parametrize(("name", "found"), [("hexapod", "6 and 5"), ("3-rps", "3 and 2")])
def test_too_few_motors_are_refused_with_both_numbers(name: str, found: str) -> None:
    machine = machine_of(name)
    first, second, *others = machine.legs
    legs = first, replace(second, kind=LegKind.PASSIVE), *others
    loose = replace(machine, legs=legs, motor_rank=machine.motor_rank - 1)
    mobility, motors = found.split(" and ")
    with pytest.raises(NotIdentifiable, match=f"mobility {mobility} and {motors} motors"):
        forward_kinematics(loose, np.zeros(loose.n_legs))
    with pytest.raises(NotIdentifiable, match=f"mobility {mobility} and {motors} motors"):
        Follower(loose)


def test_a_travel_that_home_cannot_enter_is_refused_once() -> None:
    machine = machine_of("hexapod-strut")
    far = replace(machine.legs[6], travel=(5.0, 5.1))
    machine = replace(machine, legs=(*machine.legs[:6], far))
    with pytest.raises(DidNotConverge, match=r"found 0 of 3 inside the travel.*check legcal\.home"):
        random_configurations(machine, 3, 1)


# Home


CARRIED = Layout((LegLayout(cut="carry"), *[LegLayout(sphere=k % 2 == 0) for k in range(6)]))


def check_closed(machine: Machine) -> None:
    configuration = machine.home_configuration
    assert np.abs(machine.chain.residual(configuration)).max() < 1e-12
    np.testing.assert_allclose(
        platform_pose(machine, configuration).as_matrix(), machine.home.as_matrix(), atol=1e-12
    )
    R, t = machine.home.rotation.as_matrix(), machine.home.translation
    found = pose_equations(machine.legs, R[None], t[None])  # of which readings change some
    assert np.abs(found.values[0, ~found.measured]).max(initial=0.0) < 2e-13


@pytest.mark.parametrize(
    ("description", "carried"),
    [("6-UPS", True), ("3-RPR, tilted plane", False), ("3-UPU", True), ("Tricept", False)],
)
def test_a_rounded_home_closes(description: str, carried: bool, tmp_path: Path) -> None:
    drawn = MACHINES[description]()
    rounded = RigidTransform.from_matrix(np.round(drawn.home.as_matrix(), 4))
    assert np.abs(rounded.as_matrix() - drawn.home.as_matrix()).max() > 1e-6
    path = write_machine(tmp_path, drawn, CARRIED if carried else Layout())
    keyed(path.name, legcal__home=motion_to_xyz_quat(rounded))(tmp_path)
    machine = load_mechanism(path)
    check_closed(machine)
    T = forward_kinematics(machine, inverse_kinematics(machine, machine.home))
    np.testing.assert_allclose(T.as_matrix(), machine.home.as_matrix(), atol=1e-11)


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


AXIS = r"leg 'leg\d' .*\d mm off the plane normal to its axis"


@pytest.mark.parametrize(
    ("name", "step", "found"),
    [
        ("hexapod-rod", (0, 0, 0, 0, 0, 0.05), r"leg '\w+' .*\d mm off its constant length"),
        ("3-rps", (0, 0, 0.2, 0, 0, 0), AXIS),
        ("3-upu", (0, 0, 0.2, 0, 0, 0), r"leg 'leg\d' .*\d mm twisted at its end"),
        ("tricept", (0.2, 0, 0, 0, 0, 0), r"leg '\w+' .*\d mm off the direction that it has in"),
        ("3-rpr", (0, 0, 0, 0, 0, 0.05), r"the platform .*50 mm out of its plane"),
    ],
)
def test_poses_and_homes_that_legs_forbid_are_refused_by_leg_and_amount(
    name: str, step: tuple[float, ...], found: str, tmp_path: Path
) -> None:
    machine = machine_of(name)
    there = displaced(machine.home, step)
    with pytest.raises(UsageError, match=f"The platform cannot take this pose: .*{found}"):
        inverse_kinematics(machine, there)
    with pytest.raises(ModelError, match=rf"legcal\.home could not be used: found {found}"):
        load_mechanism(write_home(tmp_path, name, there))
    if name == "3-rps":
        q = inverse_kinematics(machine, machine.home)
        with pytest.raises(UsageError, match=r"followed from its start: found leg .* mm off"):
            forward_kinematics(machine, q, start=displaced(machine.home, [0, 0, 0.3, 0, 0, 0]))


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


# The singularity measure


def _turned(machine: Machine, degrees: float, height: float = 0.4) -> RigidTransform:
    """Return home turned about z, from the attitude in which base and platform are symmetric."""
    turn = Rotation.from_euler("z", degrees, degrees=True) * machine.home.rotation
    return RigidTransform.from_components([0.0, 0.0, height], turn)


def _lines(machine: Machine, T: RigidTransform) -> Array:
    """Return the unit leg lines, moments first, about the mean platform joint in mean lengths."""
    vectors = vectors_A_to_B(machine, T)
    lengths = np.linalg.norm(vectors, axis=1)
    u = vectors / lengths[:, None]
    arms = T.rotation.apply(machine.B_platform - machine.B_platform.mean(axis=0))
    return np.hstack([np.cross(arms, u) / lengths.mean(), u])


@pytest.mark.parametrize("name", ["hexapod", "6-sps", "nategh-agheli"])
def test_a_hexapod_has_the_smallest_singular_value_of_its_leg_lines(name: str) -> None:
    machine = machine_of(name)
    for step in ([0.0] * 6, [0.1, 0.2, -0.1, 0.02, 0.03, 0.01]):
        T = displaced(machine.home, step)
        values = np.linalg.svd(_lines(machine, T), compute_uv=False)
        assert singularity(machine, T) == pytest.approx(values[-1], rel=1e-9)


@pytest.mark.parametrize("quarter", [90.0, -90.0])
def test_a_symmetric_hexapod_is_singular_after_a_quarter_turn(quarter: float) -> None:
    # Fichter: at 90 degrees about the normal all leg lines belong to one linear complex
    machine = machine_of("hexapod")
    for height in (0.3, 0.5):
        assert singularity(machine, _turned(machine, quarter, height)) < 1e-6  # digits
        for degrees in (quarter - 20.0, quarter + 20.0):
            assert singularity(machine, _turned(machine, degrees, height)) > 0.05
    assert singularity(machine, _turned(machine, 0.0, height=0.0)) < 1e-12  # flat on its base


@pytest.mark.parametrize("constrained", [False, True])
def test_the_measure_does_not_depend_on_size_or_frames(constrained: bool, tmp_path: Path) -> None:
    def machine(scale: float, shift: float, inside: float) -> MachineSpec:
        """Return a machine scaled, in another frame of the base, and of the platform [m]."""
        drawn = of_types(["RS"] * 3 if constrained else ["US"] * 6)
        legs = tuple(
            replace(leg, A=scale * leg.A + shift, B_home=scale * leg.B_home + shift)
            for leg in drawn.legs
        )
        place = scale * drawn.home.translation + shift + inside * np.array([1.0, -0.5, 2.0])
        return MachineSpec(legs, RigidTransform.from_components(place, drawn.home.rotation))

    found = []
    for k, numbers in enumerate(
        [(1.0, 0.0, 0.0), (4.0, 0.0, 0.0), (1.0, 2.0, 0.0), (1.0, 0.0, 0.3)]
    ):
        loaded = load_mechanism(write_machine(tmp_path / str(k), machine(*numbers), Layout()))
        found.append(singularity(loaded, loaded.home))
    assert found[0] > 1e-3
    np.testing.assert_allclose(found[1:], found[0], rtol=1e-7)


def test_forward_kinematics_does_not_pass_a_singular_attitude() -> None:
    machine = machine_of("hexapod")

    def side(T: RigidTransform) -> float:
        return float(np.sign(np.linalg.det(_lines(machine, T))))

    here, beyond = side(machine.home), _turned(machine, 100.0)
    assert side(beyond) == -here
    follower = Follower(machine)
    for degrees in (20.0, 40.0, 60.0, 75.0):
        wanted = _turned(machine, degrees)
        reached = follower.move_to(inverse_kinematics(machine, wanted))
        np.testing.assert_allclose(reached.as_matrix(), wanted.as_matrix(), atol=1e-9)
    # the same lengths have a pose on this side: it is found, and not the one beyond
    back = forward_kinematics(machine, inverse_kinematics(machine, beyond))
    assert side(back) == here
    assert (back.rotation * beyond.rotation.inv()).magnitude() > 0.1
    there = forward_kinematics(machine, inverse_kinematics(machine, beyond), start=beyond)
    np.testing.assert_allclose(there.as_matrix(), beyond.as_matrix(), atol=1e-9)
    with pytest.raises(DidNotConverge, match="or the mechanism is singular"):
        follower.move_to(np.array([0.5, 0.07, 0.07, 0.07, 0.07, 0.07]))
    np.testing.assert_allclose(
        follower.pose.as_matrix(), _turned(machine, 75.0).as_matrix(), atol=1e-9
    )


@pytest.mark.parametrize(
    ("name", "place", "turn", "place_beyond", "turn_beyond"),
    [
        ("nategh-agheli", (0.24, 0.02, 0.31), (-0.61, 0.61, 0.88),
         (0.26, 0.02, 0.29), (-0.66, 0.66, 0.95)),
        ("6-sps", (0.27, -0.01, 0.51), (-2.58, -1.44, -0.58),
         (0.34, -0.01, 0.52), (-3.28, -1.82, -0.73)),
    ],
)  # fmt: skip
def test_readings_from_a_little_beyond_a_singularity_are_met_on_this_side(
    name: str,
    place: tuple[float, ...],
    turn: tuple[float, ...],
    place_beyond: tuple[float, ...],
    turn_beyond: tuple[float, ...],
) -> None:
    """A single Newton step from here ends beyond."""
    machine = machine_of(name)
    here, beyond = (
        RigidTransform.from_components(t, Rotation.from_rotvec(r) * machine.home.rotation)
        for t, r in ((place, turn), (place_beyond, turn_beyond))
    )
    found = forward_kinematics(machine, inverse_kinematics(machine, beyond), start=here)
    sides = [np.sign(np.linalg.det(_lines(machine, T))) for T in (here, beyond, found)]
    assert sides[0] == -sides[1] == sides[2]
