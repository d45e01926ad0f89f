"""What tables and families cannot say: every refusal, in one sentence each."""

from pathlib import Path
from typing import Any

import pytest
from authoring import described, made, write_table

from legcal.errors import LegcalError, ModelError, OutOfClass, OutOfResources, UsageError
from legcal.machine import new_model as create
from legcal.machine.assembly import assemble
from legcal.machine.description_table import read_description
from legcal.machine.family import Family, describe_family
from legcal.machine.family import described as asked
from legcal.machine.new_model import create_model

SPS = {"type": "SPS"}
ROD = {"type": None, "types": ["SPU", "SPU", "SS"]}
PLANAR = {"type": "3-RPR", "home": {"xyz": [0, 0, 440], "rpy_deg": [0, 0, 30]}}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": None}, r"unit could not be read: found no such key"),
        ({"unit": "cm"}, r"unit could not be read: found 'cm', needed 'm' or 'mm'"),
        ({"legcal_table": 2}, r"legcal_table could not be read: found 2, needed 1"),
        ({"legcal_table": True}, r"legcal_table could not be used: found true, needed 1"),
        ({"colour": "red"}, r"colour could not be used: found an unknown key"),
        ({"ofsets": 380}, r"ofsets could not be used: .* did you mean 'offsets'"),
        ({"name": "a/b"}, r"name could not be used: found 'a/b', needed letters, digits"),
        ({"type": None}, r"found neither of type and types, needed one"),
        ({"types": ["RPS"] * 3}, r"found both of type and types, needed one"),
        ({"type": "6-RPS"}, r"type 6-RPS could not be used: found 3 base_joints, needed 6"),
        ({"type": "3-PRS"}, r"found the leg type 'PRS', needed R, U or S at the base"),
        ({"type": "x-RPS"}, r"type could not be used: found 'x-RPS', needed a type such as 6-UPS"),
        ({"type": 3}, r"type could not be used: found 3, needed a type such as 6-UPS"),
        ({"type": "²-RPS"}, r"type could not be used: found '²-RPS', needed a type such as 6-UPS"),
        ({"type": "3-RPX"}, r"found the leg type 'RPX', needed R, U or S at the base"),
        ({"base_joints": [[1e300, 2, 3]] * 3}, r"row 1, needed three numbers below 1e\+09"),
        ({"base_joints": [[1, 2, 3]] * 33}, r"base_joints .* found 33 legs, needed 2 to 32; leave"),
        ({"name": "x" * 101}, r"name could not .* digit, at most 100 of them; rename it"),
        ({"lengths": 455}, r"lengths could not .* leg 'leg1', whose type is with P, needed it for"),
        (ROD | {"lengths": [None, 455, 455]}, r"lengths could not be used: .* for leg 'leg2'"),
        (ROD | {"offsets": [380, 380, 380]}, r"offsets could not .* 'leg3', whose type is without"),
        ({"home": {"xyz": [0, 0, 440], "quat_xyzw": [0, 0, 0, 0]}}, r"a quaternion of norm 0"),
        ({"home": {"xyz": [0, 0, 440], "quat_xyzw": [0, 0, 0, 2]}}, r"yaml: home.quat_xyzw"),
        ({"type": None, "types": ["RPS", "S", "RPS"]}, r"types.1 could not be used: found .* 'S'"),
        (
            {"base_joints": [[None, 2, 3]] * 3},
            r"base_joints .* found \[null, 2, 3\] in row",
        ),
        ({"type": None, "types": ["RPS"] * 2}, r"types could not be used: found 2 entries and 3"),
        ({"platform_joints": [[1, 2, 3]]}, r"platform_joints could not .* found 1 entries and 3"),
        ({"base_joints": [[1, 2, 3]]}, r"found 1 leg, needed 2 to 32; add rows"),
        ({"base_joints": [[1, 2, 3, 4]] * 3}, r"base_joints could not .* in row 1, needed three"),
        ({"base_joints": [[1, 2, "x"]] * 3}, r"base_joints could not .* in row 1, needed three"),
        ({"base_joints": 7}, r"base_joints could not be used: found 7 in row 1"),
        ({"offsets": "long"}, r"offsets could not be used: found 'long', needed a number below"),
        ({"offsets": [380, 380]}, r"offsets could not be used: found 2 entries and 3"),
        ({"offsets": None}, r"leg 'leg1' .* an actuated slider without an offset"),
        ({"travel": None}, r"leg 'leg1' .* an actuated slider without travel"),
        ({"travel": [150, 0]}, r"travel could not be used: found \[150, 0\], needed the lower"),
        ({"travel": 150}, r"travel could not be used: found 150, needed \[lowest, highest\]"),
        ({"travel": [[0, 1], [0, 1]]}, r"travel could not be used: found 2 entries and 3"),
        ({"radius": -4}, r"radius could not be used: found -4, needed a positive number"),
        ({"radius": {"pipe": 4}}, r"radius could not be used: found {'pipe': 4}, needed"),
        ({"kinds": "loose"}, r"kinds could not .* 'loose', needed actuated, passive, constant"),
        ({"kinds": "constant"}, r"leg 'leg1' .* the kind constant with a P in its type"),
        ({"base_axes": [[0, 0, 0]] * 3}, r"base_axes could not .* in row 1, needed a direction"),
        ({"base_axes": [[0, 1, 0]]}, r"base_axes could not be used: found 1 entries and 3"),
        ({"platform_axes": [[1, 0, 0]] * 3}, r"an axis for an S joint at the platform"),
        ({"type": "UP", "platform_axes": [[1, 0, 0]] * 3}, r"an axis for a leg that is fixed"),
        ({"home": {"xyz": [0, 0, 440]}}, r"home could not be used: needed its turn once"),
        ({"home": {"rpy_deg": [0, 0, 0]}}, r"home.xyz could not be read: found no such key"),
        ({"legs": ["a", "a", "b"]}, r"legs could not be used: found 'a' twice"),
        ({"legs": ["a", "b b", "c"]}, r"legs.1 could not be used: found 'b b', needed letters"),
        ({"base_frame": ["leg1", "leg9"]}, r"base_frame .* found 'leg9', which is not a leg; did"),
        ({"base_frame": ["leg1", "leg1", "leg2"]}, r"base_frame .* found a leg twice"),
        ({"base_joints": [[1, 2, 3]] * 3}, r"found all of one side in one point"),
        (
            {
                "base_joints": [[300, 0, 0], [300, 0, 0], [0, 300, 0]],
                "platform_joints": [[180, 0, 0], [180, 0, 0], [0, 180, 0]],
            },
            r"legs 'leg1' and 'leg2' could not be used: found both between the same two points",
        ),
    ],
)
def test_what_a_table_cannot_say(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        described(tmp_path, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "m"}, r"leg 'leg1' .* length of 380 m .* mm values where m are stated: check"),
        (
            {"offsets": 0.38, "travel": [0, 0.15]},
            r"leg 'leg1' .* length of 0.00038 m .* m values where mm are stated: check the unit",
        ),
        (
            SPS | {"unit": "m", "kinds": "passive", "offsets": None, "travel": None},
            r"the base joints could not be used: found them .* mm values where m are stated",
        ),
        ({"offsets": -380}, r"length of -0.38 m .* correct its joints, offset or travel"),
        ({"radius": 0.014}, r"leg 'leg1' .* a radius of 0.014 mm on a length of 4.* its unit"),
        ({"radius": {"rod": 1e4}}, r"a radius of 1e\+04 mm on a length"),
        (SPS | {"offsets": 100}, r"leg 'leg1' cannot close at home: .* needed 100 to 250 mm"),
        (
            {"base_axes": [[0, 1, 0.1], None, None]},
            r"the base axis of leg 'leg1' at .* deg to the leg instead of 90 deg, which an R",
        ),
        (
            {"offsets": 10, "travel": [0, 20], "home": None},
            r"no home was found: no pose has all motors at the middle",
        ),
        (
            {"type": "UPS", "base_axes": [[-120, 0, 440], None, None]},
            r"the base axis of leg 'leg1' .* found it along the leg at home .* needed it across",
        ),
        (
            SPS | {"base_joints": [[300, 0, 0], [0, 0, 0], [-300, 0, 0]]},
            r"found the joints of the base or of the platform all in one point or on one line",
        ),
        (ROD | {"lengths": [None, None, 600]}, r"leg 'leg3' 456\.\d+ mm long instead of 600 mm"),
        ({"base_frame": ["leg1", "leg2"]}, r"base_frame .* found leg1, leg2, needed 3 legs whose"),
        (PLANAR, r"axis of leg 'leg1' at .* deg to the leg instead of 90 deg"),
        (
            PLANAR | {"home": {"xyz": [0, 0, 0], "rpy_deg": [0, 10, 0]}, "offsets": 50},
            r"home could not be used",
        ),
        (SPS | {"home": {"xyz": [120, 0, 0], "rpy_deg": [0, 0, 0]}}, r"'leg1' .* length of 0 m"),
    ],
)
def test_what_does_not_fit_together(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        assemble(described(tmp_path, **changes))


def test_all_problems_of_a_table_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(ModelError) as caught:
        described(tmp_path, unit="inch", offsets="long", radius=0)
    assert len(caught.value.problems) == 3
    with pytest.raises(ModelError) as caught:
        described(tmp_path, offsets=None, travel=None)
    assert len(caught.value.problems) == 6


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        ("type,base_x\n", "mm", r"found a header and no row, needed one row for each leg"),
        ("type,base_x\nRPS,1\n", "mm", r"found no column 'base_y', needed it"),
        ("{h},bse_z\n{r},0\n", "mm", r"unknown column 'bse_z', .* did you mean 'base_z'"),
        ("{h},type\n{r},RPS\n", "mm", r"found the column 'type' 2 times, needed it once"),
        ("{h}\n{r},1\n", "mm", r"\(line 2\): the row could not be used: found 6 cells, needed 5"),
        (
            "{h}\nRPS,1,x,3,4\n",
            "mm",
            r"line 2\), column base_y: the leg could .* found 'x', needed a",
        ),
        ("{h}\n{r}\n", None, r"found no unit, needed m or mm; add a column 'unit', or give --unit"),
        ("{h},unit\n{r},mm\n{r},m\n", None, r"found m and mm, needed the same in all lines"),
        ("{h},unit\n{r},mm\n{r},mm\n", "m", r"found --unit m and 'mm' in the table"),
        ("{h}\n{r}\nRPS,,2,3,4\n", "mm", r"line 3\), column base_x: .* found an empty cell"),
        ("{h}\n{r}\n,1,2,3,4\n", "mm", r"types.1 could not be used: found the leg type nothing"),
        ("{h},travel_low\n{r},0\n{r},0\n", "mm", r"travel could not be used"),
        ("{h}\nRPS,nan,2,3,4\n{r}\n", "mm", r"line 2\), column base_x: .* found 'nan'"),
        ("type;base_x\nRPS;1\n", "mm", r"found ';' between columns, needed ','"),
        ("type\tbase_x\nRPS\t1\n", "mm", r"found .* between columns, needed ','"),
        (
            "{h},radius,rod\n{r},9,8\n",
            "mm",
            r"line 2\), columns radius, tube, rod: the radius could",
        ),
    ],
)
def test_what_a_csv_cannot_say(tmp_path: Path, text: str, unit: str | None, message: str) -> None:
    path = tmp_path / "machine.csv"
    header, row = "type,base_x,base_y,platform_x,platform_y", "RPS,1,2,3,4"
    path.write_text(text.format(h=header, r=row))
    with pytest.raises(ModelError, match=message):
        read_description(path, unit)


