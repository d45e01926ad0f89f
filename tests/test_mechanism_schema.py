"""The mechanism YAML: what it may say, and what is wrong with it, all at once."""

from pathlib import Path

import numpy as np
import pytest
from mechanisms import ROOT, SHIPPED_URDF, SHIPPED_YAML

from legcal.errors import LegcalError, ModelError, OutOfClass
from legcal.machine import load_mechanism

SHIPPED = SHIPPED_YAML.read_text()


def _folder(top: Path, text: str) -> Path:
    """Write models/hexapod.yaml with a text, and the shipped URDF."""
    for name in ("models", "urdf"):
        (top / name).mkdir(parents=True)
    (top / "urdf" / "hexapod.urdf").write_bytes(SHIPPED_URDF.read_bytes())
    path = top / "models" / "hexapod.yaml"
    path.write_text(text)
    return path


def _problems(top: Path, text: str, error: type[LegcalError] = ModelError) -> tuple[str, ...]:
    path = _folder(top, text)
    with pytest.raises(error) as refusal:
        load_mechanism(path)
    assert type(refusal.value) is error
    assert all(str(path) in problem for problem in refusal.value.problems)
    assert not any("\n" in problem for problem in refusal.value.problems)
    return refusal.value.problems


def _with(old: str, new: str) -> str:
    assert old in SHIPPED
    return SHIPPED.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("- - leg1_end", "- - leg1_ned", "closed_loop.0.0 could not be used: found the frame"),
        ("- - leg1_end", "- - leg1_ned", "did you mean 'leg1_end'?"),
        ("  - leg1_seat", "  - leg1_end", "found 'leg1_end' twice"),
        ("  - leg1_seat\n", "  - leg1_seat\n  - base\n", "closed_loop.0"),
        ("- leg1_prismatic\n", "- leg9_prismatic\n", "name_mot.0 could not be used"),
        ("- leg1_prismatic\n", "- leg2_prismatic\n", "'leg2_prismatic' more than once"),
        ("- 3d\n", "", "found 6 pairs in closed_loop and 5 entries in type"),
        ("- 3d\n", "- 2d\n", "type.0 could not be used: found '2d', needed '3d'"),
        ("base: base\n", "base: bass\n", "legcal.base could not be used: found the link 'bass'"),
        ("platform: platform\n", "platform: plate\n", "legcal.platform could not be used"),
        ("platform: platform\n", "platform: base\n", "as base and as platform"),
        ("platform_free", "platform_fee", "legcal.platform_joint could not be used"),
        ("leg1: leg1_prismatic", "leg1: lost", "legcal.legs.leg1 could not be used"),
        ("  - leg1\n", "  - leg8\n", "legcal.base_frame could not be used: found 'leg8'"),
        ("  - leg1\n", "  - leg3\n", "found the leg 'leg3' more than once"),
        ("  - leg1\n", "  - leg1\n  - leg2\n", "legcal.base_frame"),
        ("0.38274", ".nan", "legcal.home.xyz.2"),
        ("version: 1", "version: true", "legcal.version could not be used: found true, needed 1"),
        ("0.38274", ".inf", "needed a finite number"),
        ("0.38274", "high", "needed a number"),
        ("0.951057", "0.7", "found a quaternion of norm 0.765"),
        ("  version: 1", "  version: 2", "legcal.version"),
        ("  version: 1\n", "", "legcal.version"),
        ("  base: base\n", "  bse: base\n", "did you mean 'base'?"),
        ("name_mot:", "name_motor:", "name_mot could not be read"),
        ("  urdf: ../urdf/hexapod.urdf", "  urdf: ../urdf/none.urdf", ""),
    ],
)
def test_a_file_that_contradicts_its_urdf_or_itself_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    if not message:
        with pytest.raises(ModelError, match=r"none\.urdf: the URDF could not be read"):
            load_mechanism(_folder(tmp_path, _with(old, new)))
        return
    assert any(message in problem for problem in _problems(tmp_path, _with(old, new)))


