"""Families of machines: N legs evenly spread, from a few dimensions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from authoring import check_same

from legcal.machine import Machine, singularity
from legcal.machine.assembly import assemble
from legcal.machine.family import Family, describe_family
from legcal.machine.new_model import create_model, urdf_text, yaml_text

GOUGH = Family("6-UPS", "mm", 300.0, 150.0, 400.0)


def _made(family: Family, folder: Path) -> Machine:
    description = describe_family(family)
    machine = create_model(description, folder).machine
    check_same(machine, description)
    return machine


@pytest.mark.parametrize(
    ("family", "mobility"),
    [
        *[(f"6-{kind}", 6) for kind in ("UPS", "SPU", "SPS")],
        *[(f"3-{kind}", 3) for kind in ("RPS", "SPR", "UPU", "RPR")],
        ("4-UPU", 3),
        ("5-SPU", 6),
    ],
)
def test_families_load_with_the_mobility_of_their_type(
    tmp_path: Path, family: str, mobility: int
) -> None:
    height = None if family == "3-RPR" else 400.0
    machine = _made(replace(GOUGH, family=family, height=height), tmp_path)
    assert machine.mobility == mobility
    assert machine.name == family.lower()
    n, kind = family.split("-")
    assert [leg.type for leg in machine.legs] == [kind] * int(n)
    radii = np.linalg.norm(machine.A_base, axis=1), np.linalg.norm(machine.B_platform, axis=1)
    np.testing.assert_allclose(radii[0], 0.3, atol=1e-12)
    np.testing.assert_allclose(radii[1], 0.15, atol=1e-12)
    if mobility == len(machine.motors):
        assert singularity(machine, machine.home) > 0.05


def test_pairs_of_a_gough_platform_stand_as_told(tmp_path: Path) -> None:
    machine = _made(replace(GOUGH, base_spread=20.0, platform_spread=40.0), tmp_path)
    A, B = machine.A_base, machine.B_platform
    angle = np.degrees(np.arctan2(A[:, 1], A[:, 0])) % 360
    np.testing.assert_allclose(angle, [10, 110, 130, 230, 250, 350], atol=1e-9)
    angle = np.degrees(np.arctan2(B[:, 1], B[:, 0])) % 360
    np.testing.assert_allclose(angle, [40, 80, 160, 200, 280, 320], atol=1e-9)


def test_metres_and_millimetres_give_the_same_files() -> None:
    in_m = assemble(describe_family(Family("6-UPS", "m", 0.3, 0.15, 0.4)))
    in_mm = assemble(describe_family(GOUGH))
    assert (yaml_text(in_m), urdf_text(in_m)) == (yaml_text(in_mm), urdf_text(in_mm))


def test_dimensions_are_those_that_were_told(tmp_path: Path) -> None:
    family = replace(
        GOUGH, offset=380.0, travel=(-5.0, 120.0), leg_radius=12.5, turn=10.0, name="mine"
    )
    machine = _made(family, tmp_path)
    assert machine.name == "mine"
    np.testing.assert_allclose(machine.q0, 0.38, atol=1e-12)
    assert {leg.travel for leg in machine.legs} == {(-0.005, 0.12)}
    assert {c.radius for leg in machine.legs for c in leg.cylinders} == {0.0125}
    np.testing.assert_allclose(machine.home.rotation.magnitude(), np.radians(10.0), atol=1e-12)
    np.testing.assert_allclose(machine.home.translation, [0.0, 0.0, 0.4], atol=1e-12)


def test_tilted_universal_joints_rise_on_the_base_and_sink_on_the_platform(tmp_path: Path) -> None:
    machine = _made(replace(GOUGH, family="3-UPU", tilt=15.0), tmp_path)
    for leg in machine.legs:
        assert leg.base_axis is not None
        assert leg.platform_axis is not None
        cosine = abs(leg.base_axis @ leg.platform_axis)
        np.testing.assert_allclose(np.degrees(np.arccos(cosine)), 30.0, atol=1e-9)
        np.testing.assert_allclose(abs(leg.base_axis[2]), np.sin(np.radians(15.0)), atol=1e-12)


@pytest.mark.parametrize("kind", ["RPS", "SPR"])
def test_tilted_revolutes_stay_across_their_leg(tmp_path: Path, kind: str) -> None:
    machine = _made(replace(GOUGH, family=f"3-{kind}", tilt=-20.0), tmp_path)
    for leg in machine.legs:
        axis = leg.base_axis if leg.base_axis is not None else leg.platform_axis
        assert axis is not None
        assert abs(axis @ (machine.home.apply(leg.B) - leg.A)) < 1e-12
        assert abs(axis[2]) > 0.1
