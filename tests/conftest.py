"""What several test files share."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import tempfile
from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import process_settings  # noqa: F401
import pytest
from xdist.scheduler import LoadScopeScheduling

# What takes long to load is loaded where it is used: the process that only hands out tests waits.
if TYPE_CHECKING:
    from hexapod_example import Run

    from legcal.machine.model import Machine
    from legcal.machine.spanning_tree import Source

# Plugins that other packages bring into Hypothesis (trio's, with selenium) warn when they load.
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Load modules without searches for dead cycles: none of what they make is dead."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Let one process run what shares fixtures: a file; all files about the example's result."""

    def scope_of(nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        if "test_recorded_sessions" in file and "example" not in nodeid:
            return nodeid
        return "example" if _is_about_the_example(config.rootpath / file) else file

    scheduler = LoadScopeScheduling(config, log)
    scheduler._split_scope = scope_of
    return scheduler


@cache
def _is_about_the_example(path: Path) -> bool:
    return "example_run" in path.read_text(encoding="utf-8")


@pytest.fixture(scope="session", autouse=True)
def _temporary_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Have temporary folders, also of other processes, made where pytest deletes them."""
    folder = str(tmp_path_factory.mktemp("temporary"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", folder)
        patch.setenv("TMPDIR", folder)
        yield


@pytest.fixture(scope="session", autouse=True)
def _sessions_are_simulated_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Share what is simulated among all processes that run tests."""
    from simulated import keep_simulated

    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    keep_simulated(shared / "simulated")


@pytest.fixture
def answered_signals() -> Iterator[None]:
    """Answer signals as Python does, also where the tests were started with them ignored."""
    handlers: dict[signal.Signals, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session", autouse=True)
def _models_are_read_once() -> Iterator[None]:
    """Make machines and sample their workspaces once a process."""
    from legcal.machine import configurations, loader

    load = loader._load
    machines: dict[tuple[str, ...], Machine] = {}

    def load_once(source: Source) -> Machine:
        if source.block is None or source.notes or source.poses is not None:
            return load(source)
        stated = repr((source.closures, source.motors, source.block, source.leg_radius))
        key = (source.path.name, source.urdf.path.name, stated, source.urdf.text)
        if key not in machines:
            machines[key] = load(source)
        found = machines[key]
        urdf = replace(found.urdf, path=source.urdf.path)
        return replace(found, yaml_path=source.path, urdf_path=urdf.path, urdf=urdf)

    draw = configurations.random_poses
    workspaces: dict[bytes, tuple[Any, Any]] = {}

    def draw_once(machine: Machine, n: int, seed: Any) -> tuple[Any, Any]:
        """Return the sample of the workspace of a machine with these legs, the same every time."""
        if not isinstance(seed, int):  # a generator, which goes on from draw to draw
            return draw(machine, n, seed)
        key = pickle.dumps((machine.urdf.content, machine.legs, machine.home.as_matrix(), n, seed))
        if key not in workspaces:
            workspaces[key] = draw(machine, n, seed)
        readings, poses = workspaces[key]
        return readings.copy(), list(poses)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(configurations, "random_poses", draw_once)
        patch.setattr(loader, "_load", load_once)
        yield


@pytest.fixture(scope="module")
def without_steps() -> Iterator[None]:
    """Calibrate without the four steps: half of the time where the cameras are given."""
    from legcal.calibration.four_steps import Steps

    left_out = Steps(None, None, "They were left out.")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("legcal.calibration.estimate.four_steps", lambda *_: left_out)
        yield


@pytest.fixture
def without_remedies() -> Iterator[None]:
    """Refuse what is not identifiable without trying what would mend it, which takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        name = "legcal.calibration.identify.identifiability.find_remedies"
        patch.setattr(name, lambda *_: ())
        yield


@pytest.fixture(scope="session")
def example_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Calibrate a copy of the example once for all tests that look at the result."""
    from hexapod_example import Run, copy_of_the_example

    from legcal import calibrate

    folder = copy_of_the_example(tmp_path_factory.mktemp("example") / "hexapod")
    output = folder.parent / "calibrated"
    stages: list[str] = []
    calibration = calibrate(
        folder, output=output, progress=lambda stage, done, total: stages.append(stage)
    )
    return Run(folder, output, calibration, tuple(dict.fromkeys(stages)))
