"""Overconstrained machines: which parameters are tied, and that errors and fits keep the mobility.

Ties are counted by hand: in an Exechon and wherever two UPR legs share a plane, the outer axes at
the base lie along the line of the bases (four angles), the axes at the platform are parallel and
across the line of the platform joints (three) and across the outer ones (two twists).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fit_sessions import MachineSession, machine_session
from layouts import Layout, LegLayout, MachineSpec, write_machine
from machines import exechon, two_upr_two_sps
from thinned import thinned

from legcal import Machine, ParameterErrors, Spread, identifiability, load_mechanism
from legcal.calibration.joint_fit.variables import start_from
from legcal.estimation.problem import Frames
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.closing import solve_poses
from legcal.machine.kinematics import platform_in_base
from legcal.machine.leg import Leg
from legcal.machine.parameters import geometries, moved_legs, parametrization_of
from legcal.machine.ties import machine_ties, on_ties
from legcal.simulation.truth import write_true_model

KINDS: dict[str, tuple[Callable[[], MachineSpec], int, int]] = {  # mobility, parameters less ties
    "exechon": (exechon, 3, 19 - 7),
    "2-UPR + 2-SPS": (two_upr_two_sps, 4, 24 - 7),
}
LAYOUTS = (
    Layout(),
    Layout((LegLayout(cut="mid"),)),
    Layout((LegLayout(hung="platform", slid=0.05, seed=3),)),
)


def written(kind: str, layout: Layout, folder: Path) -> Machine:
    return load_mechanism(write_machine(folder, KINDS[kind][0](), layout))


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
        [("exechon", LAYOUTS[-1]), ("2-UPR + 2-SPS", LAYOUTS[0])],
        lambda kind, _: kind == "exechon",
    ),
)
def test_what_is_tied_is_what_keeps_the_mobility(kind: str, layout: Layout, tmp_path: Path) -> None:
    machine = written(kind, layout, tmp_path)
    _, mobility, n_free = KINDS[kind]
    assert machine.mobility == mobility
    assert any("overconstrained: 2 of the" in note for note in machine.diagnostics)
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


@pytest.mark.parametrize("kind", thinned(KINDS, ["exechon"]))
def test_true_machines_close_and_fits_find_them(kind: str, tmp_path: Path) -> None:
    machine = written(kind, LAYOUTS[0], tmp_path)
    two, turn = Spread(2e-3), Spread(float(np.deg2rad(1.0)))
    errors = ParameterErrors(two, two, two, two, axes=turn, twists=turn)
    true = write_true_model(machine, errors, np.random.default_rng(2), tmp_path / "true")
    assert true.mobility == machine.mobility
    assert keeps_its_plane(geometries(true)) < 1e-9
    session = wrong_but_tied(machine_session(str(true.yaml_path)), true)
    found = session.fit()
    assert keeps_its_plane(found.legs) < 1e-9
    assert session.off(found.legs) < 1e-7