def test_a_csv_whose_file_name_is_no_name_asks_for_one(tmp_path: Path) -> None:
    path = tmp_path / "my machine (2).csv"
    path.write_text("type,base_x,base_y,platform_x,platform_y\n" + "SS,1,2,3,4\nSS,5,6,7,8\n")
    with pytest.raises(ModelError, match=r"found 'my machine \(2\)', needed letters.* --name NAME"):
        read_description(path, "mm")
    assert read_description(path, "mm", "mine").name == "mine"


def test_a_unit_may_be_told_beside_the_table(tmp_path: Path) -> None:
    machine = read_description(write_table(tmp_path, unit=None), unit="mm")
    assert machine.legs[0].offset == 0.38
    with pytest.raises(ModelError, match="found --unit m and 'mm' in the table"):
        read_description(write_table(tmp_path), unit="m")


def test_tables_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="found no such file"):
        read_description(tmp_path / "none.yaml")
    with pytest.raises(ModelError, match="found no such file"):
        read_description(tmp_path / "none.csv")
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ModelError, match="needed 'key: value' lines"):
        read_description(tmp_path / "list.yaml")


GOOD = Family("6-UPS", "mm", 300.0, 150.0, 400.0)


@pytest.mark.parametrize(
    ("family", "message"),
    [
        (Family("6-UPS"), r"found no --base-radius and no --platform-radius and no --height and"),
        (Family("hexapod"), r"found 'hexapod', needed a number of legs from 2 to 32 and"),
        (Family("1-UPS"), r"found '1-UPS', needed a number of legs from 2"),
        (Family("3-PRS"), r"found '3-PRS', needed a number of legs"),
        (Family("6-UPS", "inch", 3.0, 2.0, 4.0), r"found the unit 'inch', needed m or mm"),
        (Family("6-UPS", "mm", -3.0, 2.0, 4.0), r"found --base-radius -3, needed a positive"),
        (Family("6-UPS", "mm", 300.0, float("nan"), 4.0), r"--platform-radius nan, needed a pos"),
        (Family("3-RPR", "mm", 300.0, 150.0, 4.0), r"found --height for a planar machine"),
        (Family("3-RPR", "mm", 300.0, 150.0, tilt=4.0), r"found --tilt for axes that cannot tilt"),
        (Family("6-SPS", "mm", 3.0, 2.0, 4.0, tilt=4.0), r"found --tilt for axes that cannot"),
        (Family("3-RPS", "mm", 3.0, 2.0, 4.0, 30.0), r"found --base-spread for 3 legs, needed"),
        (Family("6-SS", "mm", 3.0, 2.0, 4.0, offset=3.0), r"found --offset for legs without P"),
        (Family("6-UPS", "mm", 300.0, 150.0, 4.0, 0.0), r"found --base-spread 0 deg, needed an"),
        (Family("6-UPS", "mm", 3.0, 2.0, 4.0, tilt=90.0), r"found --tilt 90 deg, needed at most"),
        (Family("6-UPS", "mm", 3.0, 2.0, 4.0, turn=200.0), r"found --turn 200 deg, needed at"),
        (Family("6-UPS", "mm", 3.0, 2.0, 4.0, travel=(2.0, 1.0)), r"found --travel 2 1, needed"),
        (Family("6-UPS", "mm", 3.0, 2.0, 4.0, offset=1e12), r"found --offset 1e\+12, needed"),
        (Family("6-UPS", "mm", 3.0, 2.0, 4.0, name="../up"), r"the name could not .* '../up'"),
    ],
)
def test_what_a_family_cannot_be(family: Family, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        describe_family(family)


def test_millimetres_where_metres_are_stated_are_asked_about_in_families_too() -> None:
    with pytest.raises(ModelError, match="mm values where m are stated"):
        assemble(describe_family(Family("6-UPS", "m", 300.0, 150.0, 400.0)))


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"table": None, "family": None}, r"found neither of a table and --family"),
        ({"table": Path("t.yaml"), "family": "6-UPS"}, r"found both of a table and --family"),
        ({"table": Path("t.yaml"), "unit": "inch"}, r"found 'inch', needed mm or m"),
        (
            {"table": Path("t.yaml"), "dimensions": {"base_radius": 3.0, "tilt": 0.0}},
            r"found --base-radius, --tilt beside a table",
        ),
    ],
)
def test_a_request_is_for_one_thing(request_: dict[str, Any], message: str) -> None:
    asked_for: dict[str, Any] = {"family": None, "unit": None, "name": None, "dimensions": {}}
    with pytest.raises(UsageError, match=message):
        asked(**(asked_for | request_))


