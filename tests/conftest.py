"""What several test files share."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import one_thread  # noqa: F401
import pytest
from hexapod_example import Run, copy_of_the_example

from legcal import calibrate
from legcal.machine import Machine, loader
from legcal.machine.files import find_model
from legcal.machine.spanning_tree import Source

# Plugins that other packages bring into Hypothesis (trio's, with selenium) warn when they load.
os.environ.setdefault("HYPOTHESIS_NO_PLUGINS", "1")

LEFT = ("observations.csv", ".legcal-cache.json")  # beside a dataset, for the next run
STAGES = "stages.txt"


@pytest.fixture(scope="session", autouse=True)
def _shipped_models_are_loaded_once() -> Iterator[None]:
    """Load each shipped model once a process: hundreds of tests start with one."""
    folder, load = find_model("hexapod").parent, loader._load
    machines: dict[tuple[Path, str, str], Machine] = {}

    def loaded(source: Source) -> Machine:
        if source.path.parent != folder:
            return load(source)
        key = (source.path, source.file.model_dump_json(), source.urdf.text)
        if key not in machines:
            machines[key] = load(source)
        return machines[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loader, "_load", loaded)
        yield


@pytest.fixture(scope="session")
def example_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Calibrate a copy of the example once for all tests that look at the result.

    Of several processes that run tests, those that come later take the outlines of the first.
    """
    folder = copy_of_the_example(tmp_path_factory.mktemp("example") / "hexapod")
    output = folder.parent / "calibrated"
    shared = _shared(tmp_path_factory)
    stages: list[str] = []
    earlier = shared is not None and shared.exists()
    if shared is not None and earlier:
        for name in LEFT:
            shutil.copy(shared / name, folder)
    calibration = calibrate(
        folder, output=output, progress=lambda stage, done, total: stages.append(stage)
    )
    if shared is not None and earlier:
        stages = (shared / STAGES).read_text().splitlines()
    elif shared is not None:
        _leave(folder, stages, shared)
    return Run(folder, output, calibration, tuple(dict.fromkeys(stages)))


def _shared(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """Return where the processes of one run of the tests find the example; None of a single one."""
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID")
    return None if run is None else tmp_path_factory.getbasetemp().parent / f"example-{run}"


def _leave(folder: Path, stages: list[str], shared: Path) -> None:
    """Leave the outlines to other processes, all at once."""
    part = folder.parent / "shared"
    part.mkdir()
    for name in LEFT:
        shutil.copy(folder / name, part)
    (part / STAGES).write_text("\n".join(dict.fromkeys(stages)))
    try:
        part.rename(shared)
    except OSError:  # another process was faster
        shutil.rmtree(part)