def test_all_problems_of_a_file_come_together(tmp_path: Path) -> None:
    text = SHIPPED.replace("- - leg1_end", "- - nowhere").replace("base: base\n", "base: bass\n")
    text = text.replace("leg5: leg5_prismatic", "leg5: lost")
    assert len(_problems(tmp_path, text)) == 3
    text = SHIPPED.replace("0.38274", ".nan").replace("version: 1", "version: 3")
    assert len(_problems(tmp_path / "schema", text)) == 2


def test_two_frame_legs_are_too_few_in_space(tmp_path: Path) -> None:
    text = _with("  - leg1\n", "")
    assert "found 2 legs, needed 3 for a mechanism in space" in _problems(tmp_path, text)[0]


def test_joints_that_stand_for_others_need_a_type_each(tmp_path: Path) -> None:
    text = _with("joint_name: []", "joint_name: [leg1_b1]")
    assert "1 names and 0 entries" in _problems(tmp_path / "unequal", text)[0]


def test_an_almost_unit_quaternion_is_normalised(tmp_path: Path) -> None:
    text = SHIPPED.replace("0.951057", "0.9515").replace("0.309017", "0.30903")
    machine = load_mechanism(_folder(tmp_path, text))
    assert np.linalg.norm(machine.home.rotation.as_quat()) == pytest.approx(1.0, abs=1e-15)


def test_yaml_is_read_safely(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    text = f"{SHIPPED}\nextra: !!python/object/apply:os.system ['touch {trace}']\n"
    assert "python/object/apply" in _problems(tmp_path, text)[0]
    assert not trace.exists()


@pytest.mark.parametrize("text", ["", "- 1\n", "a: [1\n", SHIPPED + "\nname_mot: []\n"])
def test_what_is_not_a_mechanism_file_is_refused(tmp_path: Path, text: str) -> None:
    assert _problems(tmp_path, text)


def test_keys_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    machine = load_mechanism(_folder(tmp_path, "robot_color: red\n" + SHIPPED))
    assert machine.mobility == 6


def test_the_urdf_is_found_beside_or_in_the_neighbour_folder(tmp_path: Path) -> None:
    text = _with("  urdf: ../urdf/hexapod.urdf\n", "")
    path = _folder(tmp_path, text)
    assert load_mechanism(path).urdf_path == tmp_path / "urdf" / "hexapod.urdf"
    (tmp_path / "urdf" / "hexapod.urdf").rename(tmp_path / "models" / "hexapod.urdf")
    assert load_mechanism(path).urdf_path == tmp_path / "models" / "hexapod.urdf"
    (tmp_path / "models" / "hexapod.urdf").unlink()
    with pytest.raises(ModelError, match=r"write its path in legcal\.urdf"):
        load_mechanism(path)


def test_a_urdf_alone_closes_no_loop(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_bytes(SHIPPED_URDF.read_bytes())
    with pytest.raises(OutOfClass, match=r"arm\.urdf: this is not a parallel mechanism"):
        load_mechanism(path)


def test_a_folder_of_the_same_name_does_not_hide_a_shipped_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hexapod").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_mechanism("hexapod").name == "hexapod"


def test_an_unknown_name_lists_the_shipped_models(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"or one of .*hexapod"):
        load_mechanism("octopod")
    with pytest.raises(ModelError, match="found a folder"):
        load_mechanism(tmp_path)


@pytest.mark.parametrize("name", ["hexapod.yaml", "hexapod.csv"])
def test_a_table_of_legs_is_no_model_and_says_how_to_make_one(name: str, tmp_path: Path) -> None:
    table = tmp_path / name
    table.write_text((ROOT / "models" / "tables" / "hexapod.yaml").read_text())
    with pytest.raises(ModelError, match=r"found a (table|CSV).*: legcal new .* -o DIR") as caught:
        load_mechanism(table)
    assert str(table) in str(caught.value)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("file", ["", "dataset.yaml"])
def test_a_dataset_is_no_model_and_says_what_takes_one(file: str, tmp_path: Path) -> None:
    (tmp_path / "dataset.yaml").write_text("model: hexapod\n")
    with pytest.raises(ModelError, match="found a dataset, needed a model") as caught:
        load_mechanism(tmp_path / file)
    assert f"legcal identify {tmp_path}," in str(caught.value)
    assert f"legcal calibrate {tmp_path} -o OUT" in str(caught.value)
