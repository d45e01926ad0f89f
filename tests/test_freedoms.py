"""Mobility, constraints and motors against screws of joints; ties, and motors too many."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from fit_sessions import MachineSession, machine_session
from layouts import Layout, LegLayout, LegSpec, MachineSpec, write_machine
from machines import (
    displaced,
    exechon,
    exechon_and_ups,
    four_upu,
    of_types,
    planar,
    ring,
    two_upr_two_sps,
)
from outline_sessions import made
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal import (
    Follower,
    Machine,
    ParameterErrors,
    Spread,
    forward_kinematics,
    identifiability,
    inverse_kinematics,
    load_mechanism,
    random_configurations,
)
from legcal.calibration.joint_fit.variables import start_from
from legcal.calibration.session_changes import session_tests
from legcal.data.image_choice import image_sequences
from legcal.data.measurements import row_names
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable
from legcal.estimation.problem import Frames
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.closing import solve_poses
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg
from legcal.machine.model import readings_at
from legcal.machine.parameters import geometries, moved_legs, parametrization_of
from legcal.machine.ties import machine_ties, on_ties
from legcal.simulation.session import given_poses
from legcal.simulation.truth import write_true_model

A, P, C = "actuated", "passive", "constant"
KINDS: dict[str, MachineSpec] = {
    "Exechon": exechon(),
    "Exechon + UPS": exechon_and_ups(),
    "2-UPR + 2-SPS": two_upr_two_sps(),
    "4-UPU": four_upu(),
    "Tricept": of_types(["US", "US", "US", "U"], [A, A, A, P]),
    "SP": of_types(["SS", "US", "SS", "S", "SS"], [A, A, A, A, P]),
    "5-UPS + rod": of_types(["US"] * 6, [A] * 5 + [C]),
    "6-UPS by hand": of_types(["US"] * 6, [P] * 6),
    "3-RPS, two motors": of_types(["RS"] * 3, [A, A, P]),
    "7-UPS": of_types(["US"] * 7),
    "4-RPR": planar(kinds=(A,) * 4),
    "2-RPS + 2-SPS + rod": of_types(["RS", "RS", "SS", "SS", "SS"], [A] * 4 + [C]),
}


LAYOUTS = {
    "hung from the base": Layout(),
    "cut behind the slider": Layout((LegLayout(cut="mid"),)),
    "hung from the platform": Layout((LegLayout(hung="platform", slid=0.05, seed=3),)),
}


# Freedoms by the screws of joints, without anything of legcal: the platform moves as every leg
# alone lets it, so that its twists are those in which the twists of all legs have part.


class Freedoms(NamedTuple):
    """What the joints of a machine leave."""

    mobility: int
    n_constraints: int  # of all legs
    n_redundant: int  # of them, those that follow from others
    left_by_motors: int  # freedoms of the platform with all motors held


def freedoms_of(machine: MachineSpec) -> Freedoms:
    """Return the freedoms of a platform at home."""
    wrenches = [null_space(_twists(leg)).T for leg in machine.legs]
    held = [null_space(_twists(leg, with_slider=leg.kind != "actuated")).T for leg in machine.legs]
    free, with_motors = (np.linalg.matrix_rank(np.concatenate(w), 1e-9) for w in (wrenches, held))
    n = sum(map(len, wrenches))
    return Freedoms(6 - int(free), n, n - int(free), 6 - int(with_motors))


def _twists(leg: LegSpec, *, with_slider: bool = True) -> Array:
    """Return the screws (n, 6) of the joints of a leg: angular parts, velocities of the origin."""
    found = []
    ends = (leg.A, leg.base_axis), (leg.B_home, leg.platform_axis)
    for letter, (point, axis) in zip(leg.type, ends, strict=False):
        axes = np.eye(3)
        if letter != "S":
            outer = np.asarray(axis)
            axes = np.array([outer, np.cross(leg.u, outer)])[: {"R": 1, "U": 2}[letter]]
        found += [np.concatenate([w, np.cross(point, w)]) for w in axes]
    if with_slider and leg.kind != "constant":
        found.append(np.concatenate([np.zeros(3), leg.u]))
    return np.array(found)


# Each kind in one layout: test_model_layouts.py compares them.
@pytest.mark.parametrize(("kind", "layout"), list(zip(KINDS, cycle(LAYOUTS), strict=False)))
def test_freedoms_are_those_of_the_screws_of_the_joints(
    kind: str, layout: str, tmp_path: Path
) -> None:
    drawn = KINDS[kind]
    expected = freedoms_of(drawn)
    machine = load_mechanism(write_machine(tmp_path, drawn, LAYOUTS[layout]))
    assert [leg.kind.value for leg in machine.legs] == [leg.kind for leg in drawn.legs]
    assert [leg.type for leg in machine.legs] == [
        ("" if leg.kind == C else "P").join(leg.ends) for leg in drawn.legs
    ]
    assert machine.mobility == expected.mobility
    assert len(machine.motors) == [leg.kind for leg in drawn.legs].count(A)
    assert machine.is_determined == (expected.left_by_motors == 0)
    more = len(machine.motors) > expected.mobility
    assert machine.is_redundant == (more and expected.left_by_motors == 0)
    if not machine.spatial:  # where all legs keep to one plane by themselves
        return
    n_constraints = sum(leg.n_constraints for leg in geometries(machine))
    assert n_constraints == expected.n_constraints
    said = [note for note in machine.diagnostics if "overconstrained" in note]
    of = f"{expected.n_redundant} of the {expected.n_constraints}"
    assert len(said) == (expected.n_redundant > 0)
    assert all(of in note for note in said)


def test_exact_outlines_give_a_machine_whose_frame_a_leg_fixed_to_the_platform_defines(
    tmp_path: Path,
) -> None:
    types, kinds = ["SS", "US", "SS", "S", "SS"], [A, A, A, A, P]
    drawn = replace(of_types(types, kinds), frame_legs=(0, 3, 1))
    layout = LAYOUTS["hung from the platform"]
    session = machine_session(str(write_machine(tmp_path, drawn, layout)))
    assert session.off(session.start.legs) > 2e-3
    assert session.off(session.fit().legs) < 1e-7


# Overconstrained machines: errors and fits keep the mobility


# Ties are counted by hand: in an Exechon and wherever two UPR legs share a plane, the outer axes at
# the base lie along the line of the bases (four angles), the axes at the platform are parallel and
# across the line of the platform joints (three) and across the outer ones (two twists).
TIED = {"Exechon": 19 - 7, "2-UPR + 2-SPS": 24 - 7}  # parameters less ties


def keeps_its_plane(legs: tuple[Leg, ...]) -> float:
    """Return how far two UPR legs are from sharing a plane that turns about the line of A [rad]."""
    one, two = legs[:2]

    def off(axis: Array | None, b: Array, *, parallel: bool) -> float:
        a, b = np.asarray(axis), b / np.linalg.norm(b)
        return float(np.linalg.norm(cross(a, b)) if parallel else abs(a @ b))

    line, across = two.A - one.A, two.B - one.B
    return max(
        off(one.base_axis, line, parallel=True),
        off(two.base_axis, line, parallel=True),
        off(one.platform_axis, np.asarray(two.platform_axis), parallel=True),
        off(one.platform_axis, across, parallel=False),
        abs(one.twist or 0.0),
        abs(two.twist or 0.0),
    )


@pytest.mark.parametrize(
    ("kind", "layout"),
    thinned(
        [("Exechon", "hung from the platform"), ("2-UPR + 2-SPS", "hung from the base")],
        lambda kind, _: kind == "Exechon",
    ),
)
def test_what_is_tied_is_what_keeps_the_mobility(kind: str, layout: str, tmp_path: Path) -> None:
    machine, n_free = (
        load_mechanism(write_machine(tmp_path, KINDS[kind], LAYOUTS[layout])),
        TIED[kind],
    )
    report = identifiability(machine, (machine.leg_names,) * 3, 4)
    assert (report.full.rank, report.full.of, report.identifiable) == (n_free, n_free, True)
    found, legs = parametrization_of(machine, twists=True), geometries(machine)
    step = 3e-3 * np.random.default_rng(1).uniform(-1.0, 1.0, len(found))
    moved = moved_legs(legs, found.place, step)
    assert keeps_its_plane(moved) > 1e-3
    tied = on_ties(moved, legs, machine_ties(machine), found.place, np.ones(len(found)))
    assert keeps_its_plane(tied) < 1e-11
    apart = np.linalg.norm([a.B - b.B for a, b in zip(tied, legs, strict=True)])
    assert apart > 1e-3  # what is not tied keeps its errors


def wrong_but_tied(session: MachineSession, true: Machine) -> MachineSession:
    """Return a session whose wrong nominal legs have the mobility, as those of any model."""
    legs, start, place = session.legs, session.start, session.legs.parametrization.place
    unit = np.ones(len(legs.parametrization))
    away = on_ties(legs.nominal, session.truth.legs, machine_ties(true), place, unit)
    home = Frames.of([platform_in_base(true, true.home)])
    there = solve_poses(away, legs.frame_legs, home.R, home.t)
    nominal = replace(legs, nominal=away, home=Frames(there.R, there.t).motions[0])
    poses = session.truth.T_Rb_Re
    begin = start_from(away, session.measurements, nominal, start.T_camera_Rb, poses, "nominal")
    assert session.off(away) > 2e-3
    return replace(session, legs=nominal, start=begin)


@pytest.mark.parametrize("kind", thinned(TIED, ["Exechon"]))
def test_true_machines_close_and_fits_find_them(kind: str, tmp_path: Path) -> None:
    machine = load_mechanism(write_machine(tmp_path, KINDS[kind], Layout()))
    two, turn = Spread(2e-3), Spread(float(np.deg2rad(1.0)))
    errors = ParameterErrors(two, two, two, two, axes=turn, twists=turn)
    true = write_true_model(machine, errors, np.random.default_rng(2), tmp_path / "true")
    assert true.mobility == machine.mobility
    assert keeps_its_plane(geometries(true)) < 1e-9
    session = wrong_but_tied(machine_session(str(true.yaml_path)), true)
    found = session.fit()
    assert keeps_its_plane(found.legs) < 1e-9
    assert session.off(found.legs) < 1e-7


# More motors than freedoms: poses of least squares, wrong readings


def reading_residuals(machine: Machine, T_base_platform: RigidTransform, q: Array) -> Array:
    """Return the residuals of readings q (n_legs,) at a pose [m], zero for legs without motor.

    Without redundant motors they vanish at the pose of forward kinematics, up to rounding.
    """
    motors, residuals = list(machine.motors), np.zeros(machine.n_legs)
    residuals[motors] = np.asarray(q)[motors] - readings_at(machine, T_base_platform)[motors]
    return residuals


def test_motors_as_many_as_freedoms_that_hold_fewer_do_not_determine_the_pose(
    tmp_path: Path,
) -> None:
    """Three motors of a planar platform turn about one point; a fourth leg is passive."""
    B, z = ring([0, 100, 220, 300], 0.12), np.array([0.0, 0.0, 1.0])
    base = np.array([[-0.4, 0.1, 0.0]] * 3 + [[0.1, -0.5, 0.0]])
    legs = [
        LegSpec("RR", a, b, k, z, z)
        for a, b, k in zip(base, B, ["actuated"] * 3 + ["passive"], strict=True)
    ]
    spec = MachineSpec(tuple(legs), RigidTransform.identity(), frame_legs=(0, 3), normal=z)
    machine = load_mechanism(write_machine(tmp_path, spec, Layout()))
    assert machine.mobility == len(machine.motors) == 3
    assert any("motors 3, which hold only 2" in note for note in machine.diagnostics)
    with pytest.raises(NotIdentifiable, match="3 motors that hold 2 of these freedoms"):
        Follower(machine)


@pytest.mark.parametrize("name", ["4-RPR", "2-RPS + 2-SPS + rod"])
def test_poses_are_those_of_least_squares(name: str, tmp_path: Path) -> None:
    machine = load_mechanism(write_machine(tmp_path, KINDS[name], Layout()))
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
    machine = load_mechanism(write_machine(tmp_path, KINDS["4-RPR"], Layout()))
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
