"""True machines: drawn errors are what a written model differs by, and it is one machine still."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from layouts import Layout, LegLayout, LegSpec, MachineSpec, write_machine
from machines import MACHINES, ring
from mechanisms import ROOT
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.errors import ModelError, UsageError
from legcal.geometry import roll_pitch_yaw
from legcal.geometry.types import Array
from legcal.machine import (
    EquationKind,
    Leg,
    LegKind,
    Machine,
    geometries,
    load_mechanism,
    parametrization_of,
    pose_equations,
    vector_of,
)
from legcal.machine.parameters import in_links
from legcal.machine.urdf import UrdfPatch
from legcal.simulation import truth
from legcal.simulation.dataset import simulate
from legcal.simulation.poses import draw_poses
from legcal.simulation.request import Level
from legcal.simulation.settings import Distribution, ParameterErrors, SimulationSettings, Spread
from legcal.simulation.truth import draw_errors, write_true_model

SHIPPED = sorted(path.stem for path in (ROOT / "models").glob("*.yaml"))
LAYOUTS = {
    "S as revolutes, hung from the platform": Layout(
        (LegLayout(hung="platform", sphere=False, flip_axes=True),)
    ),
    "cut behind the slider": Layout((LegLayout(cut="mid", flip_slider=True, slid=0.02),)),
    "cut before the slider": Layout((LegLayout(cut="slider", mount=True),)),
    "carried by leg 2": Layout(
        (LegLayout(), LegLayout(cut="carry"), *[LegLayout(spin="S", seed=k) for k in range(5)])
    ),
}
ALL = ParameterErrors(
    base_joints=Spread(3e-3),
    platform_joints=Spread(1e-3, Distribution.NORMAL),
    offsets=Spread(2e-3),
    lengths=Spread(2e-3),
    axes=Spread(0.01),
    twists=Spread(0.01),
)
N = 140  # draws of errors
ORIGIN = re.compile(rb'(<origin xyz=")[^"]*(" rpy=")[^"]*(")')


def _apart(one: Leg, two: Leg) -> float:
    """Return the largest difference of two legs [m, rad], axes and twists as those of lines."""
    found = [np.abs(one.A - two.A).max(), np.abs(one.B - two.B).max(), abs(one.q0 - two.q0)]
    for key in ("base_axis", "platform_axis"):
        axis, other = getattr(one, key), getattr(two, key)
        assert (axis is None) == (other is None)
        if axis is not None:
            found.append(min(np.abs(axis - other).max(), np.abs(axis + other).max()))
    assert (one.twist is None) == (two.twist is None)
    if one.twist is not None and two.twist is not None:
        found.append(abs(np.remainder(one.twist - two.twist + np.pi / 2.0, np.pi) - np.pi / 2.0))
    return float(max(found))


def _check(nominal: Machine, folder: Path, seed: int = 3) -> Machine:
    """Check that a true model has the numbers that were drawn, and meets them where it stands."""
    true = write_true_model(nominal, ALL, np.random.default_rng(seed), folder)
    rng = np.random.default_rng(seed)
    draws = (draw_errors(nominal, ALL, rng) for _ in range(truth.MAX_DRAWS))
    drawn = next(legs for legs in draws if max(map(_apart, legs, geometries(true))) < 1e-6)
    assert max(map(_apart, drawn, geometries(nominal))) > 5e-4
    assert max(map(_apart, drawn, geometries(true))) < 1e-12
    for frame in ("T_base_Rb", "T_platform_Re"):
        np.testing.assert_allclose(
            getattr(true, frame).as_matrix(), getattr(nominal, frame).as_matrix(), atol=1e-12
        )
    assert np.abs(true.chain.residual(true.home_configuration)).max() < 1e-11
    assert (true.mobility, true.spatial) == (nominal.mobility, nominal.spatial)
    assert [leg.type for leg in true.legs] == [leg.type for leg in nominal.legs]
    _check_equations(true, in_links(nominal, drawn))
    return true


def _check_equations(true: Machine, legs: tuple[Leg, ...]) -> None:
    """Check the chain's poses and readings against the closed form of the drawn legs."""
    poses = draw_poses(true, 2, np.random.default_rng(0), "workspace")
    for T, readings in zip(poses.poses, poses.readings, strict=True):
        matrix = T.as_matrix()[None]
        for j, leg in enumerate(legs):
            at = pose_equations([leg], matrix[:, :3, :3], matrix[:, :3, 3])
            for demand, value in zip(at.kinds, at.values[0], strict=True):
                is_read = demand is EquationKind.LENGTH and leg.kind is not LegKind.CONSTANT
                wanted = true.legs[j].sign * readings[j] if is_read else 0.0
                assert abs(value - wanted) < 1e-10


