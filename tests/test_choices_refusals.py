"""Every way in which a choice of parameters is refused."""

from dataclasses import replace

import pytest
from chosen import HEXAPOD, choose, known

from legcal.calibration.joint_fit.choices import resolve
from legcal.data.overrides import overrides_of_call
from legcal.errors import DatasetError, UsageError


@pytest.mark.parametrize(
    ("prior", "found"),
    [
        ("leg1.offset", "found no value, needed one and its sigma"),
        ("leg1.offset=", "found '', needed a value and its sigma"),
        ("leg1.offset=0.35", "found '0.35', needed a value and its sigma"),
        ("leg1.offset=0.35±", "needed a value and its sigma"),
        ("leg1.offset=0.35±0", "found the sigma 0, needed a finite one above zero"),
        ("leg1.offset=0.35±-0.001", "found the sigma -0.001, needed a finite one above zero"),
        ("leg1.offset=0.35±1e999", "found '1e999', needed a number"),
        ("leg1.offset=0.35±nan", "needed a value and its sigma"),
        ("leg1.offset=0.35±1e-12", "found the sigma 1e-12, needed at least 1e-09; fix"),
        ("leg1.offset=0.35±1e300", "found the sigma 1e.300, needed at most 1e.06; free"),
        ("leg1.offset=350mm±0.1", "needed the unit of sigma too"),
        ("leg1.offset=350mm±1deg", "needed units of one kind"),
        ("leg1.offset=350±1furlong", "found the unknown unit 'furlong', needed one of mm, um"),
        ("leg1.offset=350±1px", "found a number in px for leg1.offset, needed a number in m"),
        ("c1.k1=0±1mm", "found a number in m for c1.k1, needed a number without unit"),
        ("leg1.offset=350±1", "found 350 m for leg1.offset, needed one between"),
        ("leg1.radius.leg1_tube=0±0.001", "found 0 m for leg1.radius.leg1_tube, needed one betw"),
        ("leg1.radius.leg1_tube=-0.01±0.001", "found -0.01 m for leg1.radius.leg1_tube"),
        ("c1.fx=129±1", "found 129 px for c1.fx, needed one between 645 and 2580, not so far"),
        ("c1.cx=1024±1", "found 1024 px for c1.cx, needed one between -0.5 and 1024"),
        ("leg1.ofset=0.35±0.1", "found an unknown name, .*; did you mean 'leg1.offset'?"),
        ("*.ofset=0.35±0.1", "found a pattern that no name matches, .*; did you mean"),
        (
            "leg1.base.x=0±0.1",
            "found leg1.base.x, a coordinate that is zero by the definition of R_b",
        ),
        ("leg5.platform.z=0±0.1", "a coordinate that is zero by the definition of R_e"),
        ("leg1.length=0.3±0.1", "a leg with an encoder, whose parameter is leg1.offset"),
        ("leg1.twist=0±0.1", "an angle that is no parameter of a leg of type SPU"),
    ],
)
def test_a_prior_that_cannot_be_meant_is_refused(prior: str, found: str) -> None:
    with pytest.raises(UsageError, match=f"^The prior '.*could not be used: .*{found}") as refusal:
        choose([prior])
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("value", "found"),
    [
        ((0.35, 0.0), "found the sigma 0"),
        ((0.35, -1.0), "found the sigma -1"),
        ((0.35, float("inf")), "found the sigma inf"),
        ((0.35, float("nan")), "found the sigma nan"),
        ((float("nan"), 0.1), "found the value nan"),
        ((10**400, 0.1), "found a number beyond 1e308"),
        ((0.35,), "needed a value and its sigma"),
        ((True, 0.1), "needed a value and its sigma"),
        (("0.35", "0.1"), "needed a value and its sigma"),
        ({"mean": 0.35, "sigma": 0.1}, "needed a value and its sigma"),
        (0.35, "found 0.35, needed a value and its sigma"),
        (None, "found no value"),
    ],
)
def test_numbers_that_are_no_prior_are_refused(value: object, found: str) -> None:
    with pytest.raises(UsageError, match=f"^The prior 'leg1.offset' could not be used: .*{found}"):
        choose({"leg1.offset": value})


