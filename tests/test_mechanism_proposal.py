"""Base, platform and legs of a file that does not name them."""

from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
import yaml
from layouts import Layout, LegLayout, write_machine
from machines import MACHINES
from mechanisms import SHIPPED_URDF, SHIPPED_YAML
from thinned import thinned

from legcal.errors import OutOfClass
from legcal.machine import load_mechanism
from legcal.machine.topology import _leg_names

LAYOUTS = {
    "hung from the base": Layout(),
    "hung from the platform": Layout((LegLayout(hung="platform", mount=True),)),
    "welded": Layout((LegLayout(cut="mid", sphere=False),)),
    "carried": Layout((LegLayout(cut="carry"), *[LegLayout(seed=k) for k in range(1, 7)])),
}


def _without_block(path: Path, *keys: str) -> Path:
    """Take the block legcal out of a file, or some of its keys."""
    document = yaml.safe_load(path.read_text())
    for key in keys:
        document["legcal"].pop(key, None)
    if not keys:
        document.pop("legcal")
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


@pytest.mark.parametrize(
    ("machine", "layout"),
    thinned(
        product(["6-UPS", "3-RPR", "Tricept", "hexapod with a rod"], LAYOUTS),
        lambda machine, layout: machine == "Tricept" or layout == "hung from the base",
    ),
)
def test_base_platform_and_legs_are_taken_from_the_bodies(
    machine: str, layout: str, tmp_path: Path
) -> None:
    drawn = MACHINES[machine]()
    path = write_machine(tmp_path, drawn, LAYOUTS[layout])
    named = load_mechanism(path)
    document = yaml.safe_load(path.read_text())
    home = document["legcal"]["home"]
    found = load_mechanism(_without_block(path))
    assert found.base == "base"
    assert found.leg_names == named.leg_names
    assert found.platform_joint == named.platform_joint
    assert any("no block legcal" in note for note in found.diagnostics)
    np.testing.assert_allclose(found.A_base, named.A_base, atol=1e-9)
    assert [leg.type for leg in found.legs] == [leg.type for leg in named.legs]
    assert found.mobility == named.mobility
    assert home is not None


def test_base_frame_may_be_left_out(tmp_path: Path) -> None:
    path = write_machine(tmp_path, MACHINES["6-UPS"](), Layout())
    machine = load_mechanism(_without_block(path, "base_frame"))
    assert len(machine.frame_legs) == 3
    assert any("legcal.base_frame is not given" in note for note in machine.diagnostics)


def test_the_shipped_hexapod_is_proposed_as_it_is_written(tmp_path: Path) -> None:
    (tmp_path / "hexapod.urdf").write_bytes(SHIPPED_URDF.read_bytes())
    (tmp_path / "hexapod.yaml").write_bytes(SHIPPED_YAML.read_bytes())
    machine = load_mechanism(_without_block(tmp_path / "hexapod.yaml"))
    assert (machine.base, machine.platform) == ("base", "platform")
    assert machine.platform_joint == "platform_free"
    assert machine.leg_names == tuple(f"leg{j}" for j in range(1, 7))
    assert machine.frame_legs == (0, 2, 4)


def test_a_closed_chain_in_which_the_joint_at_A_moves_is_refused(tmp_path: Path) -> None:
    links = "".join(f'<link name="{name}"/>' for name in ("base", "a", "b", "c", "d", "e", "end"))
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.{i + 1} 0.{i * i} 0"/><axis xyz="0 0 1"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for i, (parent, child) in enumerate(pairwise(["base", "a", "b", "c", "d", "e"]))
    )
    joints += '<joint name="seat" type="fixed"><parent link="e"/><child link="end"/></joint>'
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    (tmp_path / "r.yaml").write_text("closed_loop: [[end, base]]\ntype: ['6d']\nname_mot: [j0]\n")
    with pytest.raises(OutOfClass, match="one closed chain in which no link is a platform on legs"):
        load_mechanism(tmp_path / "r.yaml")


def test_legs_are_numbered_where_the_names_of_their_joints_give_no_plain_names() -> None:
    assert _leg_names(["a_q", "b.1_q"]) == ["a", "b.1"]
    assert _leg_names(["rig/a_q", "rig/b_q"]) == ["leg1", "leg2"]