@pytest.mark.parametrize("name", SHIPPED)
def test_a_true_model_of_a_shipped_one_has_the_drawn_numbers(name: str, tmp_path: Path) -> None:
    nominal = load_mechanism(name)
    true = _check(nominal, tmp_path)
    assert true.yaml_path == tmp_path / "models" / f"{name}.yaml"
    assert true.urdf_path.resolve() == tmp_path / "urdf" / f"{name}.urdf"
    before, after = nominal.urdf.content, true.urdf.content
    assert before != after
    assert ORIGIN.sub(rb"\1\2\3", before) == ORIGIN.sub(rb"\1\2\3", after)


@pytest.mark.parametrize(
    ("machine", "layout"),
    thinned(
        product(["6-UPS", "3-UPU", "Tricept"], LAYOUTS),
        lambda machine, layout: machine == "Tricept" or layout == "carried by leg 2",
    ),
)
def test_a_true_model_can_be_written_in_any_tree(machine: str, layout: str, tmp_path: Path) -> None:
    path = write_machine(tmp_path / "nominal", MACHINES[machine](), LAYOUTS[layout])
    _check(load_mechanism(path), tmp_path)


@pytest.mark.parametrize("cut", ["far", "mid"])
@pytest.mark.parametrize("hung", ["base", "platform"])
@pytest.mark.parametrize(
    "machine", thinned(["2-RPR with a rod", "hexapod with a rod"], ["2-RPR with a rod"])
)
def test_rods_get_other_lengths_wherever_they_hang(
    machine: str, hung: str, cut: str, tmp_path: Path
) -> None:
    layout = Layout((LegLayout(hung=hung, cut=cut, seed=2),))
    path = write_machine(tmp_path / "nominal", MACHINES[machine](), layout)
    nominal = load_mechanism(path)
    true = _check(nominal, tmp_path)
    rods = [j for j, leg in enumerate(true.legs) if leg.kind is LegKind.CONSTANT]
    assert len(rods) == 1
    assert abs(true.q0[rods[0]] - nominal.q0[rods[0]]) > 1e-5


def test_a_leg_welded_to_the_platform_link_itself_moves_with_its_own_frame(tmp_path: Path) -> None:
    layout = Layout((LegLayout(sphere=False, seed=1), *[LegLayout(seed=k) for k in range(2, 7)]))
    path = write_machine(tmp_path / "nominal", MACHINES["6-UPS"](), layout)
    joints = load_mechanism(path).urdf.joints
    end, seat = (joints[f"leg1_{name}_frame"].T_parent_origin for name in ("end", "seat"))
    T = end * seat.inv()
    origin = " ".join(repr(float(x)) for x in T.translation)
    angles = " ".join(repr(float(x)) for x in roll_pitch_yaw(T.rotation.as_matrix()))
    urdf = path.with_suffix(".urdf")
    head, tail = urdf.read_text().split('<joint name="leg1_end_frame"')
    tail = re.sub("<origin [^>]*>", f'<origin xyz="{origin}" rpy="{angles}"/>', tail, count=1)
    urdf.write_text(f'{head}<joint name="leg1_end_frame"{tail}')
    path.write_text(path.read_text().replace("- leg1_seat", "- platform"))
    _check(load_mechanism(path), tmp_path)


def test_without_errors_the_urdf_is_the_nominal_one(tmp_path: Path) -> None:
    for name in ("hexapod", "3-upu-tilted", "tricept"):
        nominal = load_mechanism(name)
        true = write_true_model(nominal, ParameterErrors(), np.random.default_rng(0), tmp_path)
        assert true.urdf.content == nominal.urdf.content
        np.testing.assert_allclose(true.home.as_matrix(), nominal.home.as_matrix(), atol=1e-12)


def _differences(
    nominal: Machine, errors: ParameterErrors, n: int
) -> tuple[tuple[str, ...], Array]:
    """Return the names of all parameters and n draws of their errors, (n, n_parameters)."""
    found, legs = parametrization_of(nominal, twists=True), geometries(nominal)
    rng = np.random.default_rng(11)
    nothing = vector_of(found, legs, legs)
    rows = [vector_of(found, draw_errors(nominal, errors, rng), legs) for _ in range(n)]
    return found.names, np.array(rows) - nothing


