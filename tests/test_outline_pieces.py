import numpy as np
import pytest

from legcal.machine import Cylinder
from legcal.vision.visibility import END_COVER, Segment, visible_segments


def tube(radius: float = 0.012) -> Cylinder:
    return Cylinder("tube", radius, "base", 0.0, 0.25)


def rod(radius: float = 0.008) -> Cylinder:
    return Cylinder("rod", radius, "platform", -0.3, 0.0)


def test_where_two_cylinders_overlap_the_thicker_one_is_seen() -> None:
    pieces = visible_segments([tube(), rod()], 0.4)
    assert [piece.link for piece in pieces] == ["tube", "rod"]
    assert pieces[0].start == pytest.approx(END_COVER * 0.012)
    assert pieces[0].end == pytest.approx(0.25)
    assert pieces[1].start == pytest.approx(0.25 + END_COVER * 0.012)
    assert pieces[1].end == pytest.approx(0.4 - END_COVER * 0.008)


def test_the_order_of_the_cylinders_does_not_matter() -> None:
    assert visible_segments([tube(), rod()], 0.4) == visible_segments([rod(), tube()], 0.4)


def test_equally_thick_cylinders_look_like_one_named_by_the_longest() -> None:
    (piece,) = visible_segments([tube(0.01), rod(0.01)], 0.4)
    assert piece == Segment("rod", 0.01, END_COVER * 0.01, 0.4 - END_COVER * 0.01)


def test_a_rod_that_is_all_inside_the_tube_is_not_seen() -> None:
    pieces = visible_segments([tube(), Cylinder("rod", 0.008, "platform", -0.1, 0.0)], 0.26)
    assert [piece.link for piece in pieces] == ["tube"]


def test_the_longest_stretch_of_a_rod_with_a_collar_is_used() -> None:
    collar = Cylinder("collar", 0.02, "base", 0.1, 0.12)
    pieces = visible_segments([Cylinder("rod", 0.008, "base", 0.0, 0.4), collar], 0.4)
    (piece,) = [piece for piece in pieces if piece.link == "rod"]
    assert piece.start == pytest.approx(0.12 + END_COVER * 0.02)


def test_of_two_cylinders_of_one_link_the_longest_is_the_part_and_the_other_hides_it() -> None:
    collar = Cylinder("rod", 0.02, "base", 0.1, 0.16)
    (piece,) = visible_segments([Cylinder("rod", 0.008, "base", 0.0, 0.4), collar], 0.4)
    assert (piece.link, piece.radius) == ("rod", 0.008)
    assert piece.start == pytest.approx(0.16 + END_COVER * 0.02)


def test_equally_long_cylinders_have_one_name_at_every_length() -> None:
    halves = [Cylinder("a", 0.01, "platform", -0.3, 0.0), Cylinder("b", 0.01, "base", 0.0, 0.3)]
    lengths = np.linspace(0.35, 0.608, 500)
    assert {piece.link for x in lengths for piece in visible_segments(halves, float(x))} == {"b"}


def test_a_leg_without_cylinders_shows_nothing() -> None:
    assert visible_segments([], 0.4) == ()
