"""Parameters fixed, freed and given priors by name: what overrides come to, and their refusals."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dataset_folder import Folder, folder

from legcal import load_dataset, load_mechanism
from legcal.calibration.joint_fit.parameter_choices import (
    Choices,
    KnownParameters,
    Prior,
    known_parameters,
    resolve,
)
from legcal.data.dataset_file import overrides_of_call
from legcal.data.measurements import View
from legcal.errors import UsageError
from legcal.vision.camera import Camera

__all__ = ["folder"]

# Three views of two cameras
K = np.array([[1290.0, 0.0, 511.0], [0.0, 1285.0, 380.0], [0.0, 0.0, 1.0]])
OTHER_K = np.array([[1800.0, 0.0, 511.0], [0.0, 1800.0, 380.0], [0.0, 0.0, 1.0]])
VIEWS = (
    View("c2", Camera(K, 1024, 768)),
    View("c1", Camera(K.copy(), 1024, 768)),
    View("tele", Camera(OTHER_K, 1024, 768)),
)
Priors = Mapping[str, object] | Sequence[str]


def known(model: str = "hexapod") -> KnownParameters:
    return known_parameters(load_mechanism(model), VIEWS)


HEXAPOD = known()


def choose(
    priors: Priors = (),
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    parameters: KnownParameters = HEXAPOD,
) -> Choices:
    return resolve(overrides_of_call(priors, fixed, free), parameters)


@pytest.mark.parametrize(
    "stated",
    [
        {"leg1.offset": (0.35, 1e-4)},
        {"leg1.offset": {"value": 0.35, "sigma": 1e-4}},
        *({"leg1.offset": text} for text in ("0.3500±0.0001", "0.35 +/- 0.0001", "35cm±100um")),
        *([f"leg1.offset={text}"] for text in ("0.35+-1e-4", "350±0.1mm", "350 ± .1 mm")),
    ],
)
def test_a_prior_is_written_as_people_write_it(stated: Priors) -> None:
    assert choose(stated).priors == {"leg1.offset": Prior(0.35, 1e-4)}


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
    with pytest.raises(UsageError, match=r"0.45 m differs by more than 15 % .* 0.5567 m"):
        choose(["leg1.base:leg3.base=450±0.05mm"], parameters=delta)
    for text in ("MEASURED±SIGMAmm", "MEASURED+-0.05mm"):
        with pytest.raises(UsageError, match="replace MEASURED by the measured value"):
            choose([f"leg1.base:leg3.base={text}"], parameters=delta)


def test_units_are_those_of_the_parameter() -> None:
    upu = known("3-upu-tilted")
    found = choose(
        ["leg1.base_axis.1=1±0.1deg", "c1.fx=1300±3px", "c1.k1=-0.1±0.01"], parameters=upu
    )
    assert found.priors["leg1.base_axis.1"].mean == pytest.approx(np.radians(1.0))
    assert found.priors["c1.fx"] == Prior(1300.0, 3.0)
    assert found.priors["c1.k1"] == Prior(-0.1, 0.01)


def test_a_twist_is_an_angle_between_lines() -> None:
    parameters = known("3-upu-tilted")
    nominal = parameters.by_name["leg1.twist"].nominal
    for turns in (-1, 0, 1):
        value = nominal + 0.01 + turns * np.pi
        if abs(value) <= np.pi:
            found = choose({"leg1.twist": (value, 1e-3)}, parameters=parameters)
            assert found.priors["leg1.twist"].mean == pytest.approx(nominal + 0.01)


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


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ((0.35, float("inf")), "sigma inf"),
        ((10**400, 0.1), "beyond 1e308"),
        ((True, 0.1), "needed a value and its sigma"),
        ({"mean": 0.35, "sigma": 0.1}, "needed a value and its sigma"),
        (None, "no value"),
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
        ("tricept", "centre.platform.z", "has no effect"),
        ("hexapod-rod", "leg6.offset", "leg6.length"),
    ],
)
def test_names_that_are_no_parameters_and_values_out_of_range_are_refused(
    model: str, name: str, found: str
) -> None:
    with pytest.raises(UsageError, match=found):
        choose(fixed=[name], parameters=known(model))
