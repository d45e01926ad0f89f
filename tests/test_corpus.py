"""Every robot of example-robot-data is refused in one sentence: none is a parallel robot."""

from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import pytest

from legcal import load_mechanism
from legcal.errors import LegcalError


def _corpus() -> list[Path]:
    try:
        found = files("example-robot-data") or []
    except PackageNotFoundError:
        return []
    return sorted(Path(str(f.locate())) for f in found if f.suffix == ".urdf")


@pytest.mark.corpus
def test_every_robot_of_the_corpus_is_refused_in_one_sentence() -> None:
    robots = _corpus()
    if not robots:
        pytest.skip("example-robot-data is not installed: pip install 'legcal[corpus]'")
    for robot in robots:
        with pytest.raises(LegcalError) as refusal:
            load_mechanism(robot)
        for problem in refusal.value.problems:
            assert "\n" not in problem, robot.name
            assert robot.name in problem, robot.name
