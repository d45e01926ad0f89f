"""Data flows down the rooms and never up, and the method cannot see the simulated truth."""

import ast
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
BESIDE = "simulation"  # it knows the truth
# The rooms, from below to above, and the modules of each that other rooms use; all others are its
# own affair.
LISTED = """
geometry: covariances lines motions tables types
files: folder motions quantity schema table
pages: document svg
machine: actuator closing configurations equations files home inspection
    kinematics leg loader meshes model model_writer parameters picture redundancy rods shapes
    solver spanning_tree ties tolerance urdf
descriptions: controllers firmware new_model
vision: board camera camera_file cylinder distortion image_file point_pose visibility
data: cache corners dataset dataset_file image_choice image_tables landmarks measurements
    new_dataset outlines photograph_matching photograph_notes reading_units readings_sheet
    reasons
recordings: frames importing
estimation: clusters loss problem solver uncertainty variances
perception: agreement alignment board_adjustment board_corners body_edges camera_search
    candidate_pairs diagnostics free_poses image_quality outline overlays photographs placement
paper: conditions criteria four_steps unknowns
calibration: camera_calibration.calibration camera_calibration.document
    camera_calibration.projection detection doctor documents evaluation identify.identifiability
    identify.report joint_fit.outline_errors joint_fit.parameter_choices joint_fit.part_errors
    joint_fit.platform joint_fit.predicted joint_fit.sensitivity joint_fit.variables
    location.document location.locate location.tool_poses ordered_dataset pipeline result
    result_folder summary verification
planning: places request session shooting
exports: formats subject
report: calibration calibration_page machine plan render scene session
viewer: click_server server shooting source view_server
cli:
simulation: dataset observe paper session settings
"""
PUBLIC = {
    room: set(modules.split()) for room, modules in re.findall(r"^(\w+):([^:]*)$", LISTED, re.M)
}
ROOMS = tuple(room for room in PUBLIC if room != BESIDE)
OUTSIDE = {
    "__main__",
    "arguments",
    "brief",
    "errors",
    "progress",
    "signals",
    "version",
    "workers",
}


@cache
def _modules() -> dict[str, Path]:
    found = {}
    for path in (ROOT / "legcal").rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def _statements(module: str) -> list[ast.Import | ast.ImportFrom]:
    """Return what a module says to import, wherever it says so."""
    found, waiting = [], [ast.parse(_modules()[module].read_text())]  # no expression imports
    while waiting:
        node: Any = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            found.append(node)
        for block in ("body", "handlers", "orelse", "finalbody", "cases"):
            waiting += getattr(node, block, [])
    return found


@cache
def _imports(module: str) -> frozenset[str]:
    """Return the modules that a module imports from."""
    names: set[str] = set()
    for node in _statements(module):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif node.module in _modules():
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                names.add(name if name in _modules() else node.module)
    return frozenset(names & _modules().keys() - {"legcal", module})


@cache
def _reachable(module: str) -> frozenset[str]:
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        for name in _imports(waiting.pop()) - seen:
            seen.add(name)
            waiting.append(name)
    return frozenset(seen)


def _room(module: str) -> str:
    return module.split(".")[1] if "." in module else module


def _of(*rooms: str) -> list[str]:
    return [module for module in _modules() if _room(module) in rooms]


def test_every_module_is_in_a_room() -> None:
    assert {_room(module) for module in _modules()} == {"legcal", BESIDE, *OUTSIDE, *ROOMS}


def test_no_module_imports_itself_in_a_circle() -> None:
    assert [module for module in _modules() if module in _reachable(module)] == []


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_reaches_only_rooms_below_it(room: str) -> None:
    above = set(ROOMS[ROOMS.index(room) + 1 :])
    up = {(m, other) for m in _of(room) for other in _reachable(m) if _room(other) in above}
    assert up == set()


@pytest.mark.parametrize("room", [*ROOMS, BESIDE])
def test_other_rooms_use_only_public_modules_of_a_room(room: str) -> None:
    """What a room offers is listed; a module that nobody outside uses any more leaves the list."""
    used = {
        other.removeprefix(f"legcal.{room}.")
        for module in _modules()
        if _room(module) != room
        for other in _imports(module)
        if _room(other) == room
    }
    assert used - {f"legcal.{room}"} == PUBLIC[room]


def test_four_steps_and_joint_fit_do_not_know_each_other() -> None:
    rooms = ("legcal.paper", "legcal.estimation"), ("legcal.paper", "legcal.calibration.joint_fit")
    for pair in rooms:
        for here, there in (pair, pair[::-1]):
            of_here = [m for m in _modules() if f"{m}.".startswith(f"{here}.")]
            assert of_here
            assert not {
                o for m in of_here for o in _reachable(m) if f"{o}.".startswith(f"{there}.")
            }


def test_estimation_knows_no_images_and_no_robot() -> None:
    assert {_room(other) for m in _of("estimation") for other in _reachable(m)} <= {
        "errors",
        "files",
        "geometry",
        "estimation",
        "signals",
    }


def test_only_the_command_line_imports_the_simulation() -> None:
    method = set(ROOMS) - {"cli"}
    users = {m for m in _of(*method) if any(_room(o) == BESIDE for o in _reachable(m))}
    assert users == set()


def test_the_simulation_reaches_neither_report_nor_command_line() -> None:
    reached = {(m, o) for m in _of(BESIDE) for o in _reachable(m) if _room(o) in {"report", "cli"}}
    assert reached == set()


def test_no_module_names_the_true_model_of_the_example() -> None:
    users = [m for m, path in _modules().items() if "hexapod-truth" in path.read_text()]
    assert users == []
