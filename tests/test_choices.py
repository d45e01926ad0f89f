"""Parameters fixed, freed and given priors by name: what overrides come to."""

from dataclasses import replace

import numpy as np
import pytest
from chosen import HEXAPOD, choose, known

from legcal import load_mechanism
from legcal.calibration.joint_fit.choices import NO_CHOICES, Prior, resolve
from legcal.data.overrides import overrides_of_call
from legcal.machine import parametrization_of


@pytest.mark.parametrize("model", ["hexapod", "hexapod-rod", "3-upu-tilted", "3-rpr", "tricept"])
def test_every_parameter_of_a_machine_can_be_named(model: str) -> None:
    parameters = known(model)
    names = parametrization_of(load_mechanism(model), twists=True).names
    assert tuple(parameters.by_name)[: len(names)] == names
    assert choose(free=names, parameters=parameters).free == set(names)
    assert parameters.by_name.keys().isdisjoint(parameters.others)


def test_nothing_asked_is_no_choice() -> None:
    assert choose() == NO_CHOICES
    assert NO_CHOICES.document() == {}


@pytest.mark.parametrize(
    ("text", "mean", "sigma"),
    [
        ("0.3500±0.0001", 0.35, 1e-4),
        ("0.35+-1e-4", 0.35, 1e-4),
        ("0.35 +/- 0.0001", 0.35, 1e-4),
        ("350±0.1mm", 0.35, 1e-4),
        ("350 ± 0.1 mm", 0.35, 1e-4),
        ("35cm±100um", 0.35, 1e-4),
        ("-1.5e-2±.01", -0.015, 0.01),
    ],
)
def test_a_prior_is_written_as_people_write_it(text: str, mean: float, sigma: float) -> None:
    by_option = choose([f"leg1.offset={text}"]).priors["leg1.offset"]
    by_name = choose({"leg1.offset": text}).priors["leg1.offset"]
    assert by_option == by_name
    assert (by_option.mean, by_option.sigma) == (mean, sigma)


def test_the_four_ways_to_state_a_prior_are_one() -> None:
    expected = {"leg1.offset": Prior(0.35, 1e-4)}
    for priors in (
        {"leg1.offset": (0.35, 1e-4)},
        {"leg1.offset": {"value": 0.35, "sigma": 1e-4}},
        {"leg1.offset": "0.35±0.0001"},
        ["leg1.offset=0.35±0.0001"],
    ):
        assert choose(priors).priors == expected


def test_units_are_those_of_the_parameter() -> None:
    upu = known("3-upu-tilted")
    found = choose(
        ["leg1.base_axis.1=1±0.1deg", "c1.fx=1300±3px", "c1.k1=-0.1±0.01"], parameters=upu
    )
    assert found.priors["leg1.base_axis.1"].mean == pytest.approx(np.radians(1.0))
    assert found.priors["c1.fx"] == Prior(1300.0, 3.0)
    assert found.priors["c1.k1"] == Prior(-0.1, 0.01)


def test_a_pattern_stands_for_all_that_it_matches() -> None:
    found = choose(
        {"*.radius.*_tube": (0.011, 1e-4)}, fixed=["leg2.base.*", "*.offset"], free=["tele.k?"]
    )
    assert set(found.priors) == {f"leg{j}.radius.leg{j}_tube" for j in range(1, 7)}
    assert found.fixed == {f"leg2.base.{axis}" for axis in "xyz"} | {
        f"leg{j}.offset" for j in range(1, 7)
    }
    assert found.free == {"tele.k1", "tele.k2", "tele.k3"}


def test_views_of_one_camera_have_one_set_of_intrinsics() -> None:
    assert choose(free=["c2.fx"]) == choose(free=["c1.fx"]) == choose(free=["c[12].fx"])
    assert choose(free=["*.fx"]).free == {"c1.fx", "tele.fx"}


def test_a_parameter_can_be_fixed_away_from_nominal() -> None:
    found = choose(fixed=["leg1.offset=351mm", "leg2.offset", "c2.cx=512.5"])
    assert found.fixed == {"leg1.offset", "leg2.offset", "c1.cx"}
    assert found.values == {"leg1.offset": 0.351, "c1.cx": 512.5}


def test_a_twist_is_an_angle_between_lines() -> None:
    parameters = known("3-upu-tilted")
    nominal = parameters.by_name["leg1.twist"].nominal
    for turns in (-1, 0, 1):
        value = nominal + 0.01 + turns * np.pi
        if abs(value) <= np.pi:
            found = choose({"leg1.twist": (value, 1e-3)}, parameters=parameters)
            assert found.priors["leg1.twist"].mean == pytest.approx(nominal + 0.01)


def test_a_prior_says_more_than_to_free_and_a_value_more_than_to_fix() -> None:
    found = choose({"c1.fx": (1290.0, 3.0)}, free=["c1.f?"])
    assert found.free == {"c1.fy"}
    assert set(found.priors) == {"c1.fx"}
    assert choose(fixed=["*.offset", "leg1.offset=0.35"]).values == {"leg1.offset": 0.35}


def test_who_holds_what() -> None:
    found = choose({"c1.fx": (1290.0, 3.0)}, fixed=["leg1.offset"], free=["c1.fy"])
    assert found.holds("leg1.offset")
    assert not found.holds("leg2.offset")
    assert [found.holds(f"c1.{name}", by_default=True) for name in ("fx", "fy", "cx")] == [
        False,
        False,
        True,
    ]


def test_what_a_run_asks_for_wins_over_the_dataset() -> None:
    in_file = [
        replace(override, in_file=True)
        for override in overrides_of_call({"leg1.offset": (0.35, 1e-4)}, ["leg2.offset"], ["c1.fx"])
    ]
    asked = overrides_of_call(["leg2.offset=0.35±0.001"], ["leg1.offset"], ["c1.fx"])
    found = resolve([*in_file, *asked], HEXAPOD)
    assert found.fixed == {"leg1.offset"}
    assert found.free == {"c1.fx"}
    assert found.priors == {"leg2.offset": Prior(0.35, 0.001)}
    assert found.notes == (
        "What the dataset says of leg1.offset, leg2.offset gave way to what this run asks for.",
    )


def test_what_was_chosen_is_a_document() -> None:
    found = choose({"c1.fx": (1290.0, 3.0)}, ["leg2.offset", "leg1.offset=0.35"], ["c1.k1"])
    assert found.document() == {
        "fixed": ["leg2.offset"],
        "fixed_at": {"leg1.offset": 0.35},
        "free": ["c1.k1"],
        "priors": {"c1.fx": [1290.0, 3.0]},
    }


def test_the_same_prior_twice_is_one() -> None:
    assert len(choose(["leg1.offset=0.35±0.1", "leg1.offset=350±100mm"]).priors) == 1
