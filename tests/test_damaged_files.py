"""Damaged files of every kind that is read: refused in a sentence, or used; never anything else."""

import pytest
from fuzzing.running import count_cases, drawn_cases

PARTS = 4


@pytest.mark.parametrize("part", range(PARTS))
def test_mutated_files_are_used_or_refused_in_time_and_memory(part: int) -> None:
    cases = drawn_cases(2000, seed=0, deep_share=0.0)[part::PARTS]
    count = count_cases(cases)
    assert count.n_cases == len(cases)
    assert not count.faults, [(ended.case.name, ended.fault) for ended in count.faults]
    assert min(count.codes["0"], count.codes["2"]) > 0
