"""legcal in an interactive session: short to look at; arrays, texts and figures to go on with."""

import contextlib
import dataclasses
import io
import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hexapod_example import ROOT, Run
from lxml import etree, html
from machines import created_hexapod
from scipy.spatial.transform import RigidTransform, Rotation
from simulated import simulated

import legcal
from legcal.errors import DatasetError, UsageError
from legcal.simulation.settings import Level


def test_everything_that_is_returned_is_short_to_look_at(example_run: Run) -> None:
    calibration = example_run.calibration
    shown = [
        calibration,
        calibration.dataset,
        calibration.dataset.machine,
        calibration.dataset.machine.legs[0],
        calibration.dataset.measurements,
        calibration.solution,
        calibration.solution.outlines,
        calibration.platform,
        calibration.steps,
        legcal.load_result(example_run.output),
        legcal.load_result(example_run.output).result,
        legcal.evaluate("hexapod", "hexapod"),
        legcal.identifiability(calibration.dataset.machine),
    ]
    for one in shown:
        for text in (repr(one), str(one)):
            assert 1 <= len(text.splitlines()) <= 10, type(one)
            assert len(text) < 1000, type(one)


def test_a_result_that_is_loaded_says_what_the_calibration_said(example_run: Run) -> None:
    calibration, loaded = example_run.calibration, legcal.load_result(example_run.output)
    assert loaded.summary() == calibration.summary()
    assert calibration.verdict.sentence in calibration.summary()
    assert "outlines of 45 images used" in repr(loaded)
    assert legcal.evaluate(loaded, example_run.output).displacement.max() == 0.0
    table = calibration.table()
    rows = {row["parameter"]: row for row in table}
    found = calibration.solution.estimates.values["leg2.offset"]
    assert rows["leg2.offset"]["calibrated"] == pytest.approx(1e3 * found, rel=1e-12)
    assert rows["leg2.offset"]["unit"] == "mm"
    assert table[-1] == list(table)[-1]
    assert len(table) == len(loaded.result.parameters)
    assert repr(table).count("\n") == len(table)


def test_a_figure_shows_the_sigma_of_every_parameter(example_run: Run) -> None:
    calibration = example_run.calibration
    figure = html.fromstring(calibration.plot_uncertainty())
    tips = [title.text or "" for title in figure.iter("title")]
    for row in calibration.result.parameters:
        if row.sigma and row.unit == "m":
            assert f"{row.name}, 1 sigma: {1e3 * row.sigma:.3g} mm" in tips


def test_a_machine_is_drawn_with_numbered_joints_and_hostile_names(tmp_path: Path) -> None:
    machine = legcal.load_mechanism("3-rps")
    hostile = dataclasses.replace(machine, name="<script>")
    figure = legcal.plot_machine(hostile)
    assert figure._repr_svg_() == figure
    figure.savefig(tmp_path / "machine.svg")
    with pytest.raises(UsageError, match=r"needed \.svg"):
        figure.savefig(tmp_path / "machine.png")
    drawn = etree.parse(tmp_path / "machine.svg").getroot()
    texts = [text.text for text in drawn.iter("{*}text")]
    assert "<script> at home" in texts
    for name in ("A1", "A2", "A3", "B1", "B2", "B3"):
        assert texts.count(name) == 2  # from above, and from the side
    discs = [disc for disc in drawn.iter("{*}circle") if disc.get("data-joint")]
    uv = np.array([[float(disc.get(k, "nan")) for k in ("cx", "cy")] for disc in discs[:3]])
    xy = machine.A_base[:, :2] * [1.0, -1.0]
    scale = np.linalg.norm(uv[1] - uv[0]) / np.linalg.norm(xy[1] - xy[0])
    np.testing.assert_allclose(uv - uv[0], scale * (xy - xy[0]), atol=0.11)  # rounded to 0.1
    flat = legcal.plot_machine(legcal.load_mechanism("3-rpr"))
    assert flat.count(">A1<") == 1  # a plane is seen from above


def test_notebooks_show_other_objects_as_tables_of_text() -> None:
    machine = dataclasses.replace(legcal.load_mechanism("3-rps"), name="<b>")
    html = machine._repr_html_()  # type: ignore[attr-defined]
    assert "&lt;b&gt;" in html
    assert "<b>" not in html


