"""Why the fit rejects an outline, in the table of observations."""

from dataclasses import replace

import numpy as np
import pytest
from hexapod_session import PINHOLE, Session, disturbed_start, moved_outlines, simulate

from legcal.calibration.joint_fit.fit import refine
from legcal.data.outlines import Outlines


@pytest.fixture(scope="module")
def session() -> Session:
    return simulate(8)


def swapped(outlines: Outlines, one: int, other: int) -> Outlines:
    """Return outlines of which one shows the line of another."""
    h, ends = outlines.h.copy(), outlines.ends.copy()
    h[one], ends[one] = outlines.h[other], outlines.ends[other]
    return replace(outlines, h=h, ends=ends)


def find(outlines: Outlines, row: int, leg: int, edge: int) -> int:
    found = (outlines.row == row) & (outlines.leg == leg) & (outlines.edge == edge)
    return int(np.flatnonzero(found)[0])


def test_an_outline_on_the_edge_of_another_leg_says_of_which(session: Session) -> None:
    o = session.outlines
    one, two = np.unique(o.leg[o.row == 2])[:2].tolist()
    wrong, right = find(o, 2, one, 1), find(o, 2, two, 2)
    outlines = swapped(o, wrong, right)
    found = refine(session.legs, session.measurements, outlines, disturbed_start(session)).outlines
    assert np.flatnonzero(~found.used).tolist() == [wrong]
    assert found.reason[wrong].startswith("disagrees with the fit by ")
    assert found.reason[wrong].endswith(f" px, lies on edge 2 of {session.legs.names[two]}.rod")


def test_an_outline_on_the_wrong_edge_of_its_leg_says_so(session: Session) -> None:
    o = session.outlines
    leg = int(o.leg[o.row == 5][0])
    wrong = find(o, 5, leg, 1)
    outlines = swapped(o, wrong, find(o, 5, leg, 2))
    found = refine(session.legs, session.measurements, outlines, disturbed_start(session)).outlines
    assert found.reason[wrong].endswith(f"lies on edge 2 of {session.legs.names[leg]}.rod")


def test_an_outline_on_no_edge_says_only_how_far_it_is(session: Session) -> None:
    shift = np.zeros((len(session.outlines), 2))
    shift[11] = 5.4
    outlines = moved_outlines(session.outlines, PINHOLE, shift)
    found = refine(session.legs, session.measurements, outlines, disturbed_start(session)).outlines
    assert found.reason[11] == "disagrees with the fit by 5.4 px"
