"""What cameras see of legs, and where solids of all kinds and borders hide them."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from machines import copied_model
from scipy.spatial.transform import RigidTransform

import legcal
from legcal.data.outlines import Outlines
from legcal.geometry.motions import components, look_at
from legcal.machine.configurations import Configurations, random_configurations
from legcal.machine.kinematics import platform_in_base, platforms_in_base
from legcal.machine.leg import Cylinder
from legcal.machine.model import Machine
from legcal.machine.shapes import PlacedOccluders
from legcal.perception.body_edges import predicted_edges
from legcal.simulation.observe import legs_in_image, shares
from legcal.simulation.solids import pose_machine, solids_of
from legcal.vision.camera import Camera, sample_camera
from legcal.vision.distortion import DistortionModel
from legcal.vision.visibility import (
    Bodies,
    Seen,
    in_picture,
    pixels_inside,
    visible_parts,
    visible_segments,
)

FAR = np.array([1.4, 0.3, 0.25])
MIDDLE = np.array([0.0, 0.0, 0.2])


def test_a_leg_counts_as_seen_from_40_percent_on() -> None:
    machine = legcal.load_mechanism("hexapod")
    at_home = machine.home_configuration[None], np.zeros((1, machine.n_legs)), [machine.home]
    (here,) = pose_machine(machine, solids_of(machine), Configurations(*at_home))
    least = list[float]()
    for height in np.linspace(0.0, 0.6, 40):
        T = look_at(FAR, MIDDLE + np.array([0.0, 0.0, height]))  # more and more is below the image
        image = machine.legs, here, sample_camera(), T
        seen, every = legs_in_image(*image), legs_in_image(*image, least=0.0)
        share = shares(every, machine.n_legs)[0]
        np.testing.assert_array_equal(np.unique(seen.leg), np.flatnonzero(share >= 0.4))
        least += share[share > 0.0].tolist()
    assert min(abs(share - 0.4) for share in least) < 0.02


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", [-0.3, 0.0, 0.0, 0.0, 0.0]),
        ("plumb_bob", [-0.2, 0.05, 1e-3, 1e-3, 0.0]),
        ("plumb_bob", [0.2, -0.05, 0.0, 0.0, 0.0]),
        ("rational_polynomial", [0.3, 0.1, 0.0, 0.0, 0.01, 0.5, 0.2, 0.02]),
        ("equidistant", [0.1, -0.02, 1e-3, 0.0]),
    ],
)
def test_points_that_a_lens_folds_back_are_not_in_the_picture(
    model: DistortionModel, distortion: list[float]
) -> None:
    K = np.array([[900.0, 0.0, 512.0], [0.0, 920.0, 384.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, 1024, 768, np.array(distortion), model)
    xy = np.random.default_rng(0).uniform(-3.0, 3.0, (3000, 2))
    points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    pixels = camera.distort(xy)
    back = np.linalg.norm(camera.undistort(pixels) - xy, axis=1) < 1e-3
    np.testing.assert_array_equal(
        in_picture(camera, points, 0.1), pixels_inside(camera, pixels) & back
    )
    assert 0.1 < camera.unfolded < 2.0


# Solids that are not measured


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
    parts = [trimesh.creation.box((0.1, 0.1, 0.01)), trimesh.creation.box((0.01, 0.1, 0.1))]
    angle: Any = trimesh.util.concatenate(parts)
    (root / "urdf").mkdir()
    angle.export(root / "urdf/angle.stl")
    trimesh.creation.annulus(0.013, 0.02, 0.2).export(root / "urdf/hollow.stl")

    def with_more(text: str) -> str:
        for link in ("base", "platform"):
            text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{ON_ENDS}</link>')
        for j in range(1, 7):
            stage = f'<link name="leg{j}_tube">'
            text = text.replace(stage, f"{stage}{HOLLOW if j == 6 else HOUSING}{MOTOR}")
        return text

    return cache(lambda name: legcal.load_mechanism(copied_model(root, name, with_more)))


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
    # what of it is not measured as triangles, and as occluders
    solids = [solid for solid in solids_of(machine) if solid.leg is None]
    poses = pose_machine(machine, solids, random_configurations(machine, 2, 0))
    A, B = (np.array([getattr(here, end) for here in poses]) for end in ("A", "B"))
    for here, placed in zip(poses, PlacedOccluders.at(machine.occluders, A, B), strict=True):
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


def test_an_image_of_several_poses_shows_what_it_shows_alone(
    with_solids: Callable[[str], Machine],
) -> None:
    """Also where solids of legs hide others: they stand elsewhere in each image."""
    machine, camera, T = with_solids("hexapod"), sample_camera(), look_at(FAR, MIDDLE)
    motions = platforms_in_base(machine, random_configurations(machine, 6, 0).poses)
    occluders, every = machine.occluders, np.ones((1, machine.n_legs), dtype=np.bool_)

    def seen(some: Sequence[RigidTransform]) -> tuple[Seen, Outlines]:
        R, t = components(some)
        base = machine.T_base_Rb
        bodies = Bodies.at(machine.legs, R, t, machine.size, T_base_Rb=base, occluders=occluders)
        view, ends = np.zeros(len(some), dtype=np.intp), (bodies.A, bodies.B)
        edges = predicted_edges(occluders, [(camera, T)], view, ends, every)
        return visible_parts(camera, T, bodies), edges

    parts, edges = seen(motions)
    for k, motion in enumerate(motions):
        alone, edges_alone = seen([motion])
        together = parts.only(k)
        order, order_alone = (np.lexsort((np.array(x.part), x.leg)) for x in (together, alone))
        np.testing.assert_array_equal(together.leg[order], alone.leg[order_alone])
        np.testing.assert_allclose(together.ends[order], alone.ends[order_alone], atol=1e-6)
        here = edges.choose(edges.row == k)
        np.testing.assert_array_equal(here.leg, edges_alone.leg)
        np.testing.assert_allclose(here.ends, edges_alone.ends, atol=1e-6)


@pytest.mark.parametrize(("name", "n_seen"), [("hexapod", 0), ("delta", 6), ("3-prs", 3)])
def test_joints_on_the_base_span_a_plate_and_those_on_arms_and_carriages_do_not(
    name: str, n_seen: int
) -> None:
    machine = legcal.load_mechanism(name)
    R, t = components([platform_in_base(machine, machine.home)])
    bodies = Bodies.at(machine.legs, R, t, machine.size, T_base_Rb=machine.T_base_Rb)
    base, platform = (X[0, : machine.n_legs].mean(axis=0) for X in (bodies.A, bodies.B))
    behind = base + 4.0 * machine.size * (base - platform) / np.linalg.norm(base - platform)
    aside = np.array([0.0, 1e-3, 0.0])
    seen = visible_parts(sample_camera(), look_at(behind, base + aside), bodies)
    assert np.count_nonzero(seen.visible_legs(1, machine.n_legs)) == n_seen


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