def test_errors_have_the_size_and_distribution_that_was_asked_for() -> None:
    names, found = _differences(load_mechanism("3-upu-tilted"), ALL, N)
    sizes = {".base.": 3e-3, ".platform.": 1e-3, ".offset": 2e-3, "_axis.": 0.01, ".twist": 0.01}
    for i, name in enumerate(names):
        size = next(size for key, size in sizes.items() if key in name)
        column = found[:, i]
        is_normal = ".platform." in name
        sd = size if is_normal else size / np.sqrt(3.0)
        assert abs(column.mean()) < 4.0 * sd / np.sqrt(N)
        assert abs(column.std() / sd - 1.0) < 0.3
        assert (np.abs(column).max() > 1.8 * size) == is_normal
        assert is_normal or np.abs(column).max() < size * (1.0 + 1e-9)
    correlation = np.corrcoef(found.T) - np.eye(len(names))
    assert np.abs(correlation).max() < 0.45


def test_errors_of_one_kind_do_not_depend_on_those_of_another() -> None:
    nominal = load_mechanism("tricept")
    names, everything = _differences(nominal, ALL, 1)
    _, offsets = _differences(nominal, ParameterErrors(offsets=ALL.offsets), 1)
    of_offsets = np.array([name.endswith(".offset") for name in names])
    np.testing.assert_allclose(offsets[0, of_offsets], everything[0, of_offsets], atol=1e-15)
    assert np.abs(offsets[0, ~of_offsets]).max() < 1e-12


def test_coplanar_joints_stay_in_their_plane(tmp_path: Path) -> None:
    nominal = load_mechanism("hexapod")
    errors = ParameterErrors(Spread(2e-3), Spread(2e-3), coplanar=True)
    true = write_true_model(nominal, errors, np.random.default_rng(5), tmp_path)
    for joints in (true.parameters.base_joints, true.parameters.platform_joints):
        assert np.abs(joints[:, 2]).max() < 1e-15
        assert np.abs(joints - nominal.parameters.base_joints).max() > 1e-4


@pytest.mark.parametrize("size", [-1e-3, float("nan"), 2.0])
def test_sizes_that_are_none_are_refused(size: float, tmp_path: Path) -> None:
    errors = ParameterErrors(base_joints=Spread(1e-3), axes=Spread(size))
    with pytest.raises(UsageError, match="errors of axes could not be drawn: found a size of"):
        write_true_model(load_mechanism("3-upu"), errors, np.random.default_rng(0), tmp_path)


RADIUS = re.compile(rb'radius="[^"]*"')


@pytest.mark.parametrize("name", ["hexapod", "3-rpr", "tricept"])
def test_radii_of_the_true_legs_are_drawn_and_nothing_else_with_them(
    name: str, tmp_path: Path
) -> None:
    nominal = load_mechanism(name)
    of_radii = ParameterErrors(radii=Spread(1e-4))
    true = write_true_model(nominal, of_radii, np.random.default_rng(2), tmp_path)
    before, after = nominal.urdf.content, true.urdf.content
    assert RADIUS.sub(b"", before) == RADIUS.sub(b"", after)
    pairs = [
        (j, was.radius, now.radius)
        for j, (leg, true_leg) in enumerate(zip(nominal.legs, true.legs, strict=True))
        for was, now in zip(leg.cylinders, true_leg.cylinders, strict=True)
    ]
    errors = {(j, was): now - was for j, was, now in pairs}
    assert all(errors[j, was] == now - was for j, was, now in pairs)  # one tube stays one
    size = np.abs(list(errors.values()))
    assert 3e-5 < size.max() <= 1e-4
    assert len(set(errors.values())) == len(errors) >= nominal.n_legs
    both = replace(ALL, radii=Spread(1e-4))
    found = write_true_model(nominal, both, np.random.default_rng(2), tmp_path / "both")
    alone = write_true_model(nominal, ALL, np.random.default_rng(2), tmp_path / "alone")
    assert RADIUS.findall(found.urdf.content) == RADIUS.findall(after)
    assert np.array_equal(found.A_base, alone.A_base)


@pytest.mark.parametrize("spread", [Spread(8e-3), Spread(2e-3, Distribution.NORMAL)])
def test_errors_that_leave_nothing_of_a_leg_are_refused(spread: Spread, tmp_path: Path) -> None:
    errors = ParameterErrors(radii=spread)
    with pytest.raises(UsageError, match=r"errors of radii could not be drawn: .* needed at most"):
        write_true_model(load_mechanism("hexapod"), errors, np.random.default_rng(0), tmp_path)


