"""Data flows down the layers and never up, and the method cannot see the simulated truth."""

import ast
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LAYERS = (
    "geometry",
    "files",
    "mechanism",
    "authoring",
    "vision",
    "observations",
    "detection",
    "recognition",
    "photographs",
    "closer_look",
    "image_notes",
    "examining",
    "dataset",
    "camera_calibration",
    "stages",
    "refinement",
    "identify",
    "calibration",
    "repeatability",
    "report",
    "location",
    "overlays",
    "workpiece",
    "board_views",
    "detecting",
    "starting",
    "disagreeing",
    "fitting",
    "pipeline",
    "checking",
    "cli",
)
SIMULATED = {"simulation", "studies"}  # what knows the truth


@cache
def _modules() -> dict[str, Path]:
    found = {}
    for path in (ROOT / "legcal").rglob("*.py"):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def _imports(module: str) -> frozenset[str]:
    """Return the modules of the package that a module names in an import, wherever it stands."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(_modules()[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    # The root only hands out public names; every import passes through it.
    return frozenset(names & _modules().keys() - {"legcal", module})


def _reachable(module: str) -> set[str]:
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        for name in _imports(waiting.pop()) - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def _unit(module: str) -> str:
    return module.split(".")[1] if "." in module else module


def test_every_part_of_the_package_has_its_place() -> None:
    outside = {
        "legcal",
        "__main__",
        "errors",
        "processors",
        "progress",
        "signals",
        "version",
        "workers",
    }
    assert {_unit(module) for module in _modules()} == outside | set(LAYERS) | SIMULATED


def test_no_module_imports_itself_in_a_circle() -> None:
    circles = [module for module in _modules() if module in _reachable(module)]
    assert circles == []


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_reaches_only_layers_below_it(layer: str) -> None:
    above = set(LAYERS[LAYERS.index(layer) + 1 :])
    modules = [module for module in _modules() if _unit(module) == layer]
    assert modules, f"the layer {layer} has no module"
    up = {(m, other) for m in modules for other in _reachable(m) if _unit(other) in above}
    assert up == set()


def test_steps_and_fit_do_not_know_each_other() -> None:
    for here, there in (("stages", "refinement"), ("refinement", "stages")):
        modules = [module for module in _modules() if _unit(module) == here]
        assert not {other for m in modules for other in _reachable(m) if _unit(other) == there}


def test_geometry_knows_no_robot_and_no_camera() -> None:
    modules = [module for module in _modules() if _unit(module) == "geometry"]
    units = {_unit(other) for module in modules for other in _reachable(module)}
    assert units <= {"geometry"}


def test_no_module_of_the_method_imports_the_simulation() -> None:
    method = set(LAYERS) - {"cli"}
    users = {
        module
        for module in _modules()
        if _unit(module) in method
        and any(_unit(other) in SIMULATED for other in _reachable(module))
    }
    assert users == set()


def test_the_simulation_does_not_reach_the_method() -> None:
    method = {"detection", "stages", "refinement", "identify", "calibration", "repeatability"}
    modules = [module for module in _modules() if _unit(module) == "simulation"]
    assert modules
    reached = {(m, other) for m in modules for other in _reachable(m) if _unit(other) in method}
    assert reached == set()


def test_the_simulation_takes_only_cameras_and_tables_from_what_observes() -> None:
    cameras = {f"vision.{name}" for name in ("camera", "camera_file", "camera_writer")}
    boards = {f"vision.board{name}" for name in ("", "_dictionaries", "_objects")}
    tables = {"measurements", "outlines", "table", "axes_file", "corners", "corners_file"}
    allowed = cameras | boards | {f"observations.{name}" for name in tables}
    modules = [module for module in _modules() if _unit(module) == "simulation"]
    taken = {
        (module, other)
        for module in modules
        for other in _imports(module)
        if _unit(other) in {"vision", "observations"}
        and other.removeprefix("legcal.") not in allowed
    }
    assert taken == set()


def test_no_module_names_the_true_model_of_the_example() -> None:
    users = [m for m, path in _modules().items() if "hexapod-truth" in path.read_text()]
    assert users == []
