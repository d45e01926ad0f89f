"""Parameters and legs in words."""

import pytest

from legcal.calibration.identify.session import legs_in_words, views_in_words
from legcal.machine import describe_direction, joined, leg_labels

LEGS = ("leg1", "leg2", "leg3", "leg4")


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        (("leg2.platform.z", "leg4.platform.z"), "z of platform joints 2 and 4 together"),
        (("leg4.platform.z", "leg2.platform.z"), "z of platform joints 2 and 4 together"),
        (("leg3.offset",), "offset of leg 3"),
        (("leg1.base.y", "leg1.base.x"), "x and y of base joint 1"),
        (
            ("leg2.length", "leg1.base.x"),
            "length of leg 2 and x of base joint 1 together",
        ),
        (
            ("leg1.base_axis.2", "leg1.platform_axis.2"),
            "angle 2 of base axis of leg 1 and angle 2 of platform axis of leg 1 together",
        ),
        (("leg1.base_axis.1", "leg1.base_axis.2"), "angles 1 and 2 of base axis of leg 1"),
        (("leg2.twist", "leg3.twist"), "twists of legs 2 and 3 together"),
        (("leg2.radius.rod", "leg2.radius.tube"), "radius of leg 2"),
        (("leg3.radius.rod", "c1.fx"), "radius of leg 3 and fx of camera c1 together"),
        (("c1.fy", "c2.fx", "c1.fx"), "fx and fy of camera c1 and fx of camera c2 together"),
        (("leg1.left.k1",), "k1 of camera leg1.left"),
        (
            ("leg1.offset", "leg1.base.x", "leg2.base.y", "leg3.base.z", "leg4.platform.x"),
            "offset of leg 1, x of base joint 1, y of base joint 2 and 2 more such changes "
            "together",
        ),
    ],
)
def test_directions_are_named_as_people_say_them(parameters: tuple[str, ...], words: str) -> None:
    assert describe_direction(parameters, LEGS) == words


def test_legs_are_numbers_where_their_names_have_one() -> None:
    assert leg_labels(("leg1", "Leg_2")) == {"leg1": "1", "Leg_2": "2"}
    assert leg_labels(("leg1", "centre")) == {"leg1": "1", "centre": "centre"}
    assert leg_labels(("leg1", "1")) == {"leg1": "leg1", "1": "1"}
    assert legs_in_words((0, 1), ("leg3", "centre")) == "legs 3 and centre"
    assert legs_in_words((0, 2, 3), LEGS) == "legs 1, 3 and 4"
    assert legs_in_words((1,), LEGS) == "leg 2"
    assert joined([]) == ""


def test_names_of_legs_may_contain_dots_and_each_other() -> None:
    legs = ("a", "a.b", "centre")
    assert describe_direction(("a.b.base.x",), legs) == "x of base joint a.b"
    assert describe_direction(("a.base.x",), legs) == "x of base joint a"


def test_equal_views_are_one_from_several_places() -> None:
    assert views_in_words(["1,2", "1,2"]) == "1,2 from two places"
    assert views_in_words(["1,2", "2,3", "1,2", "1,2"]) == "1,2 from three places; 2,3"