def test_other_cylinders_keep_their_radii_and_their_places_in_the_file() -> None:
    content = b"""<robot name="a"><link name="x"><collision><geometry>
    <cylinder radius="1" length="1"/></geometry></collision><visual><geometry>
    <box size="1 1 1"/></geometry></visual><visual><geometry>
    <cylinder radius='2' length="1"/></geometry></visual><visual><geometry>
    <cylinder length="1" radius='3'/></geometry></visual></link></robot>"""
    for number, old in enumerate((b"'2'", b"'3'")):
        patch = UrdfPatch(content)
        patch.set_radius("x", number, 0.25)
        assert patch.content() == content.replace(old, b"'0.25'").replace(b"'", b'"')


def _five_parallel_rods(folder: Path) -> Path:
    """Write a platform that five equal and parallel rods keep upright: no others would."""
    A = ring([10, 80, 150, 220, 290, 330, 100, 190], 0.3)
    A[:, 2] = np.linspace(-0.03, 0.03, 8)
    home = RigidTransform.from_translation([0.05, 0.02, 0.5])
    B = np.vstack([A[:5] + home.translation, home.apply(ring([121.0, 218.0, 315.0], 0.15))])
    kinds = ["constant"] * 5 + ["actuated"] * 3
    legs = [LegSpec("US", a, b, kind) for a, b, kind in zip(A, B, kinds, strict=True)]
    return write_machine(folder, MachineSpec(tuple(legs), home), Layout())


def test_errors_that_leave_no_closed_machine_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nominal = load_mechanism(_five_parallel_rods(tmp_path / "nominal"))
    monkeypatch.setattr(truth, "MAX_DRAWS", 3)
    chance = np.random.default_rng(1)
    assert write_true_model(
        nominal, ParameterErrors(offsets=Spread(2e-3)), chance, tmp_path
    ).is_determined
    with pytest.raises(ModelError, match=r"found 3 times .*smaller errors"):
        write_true_model(nominal, ParameterErrors(lengths=Spread(2e-3)), chance, tmp_path)
    assert not list((tmp_path / "models").glob("*"))


def test_a_refusal_does_not_name_the_files_that_are_gone(tmp_path: Path) -> None:
    errors = ParameterErrors(Spread(1.0), Spread(1.0), Spread(1.0))
    with pytest.raises(ModelError, match=r"20 times a machine that .* in 20 draws") as caught:
        write_true_model(load_mechanism("hexapod"), errors, np.random.default_rng(0), tmp_path)
    assert str(tmp_path) not in str(caught.value)


def test_a_machine_without_enough_motors_gets_a_true_model_and_poses(tmp_path: Path) -> None:
    path = tmp_path / "models" / "tricept.yaml"
    path.parent.mkdir()
    document = yaml.safe_load((ROOT / "models" / "tricept.yaml").read_text())
    document["name_mot"] = document["name_mot"][1:]
    document["legcal"]["urdf"] = str(ROOT / "urdf" / "tricept.urdf")
    path.write_text(yaml.safe_dump(document))
    nominal = load_mechanism(path)
    assert not nominal.is_determined
    true = _check(nominal, tmp_path / "true")
    poses = draw_poses(true, 8, np.random.default_rng(0))
    assert np.ptp(poses.readings, axis=0).min() > 0.02


def test_meshes_beside_the_nominal_urdf_are_seen_on_the_true_machine(tmp_path: Path) -> None:
    mesh = '<visual><geometry><mesh filename="meshes/plate.stl"/></geometry></visual>'
    for kind, suffix in (("models", "yaml"), ("urdf", "urdf")):
        (tmp_path / kind).mkdir()
        text = (ROOT / kind / f"3-rps.{suffix}").read_text()
        text = text.replace('<link name="platform"/>', f'<link name="platform">{mesh}</link>')
        (tmp_path / kind / f"3-rps.{suffix}").write_text(text)
    (tmp_path / "urdf" / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.02)).export(tmp_path / "urdf" / "meshes" / "plate.stl")
    settings = SimulationSettings(level=Level.OUTLINES, poses=1, views=1)
    simulate(tmp_path / "models" / "3-rps.yaml", tmp_path / "seen", settings)
    assert (tmp_path / "seen" / "observations.csv").exists()
