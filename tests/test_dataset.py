"""dataset.yaml: what it gives, and every way in which it is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from dataset_folder import HEXAPOD, ROOT, SIZE, Folder, folder, hexapod
from scipy.spatial.transform import RigidTransform

from legcal.data.dataset import load_dataset
from legcal.errors import DatasetError, ModelError
from legcal.machine import Machine

__all__ = ["folder"]


def refused(folder: Folder) -> str:
    folder.write()
    with pytest.raises(DatasetError) as refusal:
        load_dataset(folder.path)
    return str(refusal.value)


def test_example_is_read_as_it_is_written() -> None:
    dataset = load_dataset(ROOT / "examples" / "hexapod")
    measurements = dataset.measurements
    assert (measurements.n_rows, measurements.n_poses, len(measurements.views)) == (45, 45, 3)
    assert measurements.q.shape == (45, 6)
    assert measurements.q[0, 4] == 0.1331597
    assert measurements.sigma_q == 2e-6
    assert measurements.image[16] == "images/c2_k02.jpg"
    assert measurements.views[measurements.view[16]].name == "c2"
    T = measurements.views[0].T_base_camera
    assert T is not None
    np.testing.assert_allclose(T.translation, [-0.2253, -0.9482, 0.2459])
    assert dataset.notes == ()
    assert dataset.read_image(0).shape == (768, 1024)


def test_folder_and_its_file_give_the_same_dataset(folder: Folder) -> None:
    by_folder, by_file = load_dataset(folder.path), load_dataset(folder.path / "dataset.yaml")
    assert by_folder.folder == by_file.folder == folder.path
    np.testing.assert_array_equal(by_folder.measurements.q, by_file.measurements.q)


def test_dataset_in_the_current_folder_is_read(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.path)
    assert load_dataset(".").measurements.n_rows == 4
    assert load_dataset("dataset.yaml").measurements.n_rows == 4


def test_views_keep_their_camera_pose_and_legs(folder: Folder) -> None:
    c1, c2 = load_dataset(folder.path).measurements.views
    assert (c1.name, c1.legs, c2.name, c2.legs) == ("c1", None, "c2", ("leg1", "leg4"))
    assert (c1.camera.width, c1.camera.height) == SIZE
    assert isinstance(c1.T_base_camera, RigidTransform)
    assert c2.T_base_camera is None


def test_rounded_quaternion_is_made_unit(folder: Folder) -> None:
    folder.entry["views"]["c1"]["T_base_camera"]["quat_xyzw"] = [0.0, 0.0, 0.7071, 0.7071]
    folder.write()
    T = load_dataset(folder.path).measurements.views[0].T_base_camera
    assert T is not None
    np.testing.assert_allclose(T.rotation.as_quat(), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_view_names_are_text_whatever_yaml_thinks_of_them(folder: Folder) -> None:
    text = (folder.path / "dataset.yaml").read_text()
    (folder.path / "dataset.yaml").write_text(text.replace("c1:", "01:").replace("c2:", "on:"))
    table = (folder.path / "measurements.csv").read_text()
    table = table.replace("\nc1,", "\n01,").replace("\nc2,", "\non,")
    (folder.path / "measurements.csv").write_text(table)
    assert [v.name for v in load_dataset(folder.path).measurements.views] == ["01", "on"]


def test_view_without_rows_is_noted(folder: Folder) -> None:
    folder.entry["views"]["c9"] = {"camera": "camera_info.yaml"}
    folder.write()
    (note,) = load_dataset(folder.path).notes
    assert "view c9 has no row" in note


def test_mechanism_is_a_path_before_it_is_a_shipped_name(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Path] = []

    def load(path: Path) -> Machine:
        asked.append(path)
        return hexapod()

    monkeypatch.setattr("legcal.data.dataset.load_mechanism", load)
    monkeypatch.setattr("legcal.data.dataset.shipped_names", lambda: ["shipped"])
    for named in ("model", "shipped", "../elsewhere/model.yaml"):
        (folder.path / "model").touch()
        folder.entry["mechanism"] = named
        folder.write()
        load_dataset(folder.path)
    assert asked[0] == folder.path / "model"
    assert asked[1].name == "shipped.yaml"
    assert folder.path not in asked[1].parents
    assert asked[2] == folder.path / "../elsewhere/model.yaml"


def test_missing_mechanism_is_refused(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    folder.entry["mechanism"] = "models/none.yaml"
    folder.write()
    with pytest.raises(ModelError, match=r"none\.yaml: .* found no such file"):
        load_dataset(folder.path)


def test_mechanism_is_read_relative_to_the_dataset(
    folder: Folder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    (folder.path / "models").symlink_to(HEXAPOD.parent)
    (folder.path / "urdf").symlink_to(HEXAPOD.parents[1] / "urdf")
    folder.entry["mechanism"] = "models/hexapod.yaml"
    folder.write()
    assert load_dataset(folder.path).machine.leg_names == hexapod().leg_names


def test_missing_folder_and_file_are_refused(folder: Folder) -> None:
    with pytest.raises(DatasetError, match="found no such folder, needed a folder with a dataset"):
        load_dataset(folder.path / "none")
    with pytest.raises(DatasetError, match=r"found no dataset\.yaml in the folder"):
        load_dataset(folder.path / "images")
    with pytest.raises(DatasetError, match="found no such folder"):
        load_dataset(folder.path / "images" / "c1_1.png")


@pytest.mark.parametrize("version", [2, 0, "1.5", "one", True, None])
def test_other_versions_are_refused_alone(folder: Folder, version: object) -> None:
    folder.entry = {"legcal_dataset": version, "things": "of another time"}
    message = refused(folder)
    assert "needed version 1; use the legcal that wrote it" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"encoder_sigma": 0.0}, "encoder_sigma could not be read: found 0.0, needed a number gre"),
        ({"encoder_sigma": -1e-6}, "found -1e-06, needed a number greater than 0"),
        ({"encoder_sigma": float("nan")}, "found nan, needed a finite number"),
        ({"encoder_sigma": float("inf")}, "found inf, needed a finite number"),
        ({"encoder_sigma": "small"}, "found 'small', needed a number"),
        ({"views": {}}, "views could not be read: found {}, needed at least 1 entries"),
        ({"views": ["c1"]}, "views could not be read: found ['c1'], needed a mapping"),
        ({"mechanism": None}, "mechanism could not be read: found nothing, needed a text"),
        ({"measurement": "x"}, "found an unknown key; did you mean 'measurements'?"),
        ({"zzz": "x"}, "found an unknown key; known are: legcal_dataset, mechanism, measure"),
        ({"measurements": "/etc/passwd"}, "found an absolute path (/etc/passwd)"),
        ({"measurements": "../m.csv"}, "found a path that leads out of the dataset folder"),
        ({"measurements": "none.csv"}, "none.csv: the table of measurements could not be read"),
    ],
)
def test_wrong_values_are_refused(folder: Folder, change: dict[str, Any], message: str) -> None:
    folder.entry.update(change)
    assert message in refused(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": ...}, "views.c1.camera could not be read: found no such key, needed it"),
        ({"camera": "none.yaml"}, "none.yaml: the camera file could not be read: found no such"),
        ({"gamma": 0}, "views.c1.gamma could not be read: found 0, needed 0.2 or more"),
        ({"gamma": 100}, "views.c1.gamma could not be read: found 100, needed 5 or less"),
        ({"gamma": True}, "views.c1.gamma could not be read: found True, needed a number"),
        ({"T_base_camer": {}}, "found an unknown key; did you mean 'T_base_camera'?"),
        ({"T_base_camera": [1, 2, 3]}, "T_base_camera could not be read: found [1, 2, 3], needed"),
        (
            {"T_base_camera": {"xyz": [1, 2], "quat_xyzw": [0, 0, 0, 1]}},
            "views.c1.T_base_camera.xyz could not be read: found 2 numbers",
        ),
        (
            {"T_base_camera": {"xyz": [1, 2, 3], "quat_xyzw": [0, 0, 0, 0]}},
            "found a quaternion of norm 0, needed 1 within 0.001",
        ),
        (
            {"T_base_camera": {"xyz": [1, 2, 3], "quat_xyzw": [0, 0, 0, 1.002]}},
            "found a quaternion of norm 1.002, needed 1 within 0.001",
        ),
        (
            {"T_base_camera": {"xyz": [1, 2, float("nan")], "quat_xyzw": [0, 0, 0, 1]}},
            "T_base_camera.xyz.2 could not be read: found nan, needed a finite number",
        ),
        (
            {"T_base_camera": {"xyz": [1, 2, 3], "quat": [0, 0, 0, 1]}},
            "quat could not be used: found an unknown key; did you mean 'quat_xyzw'?",
        ),
        ({"legs": []}, "views.c1.legs could not be read: found [], needed at least 1 entries"),
        ({"legs": ["leg1", "leg1"]}, "found leg1 twice, needed each leg once"),
        ({"legs": ["leg1", "leg7"]}, "found the unknown leg 'leg7', needed legs of the mechanism"),
        ({"legs": "leg1"}, "views.c1.legs could not be read: found 'leg1', needed a list"),
    ],
)
def test_wrong_views_are_refused(folder: Folder, change: dict[str, Any], message: str) -> None:
    view = {**folder.entry["views"]["c1"], **change}
    folder.entry["views"]["c1"] = {k: v for k, v in view.items() if v is not ...}
    assert message in refused(folder)


def test_every_problem_of_the_file_is_listed_at_once(folder: Folder) -> None:
    folder.entry["encoder_sigma"] = -1
    folder.entry["views"]["c1"]["legs"] = []
    folder.entry["views"]["c2"] = {}
    del folder.entry["measurements"]
    assert len(refused(folder).splitlines()) == 4


def test_problems_of_cameras_and_legs_are_listed_at_once(folder: Folder) -> None:
    folder.entry["views"]["c1"]["camera"] = "none.yaml"
    folder.entry["views"]["c2"]["legs"] = ["leg9", "leg8"]
    assert len(refused(folder).splitlines()) == 3


def test_broken_yaml_is_refused_with_its_line(folder: Folder) -> None:
    (folder.path / "dataset.yaml").write_text("legcal_dataset: 1\nviews: {c1: [}\n")
    with pytest.raises(DatasetError, match=r"dataset.yaml, line 2, column \d+: the dataset file"):
        load_dataset(folder.path)


def test_repeated_view_is_refused(folder: Folder) -> None:
    text = yaml.safe_dump(folder.entry).replace("  c2:", "  c1:")
    (folder.path / "dataset.yaml").write_text(text)
    with pytest.raises(DatasetError, match="found the key 'c1' twice"):
        load_dataset(folder.path)
