"""Exports are read back, by the programs that they are for or by an evaluation of our own."""

import csv
import ctypes
import importlib.util
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml
from hexapod_example import Run
from layouts import Layout, write_machine
from machines import planar
from scipy.spatial.transform import RigidTransform, Rotation

import legcal
from legcal import (
    Machine,
    ParameterErrors,
    Spread,
    export,
    forward_kinematics,
    inverse_kinematics,
    load_mechanism,
)
from legcal.errors import OutOfClass, UsageError
from legcal.exports.formats import formats_of
from legcal.exports.subject import Subject, identifiers, load_subject
from legcal.geometry.types import Array
from legcal.machine.closing import COORDINATES, independent_coordinates
from legcal.machine.configurations import random_poses
from legcal.simulation.truth import write_true_model

NAMES = ("hexapod", "3-rps", "3-upu", "tricept", "3-rpr")
ACTUATED = ("delta", "servo-hexapod", "3-prs", "hexaglide", "linear-delta", "orthoglide")
OTHERS = ("hexapod-rod", "nategh-agheli")
KINEMATICS = (*NAMES, *OTHERS, *ACTUATED)
ERRORS = ParameterErrors(
    base_joints=Spread(2e-3),
    platform_joints=Spread(2e-3),
    offsets=Spread(1e-3),
    lengths=Spread(1e-3),
    axes=Spread(3e-3),
)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Subject]:
    """Give machines that are not what their nominal models say."""

    @cache
    def made(name: str) -> Subject:
        nominal = load_mechanism(name)
        folder = tmp_path_factory.mktemp("model")
        true = write_true_model(nominal, ERRORS, np.random.default_rng(7), folder)
        return Subject(true, name, nominal)

    return made


def written(subject: Subject, to: str, path: Path) -> Path:
    """Return the file of an export."""
    return export(subject, to, path).paths[0]


def poses_of(machine: Machine, count: int = 3) -> tuple[Array, list[RigidTransform]]:
    """Return readings of the motors, zero for other legs, and the poses there."""
    q, poses = random_poses(machine, count, np.random.default_rng(11))
    is_motor = np.isin(np.arange(machine.n_legs), machine.motors)
    return np.where(is_motor, q, 0.0), poses


def column_legs(machine: Machine) -> list[int]:
    """Return the leg of each column of readings: rods on one motor have one."""
    return sorted(set(machine.reads))


def far_away(machine: Machine) -> Array:
    """Return readings that no machine reaches."""
    columns = column_legs(machine)
    other_way = [machine.legs[j].actuator is not None and k % 2 for k, j in enumerate(columns)]
    return np.where(other_way, 5.0, -5.0) * machine.sign[columns]


def own_of(T: RigidTransform, names: Sequence[str]) -> Array:
    """Return a machine's own coordinates of a pose [m, rad]."""
    everything = [*T.translation, *T.rotation.as_euler("xyz")]
    return np.array([everything[COORDINATES.index(name)] for name in names])


# --- source code --------------------------------------------------------------------------------


def module_at(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("exported", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class InC:
    """The functions of an exported C file, compiled; where they return -1 a ValueError."""

    def __init__(self, subject: Subject, folder: Path) -> None:
        source = written(subject, "c", folder / "kinematics.c")
        library = folder / "kinematics.so"
        strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-shared", "-fPIC")
        subprocess.run(["gcc", *strict, source, "-o", library, "-lm"], check=True)
        self.library: Any = ctypes.CDLL(str(library))
        self.prefix = identifiers([subject.name])[0]
        self.machine, self.n_readings = subject.machine, len(column_legs(subject.machine))
        self.COORDINATES = tuple(COORDINATES[k] for k in independent_coordinates(subject.machine))

    def _call(self, name: str, given: Array, before: Array) -> Array:
        numbers, found = ctypes.c_double * len(given), ctypes.c_double * len(before)
        out = found(*before)  # poses are searched from there
        if getattr(self.library, f"{self.prefix}_{name}")(numbers(*given), out) != 0:
            assert name == "inverse_kinematics" or np.array_equal(out, before)
            raise ValueError("no pose was found, or these readings do not allow one")
        return np.array(out)

    def _pose(self, name: str, given: Array) -> Array:
        found = self._call(name, given, self.packed(self.machine.home.as_matrix()))
        return np.vstack([np.column_stack([found[:9].reshape(3, 3), found[9:]]), [0, 0, 0, 1]])

    @staticmethod
    def packed(T: Array) -> Array:
        return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])

    def inverse_kinematics(self, T: Array) -> Array:
        return self._call("inverse_kinematics", self.packed(T), np.zeros(self.n_readings))

    def forward_kinematics(self, q: Array) -> Array:
        return self._pose("forward_kinematics", q)

    def pose_at(self, x: Array) -> Array:
        return self._pose("pose_at", x)


