"""Models written with other numbers: the same files but for these, loaded again and closed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from layouts import Layout, LegLayout, write_machine
from lxml import etree
from machines import MACHINES, SHIPPED_URDF, SHIPPED_YAML, of_types, written_with
from scipy.spatial.transform import RigidTransform

from legcal import (
    Machine,
    ParameterErrors,
    Spread,
    export,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
)
from legcal.errors import DidNotConverge, ModelError, OutOfClass, UsageError
from legcal.exports.subject import Subject
from legcal.geometry.types import Array
from legcal.machine.home import home_of_legs
from legcal.machine.leg import Leg
from legcal.machine.model_writer import check_closes, write_calibrated_yaml, write_urdf
from legcal.machine.parameters import (
    geometries,
    moved_legs,
    parametrization_of,
    reframed,
    vector_of,
)
from legcal.machine.urdf import UrdfPatch
from legcal.simulation.settings import Distribution
from legcal.simulation.truth import draw_errors, write_true_model

ORIGIN = re.compile(rb"""(<origin\b[^>]*?\bxyz\s*=\s*["'])([^"']*)(["'])""")
ORIGINS = re.compile(rb'(<origin xyz=")[^"]*(" rpy=")[^"]*(")')
RADIUS = re.compile(rb'radius="[^"]*"')


def other_legs(nominal: Machine, size: float) -> tuple[Leg, ...]:
    """Return legs whose every parameter is wrong by so much [m, and ten times that in rad]."""
    parametrization = parametrization_of(nominal, twists=True)
    sizes = {"m": size, "rad": 10.0 * size, "": size}
    unit = np.array([sizes[unit] for unit in parametrization.units])
    signs = np.random.default_rng(2).choice([-1.0, 1.0], len(unit))
    legs = moved_legs(geometries(nominal), parametrization.place, unit * signs)
    return reframed(legs, nominal.frame_legs, np.asarray(nominal.T_platform_Re.inv().translation))


def write(nominal: Machine, legs: tuple[Leg, ...], folder: Path) -> Machine:
    """Write a calibrated model and load it again."""
    home = home_of_legs(nominal, legs, 0.2)
    assert home is not None
    return written_with(nominal, legs, folder, home)


def apart(one: Leg, two: Leg) -> float:
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


# --- calibrated models --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["hexapod", "3-upu-tilted", "hexapod-rod", "tricept", "3-prs", "delta"],
)
def test_a_calibrated_model_has_the_numbers_that_were_wanted(name: str, tmp_path: Path) -> None:
    nominal = load_mechanism(name)
    legs = other_legs(nominal, 3e-3)
    written = write(nominal, legs, tmp_path)
    parametrization = parametrization_of(nominal, twists=True)
    here = vector_of(parametrization, geometries(written), legs)
    np.testing.assert_allclose(here, vector_of(parametrization, legs, legs), atol=1e-11)
    for frame in ("T_base_Rb", "T_platform_Re"):
        np.testing.assert_allclose(
            getattr(written, frame).as_matrix(), getattr(nominal, frame).as_matrix(), atol=1e-12
        )


@pytest.mark.parametrize("name", ["hexapod", "delta"])
def test_nominal_parameters_leave_every_byte(name: str, tmp_path: Path) -> None:
    nominal = load_mechanism(name)
    write_urdf(nominal, geometries(nominal), tmp_path / "same.urdf")
    assert (tmp_path / "same.urdf").read_bytes() == nominal.urdf_path.read_bytes()


def test_the_yaml_keeps_the_gains_of_motors(tmp_path: Path) -> None:
    """The URDF's joint then moves by the reading times the gain, as the equations say."""
    nominal, motor = load_mechanism("delta"), "arm2"
    parametrization = parametrization_of(nominal, twists=True)
    step = np.array([1e-3 * one.startswith(f"{motor}.gain") for one in parametrization.names])
    assert step.any()
    at_1001 = write(nominal, moved_legs(geometries(nominal), parametrization.place, step), tmp_path)
    assert [a.gain for a in at_1001.actuators] == [1.0, 1.001, 1.0]
    np.testing.assert_allclose(at_1001.A_base, nominal.A_base, atol=1e-12)
    q = inverse_kinematics(at_1001, at_1001.home) + 0.03  # of the motors, of rods in pairs
    T = forward_kinematics(at_1001, q)
    np.testing.assert_allclose(inverse_kinematics(at_1001, T), q, atol=1e-9)
    moved = q * np.where([leg.prismatic == motor for leg in nominal.legs], 1.001, 1.0)
    before = forward_kinematics(nominal, moved)
    np.testing.assert_allclose(T.as_matrix(), before.as_matrix(), atol=1e-9)
    half = write(
        at_1001, moved_legs(geometries(at_1001), parametrization.place, step), tmp_path / "more"
    )
    assert half.actuators[1].gain == pytest.approx(1.002)
    subject = Subject(at_1001, "calibrated")
    (note,) = export(subject, "urdf", tmp_path / "alone.urdf").notes
    assert f"'{motor}' 1.001" in note
    with pytest.raises(OutOfClass, match=r"found gains other than 1 .* MuJoCo"):
        export(subject, "mjcf", tmp_path / "alone.xml")
    text = (tmp_path / "calibrated.yaml").read_text()
    for old, new, named in (
        (f"{motor}:\n      gain", "arm9:\n      gain", "legcal.motors.arm9"),
        ("1.001", "100.0", "needed 2 or less"),
        ("gain: 1.001", "centre_us: 1500", "us_per_deg"),
    ):
        (tmp_path / "calibrated.yaml").write_text(text.replace(old, new))
        with pytest.raises(ModelError, match=named) as refusal:
            load_mechanism(tmp_path / "calibrated.yaml")
        assert "legcal.motors." in refusal.value.facts[0].name


