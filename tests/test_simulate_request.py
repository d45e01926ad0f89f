"""Options of ``legcal simulate`` made into settings; those without effect are refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from legcal.errors import UsageError
from legcal.machine import LegKind, load_mechanism
from legcal.simulation.request import Level, Request, Sampling
from legcal.simulation.settings import (
    Distribution,
    ParameterErrors,
    SimulationSettings,
    Spread,
    requested,
)


def test_the_defaults_are_those_that_the_help_names() -> None:
    assert requested(Request(), load_mechanism("hexapod")) == SimulationSettings()


def test_all_options_have_their_setting(tmp_path: Path) -> None:
    asked = requested(
        Request(
            level=Level.OUTLINES,
            seed=4,
            error=["none", "radii=0.1mm", "joints=1mm:normal"],
            poses="7",
            sampling=Sampling.WORKSPACE,
            shared_poses=True,
            images=2,
            cameras=tmp_path / "c.yaml",
            hints=False,
            pixel_noise="0px",
        ),
        load_mechanism("hexapod"),
    )
    joints = Spread(1e-3, Distribution.NORMAL)
    assert asked == SimulationSettings(
        level=Level.OUTLINES,
        seed=4,
        errors=ParameterErrors(base_joints=joints, platform_joints=joints, radii=Spread(1e-4)),
        poses=7,
        sampling=Sampling.WORKSPACE,
        shared_poses=True,
        images=2,
        views=tmp_path / "c.yaml",
        hints=False,
        sigma_px=0.0,
    )


@pytest.mark.parametrize(
    ("given", "level"),
    [
        ({"pixel_noise": "0.2px"}, "outlines"),
        ({"table_noise": "degrees"}, "axes"),
        ({"appearance": Path("look.yaml")}, "photographs"),
        ({"blur": 0.0}, "photographs"),
        ({"clutter": 0}, "photographs"),
        ({"bits": 8}, "photographs"),
        ({"colour": False}, "photographs"),
    ],
)
def test_options_of_another_level_are_refused(given: dict[str, Any], level: str) -> None:
    nominal = load_mechanism("hexapod")
    for other in set(Level) - {Level(level)}:
        with pytest.raises(UsageError) as caught:
            requested(Request(level=other, **given), nominal)
        (problem,) = caught.value.problems
        assert f"found --level {other}, needed --level {level}" in problem


@pytest.mark.parametrize(
    ("name", "kind"),
    [("hexapod", "lengths=1mm"), ("hexapod", "axes=1deg"), ("3-rps", "twists=1deg")],
)
def test_errors_of_what_a_machine_has_not_are_refused(name: str, kind: str) -> None:
    nominal = load_mechanism(name)
    with pytest.raises(UsageError, match=f"found none in the mechanism '{name}'"):
        requested(Request(error=[kind]), nominal)
    nothing = f"{kind.partition('=')[0]}=0{'mm' if 'mm' in kind else 'deg'}"
    requested(Request(error=[nothing]), nominal)  # none of them is what it has


def test_sampling_is_refused_where_it_says_nothing() -> None:
    nominal = load_mechanism("hexapod")
    with pytest.raises(UsageError, match="found --sampling with a file of poses"):
        requested(Request(poses="p.csv", sampling=Sampling.EXTREME), nominal)
    passive = replace(nominal.legs[1], kind=LegKind.PASSIVE)
    free = replace(nominal, legs=(nominal.legs[0], passive, *nominal.legs[2:]))
    with pytest.raises(UsageError, match="found --sampling for a machine whose motors do not"):
        requested(Request(sampling=Sampling.WORKSPACE), free)


def test_coplanar_joints_without_errors_of_joints_are_refused() -> None:
    with pytest.raises(UsageError, match="--coplanar could not be used: found no errors of joints"):
        requested(Request(error=["none"], coplanar=True), load_mechanism("hexapod"))
