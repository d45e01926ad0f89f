"""Solids of a model that are not measured: where they are, and what they hide of legs."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import legcal
from legcal.geometry.motions import look_at
from legcal.machine.configurations import random_configurations
from legcal.machine.leg import Cylinder
from legcal.machine.model import Machine
from legcal.machine.shapes import PlacedOccluders
from legcal.simulation.solids import PosedMachine, pose_machine, solids_of
from legcal.vision.visibility import visible_segments

ROOT = Path(__file__).parents[1]


def visual(shape: str, xyz: str, rpy: str = "0 0 0") -> str:
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></visual>'


HOUSING = visual('<box size="0.03 0.03 0.2"/>', "0.004 -0.003 -0.14")
HOLLOW = visual('<mesh filename="hollow.stl"/>', "0 0 -0.14")
MOTOR = visual('<cylinder radius="0.02" length="0.1"/>', "0.05 0 -0.2")
ON_ENDS = (
    visual('<box size="0.1 0.05 0.03"/>', "0.1 0 0.03", "0.3 0.2 0")
    + visual('<sphere radius="0.03"/>', "0.1 0.1 0.05")
    + visual('<mesh filename="package://any/angle.stl"/>', "-0.1 0 0.05")
)


@pytest.fixture(scope="module")
def with_solids(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Machine]:
    """Return shipped machines with solids on base, platform, and a stage of each leg.

    Of their meshes one, on both ends, is not convex, the other surrounds the last leg.
    """
    root = tmp_path_factory.mktemp("solids")
    (root / "models").mkdir()
    (root / "urdf").mkdir()
    parts = [trimesh.creation.box((0.1, 0.1, 0.01)), trimesh.creation.box((0.01, 0.1, 0.1))]
    angle: Any = trimesh.util.concatenate(parts)
    angle.export(root / "urdf/angle.stl")
    trimesh.creation.annulus(0.013, 0.02, 0.2).export(root / "urdf/hollow.stl")

    @cache
    def machine(name: str) -> Machine:
        text = (ROOT / f"urdf/{name}.urdf").read_text()
        for link in ("base", "platform"):
            text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{ON_ENDS}</link>')
        for j in range(1, 7):
            stage = f'<link name="leg{j}_tube">'
            text = text.replace(stage, f"{stage}{HOLLOW if j == 6 else HOUSING}{MOTOR}")
        (root / f"urdf/{name}.urdf").write_text(text)
        (root / f"models/{name}.yaml").write_text((ROOT / f"models/{name}.yaml").read_text())
        return legcal.load_mechanism(root / f"models/{name}.yaml")

    return machine


def posed(machine: Machine, n: int) -> tuple[tuple[PosedMachine, ...], list[PlacedOccluders]]:
    """Return a machine in poses: what of it is not measured as triangles, and as occluders."""
    solids = [solid for solid in solids_of(machine) if solid.leg is None]
    found = random_configurations(machine, n, 0)
    poses = pose_machine(machine, solids, found)
    A, B = (np.array([getattr(here, name) for here in poses]) for name in ("A", "B"))
    return poses, PlacedOccluders.at(machine.occluders, A, B)


@pytest.mark.parametrize(
    "name",
    ["hexapod", "3-prs", "delta"],
)
def test_hidden_is_what_rays_at_the_model_do_not_reach(
    name: str, with_solids: Callable[[str], Machine]
) -> None:
    """Rays meet triangles of the visuals at the links' poses in Pinocchio, by another code."""
    machine = with_solids(name)
    size, rng = machine.size, np.random.default_rng(3)
    share, n_hidden = list[float](), 0
    for here, placed in zip(*posed(machine, 2), strict=True):
        middle = 0.5 * (here.A.mean(axis=0) + here.B.mean(axis=0))
        direction = rng.normal(size=3)
        centre = middle + 4.0 * size * direction / np.linalg.norm(direction)
        points = middle + size * rng.uniform(-1.0, 1.0, (2500, 3))
        none, zero = np.full(len(points), -1), np.zeros(len(points))
        T = look_at(centre, middle)
        seen = placed.before(T.as_matrix())
        hidden = seen.hide(T.inv().apply(points), none, zero, zero) >= 0
        by_rays = here.hidden(centre, points, zero)
        share.append(float(np.mean(hidden != by_rays)))
        n_hidden += int(np.count_nonzero(by_rays))
    assert n_hidden > 50
    assert max(share) < 0.003  # polygons stand for circles, one around and one within


@pytest.mark.parametrize("name", ["leg1", "leg6"])  # a box, and a mesh that is hollow
def test_a_rod_is_not_looked_for_inside_the_housing_of_its_leg(
    name: str, with_solids: Callable[[str], Machine]
) -> None:
    machine = with_solids("hexapod")
    leg = machine.legs[machine.leg_names.index(name)]
    length = leg.length_at(0.5 * sum(leg.travel))
    segments = visible_segments(leg.cylinders, length)
    # from 0.14 - 0.1 to 0.14 + 0.1 from A inside it; the longer stretch begins at its end
    assert segments
    for segment in segments:
        assert segment.start == pytest.approx(0.24 + 2.0 * segment.radius, abs=1e-3)
    bare = [
        Cylinder(c.link, c.radius, c.side, c.start, c.end)  # without what encloses it
        for c in leg.cylinders
    ]
    assert visible_segments(bare, length)[0].start < 0.1
