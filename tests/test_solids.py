"""The solids that a machine is seen as: every visual of its URDF, at its place."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from machines import ROOT, copied_model
from scipy.spatial.transform import Rotation
from yourdfpy import URDF

from legcal import Machine, load_mechanism
from legcal.errors import ModelError
from legcal.machine.meshes import ray_caster
from legcal.simulation.session import draw_poses
from legcal.simulation.solids import (
    Box,
    Mesh,
    Shape,
    SolidCylinder,
    Sphere,
    link_poses,
    placed,
    solids_of,
)

STL = b"""solid one
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid one
"""


def hexapod_showing(folder: Path, visuals: str) -> Machine:
    """Return the hexapod with visuals on its platform."""
    old, new = '<link name="platform"/>', f'<link name="platform">{visuals}</link>'
    return load_mechanism(copied_model(folder, "hexapod", lambda text: text.replace(old, new)))


@pytest.mark.parametrize(
    ("visual", "message"),
    [
        ('<mesh filename="gone.stl"/>', "found no mesh file 'gone.stl', needed it beside the URDF"),
        ('<mesh filename=""/>', "found no mesh file"),
        ('<mesh filename="bad.stl"/>', r"mesh file 'bad.stl'"),
        ('<box size="0.1 0.1 0"/>', 'found <box size="0.1 0.1 0">, needed 3 positive numbers'),
        ('<mesh filename="one.stl" scale="1 0 1"/>', "needed 3 numbers other than zero"),
        ("<box/>", 'found <box size="">, needed 3 positive numbers'),
        ("<sphere/>", 'found <sphere radius="">, needed a positive number'),
        ("<capsule/>", "found <capsule>, needed a cylinder, sphere, box or mesh"),
    ],
)
def test_visuals_that_cannot_be_shown_are_named(tmp_path: Path, visual: str, message: str) -> None:
    (tmp_path / "bad.stl").write_bytes(b"nothing of a mesh")
    (tmp_path / "one.stl").write_bytes(STL)
    with pytest.raises(ModelError, match=message):
        solids_of(hexapod_showing(tmp_path, f"<visual><geometry>{visual}</geometry></visual>"))


def test_only_photographs_need_meshes_and_empty_boxes_are_no_parts(tmp_path: Path) -> None:
    shapes = '<mesh filename="gone.stl"/>', '<box size="0 0 0"/>', '<sphere radius="0.02"/>'
    visuals = "".join(f"<visual><geometry>{shape}</geometry></visual>" for shape in shapes)
    machine = hexapod_showing(tmp_path, visuals)
    shown = [s for s in solids_of(machine, meshes_needed=False) if s.link == "platform"]
    assert [s.shape for s in shown] == [Sphere(0.02)]
    with pytest.raises(ModelError, match=r"--level outlines") as refusal:
        solids_of(machine)
    assert len(refusal.value.problems) == 1


@pytest.mark.parametrize("name", ["hexapod", "delta"])
def test_visuals_stand_where_the_scene_of_yourdfpy_shows_them(name: str) -> None:
    machine = load_mechanism(ROOT / "models" / f"{name}.yaml")
    robot = URDF.load(io.BytesIO(machine.urdf.content))
    joints = machine.urdf.joints.values()
    parents = {joint.child: joint.parent for joint in joints if joint.type != "floating"}
    for configuration in draw_poses(machine, 2, np.random.default_rng(0)).configurations:
        q = {
            joint.name: float(configuration[machine.chain.q_index(joint.name)])
            for joint in joints
            if joint.type in ("revolute", "prismatic")
        }
        robot.update_cfg(q)
        poses = link_poses(machine, configuration)
        shown = [robot.scene.graph.get(node) for node in robot.scene.graph.nodes_geometry]
        ours = placed(solids_of(machine), poses)
        assert len(ours) == len(shown) >= machine.n_legs
        for p in ours:
            root = str(p.solid.link)
            while root in parents:  # it knows no loops: legs hang where the tree has them
                root = parents[root]
            found = (poses[root].inv() * p.T_base_solid).as_matrix()
            T_root = np.linalg.inv(robot.get_transform(root))
            there = [
                shape_of(robot.scene.geometry[geometry].primitive)
                for T, geometry in shown
                if np.abs(T_root @ T - found).max() < 1e-12
            ]
            assert p.solid.shape in there


def shape_of(primitive: Any) -> Shape:
    """Return a cylinder or a box of trimesh."""
    if hasattr(primitive, "radius"):
        return SolidCylinder(float(primitive.radius), float(primitive.height))
    x, y, z = (float(size) for size in primitive.extents)
    return Box((x, y, z))


def test_a_mesh_is_scaled_and_placed_as_yourdfpy_shows_it(tmp_path: Path) -> None:
    (tmp_path / "one.stl").write_bytes(STL)
    machine = hexapod_showing(
        tmp_path,
        '<visual><origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/>'
        '<geometry><mesh filename="../one.stl" scale="0.1 -0.2 0.3"/></geometry></visual>',
    )
    (mesh,) = (s for s in solids_of(machine) if s.link == "platform")
    assert isinstance(mesh.shape, Mesh)
    turn = Rotation.from_euler("xyz", [0.4, 0.5, 0.6])
    expected = turn.apply([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, -0.2, 0.0]])
    expected += [0.1, 0.2, 0.3]
    found = mesh.T_link_solid.apply(mesh.shape.vertices)
    assert sorted(np.round(found, 9).tolist()) == sorted(np.round(expected, 9).tolist())
    corners = found[mesh.shape.faces[0]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    assert abs(normal @ turn.apply([0.0, 0.0, 1.0])) == pytest.approx(0.02)


def test_meshes_hide_the_same_with_and_without_embree(monkeypatch: pytest.MonkeyPatch) -> None:
    sphere = trimesh.creation.icosphere(2, 0.1)
    rng = np.random.default_rng(3)
    aims = np.column_stack([rng.uniform(-0.15, 0.15, (200, 2)), np.ones(200)])
    start = np.tile([0.0, 0.0, -1.0], (200, 1))
    triangles = []
    for is_there in (True, False):
        monkeypatch.setattr("trimesh.base.ray.has_embree", is_there)
        triangles.append(ray_caster(sphere.vertices, sphere.faces).intersects_first(start, aims))
    np.testing.assert_array_equal(*triangles)
    assert 20 < np.count_nonzero(triangles[0] >= 0) < 180
