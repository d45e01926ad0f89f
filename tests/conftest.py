"""What several test files share."""

import one_thread  # noqa: F401
import pytest
from hexapod_example import Run, copy_of_the_example

from legcal import calibrate


@pytest.fixture(scope="session")
def example_run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Calibrate a copy of the example once for all tests that look at the result."""
    folder = copy_of_the_example(tmp_path_factory.mktemp("example") / "hexapod")
    output = folder.parent / "calibrated"
    stages: list[str] = []
    calibration = calibrate(
        folder, output=output, progress=lambda stage, done, total: stages.append(stage)
    )
    return Run(folder, output, calibration, tuple(dict.fromkeys(stages)))
