"""What several cases start from: simulated datasets and small files, each made once a process."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from command_outcomes import run
from dataset_folder import small_folder
from model_formats import write_format
from scipy.spatial.transform import Rotation
from simulated import simulated

from legcal.machine.loader import load_mechanism

ROOT = Path(__file__).resolve().parents[1]
SIMULATED = ("3-rpr-outlines", "hexapod-outlines")  # by machine and level


@cache
def _top() -> Path:
    return Path(tempfile.mkdtemp(prefix="legcal-inputs-"))


def remove_inputs() -> None:
    """Delete all that was made."""
    shutil.rmtree(_top(), ignore_errors=True)
    for made in (_top, made_input):
        made.cache_clear()


@cache
def made_input(name: str) -> Path:
    """Return the folder of an input; nobody may change it: take a copy."""
    folder = _top() / name
    if name in SIMULATED:
        machine, _, level = name.rpartition("-")
        simulated(folder, machine, views=3, level=level, seed=3, poses=8)
    else:
        folder.mkdir()
        MAKERS[name](folder)
    return folder


def copy_of(name: str, folder: Path) -> Path:
    """Copy an input into a new folder."""
    return Path(shutil.copytree(made_input(name), folder))


def _plain(folder: Path) -> None:
    """Write two views with two small pictures of nothing each, of the shipped hexapod."""
    made = small_folder(folder)
    made.entry["mechanism"] = "hexapod"
    made.write()


def _model(folder: Path) -> None:
    """Copy the files of the shipped hexapod."""
    for name in ("models/hexapod.yaml", "urdf/hexapod.urdf"):
        (folder / name).parent.mkdir()
        shutil.copy(ROOT / name, folder / name)


def _delta(folder: Path) -> None:
    """Copy the files of the shipped Delta beside each other."""
    model = (ROOT / "models/delta.yaml").read_text()
    (folder / "delta.yaml").write_text(model.replace("../urdf/", ""))
    shutil.copy(ROOT / "urdf/delta.urdf", folder)


def _tables(folder: Path) -> None:
    """Copy the tables of all shipped models, and write one as CSV."""
    for path in (ROOT / "models/tables").glob("[!.]*"):
        shutil.copy(path, folder)
    (folder / "tripod.csv").write_text(
        "type,base_x,base_y,platform_x,platform_y,platform_z,offset,travel_low,travel_high,tube\n"
        "UPU,300,0,180,0,0,385,0,140,14\n"
        "UPU,-150,259.81,-90,155.88,0,385,0,140,14\n"
        "UPU,-150,-259.81,-90,-155.88,0,385,0,140,14\n"
    )


def _tool_poses(folder: Path) -> None:
    """Measure a tool at the poses of a simulated hexapod, with known noise."""
    source = made_input("hexapod-outlines")
    shutil.copytree(source / "truth", folder / "hexapod")
    truth = json.loads((source / "truth/truth.json").read_text())
    rows = _measured(list(truth["poses"].values()), np.random.default_rng(1))
    header = [*rows[0]]
    text = "".join(",".join(row[name] for name in header) + "\n" for row in rows)
    (folder / "hexapod.csv").write_text(",".join(header) + "\n" + text)


def _measured(poses: list[dict[str, Any]], chance: np.random.Generator) -> list[dict[str, str]]:
    """Return the rows of a table of tool poses: 0.02 mm and 0.01 deg of noise a component."""
    base_R = Rotation.from_euler("xyz", [10.0, -20.0, 130.0], degrees=True)
    base_t = np.array([1.2, -0.4, 0.8])
    tool_R = Rotation.from_euler("xyz", [5.0, 8.0, -30.0], degrees=True)
    tool_t = np.array([0.02, -0.03, 0.11])
    rows = []
    for pose in poses:
        R = Rotation.from_quat(pose["T_base_platform"]["quat_xyzw"])
        t = np.array(pose["T_base_platform"]["xyz"])
        noise = Rotation.from_rotvec(np.radians(0.01) * chance.normal(size=3))
        place = base_R.apply(R.apply(tool_t) + t) + base_t + 2e-5 * chance.normal(size=3)
        quaternion = (noise * base_R * R * tool_R).as_quat()
        readings = {k: repr(v) for k, v in pose["joints"].items() if k.endswith("_prismatic")}
        cells = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*place, *quaternion], strict=True)
        rows.append(readings | {name: repr(float(value)) for name, value in cells})
    return rows


def _result(folder: Path) -> None:
    """Calibrate a 3-RPR, and take new images of the same machine for a check."""
    shutil.copytree(made_input("3-rpr-outlines"), folder / "set")
    words = ["calibrate", str(folder / "set"), "-o", str(folder / "result"), "--no-report"]
    assert run(words).code == 0


def _formats(folder: Path) -> None:
    """Write machines in the formats of others: a hexapod, and a 3-RPR in MJCF."""
    entry = yaml.safe_load((ROOT / "models/hexapod.yaml").read_text())
    urdf = (ROOT / "urdf/hexapod.urdf").read_text()
    del entry["legcal"]
    (folder / "gepetto").mkdir()
    (folder / "gepetto/robot.yaml").write_text(yaml.safe_dump(entry))
    (folder / "gepetto/robot.urdf").write_text(urdf)
    (folder / "bare.yaml").write_text(yaml.safe_dump(entry))
    (folder / "bare.urdf").write_text(urdf)
    loops = "".join(
        f'<loop_joint name="loop{k}" type="spherical"><link1 link="{one}"/>'
        f'<link2 link="{other}"/></loop_joint>'
        for k, (one, other) in enumerate(entry["closed_loop"])
    )
    (folder / "loops.urdf").write_text(urdf.replace("</robot>", f"{loops}</robot>"))
    (folder / "planar.xml").write_text(_planar_mjcf())


def _planar_mjcf() -> str:
    """Return three legs from a circle of 0.4 m to one of 0.14 m, at readings of zero."""
    bodies, ties, motors = "", "", ""
    for j, angle in enumerate((0.3, 2.4, 4.5)):
        A = 0.4 * np.array([math.cos(angle), math.sin(angle)])
        B = 0.14 * np.array([math.cos(angle + 0.6), math.sin(angle + 0.6)])
        length, turn = np.linalg.norm(B - A), math.atan2(*(B - A)[::-1])
        bodies += (
            f'<body name="tube{j}" pos="{A[0]:.12f} {A[1]:.12f} 0" euler="0 0 {turn:.12f}">'
            f'<joint name="a{j}" axis="0 0 1"/>'
            f'<body name="rod{j}"><joint name="q{j}" type="slide" axis="1 0 0" range="-0.1 0.1"/>'
            f'<geom type="cylinder" size="0.01" fromto="0.1 0 0 0.2 0 0"/>'
            f'<body name="end{j}" pos="{length:.12f} 0 0"><joint name="b{j}" axis="0 0 1"/></body>'
            "</body></body>"
        )
        ties += f'<weld body1="end{j}" body2="platform"/>'
        motors += f'<position joint="q{j}"/>'
    platform = '<body name="platform"><freejoint name="free"/></body>'
    return (
        '<mujoco model="planar"><compiler angle="radian"/>'
        f"<worldbody>{bodies}{platform}</worldbody><equality>{ties}</equality>"
        f"<actuator>{motors}</actuator></mujoco>"
    )


def _written(style: str) -> Callable[[Path], None]:
    """Write the shipped hexapod in the format of another program."""

    def write(folder: Path) -> None:
        write_format(load_mechanism("hexapod"), style, folder)

    return write


MAKERS: dict[str, Callable[[Path], None]] = {
    "plain": _plain,
    "model": _model,
    "delta": _delta,
    "tables": _tables,
    "tool-poses": _tool_poses,
    "result": _result,
    "formats": _formats,
    **{style: _written(style) for style in ("mjcf bodies", "loop_joint", "gepetto")},
}