@pytest.mark.parametrize(
    ("model", "name", "found"),
    [
        ("3-rpr", "leg1.base.z", "a coordinate on which nothing depends"),
        ("3-rpr", "leg1.base_axis.1", "an angle that is no parameter of a leg of type RPR"),
        ("tricept", "centre.offset", "a leg without an encoder"),
        ("tricept", "centre.platform.z", "a coordinate on which nothing depends"),
        ("hexapod-rod", "leg6.offset", "a leg of constant length, whose parameter is leg6.length"),
    ],
)
def test_what_is_no_parameter_says_why(model: str, name: str, found: str) -> None:
    with pytest.raises(
        UsageError, match=f"found {name}, {found}.*needed a parameter; leave it out"
    ):
        choose(fixed=[name], parameters=known(model))


@pytest.mark.parametrize("name", ["c2.fx", "leg1.radius.leg1_tube"])
def test_measured_axes_leave_nothing_of_cameras_and_radii(name: str) -> None:
    with pytest.raises(
        UsageError, match=f"found {name}, measured axes, in which cameras and radii"
    ):
        choose(free=[name], parameters=known(axes_given=True))


@pytest.mark.parametrize(
    ("priors", "fixed", "free", "found"),
    [
        (["leg1.offset=0.35±0.1", "leg1.offset=0.36±0.1"], [], [], "given two different priors"),
        (["leg1.offset=0.35±0.1", "*.offset=0.35±0.2"], [], [], "given two different priors"),
        (["leg1.offset=0.35±0.1"], ["*.offset"], [], "both fixed and given a prior"),
        ([], ["leg1.offset"], ["leg1.offset"], "both fixed and freed"),
        ([], ["leg1.offset=0.35", "leg1.offset=0.36"], [], "fixed at two values"),
    ],
)
def test_wishes_that_contradict_each_other_are_refused(
    priors: list[str], fixed: list[str], free: list[str], found: str
) -> None:
    with pytest.raises(UsageError, match=rf"leg1\.offset could not be {found}: .*remove the other"):
        choose(priors, fixed, free)


def test_two_priors_on_one_camera_by_two_names_are_refused() -> None:
    with pytest.raises(UsageError, match=r"c1\.fx, which is c2\.fx too, could not be given two"):
        choose(["c1.fx=1290±3", "c2.fx=1291±3"])


@pytest.mark.parametrize("value", ["", "x", "1e999", "nan", "350foot"])
def test_a_value_that_nothing_can_be_fixed_at_is_refused(value: str) -> None:
    with pytest.raises(
        UsageError, match=r"^The parameter to fix 'leg1\.offset=.*' could not be used"
    ):
        choose(fixed=[f"leg1.offset={value}"])


def test_all_problems_are_told_at_once() -> None:
    with pytest.raises(UsageError) as refusal:
        choose(fixed=["leg9.offset", "leg1.base.x"], free=["c9.fx"])
    assert len(refusal.value.problems) == 3


@pytest.mark.parametrize("model", ["hexapod", "3-upu-tilted"])
def test_a_machine_of_which_all_is_fixed_is_refused(model: str) -> None:
    parameters = known(model)
    names = [name for name, p in parameters.by_name.items() if p.kind == "kinematic"]
    with pytest.raises(UsageError, match="found all of its parameters fixed, needed one at least"):
        choose(fixed=names, parameters=parameters)
    assert choose(fixed=names[1:], parameters=parameters).fixed == set(names[1:])


def test_problems_of_the_dataset_alone_are_its_own() -> None:
    overrides = [
        replace(override, in_file=True) for override in overrides_of_call(fixed=["leg9.offset"])
    ]
    with pytest.raises(DatasetError, match="unknown name"):
        resolve(overrides, HEXAPOD)
