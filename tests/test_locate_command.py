"""``legcal locate``: the file that it writes, the frames in the URDF, options and exit codes."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import yaml
from located import BASE, TOOL, Located, located, motion_error, shipped, write_poses
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import Location, cli, load_location, load_mechanism, locate, write_location
from legcal.calibration.location.document import location_document
from legcal.calibration.location.urdf import with_frames, write_located_model
from legcal.errors import DatasetError, ModelError, UsageError
from legcal.machine import platform_pose


@pytest.fixture(scope="module")
def made() -> Located:
    return located("hexapod", 5)


@pytest.fixture(scope="module")
def found(made: Located) -> Location:
    return locate(made.machine, made.poses)


@pytest.fixture(scope="module")
def in_part() -> Location:
    planar = located("3-rpr", 6)
    return locate(planar.machine, replace(planar.poses, oriented=np.zeros(6, dtype=np.bool_)))


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["legcal", "locate", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert isinstance(stop.value.code, int)
    return stop.value.code


def test_the_command_writes_the_file_and_the_model(
    made: Located,
    found: Location,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_poses(tmp_path / "poses.csv", made)
    words: list[str | Path] = ["hexapod", tmp_path / "poses.csv", "-o", tmp_path / "a.yaml"]
    assert run(monkeypatch, *words, "--urdf", tmp_path / "out", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    written = document.pop("written")
    assert [Path(p).relative_to(tmp_path).as_posix() for p in written] == [
        "out/models/hexapod.yaml",
        "out/urdf/hexapod.urdf",
        "a.yaml",
    ]
    assert yaml.safe_load((tmp_path / "a.yaml").read_text()) == document
    np.testing.assert_allclose(document["T_world_base"]["xyz"], found.T_world_base.translation)
    assert run(monkeypatch, *words, "--position-sigma", "0.001mm") == 1
    shown = capsys.readouterr().out
    assert "Doubtful: positions scatter" in " ".join(shown.split())
    assert load_location(tmp_path / "a.yaml").status == "doubtful"


def test_a_table_is_shown(
    made: Located,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    position = made.poses.position.copy()
    position[4] += 0.05
    write_poses(tmp_path / "poses.csv", made, replace(made.poses, position=position))
    words: list[str | Path] = ["hexapod", tmp_path / "poses.csv", "-o", tmp_path / "a.yaml"]
    assert run(monkeypatch, *words, "--encoder-sigma", "1um", "--tool-position", "0,0,5mm") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Row 5 was left out: 8" in shown
    assert "Row 5 disagrees with the others and was left out." in shown
    assert "errors of the readings counted in" in shown
    assert "The given position of the tool was not needed" in shown
    assert "T_platform_tool yaw, z" in shown


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--tool-position", "1,2"], "--tool-position could not be used"),
        (["--tool-position", "1,2,3deg"], "needed three lengths"),
        (["--tool-position", "1,2,x"], "--tool-position could not be used: found 'x'"),
        (["--position-sigma", "0.02"], "needed a number and its unit"),
        (["--angle-sigma", "3mm"], "needed a number and its unit"),
        (["--world-link", "room"], "found them without --urdf"),
        (["-o", "none/a.yaml"], "found no folder none"),
    ],
)
def test_options_that_cannot_be_used_are_refused_and_nothing_is_written(
    made: Located,
    words: list[str],
    match: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_poses(tmp_path / "poses.csv", made)
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "hexapod", "poses.csv", "-o", "a.yaml", *words) == 2
    assert match in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]


def test_a_machine_whose_motors_do_not_determine_the_pose_is_refused(
    made: Located, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_poses(tmp_path / "poses.csv", made)
    loose = replace(made.machine, mobility=7)
    with pytest.raises(Exception, match="the pose cannot be computed from readings"):
        locate(loose, tmp_path / "poses.csv")


@pytest.mark.parametrize("which", ["found", "in_part"])
def test_a_location_comes_back_from_its_file(
    which: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    location: Location = request.getfixturevalue(which)
    write_location(location, str(tmp_path / "a.yaml"))
    again = load_location(tmp_path / "a.yaml")
    before, after = location_document(location), location_document(again)
    for frame in ("T_world_base", "T_platform_tool"):
        one, two = before.pop(frame), after.pop(frame)
        np.testing.assert_allclose(one.pop("quat_xyzw"), two.pop("quat_xyzw"), atol=1e-15)
        assert one == two
    assert before == after
    np.testing.assert_array_equal(again.covariance, location.covariance)
    assert again.rows == location.rows
    assert again.held == location.held


def test_files_that_are_no_location_are_kept_and_not_read(found: Location, tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("mine: 1\n")
    with pytest.raises(UsageError, match="found another file of that name"):
        write_location(found, path)
    assert path.read_text() == "mine: 1\n"
    with pytest.raises(DatasetError, match="found no key 'legcal_location'"):
        load_location(path)
    with pytest.raises(UsageError, match="found a folder"):
        write_location(found, tmp_path)


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("covariance", {"names": ["x"], "matrix": [[1.0]]}, "found another matrix"),
        ("status", "fine", "status could not be read: found 'fine'"),
        ("residuals", {}, "residuals.chi2 could not be read"),
        ("more", 1, "more could not be used: found an unknown key"),
    ],
)
def test_damaged_files_are_refused(
    found: Location, tmp_path: Path, key: str, value: object, match: str
) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(yaml.safe_dump(location_document(found) | {key: value}))
    with pytest.raises(DatasetError, match=match):
        load_location(path)


@pytest.mark.parametrize("name", ["hexapod", "3-rpr", "tricept"])
def test_the_written_urdf_is_the_same_machine_with_world_and_tool_in_it(
    name: str, found: Location, tmp_path: Path
) -> None:
    machine = shipped(name)
    there = replace(found, T_world_base=BASE, T_platform_tool=TOOL)
    yaml_path, urdf_path = write_located_model(machine, there, tmp_path)
    old, new = machine.urdf.content.decode(), urdf_path.read_text()
    lines = [line for line in new.splitlines(keepends=True) if line not in old.splitlines(True)]
    assert len(lines) == 4
    assert "".join(line for line in new.splitlines(keepends=True) if line not in lines) == old
    written = load_mechanism(yaml_path)
    np.testing.assert_allclose(written.A_base, machine.A_base, atol=1e-14)
    model = pin.buildModelFromUrdf(str(urdf_path))
    data = model.createData()
    configuration = written.home_configuration
    pin.framesForwardKinematics(model, data, configuration)
    tool, world = (data.oMf[model.getFrameId(link)] for link in ("tool", "world"))
    T = RigidTransform.from_matrix((world.inverse() * tool).homogeneous)
    expected = BASE * platform_pose(written, configuration) * TOOL
    assert np.abs(motion_error(T, expected)).max() < 1e-12


def test_frames_of_an_earlier_location_are_replaced(found: Location, tmp_path: Path) -> None:
    first, _ = write_located_model(shipped("hexapod"), found, tmp_path / "one")
    turned = replace(found, T_world_base=BASE * TOOL, T_platform_tool=TOOL.inv())
    _, again = write_located_model(load_mechanism(first), turned, tmp_path / "two")
    _, direct = write_located_model(shipped("hexapod"), turned, tmp_path / "three")
    assert again.read_text().count('<link name="world"/>') == 1
    one, two = (_origins(path.read_text()) for path in (again, direct))
    np.testing.assert_allclose(one, two, atol=1e-14)
    with pytest.raises(UsageError, match="already there"):
        write_located_model(shipped("hexapod"), found, tmp_path / "one")


def _origins(text: str) -> list[list[float]]:
    return [
        [float(x) for x in part.split('"')[0].split()]
        for line in text.splitlines()
        if "_frame" in line and ("world" in line or '"tool"' in line)
        for part in (line.split('xyz="')[1], line.split('rpy="')[1])
    ]


def _machine_with(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    text = shipped("hexapod").urdf.content.decode()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    for folder in ("models", "urdf"):
        (tmp_path / folder).mkdir()
    (tmp_path / "urdf/hexapod.urdf").write_bytes(text.encode())
    source = shipped("hexapod").yaml_path
    (tmp_path / "models/hexapod.yaml").write_bytes(source.read_bytes())
    return tmp_path / "models/hexapod.yaml"


def test_links_of_another_meaning_are_refused_and_other_names_taken(
    found: Location, tmp_path: Path
) -> None:
    fixed = '<joint name="{0}_j" type="fixed"><parent link="{1}"/><child link="{0}"/></joint>'
    extra = "".join(
        f'<link name="{link}"/>' + fixed.format(link, parent)
        for link, parent in (("world", "base"), ("tool", "base"))
    )
    model = _machine_with(tmp_path, ("</robot>", extra + "</robot>"))
    machine = load_mechanism(model)
    with pytest.raises(UsageError, match=r"found a link 'world' that is not a root.*--world-link"):
        with_frames(machine, found)
    with pytest.raises(
        UsageError, match=r"found a link 'tool' that is not at the end.*--tool-link"
    ):
        with_frames(machine, found, world="cell")
    content = with_frames(machine, found, world="cell", tool="tcp").decode()
    assert '<link name="cell"/>' in content
    assert content.index(extra) < content.index('<link name="cell"/>')
    for names in (("a b", "tool"), ("same", "same")):
        with pytest.raises(UsageError, match="frames could not be written"):
            with_frames(machine, found, world=names[0], tool=names[1])


def test_the_world_goes_above_a_root_that_carries_the_base(found: Location, tmp_path: Path) -> None:
    table = (
        '<link name="table"/><joint name="on_table" type="fixed"><parent link="table"/>'
        '<child link="base"/><origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint>\n</robot>'
    )
    machine = load_mechanism(_machine_with(tmp_path, ("</robot>", table)))
    yaml_path, _ = write_located_model(machine, found, tmp_path / "out")
    written = load_mechanism(yaml_path).urdf
    joint = written.joints["world_table_frame"]
    on_table = RigidTransform.from_components(
        [0.1, 0.2, 0.3], Rotation.from_euler("xyz", [0.4, 0.5, 0.6])
    )
    error = motion_error(joint.T_parent_origin * on_table, found.T_world_base)
    assert np.abs(error).max() < 1e-14


def test_a_base_on_a_moving_joint_is_refused(found: Location) -> None:
    machine = replace(shipped("hexapod"), base="platform")
    with pytest.raises(ModelError, match="below the joint 'platform_free', which moves"):
        with_frames(machine, found)


def test_the_tool_of_positions_alone_is_written_along_the_platform(in_part: Location) -> None:
    assert not in_part.has_tool_orientation
    content = with_frames(shipped("3-rpr"), in_part).decode()
    assert 'rpy="0.0 0.0 0.0"/></joint>\n</robot>' in content.replace("-0.0", "0.0")