def _canonical(content: bytes) -> bytes:
    """Return a file with other quotes and white space in tags, and without numbers of origins."""
    tree = etree.fromstring(content).getroottree()
    return ORIGIN.sub(rb"\1\3", etree.tostring(tree, method="c14n"))


def test_comments_quotes_white_space_unknown_tags_and_line_ends_survive(tmp_path: Path) -> None:
    path = write_machine(tmp_path / "nominal", of_types(["US"] * 6), Layout())
    urdf = path.with_suffix(".urdf")
    text = urdf.read_text()
    text = text.replace(
        '<robot name="machine">',
        "<!-- é <joint name='leg1_slider'><origin xyz='9 9 9'/></joint> -->\n"
        '<robot  name = "machine" >\n<gazebo reference="base"><joint name="leg1_a1">'
        '<origin xyz="8 8 8"/></joint></gazebo>\n<transmission name="t"><type>a &gt; b</type>'
        "</transmission>",
    )
    text = re.sub(
        r'(name="leg2_slider".*?)<origin xyz="([^"]*)" rpy="([^"]*)"/>',
        r"\1<origin\n\t rpy = '\3'\n\t xyz = '  \2 '  />",
        text,
    )
    text = re.sub(r'(name="leg3_a1" [^>]*>)(.*?)(<origin [^>]*/>)', r"\1\3\2", text)
    urdf.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    nominal = load_mechanism(path)
    legs = other_legs(nominal, 2e-3)
    written = write(nominal, legs, tmp_path)
    assert max(map(apart, legs, geometries(written))) < 1e-12
    before, after = urdf.read_bytes(), (tmp_path / "calibrated.urdf").read_bytes()
    assert after.count(b"\n") == after.count(b"\r\n")
    assert _canonical(before) == _canonical(after)
    for kept in (b"xyz='9 9 9'", b'xyz="8 8 8"', b"a &gt; b", "<!-- é".encode()):
        assert kept in after


def test_a_leg_that_is_welded_to_the_platform_by_another_leg_is_refused(tmp_path: Path) -> None:
    path = write_machine(tmp_path, of_types(["UU"] * 3), Layout())
    machine = load_mechanism(path)
    T = machine.chain.pose(machine.home_configuration, "leg2_end", "leg1_end")
    patch = UrdfPatch(path.with_suffix(".urdf").read_bytes())
    patch.add_frame("leg2_end", "other", "other", "other_joint", T)
    path.with_suffix(".urdf").write_bytes(patch.content())
    path.write_text(path.read_text().replace("- leg1_seat", "- other"))
    with pytest.raises(OutOfClass, match="leg 'leg1' is not supported: found several welds"):
        load_mechanism(path)


def test_legs_that_meet_in_one_frame_move_alone(tmp_path: Path) -> None:
    path = write_machine(tmp_path, MACHINES["6-UPS"](), Layout())
    urdf = path.with_suffix(".urdf")
    path.write_text(path.read_text().replace("- leg5_seat", "- leg4_seat"))
    urdf.write_text(
        "\n".join(line for line in urdf.read_text().splitlines() if "leg5_seat" not in line)
    )
    nominal = load_mechanism(path)
    first, second = nominal.legs[3:5]
    assert min(np.abs(first.A - second.A).max(), np.abs(first.B - second.B).max()) < 1e-12
    legs = other_legs(nominal, 3e-3)
    assert max(map(apart, geometries(write(nominal, legs, tmp_path)), legs)) < 1e-10


@pytest.mark.parametrize("line", ["  urdf: ../urdf/hexapod.urdf\n", ""])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_the_yaml_changes_in_one_value_only(tmp_path: Path, mark: str, line: str) -> None:
    for name in ("models", "urdf"):
        (tmp_path / name).mkdir()
    (tmp_path / "urdf" / "hexapod.urdf").write_bytes(SHIPPED_URDF.read_bytes())
    path, other = tmp_path / "models" / "hexapod.yaml", "rotor: {ünïcode: [1.5e-05, 3]}\r\n"
    shipped = SHIPPED_YAML.read_text().replace("  urdf: ../urdf/hexapod.urdf\n", line)
    path.write_bytes((mark + other + shipped).encode())
    write_calibrated_yaml(load_mechanism(path), tmp_path / "calibrated.yaml", "calibrated.urdf")
    before = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    before["legcal"]["urdf"] = "calibrated.urdf"
    assert yaml.safe_load((tmp_path / "calibrated.yaml").read_text()) == before


