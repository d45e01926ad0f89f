"""Data flows down the rooms and never up, and the method cannot see the simulated truth."""

import ast
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = (
    "geometry",
    "files",
    "pages",
    "machine",
    "vision",
    "data",
    "recordings",
    "estimation",
    "perception",
    "paper",
    "calibration",
    "planning",
    "exports",
    "scene",
    "report",
    "viewer",
    "cli",
)
BESIDE = "simulation"  # it knows the truth
OUTSIDE = {
    "__main__",
    "brief",
    "cluster",
    "errors",
    "figures",
    "option_fields",
    "processors",
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
def _handed_out(facade: str) -> dict[str, str]:
    """Return which module each name of a façade comes from, seen through façades within it."""
    path = _modules()[facade].with_suffix(".pyi")
    if not path.exists():
        return {}
    found: dict[str, str] = {}
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ImportFrom):
            module = f"{facade}.{node.module}"
            inner = _handed_out(module) if module in _modules() else {}
            found |= {alias.name: inner.get(alias.name, module) for alias in node.names}
    return found


@cache
def _imports(module: str) -> frozenset[str]:
    """Return the modules that a module imports from, seen through façades."""
    names: set[str] = set()
    for node in _statements(module):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif node.module in _modules():
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                names.add(
                    name
                    if name in _modules()
                    else _handed_out(node.module).get(alias.name, node.module)
                )
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


def test_rooms_are_used_through_their_facades() -> None:
    rooms = {*ROOMS, BESIDE}
    past = set()
    for module in _of(*rooms, *OUTSIDE):
        for node in _statements(module):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [node.module or "", *(name for name in whole if name in _modules())]
            past |= {
                (module, name)
                for name in names
                if name.startswith("legcal.")
                and name.count(".") > 1
                and _room(name) in rooms - {_room(module)}
            }
    assert past == set()


@pytest.mark.parametrize("room", [*ROOMS, BESIDE])
def test_a_facade_hands_out_what_its_modules_define(room: str) -> None:
    handed_out = _handed_out(f"legcal.{room}")
    assert set(handed_out.values()) <= _modules().keys()
    submodules = {module.split(".")[2] for module in _of(room) if module.count(".") > 1}
    assert not handed_out.keys() & submodules  # a module would hide the name


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


def test_geometry_knows_no_robot_and_no_camera() -> None:
    assert {_room(other) for m in _of("geometry") for other in _reachable(m)} <= {
        "errors",
        "files",
        "geometry",
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
