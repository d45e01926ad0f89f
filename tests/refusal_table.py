"""What must be refused: the input, the command, and what the message must name.

Sentences may be put better; exit codes, kinds of errors and numbers of problems are recorded,
and the leg, view, image, file, joint, key or number that is wrong has to be named. Nothing may
be left behind.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from clicked_joints import camera_beside, seen_from, write_clicks
from command_line import run, words_of
from dataset_folder import JOINTS, SERVOS, dataset_of_readings
from edits import (
    GONE,
    Edit,
    cell,
    cut,
    doubled,
    each_row,
    header,
    kept,
    keyed,
    picture,
    remove,
    swap,
    text,
)
from machines import TRIPOD
from made_inputs import ROOT, copy_of
from outside_machines import OUTSIDE

CORNER_COLUMNS = "view,image,corner,u,v,sigma,verdict,reason,source"


@dataclass(frozen=True)
class Refusal:
    """A command that must fail.

    Parameters
    ----------
    name : str
        Unique, of the case.
    command : str
        The words after ``legcal``; ``{in}`` is a spoiled copy of the input, ``{out}`` a new place.
    named : tuple of str
        What the message has to contain.
    input : str
        The input; an empty folder without it.
    edits : tuple of callables
        What spoils it.
    """

    name: str
    command: str
    named: tuple[str, ...]
    input: str = ""
    edits: tuple[Edit, ...] = ()

    def observe(self, folder: Path) -> dict[str, Any]:
        """Return how the command ends, what is said, and the files that have changed."""
        spoiled = folder / "in"
        if self.input:
            copy_of(self.input, spoiled)
        else:
            spoiled.mkdir()
        for edit in self.edits:
            edit(spoiled)
        before = _files(folder)
        places: dict[str, Path | str] = {"in": spoiled, "out": folder / "out", "here": folder}
        outcome = run(*words_of(self.command, places), "--json", inside=folder)
        assert outcome.code != 0, f"{self.name} was not refused: {outcome.out[:200]}"
        after = _files(folder)
        error = outcome.document["error"]
        return {
            "exit": outcome.code,
            "kind": error["kind"],
            "message": error["message"],
            "problems": len(error["message"].splitlines()),
            "changed": sorted(k for k in before | after if before.get(k) != after.get(k)),
        }


def _files(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): (
            sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        )
        for path in folder.rglob("*")
    }


# --- the table ----------------------------------------------------------------------------------

Part = str | Edit  # words of the command, or what spoils the input
Rows = Iterable[tuple[str, Part | tuple[Part, ...], tuple[str, ...]]]
CALIBRATE = "calibrate {in} -o {out}"
entry = partial(keyed, "dataset.yaml")


def _cases(group: str, command: str, rows: Rows, given: str = "") -> Iterable[Refusal]:
    """Return cases by rows of a name, words (where {words} is, or at the end), edits, and needs."""
    for name, what, named in rows:
        parts = what if isinstance(what, tuple) else (what,)
        words = " ".join(part for part in parts if isinstance(part, str))
        edits = tuple(part for part in parts if not isinstance(part, str))
        line = command.replace("{words}", words) if "{words}" in command else f"{command} {words}"
        yield Refusal(f"{group}-{name}", line, named, given, edits)


def _use() -> Iterable[Refusal]:
    rows: Rows = [
        ("unknown-command", "frobnicate", ("frobnicate",)),
        ("no-dataset", "calibrate nowhere -o {out}", ("nowhere",)),
        ("no-output", "calibrate nowhere", ("--output",)),
        ("no-reference", "evaluate hexapod nowhere.urdf", ("nowhere.urdf",)),
        ("unknown-model", "inspect octopod", ("octopod", "hexapod", "tricept")),
        ("folder", "inspect {in}", ("{in}", "robot.yaml")),
        ("empty-value", "simulate hexapod -o {out} --poses=", ("--poses",)),
        ("option", "doctor x --nonsense", ("--nonsense", "legcal doctor --help lists")),
        ("fix", "calibrate x --fix leg1.offset", ("--fix of", "--set NAME=VALUE")),
        ("locate-urdf", "locate hexapod p.csv -o f --urdf d", ("--urdf of", "fixed joints")),
        ("no-workers", "detect x -o y --workers 0", ("found 0, needed 1 to 256 processes",)),
        ("two-datasets", "calibrate a b -o out", ("Expected one dataset", "docs/python.md")),
    ]
    yield from _cases("use", "", rows)
    existing = [text("thesis.tex", "years of work")]
    for name, command in {
        "calibrate": "calibrate {in} -o {in}",
        "simulate": "simulate 3-rpr -o {in} --level outlines --poses 1",
        "detect": "detect {in} -o {in}",
        "example": "example -o {in}",
    }.items():
        given = "plain" if name in {"calibrate", "detect"} else ""
        named = ("{in}",) if name != "calibrate" else ()
        yield Refusal(f"taken-{name}", command, named, given, tuple(existing))


def _options() -> Iterable[Refusal]:
    identify: Rows = [
        ("leg", "--view leg1,lge2", ("1", "'lge2'", "'leg2'")),
        ("no-leg", "--view ,", ("1",)),
        ("empty", "--view leg1,,leg2", ("1", "''")),
        ("twice", "--view leg1,leg1", ("'leg1'", "2")),
        ("images", "--images 0", ("0",)),
        ("many-images", "--images 2001", ("2001", "2000")),
        ("many-views", "--view leg1 " * 51, ("51", "50")),
        ("hand-held", "--view leg1,leg2,leg3 --hand-held", ("--board",)),
    ]
    yield from _cases("identify", "identify hexapod", identify)
    yield from _cases(
        "identify", "identify", [("dataset-view", "{in} --view leg1", ("--view",))], "plain"
    )
    drawn: Rows = [("radius", "--leg-radius 9", ("every leg has a cylinder", "hexapod.urdf"))]
    yield from _cases("inspect", "inspect {in}/models/hexapod.yaml", drawn, "model")
    checks: Rows = [
        ("output", "--check {in}/result -o {in}/result", ("{in}/result", "another folder")),
        ("holdout", "--check {in}/result --holdout 0.2 --set '*.offset'", ("--set", "--holdout")),
    ]
    yield from _cases("check", "calibrate {in}/set", checks, "result")

    simulate: Rows = [
        ("poses-file", "--poses none.csv", ("none.csv",)),
        ("error-negative", "--error joints=-2mm", ("--error", "joints", "-2")),
        ("error-no-kind", "--error 2mm", ("2mm", "KIND=SIZE")),
        ("error-no-size", "--error joints", ("'joints'", "KIND=SIZE")),
        ("error-size", "--error joints=2m", ("--error joints", "'2m'", "0 to 1 m")),
        ("error-none-there", "--error twists=1deg", ("twists",)),
        ("error-radii", "--error radii=9mm", ("radii", "9 mm")),
        ("error-shape", "--error joints=2mm:gauss", ("joints", "'gauss'")),
        ("camera-kind", "--camera webcm", ("'webcm'", "webcam, phone")),
        ("camera-two", "--camera phone --camera webcam", ("0 files and 2 kinds",)),
        ("camera-level", "--camera phone --level outlines", ("--camera phone", "--level outlines")),
        ("plan-poses", "--plan session --poses 3", ("--plan and --poses",)),
        ("board", "--board chess", ("chess",)),
        ("hand-held", "--hand-held", ("--board",)),
    ]
    yield from _cases("simulate", "simulate hexapod -o {out}", simulate)
    zeros: Rows = [("zeros", "--error offsets=1mm", ("'linear-delta'", "base-joints also"))]
    yield from _cases("simulate", "simulate linear-delta -o {out}", zeros)

    locate: Rows = [
        ("tool-position", "-o {out} --tool-position 1,2", ("--tool-position",)),
        ("tool-text", "-o {out} --tool-position 1,2,x", ("--tool-position", "'x'")),
        ("angle", "-o {out} --angle-sigma 3mm", ("--angle-sigma", "3mm")),
        ("folder", "-o none/a.yaml", ("none",)),
    ]
    yield from _cases("locate", "locate hexapod {in}/hexapod.csv", locate, "tool-poses")

    camera: Rows = [
        ("kind", "chessbord:9x6", ("chessbord", "chessboard:9x6:25mm")),
        ("dictionary", "charuco:7x5:40mm:29mm", ("charuco:7x5:40mm:29mm:DICT_4X4_50",)),
        ("legacy", "charuco:7x5:40mm:29mm:DICT_4X4_50:old", ("old", "legacy")),
        ("gap", "aprilgrid:6x6:88mm:wide", ("wide",)),
        ("gap-size", "aprilgrid:6x6:88mm:9", ("9", "0.05", "2")),
    ]
    yield from _cases("camera", "camera {in}/images -o {out} --board", camera, "plain")
    images, out = "{in}/images --board chessboard:9x6:25mm", "-o {out}"
    searched: Rows = [
        ("none", (images, out), ("4",)),
        ("missing", ("no*.png --board chessboard:9x6:25mm", out), ("no*.png",)),
        ("no-board", ("{in}/images", out), ("--board",)),
        ("other", (images, "-o {in}/camera_info.yaml"), ("camera_info.yaml",)),
        ("sizes", (images, out, picture("images/turned.png", 48, 64)),
         ("64 x 48", "48 x 64", "c1_1.png", "turned.png")),
        ("cut", (images, out, cut("images/c1_2.png", 30)), ("c1_2.png",)),
    ]  # fmt: skip
    yield from _cases("camera", "camera", searched, "plain")


def _datasets() -> Iterable[Refusal]:
    rows: Rows = [
        *((f"version-{one!r}", entry(legcal_dataset=one),
           ("legcal_dataset", f"{one}", "needed version 1; use the legcal that wrote it"))
          for one in (0, 2, "2")),
        ("model-gone", entry(mechanism="../models/own.yaml"),
         ("mechanism could not be used: found '../models/own",)),
        ("model-misspelt", entry(mechanism="hexapd"),
         ("found 'hexapd', no file there", "mean 'hexapod'")),
        ("sigma-nan", entry(encoder_sigma=float("nan")), ("encoder_sigma", "nan")),
        ("sigma-large", entry(encoder_sigma=90), ("encoder_sigma", "90 m", "to 1 m")),
        ("view-name", entry(**{"views__ c3": {"camera": "camera_info.yaml"}}), ("views",)),
        ("key", entry(measurement="x"), ("measurement", "'measurements'")),
        ("tolerance", entry(tolerance={"joints": "1 deg"}),
         ("tolerance.joints", "needed a value in m")),
        ("tolerance-0", entry(tolerance={"joints": -1.0}), ("tolerance.joints", "above zero")),
        ("travel", entry(tolerance={"travel": "0.1 mm"}),
         ("tolerance.travel", "part of the travel")),
        ("both-kinds", entry(tolerance={"joints": 1e-3}, machine_kind="bought"),
         ("needed one of them",)),
        ("outside", entry(measurements="../m.csv"), ("measurements", "../m.csv")),
        ("norm", entry(views__c1__T_base_camera__quat_xyzw=[0, 0, 0, 1.002]), ("1.002",)),
        ("legs-twice", entry(views__c1__legs=["leg1", "leg1"]), ("c1", "leg1")),
        ("leg", entry(views__c1__legs=["leg1", "leg7"]), ("c1", "'leg7'")),
        (
            "all-at-once",
            entry(encoder_sigma=-1, views__c1__legs=3, views__c2={}, measurements=GONE),
            ("encoder_sigma", "views.c1.legs", "views.c2.camera", "measurements"),
        ),
        ("yaml", text("dataset.yaml", "legcal_dataset: 1\nviews: {c1: [}\n"), ("line 2",)),
        ("repeated", swap("dataset.yaml", "  c2:", "  c1:"), ("'c1'",)),
        ("gone", remove("dataset.yaml"), ("dataset.yaml",)),
        ("no-date", text("dataset.yaml", "a: 1\nb: 2001-99-99\n"), ("line 2, column 4",)),
    ]  # fmt: skip
    yield from _cases("dataset", CALIBRATE, rows, "plain")

    prior = "parameters"
    choices: Rows = [
        ("unknown", entry(**{prior: {"fixed": ["leg9.offset"]}}), ("leg9.offset",)),
        ("pair", entry(**{prior: {"priors": {"leg1.offset": {"value": 1}}}}), ("leg1.offset",)),
        (
            "both",
            entry(**{prior: {"fixed": ["leg1.offset"], "free": ["leg1.offset"]}}),
            ("leg1.offset",),
        ),
    ]
    yield from _cases("parameters", CALIBRATE, choices, "plain")

    chess = {"kind": "chessboard", "squares_x": 9, "squares_y": 6, "square": 0.03}
    char = {
        "kind": "charuco", "squares_x": 7, "squares_y": 5, "square": 0.04, "marker": 0.03,
        "dictionary": "DICT_4X4_50",
    }  # fmt: skip
    april = {"kind": "aprilgrid", "tags_x": 6, "tags_y": 6, "tag_size": 0.088, "tag_spacing": 0.3}
    boards: list[tuple[str, Any, tuple[str, ...]]] = [
        ("square", {**chess, "square": 30}, ("board.square", "30 m", "0.03")),
        ("kind", {**chess, "kind": "chess"}, ("board.kind", "'chess'")),
        ("half-turn", {**chess, "squares_x": 8}, ("8 x 6",)),
        ("few", {**chess, "squares_x": 3}, ("3 x 6", "4")),
        ("marker", {**char, "marker": 0.05}, ("0.05 m", "0.04 m")),
        ("dictionary", {**char, "dictionary": "4X4"}, ("board.dictionary", "'4X4'")),
        ("markers", {**char, "squares_x": 20, "squares_y": 20}, ("200", "50")),
        ("few-squares", {**char, "squares_x": 2, "squares_y": 3}, ("2 x 3",)),
        ("tags", {**april, "tags_x": 60, "tags_y": 60}, ("60 x 60", "587")),
    ]
    up = {"on": "platform"}
    pose = {"xyz": [0, 0, 0], "quat_xyzw": [0, 0, 0, 1]}
    two: list[tuple[str, Any, tuple[str, ...]]] = [
        ("on-tube", char | {"on": "leg1_tube"}, ("board.on", "'leg1_tube'", "base or platform")),
        ("on-none", char | {"on": None}, ("board.on", "base or platform")),
        ("two-on-base", [char, chess], ("two boards on the base", "on the platform")),
        ("same-markers", [char, char | up | {"square": 0.05}], ("DICT_4X4", "apart")),
        ("same-bits", [char, char | up | {"dictionary": "DICT_4X4_100"}], ("DICT_4X4",)),
        ("same-squares", [chess, chess | up | {"square": 0.02}], ("numbers of squares",)),
        ("pose-of-base", char | up | {"T_base_board": pose}, ("T_base_board", "T_platform_board")),
        ("none", [], ("empty list",)),
        ("text", [char, "chessboard"], ("'chessboard'", "mapping")),
    ]
    boards += [(name, board, ("dataset.yaml", "needed", *named)) for name, board, named in two]
    of_boards = [(name, entry(board=board), named) for name, board, named in boards]
    yield from _cases("board", CALIBRATE, of_boards, "plain")


def _in_hand() -> Iterable[Refusal]:
    """Views of a camera in the hand that no board places."""
    board = {
        "kind": "charuco", "squares_x": 4, "squares_y": 3, "square": 0.03, "marker": 0.02,
        "dictionary": "DICT_4X4_50",
    }  # fmt: skip

    def corners(*places: tuple[str, int]) -> Edit:
        lines = [
            f"{place},{k},{5 + k},6,0.1,used,,detected\n" for place, n in places for k in range(n)
        ]
        return text("corners.csv", f"{CORNER_COLUMNS}\n{''.join(lines)}")

    held = entry(board=board, views__c1__hand_held=True, views__c1__T_base_camera=GONE)
    first, second = "c1-1,images/c1_1.png", "c1-2,images/c1_2.png"
    rows: Rows = [
        ("pose", entry(board=board, views__c1__hand_held=True),
         ("views.c1.T_base_camera", "one pose")),
        ("name", (held, entry(**{"views__c1-2": {"camera": "camera_info.yaml"}}),
                  cell("measurements.csv", 3, view="c1-2")), ("views.c1-2", "hand-held")),
        ("3-corners", (held, corners((first, 6), ("c2,images/c2_1.png", 6), (second, 3))),
         ("row 2", "found 3 corners")),
        ("no-image", (held, cell("measurements.csv", 2, image="")),
         ("row 2, column image", "neither an image")),
        ("corners-alone", corners(("c1,images/c1_1.png", 6)), ("corners.csv", "no board")),
        ("no-legs", entry(views__c1__legs=[], views__c2__legs=[]),
         ("views.c1.legs and views.c2.legs could not be used", "no leg and no board")),
        ("no-legs-on-base", entry(board=board, views__c1__legs=[]),
         ("views.c1.legs", "no board on the platform, needed")),
    ]  # fmt: skip
    yield from _cases("in-hand", CALIBRATE, rows, "plain")


def _measurements() -> Iterable[Refusal]:
    table = "measurements.csv"
    joint = "leg1_prismatic"

    def readings(row: int | None, value: str, column: str = joint) -> Edit:
        return cell(table, row, **{column: value})

    def image(value: str) -> Edit:
        return cell(table, 3, image=value)

    rows: Rows = [
        ("no-column", header(table, "leg6_prismatic", None), ("'leg6_prismatic'",)),
        ("column-twice", header(table, "leg2_prismatic", joint), (f"'{joint}'", "2 times")),
        ("semicolons", swap(table, ",", ";", -1), ("commas",)),
        ("short", swap(table, "c1,images/c1_2.png", "images/c1_2.png"), ("row 2", "7", "8")),
        ("long", swap(table, "c1,images/c1_2.png", "c1,,images/c1_2.png"), ("row 2", "9", "8")),
        ("underscore", readings(3, "1_0"), ("row 3 (line 4)", joint, "'1_0'")),
        ("millimetres", readings(None, "70"), (joint, "millimetres")),
        ("same-path", image("../in/images/c1_1.png"), ("row 3", "row 1")),
        ("no-path", image("images/a\0b.png"), ("row 3", "a path that cannot")),
        ("windows", image("C:\\other.png"), ("row 3", "C:\\other.png")),
        ("bytes", text(table, b"view,image\n\xff\xfe"), ("0xff",)),
        (
            "all-at-once",
            (cell(table, 1, view="c7"), readings(2, "nan"), image("/a.png"), readings(4, "9")),
            ("row 1", "row 2", "row 3", "row 4", "c7", "nan", "/a.png"),
        ),
        (
            "pose",
            (header(table, "leg6_prismatic", "leg6_prismatic"),
             swap(table, "view,image", "pose,view,image"), swap(table, "\nc", "\np,c", -1)),
            ("row 1 (line 2)", "pose p", joint),
        ),
        (
            "images-at-once",
            (remove("images/c1_1.png"), cut("images/c1_2.png", 30),
             picture("images/c2_1.png", 63, 48), text("images/c2_2.png", "text")),
            ("row 1", "row 2", "row 3", "row 4"),
        ),
    ]  # fmt: skip
    yield from _cases("measurements", CALIBRATE, rows, "plain")


def _cameras() -> Iterable[Refusal]:
    file = "camera_info.yaml"

    content = partial(keyed, file)
    K = [80.0, 0.0, 31.5, 0.0, 80.0, 23.5, 0.0, 0.0, 1.0]
    five = {"rows": 1, "cols": 5, "data": [0.0] * 5}

    def kalibr(**values: Any) -> Edit:
        camera = {
            "camera_model": "pinhole", "distortion_coeffs": [0.0] * 4,
            "distortion_model": "radtan", "intrinsics": [80.0, 80.0, 31.5, 23.5],
            "resolution": [64, 48],
        }  # fmt: skip
        return text(file, yaml.safe_dump({"cam0": camera | values}))

    def matrix(*changes: tuple[int, float]) -> Edit:
        data = list(K)
        for place, value in changes:
            data[place] = value
        return content(camera_matrix__data=data)

    def block(**changes: Any) -> Edit:
        known = {"version": 1, "sigma": {}, "names": ["fx", "cx"]}
        known |= {"covariance": [[4.0, -0.9], [-0.9, 0.25]]}
        return content(legcal_camera=_without_none(known | changes))

    rows: Rows = [
        ("sigma-name", block(sigma={"f": 1.0}), ("legcal_camera", "found f,", "fx, fy, cx")),
        ("sigma-negative", block(sigma={"fx": -1.0}), ("legcal_camera.sigma.fx",)),
        ("sigma-other", block(sigma={"fx": 2.1}), ("deviation 2 of fx", "2.1 in sigma")),
        ("no-names", block(names=None), ("no names",)),
        ("asymmetric", block(covariance=[[4.0, 0.1], [0.2, 1.0]]), ("not symmetric",)),
        ("indefinite", block(covariance=[[4.0, 3.0], [3.0, 1.0]]), ("not positive semidefinite",)),
        ("variance", block(covariance=[[4.0, 0.0], [0.0, -1.0]]), ("the variance -1 of cx",)),
        ("model", content(distortion_model="fov"), ("distortion_model", "'fov'")),
        ("equidistant", content(distortion_model="equidistant"), ("5", "4", "equidistant")),
        ("few-numbers", content(camera_matrix__data=K[:6]), ("camera_matrix", "6", "9")),
        ("last-row", matrix((8, 2.0)), ("[0, 0, 1]",)),
        (
            "all-at-once",
            content(camera_matrix__data=[0.0, *K[1:4], -3.0, 900.0, *K[6:]],
                    distortion_coefficients=five | {"cols": 3, "data": [0, 0, 0]}),
            ("fx = 0", "fy = -3", "cy = 900", "3"),
        ),
        ("kalibr-model", kalibr(camera_model="omni"), ("cam0.camera_model", "'omni'")),
        ("keys", text(file, "fx: 1\nfy: 2\n"), ("fx", "fy")),
        ("centre-negative", matrix((2, -1.0)), ("cx = -1", "64 x 48")),
        ("kalibr-none", kalibr(distortion_model="none", distortion_coeffs=[0.1, 0.0, 0.0, 0.0]),
         ("4", "0 for none")),
        ("kalibr-two", (kalibr(), _two_cameras), ("2 cameras", "cam0, cam1")),
        ("storage-xml", text(file, "<?xml version='1.0'?><opencv_storage><a>"), ("OpenCV",)),
        ("bytes", text(file, b"a: \xff\xfe\xfd"), ("UTF-8",)),
    ]  # fmt: skip
    yield from _cases("lens", CALIBRATE, rows, "plain")


def _units() -> Iterable[Refusal]:
    """Readings of servos in a unit that is not the stated one."""
    angles = 0.5 * np.sin(np.arange(24.0).reshape(4, 6))  # [rad]
    both_ways = np.concatenate([angles, -angles])
    pulses = 1500.0 + 11.1 * np.degrees(angles)
    sigma = {"encoder_sigma": dict.fromkeys(SERVOS, 1e-4)}
    degrees = {"readings": "deg", "encoder_sigma": dict.fromkeys(SERVOS, 0.1)}
    servo = {"unit": "us", "centre_us": 1500, "us_per_deg": 11.1}
    in_us = {"readings": dict.fromkeys(SERVOS, servo)}
    rows: list[tuple[str, np.ndarray, dict[str, Any], tuple[str, ...]]] = [
        ("degrees", np.degrees(angles), sigma, ("look like degrees", "write readings: deg")),
        ("one-in-degrees", angles * np.array([1.0, 57.3, 1.0, 1.0, 1.0, 1.0]), sigma,
         ("look like degrees", "write readings: {servo2: deg}")),
        ("radians", both_ways, degrees,
         ("% of the travel in deg", "in rad", "write readings: rad")),
        ("pulses", pulses, sigma, ("look like pulses", "centre_us: 1500")),
        ("pulses-as-deg", pulses, degrees, ("look like pulses", "centre_us: 1500")),
        ("no-pulses", angles, in_us, ("found 0 us", "1000.5 to 1999.5 us", "look like radians")),
        ("no-centre", pulses, sigma | {"readings": "us"},
         ("readings.servo1", "neither centre nor us")),
        ("mm", angles, sigma | {"readings": "mm"}, ("found mm and no motor that slides",)),
        ("motor", angles, sigma | {"readings": {"servo9": "deg"}},
         ("readings.servo9", "servo1, servo2")),
        ("mm-of-one", angles, sigma | {"readings": {"servo1": "mm"}},
         ("readings.servo1", "which turns")),
        ("unknown", angles, sigma | {"readings": "turns"}, ("readings", "'turns'")),
        ("no-sigma", angles, {"readings": "rad"},
         ("encoder_sigma is incomplete", "servo1, servo2")),
        ("large-sigma", angles, {"encoder_sigma": dict.fromkeys(SERVOS, 0.5)},
         ("28.6 deg", "0.5deg")),
        ("sigma-number", angles, {"encoder_sigma": 1e-4}, ("one number [m]", "'servo1' turns")),
    ]  # fmt: skip
    unseen: Rows = [
        (hidden, partial(_without_rods, hidden=hidden), said)
        for hidden, said in (
            ("leg[12]_", ("motor 'arm1'", "no cylinder along leg1, leg2", "<visual>")),
            (r"leg\d_", ("view c1 could not be used", "found no leg", "visible cylinder")),
        )
    ]
    yield from _cases("unseen", CALIBRATE, unseen, "motors")

    def given(readings: np.ndarray, stated: dict[str, Any]) -> Edit:
        return cast(Edit, partial(dataset_of_readings, readings=readings, entry=stated))

    units: Rows = [(name, given(q, stated), named) for name, q, stated, named in rows]
    one_gone = given(angles, sigma), cell("measurements.csv", None, servo1="")
    units = [*units, ("open", one_gone, ("servo1", "moves joints at the base"))]
    yield from _cases("units", CALIBRATE, units)


def _without_rods(folder: Path, hidden: str) -> None:
    """Write readings of a Delta some of whose rods are not drawn."""
    urdf, drawn = folder / "delta.urdf", rf'(<link name="{hidden}\w*">).*?</link>'
    urdf.write_text(re.sub(drawn, r"\1</link>", urdf.read_text(), flags=re.DOTALL))
    arms, angles = ("arm1", "arm2", "arm3"), np.array([[0.3, 0.2, 0.1], [0.1, 0.4, 0.3]])
    entry = {"encoder_sigma": dict.fromkeys(arms, 1e-4)}
    dataset_of_readings(folder, angles, entry, "delta.yaml", arms)


def _two_cameras(folder: Path) -> None:
    path = folder / "camera_info.yaml"
    text = path.read_text()
    path.write_text(text + text.replace("cam0", "cam1"))


def _tables() -> Iterable[Refusal]:
    o = "observations.csv"
    outlines: Rows = [
        ("part", cell(o, 1, part="leg2_rod"), ("row 1", "part", "'leg2_rod'", "leg1")),
        ("verdict", cell(o, 1, verdict="yes"), ("verdict", "'yes'", "used", "rejected")),
        ("zero", cell(o, 1, a="0", b="0", c="0"), ("norm 0",)),
        ("point", cell(o, 1, u0="5", u1="5", v0="7", v1="7"), ("u0", "v1")),
        ("indefinite", cell(o, 1, s00="1", s01="2", s11="1"), ("(1, 2, 1)",)),
        (
            "large",
            cell(o, 1, s00="1", s01="0", s11="18446744073709551616"),
            ("columns s00, s01, s11", "4.29e+09 px", "1e-05 to 100 px"),
        ),
        ("by-gamma", cell(o, 1, by_gamma="nan"), ("column by_gamma", "'nan'")),
        ("far", cell(o, 1, u0="-400", v0="-300"), ("px", "(a, b, c)")),
        ("one-gamma", cell(o, 2, gamma="2.2"), ("row 2", "gamma", "by_gamma")),
        ("no-table", text(o, ""), (o,)),
        (
            "all-at-once",
            (cell(o, 1, view="up", leg="none", edge="0"), cell(o, 4, a="x", b="y")),
            ("'up'", "'none'", "'0'", "'x'", "'y'", "row 1", "row 4"),
        ),
        ("all-rejected", cell(o, None, verdict="rejected"), ("outline",)),
        (
            "leg-rejected",
            each_row(o, lambda row: row["leg"] == "leg3" and row.update(verdict="rejected")),
            ("no image has a usable outline of leg3", "list the visible legs of each"),
        ),
    ]
    yield from _cases("outlines", CALIBRATE, outlines, "3-rpr-outlines")
    wrong = cell("measurements.csv", 2, leg2_prismatic="0.12")
    named = "readings of view c1, image p02", "from the value given by the other motors"
    yield from _cases("reading", CALIBRATE, [("of-four", wrong, named)], "redundant")
    short = cell("measurements.csv", 4, **{f"leg{j}_prismatic": "0.0001" for j in (1, 2, 3)})
    named = "readings of view c1, image p04 could not be used", "needed at most"
    yield from _cases("reading", CALIBRATE, [("out-of-reach", short, named)], "3-rpr-outlines")

    c = "corners.csv"
    line = f"{CORNER_COLUMNS}\n"
    good = "c1,images/c1_1.png,0,5.0,5.0,0.1,used,,detected\n"
    board = keyed("dataset.yaml", board={
        "kind": "chessboard", "squares_x": 9, "squares_y": 6, "square": 0.03,
    })  # fmt: skip
    other = "".join(good.replace(",0,", f",{k},") for k in range(60))
    corners: Rows = [
        (name, (board, text(c, line + rows)), named)
        for name, rows, named in (
            ("many", f"{good}c1,images/c1_2.png,99,1,2,0.1,used,,detected\n",
             ("corner", "99", "row 2")),
            ("image", f"{good}c2,images/c1_2.png,3,1,2,0.1,used,,detected\n",
             ("column image", "c1_2.png", "row 2")),
            ("of-another", other, ("corners up to 59,", "40 on the base")),
            ("none", "", ("no row",)),
        )
    ]  # fmt: skip
    yield from _cases("corners", CALIBRATE, corners, "plain")


def clicks(*left_out: str) -> Edit:
    """Click joints in the first picture of the first view."""

    def edit(folder: Path) -> None:
        (folder / "landmarks.csv").unlink(missing_ok=True)
        seen = seen_from(folder, 0, camera_beside(folder, 0.7))
        kept = {joint: px for joint, px in seen.items() if joint not in left_out}
        write_clicks(folder, {0: kept}, "0.3")

    return edit


def _landmarks() -> Iterable[Refusal]:
    """Joints clicked in pictures."""
    c = "landmarks.csv"
    rows: Rows = [
        ("outside", cell(c, 2, u="470"), ("row 2", "column u", "470 px", "63.5 px")),
        ("twice", doubled(c), ("row 13", "row 1", "the same image and joint")),
        ("few", kept(c, 3), ("view c1", "3 clicks", "4 or more, better 6")),
        ("wrong-joint", (clicks("leg4.platform"), cell(c, 1, joint="leg4.platform")),
         ("the click on leg4.platform in images/c1_1.png", "perhaps it shows leg1.base")),
        ("no-camera", (kept(c, 6), cell(c, 1, u="5"), cell(c, 3, u="60", v="40"),
                       cell(c, 4, v="2"), cell(c, 6, v="3")), ("view c1", "no camera shows")),
        ("all-at-once", (cell(c, 1, joint="leg"), cell(c, 2, u="x"), cell(c, 3, view="c9")),
         ("'leg'", "'x'", "'c9'")),
    ]  # fmt: skip
    spoiled: Rows = [
        (name, (clicks(), *(edits if isinstance(edits, tuple) else (edits,))), named)
        for name, edits, named in rows
    ]
    yield from _cases("clicks", CALIBRATE, spoiled, "plain")


def _overrides() -> Iterable[Refusal]:
    """Choices of parameters by options."""
    priors: Rows = [
        ("sigma-0", "leg1.offset=0.35±0", ("sigma 0",)),
        ("one-unit", "leg1.offset=350mm±0.1", ("unit",)),
        ("unit", "leg1.offset=350±1furlong", ("'furlong'", "mm")),
        ("pixels", "leg1.offset=350±1px", ("px", "leg1.offset", "m")),
        ("metres", "leg1.offset=350±1", ("350 m", "leg1.offset")),
        ("name", "leg1.ofset=0.35±0.1", ("'leg1.offset'",)),
        ("frame", "leg1.base.x=0±0.1", ("leg1.base.x", "R_b")),
        ("fixed", "leg1.offset=0.35±0.1' --set '*.offset", ("leg1.offset",)),
        ("camera", "c1.fx=79±3' --set 'c2.fx=78±3", ("c1.fx", "c2.fx")),
    ]
    yield from _cases("prior", f"{CALIBRATE} --set '{{words}}'", priors, "plain")
    others: Rows = [
        ("freed", "leg1.offset --set leg1.offset=free", ("leg1.offset",)),
        ("values", "leg1.offset=0.35 --set leg1.offset=0.36", ("leg1.offset",)),
        ("everything", "'*.base.?' --set '*.platform.?' --set '*.offset'", ()),
    ]
    yield from _cases("fix", f"{CALIBRATE} --set", others, "plain")
    axis: Rows = [("axis", "leg1.base_axis.1", ("leg1.base_axis.1", "RPR"))]
    yield from _cases("planar", f"{CALIBRATE} --set", axis, "3-rpr-outlines")


def _models() -> Iterable[Refusal]:
    y, u = "models/hexapod.yaml", "urdf/hexapod.urdf"
    limit = '<limit lower="-0.004" upper="0.144" effort="1000" velocity="1"/>'
    free = 'name="platform_free" type="floating">'
    seat = '<parent link="base"/><child link="leg1_seat"/>'
    b2_at = '<child link="leg3_b2_link"/><origin xyz="0.0 0.0 0.0"'
    b2 = b2_at + ' rpy="0.0 0.0 0.0"/><axis xyz="{}"/>'
    cycle = (
        '<robot name="r"><link name="base"/><link name="a"/><link name="b"/>'
        '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
        '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
    )
    rows: Rows = [
        ("frame-twice", swap(y, "  - leg1_seat", "  - leg1_end"), ("'leg1_end'",)),
        ("frame-of-another", swap(y, "  - leg5_seat", "  - leg2_seat"),
         ("closed_loop.4", "'leg2_seat'", "closed_loop.1", "write 'leg5_seat'")),
        ("motor", swap(y, "- leg1_prismatic\n", "- leg9_prismatic\n"), ("name_mot.0",)),
        ("motor-twice", swap(y, "- leg1_prismatic\n", "- leg2_prismatic\n"),
         ("'leg2_prismatic'",)),
        ("types", swap(y, "- 3d\n", ""), ("6", "5", "closed_loop", "type")),
        ("both", swap(y, "platform: platform\n", "platform: base\n"), ("base", "platform")),
        ("frame-leg", swap(y, "  - leg1\n", "  - leg8\n"), ("legcal.base_frame", "'leg8'")),
        ("frame-legs", swap(y, "  - leg1\n", ""), ("2", "3")),
        ("home-far", swap(y, "0.38274", "0.9"), ("legcal.home",)),
        ("stand-in", swap(y, "joint_name: []", "joint_name: [leg1_b1]"), ("1", "0")),
        ("list", text(y, "- 1\n"), (y,)),
        ("python", swap(y, "type:", "x: !!python/object/apply:os.system [touch trace]\ntype:"),
         ("python/object/apply",)),
        ("turning-motor", swap(y, "- leg2_prismatic\n", "- leg2_b1\n"), ("'leg2_b1'",)),
        ("home-of-slider", swap(y, "legcal:\n", "legcal:\n  home_readings: {leg1_prismatic: 0}\n"),
         ("legcal.home_readings.leg1_prismatic", "remove it")),
        ("xyz-huge", swap(u, "0.195", "1e300"), ("1e300",)),
        ("axis-0", swap(u, 'axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 0"'), ("line", "axis")),
        ("axis-2", swap(u, 'axis xyz="0.0 0.0 1.0"', 'axis xyz="0 0 2"'), ("length 2",)),
        ("radius", swap(u, 'radius="0.01"', 'radius="-0.01"'), ("-0.01",)),
        ("no-radius", swap(u, 'radius="0.01" ', ""), ("radius",)),
        ("limits", swap(u, 'lower="-0.004"', 'lower="0.2"'), ("0.2", "0.144")),
        ("floating", swap(u, 'type="floating"', 'type="spherical"'), ("'spherical'",)),
        ("mimic", swap(u, limit, f'{limit}<mimic joint="leg2_prismatic"/>'), ("<mimic>",)),
        ("no-parent", swap(u, '<parent link="leg1_b2_link"/>', ""), ("<parent link",)),
        ("parent", swap(u, '<parent link="leg1_b2_link"/>', '<parent link="lost"/>'), ("'lost'",)),
        ("second-parent", swap(u, '<child link="leg1_seat"/>', '<child link="leg1_end"/>'),
         ("'leg1_end'",)),
        ("loose", swap(u, '<link name="base"/>', '<link name="base"/><link name="loose"/>'),
         ("loose",)),
        ("doctype", (swap(u, '<link name="base"/>', '<link name="base">&a;</link>'),
                     swap(u, "<robot", '<!DOCTYPE robot [<!ENTITY a SYSTEM "file:///etc/hostname">]'
                          "><robot")), (u, "DOCTYPE")),
        ("cut", cut(u, 3000), ("line",)),
        ("no-robot", text(u, "<a/>"), (u,)),
        ("version-true", swap(y, "version: 1", "version: true"),
         ("legcal.version", "true", "needed 1")),
        ("no-leg-name", swap(y, "    leg6: leg6_prismatic\n", ""),
         ("no name", "'leg6_prismatic'")),
        ("named-twice", swap(y, "leg2: leg2_prismatic", "leg2: leg1_b1"),
         ("already named 'leg1'",)),
        ("named-off-legs", swap(y, "leg2: leg2_prismatic", "leg2: platform_free"),
         ("on no leg between base and platform",)),
        ("no-free-joint", swap(y, "  platform_joint: platform_free\n", ""),
         ("floating joint 'platform_free'",)),
        ("open-leg", swap(y, "- - leg6_end\n  - leg6_seat\ntype:\n- 3d\n", "type:\n"),
         ("on no chain from base to platform",)),
        ("floor-over-home", swap(y, "  legs:", "  floor: 0.9\n  legs:"),
         ("the floor", "0.9 m", "home at z = 0.3827 m")),
        ("home-out-of-reach", (swap(y, "- 0.0\n    - -0.0\n", "- 0.02\n    - 0.0\n"),
                               swap(y, "  legs:", "  reach: 0.01\n  legs:")),
         ("the reach", "0.01 m", "home 0.02 m from the z axis")),
        ("home-1e308", swap(y, "- 0.38274", "- 1.0e+308"), ("needed a number less than",)),
        ("leg-name", swap(y, "leg2: leg2", '"../leg2": leg2'),
         ("legs", "../leg2", "the first a letter or digit", "rename it")),
        ("no-travel", swap(u, 'upper="0.144"', 'upper="-0.004"'),
         ("line", "'leg1_prismatic'", "-0.004")),
        ("long-travel", swap(u, 'upper="0.144"', 'upper="144"'), ("travel", "'leg1'", "144 m")),
        ("no-lower", swap(u, 'lower="-0.004" ', ""), ("line", "lacks lower")),
        ("radius-thick", swap(u, 'radius="0.01"', 'radius="0.25"'),
         ("<visual> cylinder", "250 mm", "along leg")),
        ("two-parents", swap(u, limit, f'{limit}<parent link="base"/>'),
         ("line", "more than one <parent>")),
        ("link-without-name", swap(u, '<link name="leg1_seat"/>', "<link/>"), ("line", "no name")),
        ("apart", swap(u, b2_at, b2_at.replace('0.0"', '0.002"')), ("leg3_b1", "leg3_b2", "2 mm")),
        ("parallel", swap(u, b2.format("0.0 1.0 0.0"),
                          b2.format("1.0 0.0 0.0").replace("0.0 0.0 0.0", "0.0 0.002 0.0", 1)),
         ("leg3_b1", "leg3_b2", "parallel")),
        ("branches", swap(u, seat, seat.replace("base", "leg2_tube")),
         ("another leg or branches",)),
        ("planar-free", swap(u, free, free.replace("floating", "planar")),
         ("platform_free", "axis (1, 0, 0)")),
        ("planar-free-z", swap(u, free, free.replace("floating", "planar") + '<axis xyz="0 0 1"/>'),
         ("platform_free", "a planar joint, needed a floating one")),
        ("fixed-platform",
         (swap(u, 'type="floating"', 'type="fixed"'),
          swap(y, "  platform_joint: platform_free\n", "")), ("fixed to the base",)),
        ("both-files",
         (swap(u, 'xyz="0.0 0.195 0.0"', 'xyz="0.0 nan 0.0"'),
          swap(u, 'type="floating"', 'type="ball"')), (", line 35: joint 'platform_free'",)),
        ("yaml-twice", (swap(y, "0.38274", ".nan"), swap(y, "version: 1", "version: 3")),
         ("legcal.home", "legcal.version")),
        ("cycle", text(u, cycle), ("in a cycle",)),
        ("xacro", text(u, '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro">'
                          "<xacro:include/></robot>"), ("xacro",)),
        ("utf-16", _in_utf_16, ("UTF-8",)),
    ]  # fmt: skip
    placed = [(name, edits, ("{in}", *named)) for name, edits, named in rows]
    yield from _cases("model", "inspect {in}/models/hexapod.yaml", placed, "model")
    half = (text("calibrated.yaml", "closed_loop: []\n"),
            text("result.json", '{"legcal_result": 1, "mach'))  # fmt: skip
    of_inputs: dict[str, Rows] = {
        "model": [
            (
                "urdf-alone",
                (
                    "/arm.urdf",
                    lambda folder: (folder / "urdf/hexapod.urdf").rename(folder / "arm.urdf"),
                ),
                ("arm.urdf",),
            ),
            ("written", "/models/hexapod.yaml --write {in}", ("hexapod.yaml",)),
        ],
        "tables": [
            ("table", "/3-rps.yaml", ("3-rps.yaml", "legcal new")),
            ("csv", "/tripod.csv", ("tripod.csv", "legcal new", "-o DIR")),
        ],
        "plain": [("dataset", "", ("dataset", "legcal calibrate {in} -o OUT"))],
        "": [("half-a-result", half, ("no whole result.json of a calibration, needed both",))],
    }
    for given, those in of_inputs.items():
        yield from _cases("model", "inspect {in}{words}", those, given)
    files: Rows = [
        (file, (file, text(file, content)), (named,))
        for file, content, named in (
            ("other.xml", b"<a/>", "other.xml"),
            ("entity.xml", b'<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "entity.xml"),
            ("gazebo.sdf", b'<?xml version="1.0"?>\n<sdf version="1.6"><model/></sdf>', "an SDF"),
            ("m.hal", b"# hexapod\nloadrt genhexkins\nsetp x 1\n", "m.hal -o DIR"),
        )
    ]
    yield from _cases("file", "inspect {in}/{words}", files)
    yield from _cases("motors", "inspect {in}/delta.yaml", _motors(), "motors")
    slider: Rows = [("of-slider", keyed("3-prs.yaml", name_mot=[]),
                     ("the slider", "on the base itself", "the joint at A moves"))]  # fmt: skip
    yield from _cases("motors", "inspect {in}/3-prs.yaml", slider, "motors")


def _motors() -> Rows:
    """Return what files of motors that carry rods cannot be."""
    y, u = "delta.yaml", "delta.urdf"
    limits = 'lower="-0.5235987755982988" upper="1.2217304763960306"'
    motors = "name_mot:\n- arm1\n"
    home = re.findall(r"  home:\n(?:    .*\n)+", (ROOT / "models/delta.yaml").read_text())[0]

    def travel(low: str, high: str) -> Edit:
        return swap(u, limits, f'lower="{low}" upper="{high}"', -1)

    return [
        ("degrees", travel("-30", "70"), ("'arm1'", "-30 to 70 rad", "degrees")),
        ("travel", travel("1.0", "1.2"), ("'arm1' at 20.00 deg", "57.30 to 68.75 deg")),
        ("ambiguous", travel("-3.1", "3.1"),
         ("'leg1' at home is ambiguous", "-178.8 and 20.0 deg of 'arm1'", "home_readings")),
        ("reading-of-none", swap(y, "home:\n", "home_readings: {arm7: 0.1}\n  home:\n"),
         ("home_readings.arm7", "arm1")),
        ("reading", swap(y, "home:\n", "home_readings: {arm1: 20}\n  home:\n"),
         ("home_readings.arm1", "20 rad")),
        ("no-home", swap(y, home, ""),
         ("home is ambiguous", "write legcal.home,", "0.2373", "-0.3741")),
        ("two", swap(y, motors, f"{motors}- leg1_a2\n"), ("'leg1_a2'", "one motor for each leg")),
        ("none", swap(y, motors, "name_mot:\n"),
         ("'arm1'", "carries 2 rods", "a motor in name_mot")),
        ("continuous", swap(u, '"arm1" type="revolute"', '"arm1" type="continuous"'),
         ("'arm1'", "continuous", "<limit>")),
    ]  # fmt: skip


def _outside() -> Iterable[Refusal]:
    """Machines that the method does not cover."""
    rows: Rows = [
        (name, cast(Edit, write), ("{in}", *named)) for name, (write, named) in OUTSIDE.items()
    ]
    yield from _cases("outside", "inspect {in}/machine.yaml", rows)


def _formats() -> Iterable[Refusal]:
    """What another format cannot mean."""
    connect = '<connect name="loop_1" solref="0.001 1" site1="loop_1_1" site2="loop_1_2"/>'
    by_bodies = '<connect body1="leg1_end" body2="leg1_seat" anchor="0 0 0"/>'
    joint = '<freejoint name="platform_free"/>'
    slide = '<joint name="leg1_prismatic" type="slide"'
    motor = '<position name="leg1_prismatic" joint="leg1_prismatic" kp="10000.0"/>'
    world, body_2, size = "<worldbody>", '<body name="leg2_end"', 'type="capsule" size="0.01"'

    def tied(old: str, new: str) -> tuple[str, str]:
        return connect, by_bodies.replace(old, new)

    def added(text: str) -> tuple[str, str]:
        return world, f"{world}{text}"

    mjcf: list[tuple[str, tuple[str, str], tuple[str, ...]]] = [
        ("include", added('<include file="x.xml"/>'), ("include could not be used",)),
        ("no-body1", tied('body1="leg1_end"', ""), ("no body1",)),
        ("no-anchor", tied('anchor="0 0 0"', ""), ("no anchor",)),
        ("anchor", tied("0 0 0", "0 0"), ("anchor='0 0'", "3 finite numbers")),
        ("itself", tied("seat", "end"), ("to itself",)),
        ("sites", (connect, '<connect site1="a" site2="b"/>'), ("the site 'a' as site1",)),
        ("coupled", (connect, connect + '<joint joint1="leg1_prismatic" joint2="leg2_prismatic"/>'),
         ("couples <joint> coordinates",)),
        ("constraint", (connect, connect + '<conect body1="leg1_end"/>'), ("no constraint",)),
        ("element", added('<bdy name="x"/>'), ("no element of a body",)),
        ("geom", added('<geom type="cilinder"/>'), ("'cilinder'",)),
        ("motor", (motor, motor + "<motor/>"), ("names no joint",)),
        ("motor-tendon", (motor, '<motor tendon="t"/>'), ("tendon",)),
        ("motor-free", (motor, '<motor joint="platform_free"/>'), ("free joint 'platform_free'",)),
        ("joint", (slide, slide.replace("slide", "screw")), ("'screw'", "needed free")),
        ("joint-twice", (slide, slide.replace("leg1", "leg2")), ("which another joint has",)),
        ("axis", (slide + ' axis="0.0 0.0 1.0"', slide + ' axis="0 0 0"'), ("zero axis",)),
        ("body-world", added('<body name="world"/>'), ("which <worldbody> has",)),
        ("two-turns", (body_2, body_2 + ' euler="0 0 1"'), ("one orientation",)),
        ("quat", ('quat="1.0 0.0 0.0 0.0"', 'quat="0 0 0 0"'), ("no orientation",)),
        ("range", ('range="-0.004 0.144"', 'range="1 -1"'),
         (", line 17: joint 'leg1_prismatic'", "1 to -1")),
        ("grad", (world, f'<compiler angle="grad"/>{world}'), ("angle='grad'", "degree")),
        ("eulerseq", (world, f'<compiler eulerseq="xyw"/>{world}'), ("eulerseq='xyw'",)),
        ("class", added('<body childclass="no"/>'), ("default class 'no'",)),
        ("no-class", (world, f"<default><default/></default>{world}"),
         ("default class without a",)),
        ("two-joints", (joint, joint + '<joint name="x"/>'), ("a body that has other joints",)),
        ("size", (size, size.replace("0.01", "0")), ("without a radius",)),
        ("bodies-6000", ("</worldbody>", "<body/>" * 6000 + "</worldbody>"), ("at most 5000",)),
        ("outside", tied("leg1_seat", "leg2_tube"),
         ("check <equality>", "--base LINK --platform LINK")),
    ]  # fmt: skip
    yield from _of_file("mjcf", "machine.xml", "mjcf", mjcf)
    rest: Rows = [
        ("all-at-once",
         (swap("machine.xml", motor, '<position joint="leg1"/>'),
          swap("machine.xml", connect, '<connect body1="x" body2="y" anchor="0 0 0"/>')),
         ("'leg1'", "'x'", "'y'")),
        ("no-sites", swap("machine.xml", "<site ", "<camera ", -1),
         ("the site 'loop_1_1' as site1", "there are none")),
        ("inactive", swap("machine.xml", "<connect ", '<connect active="false" ', -1),
         ("without <connect> or <weld>",)),
        ("two-mechanisms", _second_mechanism,
         ("found 2 mechanisms, which have no moving body in common",)),
    ]  # fmt: skip
    yield from _cases("mjcf", "inspect {in}/machine.xml", rest, "mjcf")
    link1 = '<link1 link="leg1_tube"'
    loops: list[tuple[str, tuple[str, str], tuple[str, ...]]] = [
        ("type", ('type="spherical"', 'type="prismatic"'), ("line", "'prismatic'")),
        ("link", (link1, link1.replace("tube", "tub")), ("line", "mean 'leg1_tube'")),
        ("base", (link1, link1.replace("leg1_tube", "base")), ("line", "joins the link 'base' to")),
        ("one-link", (link1, link1.replace("link1", "link9")), ("line", "names 1 links")),
        ("xyz", (link1[1:] + ' xyz="0.0 0.0 0.0"', link1[1:] + ' xyz="0 0"'),
         ("line", "xyz='0 0'")),
        ("motor", ('<joint name="leg1_prismatic"/>', '<joint name="leg"/>'),
         ("line", "names no joint of")),
    ]  # fmt: skip
    yield from _of_file("loops", "machine.urdf", "loop_joint", loops)
    beside = text("machine.yaml", (ROOT / "models/hexapod.yaml").read_text().replace(
        "../urdf/hexapod.urdf", "machine.urdf"
    ))  # fmt: skip
    alone: Rows = [("and-yaml", beside, ("which is not read beside a mechanism YAML",))]
    yield from _cases("loops", "inspect {in}/machine.urdf", alone, "loop_joint")
    gepetto: list[tuple[str, tuple[str, str], tuple[str, ...]]] = [
        ("axes", ("joint_type:\n- UJOINT_XY", "joint_type:\n- UJOINT_XX"),
         ("'UJOINT_XX'", "SPHERICAL")),
        ("joint", ("joint_name:\n- leg1_b1", "joint_name:\n- leg1_b"), ("mean 'leg1_b1'",)),
        ("twice", ("joint_name:\n- leg1_b1", "joint_name:\n- leg2_b1"), ("'leg2_b1' twice",)),
        ("motor", ("name_mot:\n- leg1_prismatic", "name_mot:\n- leg1_b1"),
         ("stands for UJOINT_XY",)),
    ]  # fmt: skip
    yield from _of_file("gepetto", "machine/robot.yaml", "gepetto", gepetto)


def _of_file(
    group: str, file: str, given: str, rows: Iterable[tuple[str, tuple[str, str], tuple[str, ...]]]
) -> Iterable[Refusal]:
    """Put something in the place of a text of a file, which is read and must be named."""
    spoiled = [(name, swap(file, *change), ("{in}", *named)) for name, change, named in rows]
    yield from _cases(group, f"inspect {{in}}/{file}", spoiled, given)


def _in_utf_16(folder: Path) -> None:
    path = folder / "urdf/hexapod.urdf"
    path.write_bytes(path.read_text().replace("utf-8", "utf-16").encode("utf-16"))


def _second_mechanism(folder: Path) -> None:
    path = folder / "machine.xml"
    text = path.read_text()
    second = re.sub('="(leg|loop|platform)', r'="second_\1', text)
    body = second[second.index("<body") : second.index("</worldbody>")]
    tail = second[second.index("<equality>") : second.index("</mujoco>")]
    text = text.replace("</worldbody>", f"{body}</worldbody>")
    path.write_text(text.replace("</mujoco>", f"{tail}</mujoco>"))


def _new() -> Iterable[Refusal]:
    file = "3-rps.yaml"

    entry = partial(keyed, file)
    rows: Rows = [
        ("no-type", entry(type=GONE), ("type", "types")),
        ("count", entry(type="6-RPS"), ("6-RPS", "3", "6")),
        ("class", entry(type="3-PPS"), ("'PPS'",)),
        ("joints-size", entry(base_joints=[[1e300, 2, 3]] * 3), ("base_joints.0", "base_joints.2")),
        ("offsets-two", entry(offsets=[380, 380]), ("offsets", "2", "3")),
        ("no-offsets", entry(offsets=GONE), ("leg1", "offset")),
        ("travel", entry(travel=[150, 0]), ("travel", "150")),
        ("pipe", entry(radius={"pipe": 4}), ("radius", "pipe")),
        ("constant", entry(kinds="constant"), ("leg1", "constant")),
        ("axes", entry(base_axes=[[0, 0, 0]] * 3), ("base_axes.0", "not all zero")),
        ("home", entry(home={"xyz": [0, 0, 440]}), ("home",)),
        ("legs", entry(legs=["a", "a", "b"]), ("legs", "'a'")),
        ("one-point", entry(base_joints=[[1, 2, 3]] * 3), ()),
        ("millimetres", entry(offsets=0.38, travel=[0, 0.15]), ("leg1", "unit")),
        ("thin", entry(radius=0.014), ("leg1", "radius")),
        ("across", entry(base_axes=[[0, 1, 0.1], None, None]), ("leg1", "90 deg")),
    ]  # fmt: skip
    yield from _cases("table", f"new {{in}}/{file} -o {{out}}", rows, "tables")
    head, row = "type,base_x,base_y,platform_x,platform_y", "RPS,1,2,3,4"
    lines: list[tuple[str, str, str, tuple[str, ...]]] = [
        ("no-column", "type,base_x\nRPS,1\n", "--unit mm", ("'base_y'",)),
        ("no-unit", f"{head}\n{row}\n", "", ("--unit", "mm")),
        ("points-column", "point,x,y,zz\nB1,1,2,3\nP1,4,5,6\n", "--unit mm", ("'zz'", "'z'")),
        (
            "points",
            "point,x,y\nB1,1,2\nB2,a,2\nP1,4\nB1,4,5\nQQ,4,5\n",
            "--unit mm",
            ("line 3", "'a'", "line 4", "2 cells", "line 5", "'B1' twice", "line 6", "'QQ'"),
        ),
        ("units", f"{head},unit\n{row},mm\n{row},m\n", "", ("m and mm",)),
        ("travel", f"{head},travel_low\n{row},0\n{row},0\n", "--unit mm", ("travel",)),
        ("radii", f"{head},radius,rod\n{row},9,8\n", "--unit mm", ("line 2", "radius, tube, rod")),
        ("rods", f"{head}\nRSS,1,2,3,4\nRSS,4,2,5,1\n", "--unit mm --leg-radius 2",
         ("rods of type RSS", "no motors", "actuators", "servo-hexapod.yaml")),
        ("program", '#include <Servo.h>\n#define HORN 20\nfloat base[6][2] = {{1, 2}};\n',
         "--unit mm", ("source of a program", "--template", "servo-hexapod.yaml")),
    ]  # fmt: skip
    tables: Rows = [(name, (words, text("m.csv", rows)), said) for name, rows, words, said in lines]
    yield from _cases("csv", "new {in}/m.csv -o {out}", tables)
    workbooks: Rows = [
        (name, text("own.xls", start), ("workbook", "save the sheet as CSV"))
        for name, start in (("xlsx", b"PK\x03\x04none"), ("xls", b"\xd0\xcf\x11\xe0none"))
    ]
    yield from _cases("workbook", "new {in}/own.xls --unit mm -o {out}", workbooks)
    families: Rows = [
        ("6-sps", "6-SPS", ("--family 6-SPS", "--family hexapod --type SPS", "--template")),
        ("3-upu", "3-UPU", ("--family 3-UPU", "hexapod or delta", "--template")),
        ("nan", "hexapod --platform-radius nan", ("--platform-radius nan", "positive")),
        ("arm-length", "hexapod --arm-length 20", ("--arm-length", "--base-radius")),
        ("upx", "hexapod --type UPX", ("--type UPX", "with a slider")),
        ("min-length", "hexapod --min-length 600", ("--family hexapod", "min_length 600")),
        ("rods", "delta --rod-length 100", ("rods of 100 mm", "--rod-length")),
        ("height", "delta --height 374", ("--height 374", "negative")),
        ("thick", "delta --leg-radius 40", ("60 mm apart", "80 mm thick", "--leg-radius")),
    ]
    yield from _cases("family", "new --family {words} --unit mm -o {out}", families)
    units: Rows = [
        ("unit", "--unit inch", ("'inch'", "mm, um, nm, cm, m, in, ft")),
        ("no-unit", "--rod-length 400", ("--rod-length", "--unit mm")),
    ]
    yield from _cases("family", "new --family delta -o {out}", units)
    both: Rows = [
        ("both", "{in}/3-rps.yaml --family delta", ("--family",)),
        ("missing", "{in}/none.yaml", ("none.yaml",)),
        ("unit-of-two", "{in}/3-rps.yaml --unit m", ("--unit m", "'mm'")),
    ]
    yield from _cases("new", "new -o {out}", both, "tables")


def _described() -> Iterable[Refusal]:
    """Tables of machines that cannot be."""
    sps: dict[str, Any] = {"type": "SPS"}
    rod: dict[str, Any] = {"type": None, "types": ["SPU", "SPU", "SS"]}
    planar: dict[str, Any] = {"type": "3-RPR", "home": {"xyz": [0, 0, 440], "rpy_deg": [0, 0, 30]}}
    turned = {"xyz": [0, 0, 0], "rpy_deg": [0, 10, 0]}
    pairs: dict[str, Any] = {
        "base_joints": [[300, 0, 0], [300, 0, 0], [0, 300, 0]],
        "platform_joints": [[180, 0, 0], [180, 0, 0], [0, 180, 0]],
    }
    changes: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
        ("version-key", {"legcal_table": None, "version": 1},
         ("version could not", "unknown key", "add 'legcal_table: 1'")),
        ("type-digit", {"type": "²-RPS"}, ("type", "'²-RPS'")),
        ("one-leg", {"base_joints": [[1, 2, 3]]}, ("base_joints", "at least 2")),
        ("plane-of-arms",
         {"type": "3-RRR", "lengths": 150, "travel": None, "offsets": None, "home": turned,
          "actuators": {f"m{j}": {"point": [x, y, 0], "axis": [0, 0, 1], "travel_deg": [-60, 60]}
                        for j, (x, y) in enumerate([(-200, -115), (200, -115), (0, 231)])}},
         ("planar machine", "sliders along the legs")),
        ("frame-twice", {"base_frame": ["leg1", "leg1", "leg2"]},
         ("base_frame", "'leg1' more than once")),
        ("frame-two", {"base_frame": ["leg1", "leg2"]}, ("base_frame", "leg1, leg2", "needed 3")),
        ("no-xyz", {"home": {"rpy_deg": [0, 0, 0]}}, ("home.xyz",)),
        ("fixed-axis", {"type": "UP", "platform_axes": [[1, 0, 0]] * 3}, ("axis", "fixed")),
        ("two-points", pairs, ("'leg1' and 'leg2'", "same two points")),
        ("rod-length", rod | {"lengths": [None, 455, 455]}, ("lengths", "'leg2'")),
        # what does not fit together, once the machine is put together
        ("length-negative", {"offsets": -380}, ("length of -0.38 m", "offset")),
        ("no-home", {"offsets": 10, "travel": [0, 20], "home": None}, ("no home", "middle")),
        ("open-at-home", sps | {"offsets": 100}, ("'leg1'", "close at home", "100 to 250 mm")),
        ("passive-metres", sps | {"unit": "m", "kinds": "passive", "offsets": None, "travel": None},
         ("base joints",)),
        ("one-line", sps | {"base_joints": [[300, 0, 0], [0, 0, 0], [-300, 0, 0]]}, ("one line",)),
        ("axis-along", {"type": "UPS", "base_axes": [[-120, 0, 440], None, None]},
         ("'leg1'", "along the leg")),
        ("plane-home", planar | {"home": turned, "offsets": 50}, ("home",)),
    ]  # fmt: skip
    arms: dict[str, Any] = yaml.safe_load((ROOT / "models/tables/delta.yaml").read_text())
    below = {"xyz": [0, 0, -900], "rpy_deg": [0, 0, 0]}  # farther than its rods reach

    def arm1(**changes: Any) -> dict[str, Any]:
        motors = arms["actuators"]
        return {"actuators": motors | {"arm1": _without_none(motors["arm1"] | changes)}}

    of_motors: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
        ("no-axis", arm1(axis=None), ("actuators.arm1", "found point", "direction of a carriage")),
        ("travel-of-carriage", arm1(travel_deg=None, travel=[0, 1]),
         ("actuators.arm1", "found travel", "travel_deg")),
        ("radius-of-carriage",
         arm1(axis=None, point=None, travel_deg=None, direction=[1, 0, 0], travel=[0, 1],
              arm_radius=8),
         ("actuators.arm1", "arm_radius of a carriage")),
        ("slides", {"type": "6-PSS"}, ("'leg1'", "which turns", "begins with R")),
        ("no-motor-type", {"type": "6-SS"}, ("'leg1'", "the type SS", "begins with R (RSS)")),
        ("hangs-on", {"hangs_on": ["arm1"] * 4 + ["arm3", "arm9"]},
         ("'leg6'", "'arm9'", "mean 'arm3'")),
        ("arm-alone", {"hangs_on": ["arm1"] * 4 + ["arm3"] * 2}, ("actuators.arm2", "no leg")),
        ("no-length", {"lengths": None}, ("'leg1'", "no length")),
        ("point-on-axis", arm1(point=[320, 0, 0]),
         ("'leg1'", "on the axis of 'arm1'", "needed an arm")),
        ("home-below", {"home": below}, ("'leg5', 'leg6' 702.718 mm long", "400 mm there")),
        ("travel-at-home", arm1(travel_deg=[40, 70]), ("'arm1'", "20 and", "40 to 70 deg")),
        ("two-readings", arm1(travel_deg=[-180, 179]), ("'arm1'", "two readings", "not two")),
        ("reading-of-arm", {"home_readings": {"arm1": 1}}, ("home_readings.arm1", "no such carri")),
    ]  # fmt: skip
    for group, whole, of in (("tripod", TRIPOD, changes), ("arms", arms, of_motors)):
        rows: Rows = [
            (
                name,
                text("table.yaml", json.dumps(_without_none(whole | changed))),
                ("{in}/table.yaml", *named),
            )
            for name, changed, named in of
        ]
        yield from _cases(group, "new {in}/table.yaml -o {out}", rows)


def _without_none(entry: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if value is not None}


def _poses() -> Iterable[Refusal]:
    p = "hexapod.csv"
    rows: Rows = [
        ("angle", header(p, "qx", "rx"), ("'rx'",)),
        ("column", swap(p, "leg1_prismatic,", "quality,leg1_prismatic,"), ("'quality'",)),
        ("degrees", cell(p, 2, qx="90", qy="0", qz="0", qw="0"), ("90", "degrees")),
        ("two-poses", kept(p, 2), ("2", "3")),
    ]
    yield from _cases("poses", "locate hexapod {in}/hexapod.csv -o {out}", rows, "tool-poses")


def _results() -> Iterable[Refusal]:
    r = "result/result.json"

    document = partial(keyed, r)
    rows: Rows = [
        ("gone", remove(r), ("result.json",)),
        ("broken", text(r, "{"), ("result.json",)),
        ("other", document(legcal_result=GONE), ("legcal_result",)),
        ("covariance", document(covariance__0=[1.0]), ("covariance",)),
        ("asymmetric", document(covariance__0__1=1.0), ("covariance",)),
        ("kinematic", document(kinematic__covariance__0__1=1.0), ("kinematic",)),
        ("names", document(kinematic__names__0="leg9.base.x"), ()),
        ("value", _micrometre, ("leg2.base.x", "other values of leg")),
        ("held", document(kinematic__held=[[1.0], [1.0, 2.0]]), ("rows of other lengths",)),
        ("shared", document(residuals__shared_px={"bias of nothing": 0.1}), ("bias of nothing",)),
        ("model", remove("result/calibrated.yaml"), ("calibrated.yaml",)),
    ]
    yield from _cases("result", "calibrate {in}/set --check {in}/result", rows, "result")


def _scenes() -> Iterable[Refusal]:
    far = text("p.csv", f"{','.join(JOINTS)}\n{','.join(['0.5'] * 6)}\n")
    wide = keyed("camera_info.yaml", image_width=20000, image_height=20000)
    plans = (("cut", "{"), ("list", "[]"), ("empty", "{}"))
    of_inputs: list[tuple[str, str, Rows]] = [
        ("readings", "", [("travel", ("hexapod --poses {in}/p.csv", far), ("0.5",))]),
        ("plan", "", [(name, ("3-rpr --plan {in}", text("plan.json", content)),
                       ("found no plan.json in it that can be read",)) for name, content in plans]),
        ("scene", "plain", [("huge", ("hexapod --camera {in}/camera_info.yaml", wide),
                             ("20000 x 20000", "100000000"))]),
        ("scene", "", [("board", ("hexapod --board {in}/b.yaml", text("b.yaml", "a: 1")),
                        ("board",))]),
        ("scene", "model", [("invisible", ("{in}/models/hexapod.yaml", _without_visuals),
                             ("cylinder",))]),
    ]  # fmt: skip
    for group, given, rows in of_inputs:
        level = "--level outlines" if group == "plan" else "--level outlines --poses 1"
        yield from _cases(group, f"simulate -o {{out}} {level}", rows, given)


def _micrometre(folder: Path) -> None:
    path = folder / "result/result.json"
    content = json.loads(path.read_text())
    content["parameters"][0]["value"] += 1e-6
    path.write_text(json.dumps(content))


def _exports() -> Iterable[Refusal]:
    """Formats that a class does not have, and places and options that cannot be used."""
    those = "this machine has table, csv, json, urdf"
    rows: Rows = [
        ("rod", "hexapod-rod --to linuxcnc -o {out}", ("leg6", those)),
        ("model", "hexapod --to correction -o {out}", ("needed a result", those)),
        ("rails", "hexaglide --to linuxcnc -o {out}", ("'rail1' moves joints at A",)),
        ("prs", "3-prs --to reprapfirmware -o {out}", ("found 3 rods on them, needed a Delta",)),
        ("arms", "delta --to marlin -o {out}", ("motors that turn", "three linear motors")),
        ("folder", "hexapod --to table -o {in}", ("a folder",)),
        ("nodes", "hexapod --to urdf --nodes 3 -o {out}", ("correction",)),
        ("matlab", "hexapod --to matlab -o 1-a.m", ("m_1_a.m",)),
        ("no-result", "no/result.json --to csv -o {out}", ("result",)),
    ]
    yield from _cases("export", "export", rows)
    there: Rows = [
        ("taken", ("table -o {in}/a.txt", text("a.txt", "mine")), ("--force",)),
        ("ros", ("ros -o {in}/ros", text("ros/calibration.yaml", "mine")), ("--force",)),
    ]
    yield from _cases("export", "export hexapod --to", there)
    of_result: Rows = [
        ("few-nodes", "correction --nodes 1 -o {out}", ("found 1", "needed 2 to")),
        ("itself", "json -o {in}/result/result.json --force", ("which is exported",)),
    ]
    yield from _cases("export", "export {in}/result --to", of_result, "result")


def _without_visuals(folder: Path) -> None:
    path = folder / "urdf/hexapod.urdf"
    path.write_text(re.sub(r"<visual>.*?</visual>", "", path.read_text(), flags=re.DOTALL))


REFUSALS: tuple[Refusal, ...] = (
    *_use(),
    *_options(),
    *_datasets(),
    *_in_hand(),
    *_measurements(),
    *_units(),
    *_cameras(),
    *_tables(),
    *_landmarks(),
    *_overrides(),
    *_models(),
    *_outside(),
    *_formats(),
    *_new(),
    *_described(),
    *_poses(),
    *_results(),
    *_exports(),
    *_scenes(),
)