def test_a_machine_that_does_not_close_at_home_is_noticed() -> None:
    machine = load_mechanism("hexapod")
    check_closes(machine)
    mirror = RigidTransform.from_components(
        machine.home.translation * np.array([1.0, 1.0, -1.0]), machine.home.rotation
    )
    with pytest.raises(DidNotConverge, match="does not close at home"):
        check_closes(replace(machine, home=mirror))


# --- true machines of simulations ---------------------------------------------------------------

ALL = ParameterErrors(
    base_joints=Spread(3e-3),
    platform_joints=Spread(1e-3, Distribution.NORMAL),
    offsets=Spread(2e-3),
    lengths=Spread(2e-3),
    axes=Spread(0.01),
    twists=Spread(0.01),
)
N = 140  # draws of errors


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("hexapod-rod", None),
        ("3-upu-tilted", None),
        ("6-UPS", LegLayout(hung="platform", sphere=False, flip_axes=True)),
        ("Tricept", LegLayout(cut="mid", flip_slider=True, slid=0.02)),
    ],
)
def test_a_true_model_has_the_drawn_numbers_in_any_tree(
    name: str, layout: LegLayout | None, tmp_path: Path
) -> None:
    nominal = load_mechanism(
        write_machine(tmp_path / "nominal", MACHINES[name](), Layout((layout,))) if layout else name
    )
    true = write_true_model(nominal, ALL, np.random.default_rng(3), tmp_path)
    rng, found = np.random.default_rng(3), geometries(true)
    draws = (draw_errors(nominal, ALL, rng) for _ in range(20))
    drawn = next(legs for legs in draws if max(map(apart, legs, found)) < 1e-6)
    assert max(map(apart, drawn, geometries(nominal))) > 5e-4
    assert max(map(apart, drawn, found)) < 1e-12
    for frame in ("T_base_Rb", "T_platform_Re"):
        np.testing.assert_allclose(
            getattr(true, frame).as_matrix(), getattr(nominal, frame).as_matrix(), atol=1e-12
        )
    assert np.abs(true.chain.residual(true.home_configuration)).max() < 1e-11
    assert (true.mobility, true.spatial) == (nominal.mobility, nominal.spatial)
    assert [leg.type for leg in true.legs] == [leg.type for leg in nominal.legs]
    if layout is None:
        assert true.yaml_path == tmp_path / "models" / f"{name}.yaml"
        assert true.urdf_path.resolve() == tmp_path / "urdf" / f"{name}.urdf"
        before, after = nominal.urdf.content, true.urdf.content
        assert before != after
        assert ORIGINS.sub(rb"\1\2\3", before) == ORIGINS.sub(rb"\1\2\3", after)


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
    for name, column in zip(names, found.T, strict=True):
        size = next(size for key, size in sizes.items() if key in name)
        is_normal = ".platform." in name
        sd = size if is_normal else size / np.sqrt(3.0)
        assert abs(column.mean()) < 4.0 * sd / np.sqrt(N)
        assert abs(column.std() / sd - 1.0) < 0.3
        assert (np.abs(column).max() > 1.8 * size) == is_normal
        assert is_normal or np.abs(column).max() < size * (1.0 + 1e-9)
    correlation = np.corrcoef(found.T) - np.eye(len(names))
    assert np.abs(correlation).max() < 0.45


def test_errors_of_one_kind_do_not_depend_on_those_of_another(tmp_path: Path) -> None:
    nominal = load_mechanism("tricept")
    names, everything = _differences(nominal, ALL, 1)
    _, offsets = _differences(nominal, ParameterErrors(offsets=ALL.offsets), 1)
    of_offsets = np.array([name.endswith(".offset") for name in names])
    np.testing.assert_allclose(offsets[0, of_offsets], everything[0, of_offsets], atol=1e-15)
    assert np.abs(offsets[0, ~of_offsets]).max() < 1e-12
    hexapod = load_mechanism("hexapod")
    errors = ParameterErrors(Spread(2e-3), Spread(2e-3), coplanar=True)
    true = write_true_model(hexapod, errors, np.random.default_rng(5), tmp_path)
    legs = geometries(true)
    for joints in (np.array([leg.A for leg in legs]), np.array([leg.B for leg in legs])):
        assert np.abs(joints[:, 2]).max() < 1e-15
        assert np.abs(joints - [leg.A for leg in geometries(hexapod)]).max() > 1e-4


def test_radii_of_the_true_legs_are_drawn_and_nothing_else_with_them(tmp_path: Path) -> None:
    nominal = load_mechanism("tricept")
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
def test_errors_without_a_sensible_size_are_refused(spread: Spread, tmp_path: Path) -> None:
    errors, chance = ParameterErrors(radii=spread), np.random.default_rng(0)
    with pytest.raises(UsageError, match=r"errors of radii .* needed at most"):
        write_true_model(load_mechanism("hexapod"), errors, chance, tmp_path)
