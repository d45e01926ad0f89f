"""Parameters fixed, freed and given priors by name: what overrides come to, and their refusals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chosen import HEXAPOD, choose, known
from dataset_folder import Folder, folder

from legcal import calibrate, load_dataset, load_mechanism
from legcal.calibration.joint_fit.parameter_choices import (
    NO_CHOICES,
    Choices,
    Prior,
    known_parameters,
    resolve,
)
from legcal.data.overrides import overrides_of_call, overrides_of_settings
from legcal.errors import DatasetError, UsageError
from legcal.machine.parameter_id import ParameterId
from legcal.machine.parameters import parametrization_of

__all__ = ["folder"]


@pytest.mark.parametrize("model", ["hexapod-rod", "3-upu-tilted", "3-rpr", "tricept"])
def test_every_parameter_of_a_machine_can_be_named(model: str) -> None:
    parameters = known(model)
    names = parametrization_of(load_mechanism(model), twists=True).names
    assert tuple(parameters.by_name)[: len(names)] == names
    assert choose(free=names, parameters=parameters).free == set(names)
    assert parameters.by_name.keys().isdisjoint(parameters.others)


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


def test_a_length_is_between_two_joints_and_that_of_a_rod_is_its_own() -> None:
    delta = known("delta")
    one, other = (
        choose([f"{name}=550±0.05mm"], parameters=delta).priors
        for name in ("leg3.base:leg1.base", "leg1.base:leg3.base")
    )
    assert one == other == {"leg1.base:leg3.base": Prior(0.55, 5e-5)}
    rod = choose(["leg2.base:leg2.platform=400±0.05mm"], parameters=delta)
    assert rod.priors == {"leg2.length": Prior(0.4, 5e-5)}
    for name in ("leg1.base:leg3.platform", "leg1.base:nothing", "leg1.base:leg1.base"):
        with pytest.raises(UsageError, match=r"The length .* write LEG\.base:LEG\.base"):
            choose([f"{name}=550±0.05mm"], parameters=delta)
    with pytest.raises(UsageError, match="check the number and its unit"):
        choose(["leg1.base:leg3.base=550±0.05m"], parameters=delta)
    with pytest.raises(UsageError, match=r"0.45 m .* has 0.5567 m apart, needed .* within 15 %"):
        choose(["leg1.base:leg3.base=450±0.05mm"], parameters=delta)


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
    assert found.holds("leg1.offset")
    assert not found.holds("leg3.offset")
    assert [found.holds(f"c1.{name}", by_default=True) for name in ("fx", "cx")] == [True, True]
    assert not choose(free=["c1.fx"]).holds("c1.fx", by_default=True)


def test_a_twist_is_an_angle_between_lines() -> None:
    parameters = known("3-upu-tilted")
    nominal = parameters.by_name["leg1.twist"].nominal
    for turns in (-1, 0, 1):
        value = nominal + 0.01 + turns * np.pi
        if abs(value) <= np.pi:
            found = choose({"leg1.twist": (value, 1e-3)}, parameters=parameters)
            assert found.priors["leg1.twist"].mean == pytest.approx(nominal + 0.01)


def test_a_prior_wins_over_free_and_a_value_over_fixed() -> None:
    found = choose({"c1.fx": (1290.0, 3.0)}, free=["c1.f?"])
    assert found.free == {"c1.fy"}
    assert set(found.priors) == {"c1.fx"}
    assert choose(fixed=["*.offset", "leg1.offset=0.35"]).values == {"leg1.offset": 0.35}


def test_overrides_of_a_call_win_over_the_dataset() -> None:
    in_file = [
        replace(override, in_file=True)
        for override in overrides_of_call({"leg1.offset": (0.35, 1e-4)}, ["leg2.offset"], ["c1.fx"])
    ]
    of_call = overrides_of_call(["leg2.offset=0.35±0.001"], ["leg1.offset"], ["c1.fx"])
    found = resolve([*in_file, *of_call], HEXAPOD)
    assert found.fixed == {"leg1.offset"}
    assert found.free == {"c1.fx"}
    assert found.priors == {"leg2.offset": Prior(0.35, 0.001)}
    assert found.notes == (
        "This run overrides the choices of the dataset for leg1.offset, leg2.offset.",
    )


def test_what_was_chosen_is_a_document() -> None:
    assert choose() == NO_CHOICES
    assert NO_CHOICES.document() == {}
    found = choose({"c1.fx": (1290.0, 3.0)}, ["leg2.offset", "leg1.offset=0.35"], ["c1.k1"])
    assert found.document() == {
        "fixed": ["leg2.offset"],
        "fixed_at": {"leg1.offset": 0.35},
        "free": ["c1.k1"],
        "priors": {"c1.fx": [1290.0, 3.0]},
    }


def chosen(folder: Folder, block: dict[str, Any], **call: Any) -> Choices:
    folder.entry["parameters"] = block
    dataset = load_dataset(folder.write())
    known = known_parameters(dataset.machine, dataset.measurements.views)
    return resolve([*dataset.overrides, *overrides_of_call(**call)], known)


def test_the_block_of_a_dataset_says_what_a_call_can_say(folder: Folder) -> None:
    block = {
        "priors": {"leg1.offset": "350±0.1 mm", "c2.fx": {"value": 81.0, "sigma": 0.5}},
        "fixed": ["leg2.*.z", "leg3.offset=0.35"],
        "free": ["*.radius.*"],
    }
    call: dict[str, Any] = {"priors": {"leg1.offset": (0.35, 1e-4), "c1.fx": (81.0, 0.5)}}
    call |= {"fixed": block["fixed"], "free": block["free"]}
    assert load_dataset(folder.path).overrides == ()
    by_file = chosen(folder, block)
    assert by_file == chosen(folder, {}, **call)
    assert by_file.priors["leg1.offset"] == Prior(0.35, 1e-4)
    assert by_file.notes == ()


def test_a_run_that_says_the_same_needs_no_note(folder: Folder) -> None:
    block = {"priors": {"leg1.offset": "0.35±0.0001"}, "fixed": ["leg2.offset"]}
    assert chosen(folder, block, priors=["leg1.offset=350±0.1mm"]).notes == ()
    assert "leg1.offset, leg2.offset." in chosen(folder, block, free=["*.offset"]).notes[0]


def test_a_call_is_refused_before_any_work(folder: Folder, tmp_path: Path) -> None:
    before = sorted(folder.path.rglob("*"))
    for call in ({"free": ["leg9.offset"]}, {"priors": {"leg1.offset": (0.35, 0.0)}}):
        with pytest.raises(UsageError, match="could not be used"):
            calibrate(folder.path, output=tmp_path / "out", **call)
    assert not (tmp_path / "out").exists()
    assert sorted(folder.path.rglob("*")) == before


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ((0.35, float("inf")), "sigma inf"),
        ((float("nan"), 0.1), "value nan"),
        ((10**400, 0.1), "beyond 1e308"),
        ((True, 0.1), "needed a value and its sigma"),
        (("0.35", "0.1"), "needed a value and its sigma"),
        ({"mean": 0.35, "sigma": 0.1}, "needed a value and its sigma"),
        (0.35, "0.35"),
        (None, "no value"),
        ("350±1", "350 m"),
    ],
)
def test_values_that_are_no_prior_are_refused(value: object, found: str) -> None:
    with pytest.raises(UsageError, match=f"'leg1.offset.*{found}") as refusal:
        choose({"leg1.offset": value})
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("model", "name", "found"),
    [
        ("hexapod", "c1.fx=129", "129 px"),
        ("tricept", "centre.offset", "without an encoder"),
        ("tricept", "centre.platform.z", "nothing depends"),
        ("hexapod-rod", "leg6.offset", "leg6.length"),
    ],
)
def test_names_that_are_no_parameters_and_values_out_of_range_are_refused(
    model: str, name: str, found: str
) -> None:
    with pytest.raises(UsageError, match=found):
        choose(fixed=[name], parameters=known(model))


def test_problems_are_refused_as_those_of_their_source() -> None:
    in_file = [replace(o, in_file=True) for o in overrides_of_call(fixed=["leg9.offset"])]
    with pytest.raises(DatasetError, match="unknown name"):
        resolve(in_file, HEXAPOD)
    with pytest.raises(UsageError, match=r"c2\.fx, measured axes"):
        choose(free=["c2.fx"], parameters=known(axes_given=True))


def test_a_machine_of_which_all_is_fixed_is_refused() -> None:
    parameters = known("3-upu-tilted")
    names = [name for name, p in parameters.by_name.items() if p.kind == "kinematic"]
    with pytest.raises(UsageError, match="all of its parameters are fixed"):
        choose(fixed=names, parameters=parameters)
    assert choose(fixed=names[1:], parameters=parameters).fixed == set(names[1:])


@pytest.mark.parametrize(
    ("block", "found"),
    [
        ({"fixed": "leg1.offset"}, r"parameters\.fixed"),
        ({"fixed": ["leg1.offset=x"]}, r"parameters\.fixed\.0"),
        ({"free": [{"leg1": "offset"}]}, r"parameters\.free\.0"),
        ({"priors": {"leg1.offset": "9±1"}}, r"leg1\.offset .*9 m"),
    ],
)
def test_a_malformed_block_of_a_dataset_is_refused(
    folder: Folder, block: dict[str, Any], found: str
) -> None:
    with pytest.raises(DatasetError, match=found) as refusal:
        chosen(folder, block)
    assert "dataset.yaml" in str(refusal.value)


@pytest.mark.parametrize("leg", ["leg1", "z_axis", "left.front", "base.x"])
def test_a_name_says_whose_number_it_is_whatever_the_leg_is_called(leg: str) -> None:
    kinds = [
        *((kind, axis) for kind in ("base", "platform") for axis in "xyz"),
        *((kind, angle) for kind in ("base_axis", "platform_axis", "arm_point") for angle in "12"),
        *((kind, "") for kind in ("offset", "length", "twist", "gain")),
        ("radius", f"{leg}.rod"),
    ]
    for kind, component in kinds:
        parameter = ParameterId(leg, kind, component)
        assert ParameterId.parse(str(parameter)) == parameter


@pytest.mark.parametrize(
    ("text", "argument"),
    [
        ("leg1.offset", {"fixed": ["leg1.offset"]}),
        ("leg1.offset=350mm", {"fixed": ["leg1.offset=350mm"]}),
        ("leg1.offset=350±0.1mm", {"priors": ["leg1.offset=350±0.1mm"]}),
        ("leg1.offset=0.35+-1e-4", {"priors": ["leg1.offset=0.35+-1e-4"]}),
        ("*.radius.*=free", {"free": ["*.radius.*"]}),
    ],
)
def test_one_option_fixes_frees_and_gives_priors(text: str, argument: dict[str, Any]) -> None:
    nothing: dict[str, list[str]] = {"priors": [], "fixed": [], "free": []}
    assert overrides_of_settings([text]) == nothing | argument
