"""Layouts: mobility, constraints and motors against screws of joints; frames on fixed legs."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from fit_sessions import machine_session
from layouts import Layout, LegLayout, LegSpec, MachineSpec, write_machine
from machines import exechon, exechon_and_ups, four_upu, of_types, planar, two_upr_two_sps
from scipy.linalg import null_space

from legcal.geometry.types import Array
from legcal.machine.loader import load_mechanism
from legcal.machine.parameters import geometries

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