GCC = (pytest.mark.system, pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc"))


@pytest.mark.parametrize(
    ("language", "name"),
    [("python", "delta"), *(pytest.param("c", name, marks=GCC) for name in KINEMATICS)],
)
def test_exported_kinematics_are_those_of_the_model(
    language: str, name: str, calibrated: Callable[[str], Subject], tmp_path: Path
) -> None:
    subject = calibrated(name)
    machine = subject.machine
    columns = column_legs(machine)
    found: Any
    if language == "c":
        found = InC(subject, tmp_path)
    else:
        found = module_at(written(subject, "python", tmp_path / "kinematics.py"))
        assert machine.leg_names == found.LEGS
        read = [machine.legs[j].prismatic for j in columns]
        assert [name or None for name in found.READINGS] == read
    for q, T in zip(*poses_of(machine), strict=True):
        pose = forward_kinematics(machine, q)
        np.testing.assert_allclose(pose.as_matrix(), T.as_matrix(), atol=1e-10)
        there = found.inverse_kinematics(T.as_matrix())
        np.testing.assert_allclose(there, inverse_kinematics(machine, T)[columns], atol=1e-10)
        np.testing.assert_allclose(found.forward_kinematics(q[columns]), T.as_matrix(), atol=1e-9)
        again = found.pose_at(own_of(T, found.COORDINATES))
        np.testing.assert_allclose(again, T.as_matrix(), atol=1e-9)
    off = machine.home.as_matrix()
    off[:3, :3] = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix() @ off[:3, :3]
    if machine.mobility < 6:
        with pytest.raises(ValueError, match="do not allow"):
            found.inverse_kinematics(off)
    off[0, 0] = np.nan
    with pytest.raises(ValueError, match="do not allow"):
        found.inverse_kinematics(off)
    for q in (np.full(len(columns), np.nan), far_away(machine)):
        with pytest.raises(ValueError, match=r"no pose was found|finite"):
            found.forward_kinematics(q)
    if machine.actuators:  # rods have an end
        with pytest.raises(ValueError, match=r"."):
            found.pose_at(own_of(machine.home, found.COORDINATES) + 10.0)


@pytest.mark.system
@pytest.mark.skipif(shutil.which("octave") is None, reason="no octave on the path")
@pytest.mark.parametrize("name", KINEMATICS)
def test_kinematics_for_matlab_run_in_octave_and_are_those_of_the_model(
    name: str, calibrated: Callable[[str], Subject], tmp_path: Path
) -> None:
    subject = calibrated(name)
    machine = subject.machine
    written(subject, "matlab", tmp_path / "kinematics.m")
    readings, poses = poses_of(machine)
    columns = column_legs(machine)
    own = tuple(COORDINATES[k] for k in independent_coordinates(machine))
    lines = ["m = kinematics();", "format long"]
    for q, T in zip(readings[:, columns], poses, strict=True):
        matrix = ";".join(" ".join(map(repr, row)) for row in T.as_matrix().tolist())
        lines += [
            f"q = [{' '.join(map(repr, q.tolist()))}];",
            f"x = [{' '.join(map(repr, own_of(T, own).tolist()))}];",
            f"printf('%.17g ', m.inverse_kinematics([{matrix}]), m.forward_kinematics(q));",
            "printf('%.17g ', m.pose_at(x));",
            "printf('\\n');",
        ]
    lines += [
        f"try, {call}; catch e, disp(e.message), end"
        for call in (
            f"m.forward_kinematics([{' '.join(map(str, far_away(machine)))}])",
            "q = m.home_readings; q(m.is_motor) = NaN; m.forward_kinematics(q)",
            "q(m.is_motor) = Inf; m.forward_kinematics(q)",
            "T = m.home; T(1, 1) = NaN; m.inverse_kinematics(T)",
        )
    ]
    (tmp_path / "check.m").write_text("\n".join(lines) + "\n")
    done = subprocess.run(
        ["octave", "--no-gui", "--quiet", "--norc", "check.m"],
        cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60,
    )  # fmt: skip
    *rows, refusal, not_a_number, infinite, no_pose = done.stdout.splitlines()
    assert "no pose was found" in refusal
    assert "finite number" in not_a_number
    assert "finite number" in infinite
    assert "do not allow" in no_pose
    for T, printed in zip(poses, rows, strict=True):
        numbers = np.array(printed.split(), dtype=float)
        q, *both = np.split(numbers, [len(columns), len(columns) + 16])
        np.testing.assert_allclose(q, inverse_kinematics(machine, T)[columns], atol=1e-10)
        for pose in both:
            np.testing.assert_allclose(pose.reshape(4, 4).T, T.as_matrix(), atol=1e-9)


# --- models of other programs -------------------------------------------------------------------


def test_a_urdf_with_its_loops_is_the_same_machine_without_a_yaml(
    calibrated: Callable[[str], Subject], tmp_path: Path
) -> None:
    machine = calibrated("3-upu").machine
    back = load_mechanism(written(calibrated("3-upu"), "urdf", tmp_path / "alone.urdf"))
    assert len(back.motors) == len(machine.motors)
    q, poses = poses_of(machine)
    order = [machine.motor_names.index(name) for name in back.motor_names]
    T = back.chain.pose(back.home_configuration, machine.base, machine.platform)
    for readings, pose in zip(q, poses, strict=True):
        there = readings[list(machine.motors)][order]
        found = forward_kinematics(back, back.at_readings(there))
        np.testing.assert_allclose(found.as_matrix(), pose.as_matrix(), atol=1e-9)
    assert np.isfinite(T.as_matrix()).all()


def closed_in_mujoco(model: Any, data: Any, machine: Machine, q: Array) -> RigidTransform:
    """Return the pose at readings by Newton's method on MuJoCo's own constraints."""
    motors = [model.joint(machine.legs[j].prismatic) for j in machine.motors]
    at, fixed = [int(m.qposadr[0]) for m in motors], [int(m.dofadr[0]) for m in motors]
    free = np.setdiff1d(np.arange(model.nv), fixed)
    first, last = data.qpos[at].copy(), q[list(machine.motors)]
    for part in np.linspace(0.1, 1.0, 10):
        data.qpos[at] = first + part * (last - first)
        for _ in range(20):
            mujoco.mj_forward(model, data)
            missed = data.efc_pos[: data.ne].copy()
            if np.abs(missed).max() < 1e-13:
                break
            J = data.efc_J.reshape(-1, model.nv)[: data.ne]
            step = np.zeros(model.nv)
            step[free] = -np.linalg.lstsq(J[:, free], missed, rcond=1e-9)[0]
            mujoco.mj_integratePos(model, data.qpos, step, 1.0)
    body = data.body(machine.platform)
    return RigidTransform.from_components(body.xpos, Rotation.from_matrix(body.xmat.reshape(3, 3)))


@pytest.mark.parametrize("name", ["3-rpr", "3-upu", "tricept", "delta"])
def test_mujoco_loads_the_mjcf_closed_and_has_the_same_forward_kinematics(
    name: str, calibrated: Callable[[str], Subject], tmp_path: Path
) -> None:
    machine = calibrated(name).machine
    path = written(calibrated(name), "mjcf", tmp_path / "machine.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ne == machine.chain.n_rows
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-11
    assert model.nu == len(machine.motors)
    for q, T in zip(*poses_of(machine), strict=True):
        mujoco.mj_resetData(model, data)
        found = closed_in_mujoco(model, data, machine, q)
        np.testing.assert_allclose(found.as_matrix(), T.as_matrix(), atol=1e-6)
    if machine.spatial:  # our reader has no planar joints of two slides and a hinge
        back = load_mechanism(path)
        assert sorted(leg.type for leg in back.legs) == sorted(leg.type for leg in machine.legs)
        np.testing.assert_allclose(back.A_base, machine.A_base, atol=1e-9)
        np.testing.assert_allclose(back.q0, machine.q0, atol=1e-9)


# --- controllers --------------------------------------------------------------------------------


def test_the_options_of_earlier_exports_name_what_stands_in_their_place() -> None:
    with pytest.raises(AttributeError, match=r"ExportOptions: legcal\.export takes nodes="):
        getattr(legcal, "ExportOptions")  # noqa: B009


def test_corrected_commands_bring_the_machine_where_it_should_be(
    calibrated: Callable[[str], Subject], tmp_path: Path
) -> None:
    subject = calibrated("3-rpr")
    machine, nominal = subject.machine, subject.nominal
    assert nominal is not None
    found = export(subject, "correction", tmp_path / "table.csv", nodes=3)
    own, figures = found.figures["coordinates"], found.figures
    assert len(own) == machine.mobility
    assert figures["nodes"] == 3**machine.mobility
    lines = (tmp_path / "table.csv").read_text().splitlines()
    said = [line for line in lines if line.startswith("#")]
    assert all(any(note in line for line in said) for note in found.notes)
    table = np.array([row.split(",") for row in lines[len(said) + 1 :]], dtype=float)
    assert lines[len(said)].split(",")[: len(own)] == [
        f"{name}_{'mm' if name in 'xyz' else 'deg'}" for name in own
    ]
    m, units = len(own), np.array([1e3 if name in "xyz" else np.degrees(1.0) for name in own])
    of_nominal = Subject(nominal, "nominal")
    kinematics: Any = module_at(written(of_nominal, "python", tmp_path / "kinematics.py"))
    for row in table[:: max(1, len(table) // 5)]:
        pose = RigidTransform.from_matrix(kinematics.pose_at(row[m:] / units))
        reached = forward_kinematics(machine, inverse_kinematics(nominal, pose))
        np.testing.assert_allclose(units * own_of(reached, own), row[:m], atol=1e-6)
    off = figures["residual"]["max_dX_m"], figures["uncorrected"]["max_dX_m"]
    assert 0.0 < off[0] < 0.1 * off[1]


# --- parameters ---------------------------------------------------------------------------------


def test_tables_have_the_numbers_of_the_result(example_run: Run, tmp_path: Path) -> None:
    result, subject = legcal.load_result(example_run.output), load_subject(example_run.output)
    machine, links = result.machine, (result.machine.base, result.machine.platform)
    text = written(subject, "csv", tmp_path / "a.csv").read_text()
    rows = list(csv.DictReader(text.splitlines()))
    in_links = {row["name"]: row for row in rows if row["frame"] in links}
    others = {row["name"]: row for row in rows if row["frame"] not in links}
    for one in result.document.parameters:
        found = others[one.name]
        scale = {"m": 1e3, "rad": np.degrees(1.0)}.get(one.unit, 1.0)
        assert float(found["value"]) == pytest.approx(scale * one.value, abs=1e-12)
        assert float(found["nominal"]) == pytest.approx(scale * one.nominal, abs=1e-12)
        assert (found["sigma"] == "") == (one.sigma is None)
    for j, leg in enumerate(machine.legs):
        for k, axis in enumerate("xyz"):
            found = in_links[f"{leg.name}.base.{axis}"]
            assert float(found["value"]) == pytest.approx(1e3 * machine.A_base[j, k], abs=1e-9)
            assert (found["sigma"] == "") == (found["status"] != "estimated")
    document = json.loads(written(subject, "json", tmp_path / "a.json").read_text())
    assert document["units"] == {"length": "mm", "angle": "deg"}
    points = [leg["A"]["link"] for leg in document["legs"]]
    np.testing.assert_allclose(points, 1e3 * machine.A_base, atol=1e-12)
    number = {row.name: row for row in result.document.parameters}
    leg4 = next(leg for leg in document["legs"] if leg["name"] == "leg4")
    C = 1e-6 * np.array(leg4["A"]["covariance"])
    R = machine.T_base_Rb.rotation.as_matrix()
    sigma = [number[f"leg4.base.{axis}"].sigma or 0.0 for axis in "xyz"]
    np.testing.assert_allclose(np.sqrt(np.diagonal(R.T @ C @ R)), sigma, rtol=1e-9)
    kinematic = result.document.kinematic
    assert document["covariance"]["names"] == kinematic.names
    np.testing.assert_allclose(
        document["covariance"]["matrix"], 1e6 * np.array(kinematic.covariance), rtol=1e-12
    )
    text = written(subject, "table", tmp_path / "a.txt").read_text()
    assert all(f"\n{row['name']}" in text for row in rows)


def test_the_folder_for_ros_has_model_and_covariance(example_run: Run, tmp_path: Path) -> None:
    found = export(example_run.output, "ros", tmp_path / "ros")
    document = yaml.safe_load((tmp_path / "ros/calibration.yaml").read_text())
    machine = load_mechanism(tmp_path / "ros" / document["urdf"])
    result = legcal.load_result(example_run.output)
    np.testing.assert_allclose(machine.A_base, result.machine.A_base, atol=1e-12)
    known = document["parameters"]
    np.testing.assert_array_equal(known["covariance"], result.document.kinematic.covariance)
    sigma = dict(zip(known["names"], known["sigma"], strict=True))
    assert sigma["leg4.base.x"] == next(
        row.sigma for row in result.document.parameters if row.name == "leg4.base.x"
    )
    assert sorted(path.name for path in found.paths) == ["calibration.yaml", "hexapod.urdf"]


# --- names and places; refusals are in refusal_table.py -----------------------------------------

HOSTILE = ("*/ exit(1); /*", '1 leg\'s "end"', "leg?", "leg!", "if", "für\u202e")


def test_hostile_names_end_no_string_and_no_comment(tmp_path: Path) -> None:
    machine = load_mechanism("hexapod")
    legs = tuple(replace(leg, name=name) for leg, name in zip(machine.legs, HOSTILE, strict=True))
    path = Path("'; exit(1); %{ */.yaml")
    subject = Subject(replace(machine, legs=legs, yaml_path=path), "hostile")
    found = module_at(written(subject, "python", tmp_path / "kinematics.py"))
    assert found.LEGS == HOSTILE
    for to, name in (("c", "a.c"), ("matlab", "a.m"), ("linuxcnc", "a.hal"), ("mjcf", "a.xml")):
        text = written(subject, to, tmp_path / name).read_text()
        outside = re.sub(r"""'([^']|'')*'|"(\\.|[^"\\])*"|#.*""", "", text)
        assert "exit" not in outside
    mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    if shutil.which("gcc"):
        subprocess.run(["gcc", "-fsyntax-only", tmp_path / "a.c"], check=True)


def test_machines_with_more_motors_than_freedoms_have_no_kinematics(tmp_path: Path) -> None:
    path = write_machine(tmp_path, planar(kinds=("actuated",) * 4), Layout())
    machine = load_mechanism(path)
    assert not {"python", "c", "matlab", "linuxcnc"} & set(formats_of(Subject(machine, "4-rpr")))
    with pytest.raises(OutOfClass, match="as many motors as freedoms"):
        export(path, "c", tmp_path / "out.c")


def test_an_existing_file_is_replaced_where_that_is_asked_for(tmp_path: Path) -> None:
    there, pipe = tmp_path / "there.txt", tmp_path / "pipe"
    there.write_text("mine")
    export("hexapod", "table", there, force=True)
    assert there.read_text().startswith("hexapod")
    os.mkfifo(pipe)
    with pytest.raises(UsageError, match="another file"):
        export("hexapod", "table", pipe, force=True)
