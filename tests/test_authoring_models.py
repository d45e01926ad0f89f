"""Models written from tables: what is written is what was said, and it closes."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from authoring import ROOT, TABLES, check_same, described, made, write_table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry import roll_pitch_yaw
from legcal.machine import (
    LegKind,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
    singularity,
)
from legcal.machine.assembly import assemble
from legcal.machine.description_table import read_description
from legcal.machine.files import shipped_names
from legcal.machine.new_model import create_model, urdf_text, yaml_text

REAL = ROOT / "tests" / "data" / "nategh-agheli-real"
NUMBER = re.compile(r"(?<![\w.-])-?\d+\.\d+(?:e[-+]\d+)?")
EXPECTED = {
    "3-rpr": ("RPR RPR RPR", 3),
    "3-rps": ("RPS RPS RPS", 3),
    "3-spr": ("SPR SPR SPR", 3),
    "3-upu": ("UPU UPU UPU", 3),
    "3-upu-tilted": ("UPU UPU UPU", 3),
    "6-sps": ("SPS SPS SPS SPS SPS SPS", 6),
    "hexapod": ("SPU SPU SPU SPU SPU SPU", 6),
    "hexapod-rod": ("SPU SPU SPU SPU SPU SU", 5),
    "hexapod-strut": ("SPU SPU SPU SPU SPU SPU SPS", 6),
    "nategh-agheli": ("UPS UPS UPS UPS UPS UPS", 6),
    "tricept": ("SPS SPS SPS UP", 3),
}


def test_every_shipped_model_has_a_table_of_its_name() -> None:
    assert sorted(path.stem for path in TABLES) == shipped_names() == sorted(EXPECTED)


@pytest.mark.parametrize("table", [*TABLES, REAL / "table.yaml"], ids=lambda path: path.stem)
def test_shipped_models_are_what_their_tables_give_byte_for_byte(table: Path) -> None:
    description = assemble(read_description(table))
    top = REAL if table.parent == REAL else ROOT
    for path, text in (
        (top / "models" / f"{description.name}.yaml", yaml_text(description)),
        (top / "urdf" / f"{description.name}.urdf", urdf_text(description)),
    ):
        shipped = path.read_text()
        if shipped != text:  # another processor may round the last digit otherwise
            assert NUMBER.sub("#", shipped) == NUMBER.sub("#", text)
            written, made_now = ([float(x) for x in NUMBER.findall(t)] for t in (shipped, text))
            np.testing.assert_allclose(written, made_now, rtol=0, atol=1e-14)


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_shipped_models_are_as_told_and_far_from_singular(table: Path) -> None:
    machine = load_mechanism(table.stem)
    check_same(machine, read_description(table))
    types, mobility = EXPECTED[table.stem]
    assert " ".join(leg.type for leg in machine.legs) == types
    assert machine.mobility == mobility == len(machine.motors)
    assert machine.spatial is (table.stem != "3-rpr")
    assert singularity(machine, machine.home) > 0.05


def test_the_hexapod_is_the_machine_of_the_example() -> None:
    shipped = load_mechanism("hexapod")
    example = load_mechanism(ROOT / "examples" / "hexapod" / "models" / "hexapod.yaml")
    np.testing.assert_allclose(shipped.A_base, example.A_base, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shipped.B_platform, example.B_platform, rtol=0, atol=1e-12)
    np.testing.assert_allclose(shipped.q0, example.q0, rtol=0, atol=1e-12)
    assert [leg.prismatic for leg in shipped.legs] == [leg.prismatic for leg in example.legs]
    assert [leg.travel for leg in shipped.legs] == [leg.travel for leg in example.legs]
    assert set(shipped.urdf.joints) == set(example.urdf.joints)
    assert set(shipped.urdf.links) == set(example.urdf.links)


@pytest.mark.parametrize(("name", "turns"), [("3-upu", False), ("3-upu-tilted", True)])
def test_a_3upu_turns_only_where_its_axes_are_tilted(name: str, turns: bool) -> None:
    machine = load_mechanism(name)
    T = forward_kinematics(machine, np.array([0.03, 0.07, 0.12]))
    turned = float((machine.home.inv() * T).rotation.magnitude())
    assert (turned > 0.05) if turns else (turned < 1e-9)


def test_the_published_machine_tool_and_its_real_values_differ_by_millimetres() -> None:
    nominal = load_mechanism("nategh-agheli")
    real = load_mechanism(REAL / "models" / "nategh-agheli-real.yaml")
    np.testing.assert_allclose(nominal.A_base[0], [0.3054001, 0.1111565, 0.0], atol=1e-15)
    np.testing.assert_allclose(real.q0[1], 0.6072473, atol=1e-15)
    assert 1e-3 < np.abs(real.A_base - nominal.A_base).max() < 10e-3


def test_urdf_numbers_are_read_back_as_written_by_another_reader() -> None:
    yourdfpy = pytest.importorskip("yourdfpy")
    robot = yourdfpy.URDF.load(str(ROOT / "urdf" / "3-upu-tilted.urdf"), load_meshes=False)
    for j, B in enumerate(load_mechanism("3-upu-tilted").B_platform):
        seat = robot.get_transform(f"leg{j + 1}_seat", "platform")
        np.testing.assert_allclose(seat[:3, 3], B, atol=1e-15)


@given(st.tuples(*[st.floats(-4, 4)] * 2), st.sampled_from([0.0, np.pi / 2, -np.pi / 2, 1.0]))
def test_angles_of_a_rotation_are_exact_at_any_pitch(others: tuple[float, float], p: float) -> None:
    R = Rotation.from_euler("xyz", [others[0], p, others[1]]).as_matrix()
    again = Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix()
    np.testing.assert_allclose(again, R, atol=2e-15)


TYPES = (
    *("SPU", "UPS", "SPS", "UPU", "RPS", "SPR", "RPU", "UPR", "SU", "US", "SS", "RS", "SR", "UU"),
    "UP",
)


@st.composite
def random_tables(draw: st.DrawFn) -> dict[str, Any]:
    """Return a table of 3 to 7 legs of any types, with a home that suits them."""
    types = draw(st.lists(st.sampled_from(TYPES), min_size=3, max_size=7))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n = len(types)
    angles = 2.0 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n
    ring = np.stack([np.cos(angles), np.sin(angles), rng.uniform(-0.1, 0.1, n)], axis=-1)
    A = 300.0 * ring
    B = 150.0 * ring[:, [0, 1, 2]] + rng.uniform(-15.0, 15.0, (n, 3))
    T = RigidTransform.from_components(
        [*rng.uniform(-30.0, 30.0, 2), 450.0], Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3))
    )
    vectors = T.apply(B) - A
    lengths = np.linalg.norm(vectors, axis=1)
    has_slider = ["P" in kind for kind in types]
    passive = [p and rng.uniform() < 0.2 for p in has_slider]
    offsets = rng.uniform(250.0, 350.0, n)
    axes: dict[str, list[Any]] = {"base_axes": [], "platform_axes": []}
    for j, kind in enumerate(types):
        for key, letter in (("base_axes", kind[0]), ("platform_axes", kind[-1])):
            axis = rng.normal(size=3)
            if letter == "R" or rng.uniform() < 0.5:
                axis = np.cross(vectors[j], axis)
            if key == "platform_axes":
                axis = T.rotation.inv().apply(axis)
            wanted = letter in "RU" and rng.uniform() < 0.7
            along = abs(axis @ vectors[j]) / np.linalg.norm(axis) / lengths[j]
            axes[key].append(axis.tolist() if wanted and along < 0.8 else None)
    return {
        "name": "random",
        "type": None,
        "types": types,
        "base_joints": A.tolist(),
        "platform_joints": B.tolist(),
        "kinds": ["passive" if p else None for p in passive],
        "offsets": [
            float(o) if p and not f else None
            for o, p, f in zip(offsets, has_slider, passive, strict=True)
        ],
        "travel": [
            [float(f - 50.0), float(f + 60.0)] if p else None
            for f, p in zip(np.where(passive, lengths, lengths - offsets), has_slider, strict=True)
        ],
        "radius": [{"tube": 12, "rod": 7}] * n,
        "home": {
            "xyz": T.translation.tolist(),
            "quat_xyzw": T.rotation.as_quat().tolist(),
        },
        **axes,
    }


@settings(
    max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(random_tables())
def test_a_random_table_comes_back_from_its_files(tmp_path: Path, table: dict[str, Any]) -> None:
    description = described(tmp_path, **table)
    machine = create_model(description, tmp_path, force=True).machine
    check_same(machine, description)
    assert description.home is not None
    T = description.home.motion()
    np.testing.assert_allclose(machine.home.as_matrix(), T.as_matrix(), atol=1e-9)
    readings = inverse_kinematics(machine, machine.home)
    for leg, reading in zip(machine.legs, readings, strict=True):
        if leg.kind is not LegKind.CONSTANT:
            assert leg.travel[0] <= reading <= leg.travel[1]


def test_millimetres_and_metres_give_the_same_files(tmp_path: Path) -> None:
    base = [[300.4001, 0.1, 0], [-150.3, 260.7, 0], [-150.9, -260, 0]]
    in_mm = {"base_joints": base, "home": None}
    in_m = {
        "unit": "m",
        "base_joints": [[0.3004001, 0.0001, 0], [-0.1503, 0.2607, 0], [-0.1509, -0.26, 0]],
        "platform_joints": [[0.18, 0, 0], [-0.09, 0.156, 0], [-0.09, -0.156, 0]],
        "offsets": 0.38,
        "travel": [0, 0.15],
        "radius": {"tube": 0.014, "rod": 0.009},
        "home": None,
    }
    texts = []
    for changes in (in_mm, in_m):
        description = assemble(described(tmp_path, **changes))
        texts.append((yaml_text(description), urdf_text(description)))
    assert texts[0] == texts[1]


def test_a_home_that_is_not_given_has_the_legs_at_mid_travel(tmp_path: Path) -> None:
    machine = made(tmp_path, home=None)
    np.testing.assert_allclose(inverse_kinematics(machine, machine.home), 0.075, atol=1e-9)
    assert machine.home.translation[2] > 0.4
    assert machine.home.rotation.magnitude() < 1e-6


def test_a_home_with_few_digits_moves_onto_the_rods(tmp_path: Path) -> None:
    machine = made(
        tmp_path,
        type=None,
        types=["SPU", "SPU", "SS"],
        offsets=[380, 380, None],
        lengths=[None, None, 457],
    )
    assert machine.q0[2] == pytest.approx(0.457, abs=1e-12)
    vector = machine.home.apply(machine.B_platform[2]) - machine.A_base[2]
    assert np.linalg.norm(vector) == pytest.approx(0.457, abs=1e-12)


def test_a_rod_without_a_length_has_the_one_at_home(tmp_path: Path) -> None:
    machine = made(tmp_path, type=None, types=["SPU", "SPU", "SS"])
    assert machine.q0[2] == pytest.approx(np.hypot(0.44, np.hypot(0.06, 0.104)), abs=1e-12)
    assert [c.radius for c in machine.legs[2].cylinders] == [0.014]


@pytest.mark.parametrize("travel", [[None, [0, 150], [0, 150]], [0, 150]])
def test_a_passive_slider_reads_its_length_and_moves_freely(
    tmp_path: Path, travel: list[Any]
) -> None:
    machine = made(
        tmp_path,
        type="SPS",
        kinds=["passive", None, None],
        offsets=[None, 380, 380],
        travel=travel,
    )
    leg = machine.legs[0]
    length = float(np.linalg.norm(machine.home.apply(leg.B) - leg.A))
    assert (leg.kind, leg.q0) == (LegKind.PASSIVE, 0.0)
    np.testing.assert_allclose(leg.travel, [0.5 * length, 1.5 * length])


def test_a_machine_without_radii_shows_nothing(tmp_path: Path) -> None:
    assert all(leg.cylinders == () for leg in made(tmp_path, radius=None).legs)


def test_a_planar_machine_in_another_plane_floats(tmp_path: Path) -> None:
    def upright(rows: list[list[float]]) -> list[list[float]]:
        return [[x, z, y] for x, y, z in rows]

    base = upright([[400, 0, 0], [-200, 346, 0], [-200, -346, 0]])
    platform = upright([[140, 0, 0], [-70, 121, 0], [-70, -121, 0]])
    machine = made(
        tmp_path,
        type="3-RPR",
        base_joints=base,
        platform_joints=platform,
        base_axes=[[0, 1, 0]] * 3,
        platform_axes=[[0, 1, 0]] * 3,
        offsets=200,
        home={"xyz": [10, 0, 20], "rpy_deg": [0, 30, 0]},
    )
    assert not machine.spatial
    assert machine.urdf.joints["platform_free"].type == "floating"
    assert len(machine.frame_legs) == 2


def test_names_and_frames_of_the_table_are_kept(tmp_path: Path) -> None:
    machine = made(tmp_path, legs=["a", "b", "c"], base_frame=["c", "a", "b"], name="my.tripod")
    assert machine.leg_names == ("a", "b", "c")
    assert machine.frame_legs == (2, 0, 1)
    assert yaml.safe_load((tmp_path / "models" / "my.tripod.yaml").read_text())["name_mot"] == [
        "a_prismatic",
        "b_prismatic",
        "c_prismatic",
    ]


def test_a_csv_gives_the_same_files_as_the_yaml(tmp_path: Path) -> None:
    in_yaml = assemble(described(tmp_path, home=None))
    path = tmp_path / "tripod.csv"
    rows = ["type,base_x,base_y,platform_x,platform_y,offset,travel_low,travel_high,tube,rod,unit"]
    for (x, y, _), (bx, by, _) in zip(
        [[300, 0, 0], [-150, 260, 0], [-150, -260, 0]],
        [[180, 0, 0], [-90, 156, 0], [-90, -156, 0]],
        strict=True,
    ):
        rows.append(f"RPS,{x},{y},{bx},{by},380,0,150,14,9,mm")
    path.write_text("\n".join(rows))
    in_csv = assemble(read_description(path))
    assert urdf_text(in_csv) == urdf_text(in_yaml)
    assert yaml_text(in_csv) == yaml_text(in_yaml)
    assert write_table(tmp_path).exists()
