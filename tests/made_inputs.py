"""What refusals and damaged files start from, each made once a process."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from command_line import run
from dataset_folder import small_folder
from located import located, write_poses
from machines import copied_model
from model_formats import write_format
from simulated import simulated

from legcal.machine.loader import load_mechanism

ROOT = Path(__file__).resolve().parents[1]
REDUNDANT = ROOT / "tests/data/recorded/redundant"


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
    if name == "3-rpr-outlines":
        simulated(folder, "3-rpr", views=3, seed=3, poses=8)
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


def _with_motors(folder: Path) -> None:
    """Copy the files of shipped machines whose joints at A move."""
    for name in ("delta", "3-prs"):
        model = (ROOT / f"models/{name}.yaml").read_text()
        (folder / f"{name}.yaml").write_text(model.replace("../urdf/", ""))
        shutil.copy(ROOT / f"urdf/{name}.urdf", folder)


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


def _result(folder: Path) -> None:
    """Calibrate a 3-RPR, and take new images of the same machine for a check."""
    shutil.copytree(made_input("3-rpr-outlines"), folder / "set")
    words = ("calibrate", folder / "set", "-o", folder / "result", "--no-report")
    assert run(*words).code == 0


def _written(style: str, folder: Path) -> None:
    """Write the shipped hexapod in the format of another program."""
    write_format(load_mechanism("hexapod"), style, folder)


MAKERS: dict[str, Callable[[Path], object]] = {
    "plain": _plain,
    "model": lambda folder: copied_model(folder, "hexapod"),
    "motors": _with_motors,
    "redundant": lambda folder: shutil.copytree(REDUNDANT, folder, dirs_exist_ok=True),
    "tables": _tables,
    "tool-poses": lambda folder: write_poses(folder / "hexapod.csv", located("hexapod", 24)),
    "result": _result,
    **{style: partial(_written, style) for style in ("mjcf", "loop_joint", "gepetto")},
}