def test_files_that_are_there_stay_without_force(tmp_path: Path) -> None:
    made(tmp_path)
    written = tmp_path / "models" / "tripod.yaml"
    before = written.read_bytes()
    with pytest.raises(UsageError, match=r"found .*tripod.yaml and .*tripod.urdf already there"):
        made(tmp_path, offsets=385)
    assert written.read_bytes() == before
    create_model(described(tmp_path, offsets=385), tmp_path, force=True)
    assert 'xyz="0.0 0.0 0.385"' in (tmp_path / "urdf" / "tripod.urdf").read_text()


def test_a_folder_in_the_place_of_a_file_is_refused_before_anything_is_written(
    tmp_path: Path,
) -> None:
    (tmp_path / "models" / "tripod.yaml").mkdir(parents=True)
    machine = described(tmp_path)
    with pytest.raises(UsageError, match=r"found the folder .*tripod.yaml, needed a place for a"):
        create_model(machine, tmp_path, force=True)
    assert not (tmp_path / "urdf").exists()


def test_a_model_that_does_not_load_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise OutOfClass(f"{path}: this machine is outside the method.")

    machine = read_description(write_table(tmp_path))
    monkeypatch.setattr(create, "load_mechanism", refuse)
    with pytest.raises(LegcalError, match=r"table.yaml: models/tripod.yaml: this machine"):
        create_model(machine, tmp_path / "new" / "folder")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.yaml"]


def test_a_folder_that_takes_nothing_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutOfResources, match="the model could not be written"):
        create_model(described(tmp_path), tmp_path / "file" / "folder")