@pytest.mark.system
def test_the_examples_of_the_page_on_python_print_what_it_says(
    example_run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = (ROOT / "docs" / "python.md").read_text()
    (tmp_path / "calibrated").symlink_to(example_run.output)
    for machine in ("east", "west"):
        simulated(tmp_path / "machines" / machine, "3-rpr", level=Level.OUTLINES, poses=6)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    examples = re.findall(r"```python\n(.*?)```\n\n```text\n(.*?)```", page, re.DOTALL)
    assert len(examples) == page.count("```python")
    for code, expected in examples:
        if "__main__" in code:  # a program, whose processes import it
            (tmp_path / "program.py").write_text(code)
            assert subprocess.check_output([sys.executable, "program.py"], text=True) == expected
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(code, names)
        assert printed.getvalue() == expected


def test_poses_are_taken_as_programs_have_them() -> None:
    import pinocchio as pin

    machine = legcal.load_mechanism("hexapod")
    turned = machine.home * RigidTransform.from_rotation(Rotation.from_euler("z", 5, degrees=True))
    expected = legcal.inverse_kinematics(machine, turned)
    matrix = turned.as_matrix()
    for pose in (matrix, matrix.tolist(), pin.SE3(matrix)):
        np.testing.assert_allclose(legcal.inverse_kinematics(machine, pose), expected, atol=1e-12)
        there = legcal.forward_kinematics(machine, expected.tolist(), pose)
        np.testing.assert_allclose(there.as_matrix(), matrix, atol=1e-9)
        assert legcal.singularity(machine, pose) == pytest.approx(
            legcal.singularity(machine, turned), rel=1e-9
        )
        assert legcal.Follower(machine, pose).pose.translation == pytest.approx(matrix[:3, 3])
    for pose, problem in (
        (np.stack([matrix, matrix]), r"shape \(2, 4, 4\)"),
        ("home", "found a str"),
        (2.0 * matrix, "no rigid motion"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no rigid motion"),
        (np.full((4, 4), np.nan), "no rigid motion"),
        (RigidTransform.from_translation([0.0, 0.0, 400.0]), r"399\.6\d\d m from home"),
    ):
        with pytest.raises(UsageError, match=problem):
            legcal.inverse_kinematics(machine, pose)


def test_readings_are_taken_by_leg_or_by_motor_and_in_metres_and_radians() -> None:
    delta, hexapod = legcal.load_mechanism("delta"), legcal.load_mechanism("hexapod")
    lowered = RigidTransform.from_translation([0.0, 0.0, -0.01]) * delta.home
    q = legcal.inverse_kinematics(delta, lowered)
    of_motors = q[list(delta.motors)]
    assert len(of_motors) == len(delta.motor_names) == 3
    pose = legcal.forward_kinematics(delta, of_motors)
    np.testing.assert_allclose(pose.as_matrix(), lowered.as_matrix(), atol=1e-9)
    for machine, readings, problem in (
        (delta, np.degrees(of_motors), "probably in degrees"),
        (hexapod, [70.0] * 6, "probably in mm"),
        (delta, [0.1] * 4, "or \\(3,\\), one for each motor"),
        (hexapod, [0.07] * 3, "needed \\(6,\\), one for each leg;"),
        (hexapod, [np.nan] * 6, "^The pose could not be computed: found the reading nan"),
        (hexapod, {}, "found readings in a dict"),
        (hexapod, ["a"] * 6, "found readings in a list that are no array of numbers"),
        ("hexapod", [0.07] * 6, "found a str, needed a Machine"),
    ):
        with pytest.raises(UsageError, match=problem):
            legcal.forward_kinematics(machine, readings)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="found a str, needed a Machine"):
        legcal.inverse_kinematics("hexapod", hexapod.home)  # type: ignore[arg-type]


def test_arguments_of_other_types_are_named_and_what_works_is_not_refused(
    example_run: Run, tmp_path: Path
) -> None:
    machine, folder = legcal.load_mechanism("hexapod"), example_run.output
    public: Any = legcal  # without its types
    example = ROOT / "examples/hexapod"

    def made_with(**options: Any) -> object:
        sheet, into = public.SheetOptions(**options), tmp_path / "made"
        table = example / "measurements.csv"
        return public.init(example / "images", table, "hexapod", into, options=sheet)

    def shot_with(**looks: Any) -> object:
        looks = public.SimulationSettings("photographs", appearance=public.Appearance(**looks))
        return public.simulate("hexapod", tmp_path / "shot", looks)

    calls: list[tuple[Any, str]] = [
        (lambda: public.evaluate(3, machine), "found 3 (int) as model, needed a text or a path"),
        (lambda: public.evaluate(machine, folder, dataset=0), "found 0 (int) as dataset"),
        (lambda: public.plot_machine("hexapod"), "(str) as machine, needed Machine; load it"),
        (lambda: public.plot_machine(example_run.calibration), "Machine; give its .machine."),
        (lambda: public.plot_machine(legcal.load_result(folder)), "Machine; give its .machine."),
        (
            lambda: public.export(example_run.calibration, "csv", tmp_path / "x"),
            "give its .machine, or the folder that calibrate wrote.",
        ),
        (
            lambda: public.inverse_kinematics(example_run.calibration, None),
            "found a Calibration, needed a Machine; give its .machine.",
        ),
        (lambda: public.calibrate(example, holdout="a"), "as holdout, needed a number or None;"),
        (lambda: public.new(family="delta", rod_length="0.2"), "as rod_length, needed a number"),
        (lambda: public.Follower("hexapod"), "found a str, needed a Machine"),
        (lambda: public.random_configurations(machine, -1, 0), "found -1, needed 0 or more"),
        (lambda: made_with(board=3), "found 3 (int) as board of options, needed a text or a path"),
        (lambda: made_with(cameras=3), "as cameras of options, needed a text or a list;"),
        (lambda: shot_with(ambient="x"), "found 'x' (str) as ambient of appearance of settings"),
        (lambda: shot_with(lights=3), "found lights = 3, needed some of Light"),
        (lambda: shot_with(camera=3), "found camera = 3, needed industrial, "),
    ]
    for call, sentence in calls:
        with pytest.raises(UsageError) as refused:
            call()
        assert sentence in str(refused.value)
    with pytest.raises(DatasetError, match=r"^none\.yaml: "):
        made_with(cameras="none.yaml")
    with pytest.raises(TypeError, match="unexpected keyword argument 'hold_out'"):
        public.calibrate(folder, hold_out=0.2)
    size = {"base_radius": 300, "platform_radius": 150, "min_length": 345, "max_length": 489}
    made = public.new(family="hexapod", unit="mm", height=np.array(380.0), output=tmp_path, **size)
    assert made.machine.n_legs == 6
    with pytest.MonkeyPatch.context() as patch:
        own = Mock(side_effect=TypeError("an error of our own"))
        patch.setattr("legcal.descriptions.new_model.create_model", own)
        with pytest.raises(TypeError, match="an error of our own"):
            public.new(family="hexapod", unit="mm", height=380.0, output=tmp_path, **size)
    pose = np.asarray(machine.home.as_matrix(), dtype=np.float32).tolist()  # of no annotated type
    assert np.isfinite(legcal.inverse_kinematics(machine, pose)).all()
    assert pickle.loads(pickle.dumps(legcal.calibrate)) is legcal.calibrate


def test_a_calibration_has_the_machine_that_its_folder_holds(example_run: Run) -> None:
    here, there = example_run.calibration.machine, legcal.load_result(example_run.output).machine
    for one, other in zip(here.legs, there.legs, strict=True):
        np.testing.assert_array_equal([*one.A, *one.B, one.q0], [*other.A, *other.B, other.q0])
    moved = legcal.evaluate(here, example_run.calibration.dataset.machine)
    assert moved.displacement.mean() > 1e-4


def test_models_are_written_and_exported_without_the_command_line(
    example_run: Run, tmp_path: Path
) -> None:
    created = created_hexapod(tmp_path)
    assert isinstance(created.machine, legcal.Machine)
    assert created.yaml_path.is_file()
    with pytest.raises(UsageError, match="found the dimension 'radius', needed some of family"):
        legcal.new(output=tmp_path, family="hexapod", radius=1.0)
    loaded = legcal.load_result(example_run.output)
    sources: tuple[Any, ...] = (loaded, example_run.output, loaded.machine)
    for k, source in enumerate(sources):
        legcal.export(source, "json", tmp_path / f"{k}.json")
    texts = [(tmp_path / f"{k}.json").read_text() for k in range(2)]
    assert texts[0] == texts[1]
    assert loaded.table()[:2][1] == loaded.table()[1]
