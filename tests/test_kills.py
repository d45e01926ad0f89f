"""Commands that are stopped at any moment leave a whole result or none, and can go on."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzzing.kills import QUICK, Kill, drawn_kills, faults_of, remove_finished

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/environ").exists(), reason="looks at processes in /proc"
)
PER_TEST = 15  # undisturbed runs, which tests in several processes repeat, take as long


@pytest.fixture(scope="module", autouse=True)
def _removed() -> Iterator[None]:
    yield
    remove_finished()


def _faults(kills: list[Kill]) -> list[str]:
    return [f"{kill}: {fault}" for kill in kills for fault in faults_of(kill)]


def test_twelve_kills_leave_no_half_result() -> None:
    assert _faults(drawn_kills(12, 0, QUICK)) == []


@pytest.mark.system
@pytest.mark.parametrize("part", range(4))
def test_sixty_kills_of_all_commands_lose_and_falsify_nothing(part: int) -> None:
    assert _faults(drawn_kills(4 * PER_TEST, 1)[part::4]) == []
