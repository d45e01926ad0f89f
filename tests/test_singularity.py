"""The singularity measure: zero at poses that are known to be singular, not far from them."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from layouts import Layout, LegSpec, MachineSpec, write_machine
from machines import displaced, of_types, ring
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.machine.closing import singularity
from legcal.machine.kinematics import Follower, forward_kinematics, inverse_kinematics
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine, vectors_A_to_B

machine_of = cache(load_mechanism)
RING = [10.0, 110.0, 130.0, 230.0, 250.0, 350.0]


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


def _hexapod(A: Array, B: Array, home: RigidTransform) -> MachineSpec:
    """Return a 6-UPS with joints A on the base and B on the platform."""
    axis = np.array([1.0, 0.0, 0.0])
    legs = [LegSpec("US", a, home.apply(b), base_axis=axis) for a, b in zip(A, B, strict=True)]
    return MachineSpec(tuple(legs), home)


def test_a_planar_platform_is_singular_where_its_legs_meet_in_a_point() -> None:
    machine = machine_of("3-rpr")
    A, B = machine.A_base, machine.B_platform

    def at(angle: float) -> RigidTransform:
        turn = Rotation.from_rotvec([0.0, 0.0, angle])
        return RigidTransform.from_components(A.mean(axis=0) - turn.apply(B.mean(axis=0)), turn)

    angles = np.linspace(-np.pi, np.pi, 361)
    measures = [singularity(machine, at(a)) for a in angles]
    # both triangles are regular: legs meet in the centre where the platform's corners face them
    best = float(angles[int(np.argmin(measures))])
    lines = vectors_A_to_B(machine, at(best))[:, :2]
    moments = A[:, 0] * lines[:, 1] - A[:, 1] * lines[:, 0]
    assert min(measures) < 4e-3
    assert abs(np.linalg.det(np.column_stack([lines, moments]))) < 2e-4
    assert singularity(machine, at(best + 0.5 * np.pi)) > 0.1


@pytest.mark.parametrize("constrained", [False, True])
def test_the_measure_does_not_depend_on_size_or_frames(constrained: bool, tmp_path: Path) -> None:
    def machine(scale: float, shift: float, inside: float) -> MachineSpec:
        """Return a machine scaled, in another frame of the base, and of the platform [m]."""
        if constrained:
            drawn = of_types(["RS"] * 3)
        else:
            home = RigidTransform.from_components([0.0, 0.0, 0.4], Rotation.from_euler("z", 0.4))
            B = ring([50.0, 70.0, 170.0, 190.0, 290.0, 310.0], 0.2)
            drawn = _hexapod(ring(RING, 0.3), B, home)
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
