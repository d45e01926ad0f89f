"""Damaged files of every kind that is read: refused in a sentence, or used; never anything else."""

import pytest
from fuzzing.crafted import harmful_files, special_files
from fuzzing.running import count_cases, drawn_cases, run_cases

PARTS = 4


@pytest.mark.parametrize("part", range(PARTS))
def test_mutated_files_are_used_or_refused_in_time_and_memory(part: int) -> None:
    cases = drawn_cases(2000, seed=0, deep_share=0.0)[part::PARTS]
    count = count_cases(cases)
    assert count.n_cases == len(cases)
    assert not count.faults, [(ended.case.name, ended.fault) for ended in count.faults]
    assert min(count.codes["0"], count.codes["2"]) > 0


def test_files_made_to_do_harm_are_refused_in_time_and_memory() -> None:
    names, cases, words = zip(*harmful_files(), strict=True)
    found = [
        (name, ended.code, ended.fault, ended.message[:200])
        for name, word, ended in zip(names, words, run_cases(cases), strict=True)
        if ended.fault or ended.code not in (1, 2) or word not in ended.message
    ]
    assert not found


def test_pipes_devices_and_folders_are_never_read() -> None:
    names, cases = zip(*special_files(), strict=True)
    found = [
        (name, ended.fault)
        for name, ended in zip(names, run_cases(cases), strict=True)
        if ended.fault
    ]
    assert not found
