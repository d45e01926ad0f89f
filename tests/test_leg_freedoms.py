"""Types, mobility, constraints and motors of every layout, against the screws of the joints."""

from itertools import product
from pathlib import Path

import pytest
from layouts import Layout, LegLayout, MachineSpec, write_machine
from leg_screws import freedoms_of
from machines import exechon, exechon_and_ups, four_upu, of_types, planar, two_upr_two_sps
from thinned import thinned

from legcal.machine.loader import load_mechanism
from legcal.machine.parameters import geometries

A, P, C = "actuated", "passive", "constant"
KINDS: dict[str, MachineSpec] = {
    "Exechon": exechon(),
    "Exechon + UPS": exechon_and_ups(),
    "2-UPR + 2-SPS": two_upr_two_sps(),
    "4-UPU": four_upu(),
    "TriVariant": of_types(["SS", "SS", "U"]),
    "Tricept": of_types(["US", "US", "US", "U"], [A, A, A, P]),
    "SP": of_types(["SS", "US", "SS", "S", "SS"], [A, A, A, A, P]),
    "RP": of_types(["SS", "R", "SS"], [A, A, P]),
    "5-SPS": of_types(["SS"] * 5),
    "7-UPS": of_types(["US"] * 7),
    "4-RPR": planar(kinds=(A,) * 4),
    "3-RPS + SPS": of_types(["RS"] * 3 + ["SS"]),
    "5-UPS + RPS": of_types(["US"] * 5 + ["RS"]),
    "2-RPS + 2-SPS + passive SPS": of_types(["RS", "RS", "SS", "SS", "SS"], [A] * 4 + [P]),
    "2-RPS + 2-SPS + rod": of_types(["RS", "RS", "SS", "SS", "SS"], [A] * 4 + [C]),
    "5-UPS + rod": of_types(["US"] * 6, [A] * 5 + [C]),
    "3-SPS + passive UPS": of_types(["SS"] * 3 + ["US"], [A, A, A, P]),
}


LAYOUTS = {
    "hung from the base": Layout(),
    "cut behind the slider": Layout((LegLayout(cut="mid"),)),
    "hung from the platform": Layout((LegLayout(hung="platform", slid=0.05, seed=3),)),
}


def _usual(kind: str, layout: str) -> bool:
    """Say whether a kind is tried in a layout: each in one, test_model_layouts.py compares them."""
    return [*KINDS].index(kind) % len(LAYOUTS) == [*LAYOUTS].index(layout)


@pytest.mark.parametrize(("kind", "layout"), thinned(product(KINDS, LAYOUTS), _usual))
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
