"""Legs fixed to the platform among the legs that define its frame: gauge, ranks and recovery."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from fit_sessions import machine_session
from layouts import Layout, LegLayout, write_machine
from machines import of_types
from seen_numbers import n_seen
from thinned import thinned

from legcal import identifiability
from legcal.calibration.joint_fit.fit import refine
from legcal.machine.loader import load_mechanism

A, P = "actuated", "passive"
KINDS: dict[str, tuple[list[str], list[str], tuple[int, ...]]] = {
    "TriVariant": (["SS", "SS", "U"], [A, A, A], (0, 1, 2)),
    "TriVariant, the fixed leg first": (["SS", "SS", "U"], [A, A, A], (2, 0, 1)),
    "TriVariant, the fixed leg second": (["SS", "SS", "U"], [A, A, A], (0, 2, 1)),
    "Tricept": (["US", "US", "US", "U"], [A, A, A, P], (3, 0, 1)),
    "Tricept, the fixed leg last": (["US", "US", "US", "U"], [A, A, A, P], (0, 1, 3)),
    "SP": (["SS", "US", "SS", "S", "SS"], [A, A, A, A, P], (0, 3, 1)),
    "RP": (["SS", "R", "SS"], [A, A, P], (0, 1, 2)),
}
LAYOUTS = (
    Layout(),
    Layout((LegLayout(cut="mid"),)),
    Layout((LegLayout(hung="platform", slid=0.05, seed=3),)),
)


def written(kind: str, layout: Layout, folder: Path) -> Path:
    """Write a machine with a leg that is fixed to its platform."""
    types, kinds, frame = KINDS[kind]
    return write_machine(folder, replace(of_types(types, kinds), frame_legs=frame), layout)


@pytest.mark.parametrize(
    "kind",
    thinned([k for k in KINDS if k != "SP"], ["RP"]),  # SP: few poses in its travel
)
def test_identify_counts_what_shows(kind: str, tmp_path: Path) -> None:
    machine = load_mechanism(written(kind, LAYOUTS[0], tmp_path))
    report = identifiability(machine, (machine.leg_names,) * 3)
    assert report.identifiable
    assert report.full.of == report.full.rank == n_seen(machine)


@pytest.mark.parametrize(
    ("kind", "layout"),
    thinned(  # each layout, the fixed leg at each place of the frame
        product(KINDS, LAYOUTS),
        [
            ("TriVariant, the fixed leg first", LAYOUTS[1]),
            ("SP", LAYOUTS[2]),
            ("RP", LAYOUTS[0]),
        ],
    ),
)
def test_exact_outlines_give_the_machine_whatever_defines_its_frame(
    kind: str, layout: Layout, tmp_path: Path
) -> None:
    session = machine_session(str(written(kind, layout, tmp_path)))
    found = refine(session.legs, session.measurements, session.outlines, session.start)
    truth = session.truth.legs
    assert (
        max(np.abs(a.A - b.A).max() for a, b in zip(session.start.legs, truth, strict=True)) > 2e-3
    )
    for leg, true in zip(found.legs, truth, strict=True):
        assert np.abs(np.concatenate([leg.A - true.A, leg.B - true.B])).max() < 1e-7
