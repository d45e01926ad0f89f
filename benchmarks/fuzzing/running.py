"""Commands on damaged files, in child processes that may take so much time and memory.

The rule: a command ends by itself with 0, 1 or 2, in 5 s of work on a usual machine and 1 GB of
memory beyond what it starts with; a refusal leaves nothing behind, and what it prints is clean text
of bounded length.
"""

from __future__ import annotations

import gc
import json
import os
import re
import resource
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from unittest.mock import patch

import numpy as np
import yaml
from command_line import Outcome, run, words_of
from made_inputs import made_input

from fuzzing.mutations import mutate
from fuzzing.subjects import SUBJECTS, Subject
from legcal.machine import loader
from legcal.machine.files import find_model
from legcal.machine.formats import read_source
from legcal.machine.model import Machine
from legcal.machine.spanning_tree import Source

MAX_SECONDS = 5.0  # of work of the processor, on a usual machine
_USUAL = 0.105  # [s] that a usual machine takes for :func:`_some_work`
MAX_WAIT = 60.0  # [s] on the wall, with other work beside it
MAX_BYTES = 1 << 30
MAX_TEXT = 20_000  # characters that a command prints about a damaged file
MOST_OF_CHILD = 600  # cases, before another process starts anew
DEEP_SHARE = 0.03
CONTROL = re.compile(
    r"[^\x20-\x7e\xa0-\u2027\u2030-\ud7ff\ue000-\U0010ffff\n]|[\x80-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)


@dataclass(frozen=True)
class Case:
    """A damaged file: which, and how it is drawn or made."""

    subject: Subject
    seed: int = 0
    made: bytes | None = None  # the content, if it is a valid one

    @property
    def name(self) -> str:
        """Which file, and its seed."""
        return f"{self.subject.name} seed {self.seed}"

    def content(self) -> bytes:
        """Return the damaged file."""
        if self.made is not None:
            return self.made
        valid = (made_input(self.subject.input) / self.subject.file).read_bytes()
        seeds = [SUBJECTS.index(self.subject), self.seed]
        return mutate(valid, self.subject.kind, np.random.default_rng(seeds))

    def put(self, path: Path) -> None:
        """Put the damaged file at a place."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_bytes(self.content())


@dataclass(frozen=True)
class Ended:
    """How a command ended; *fault* says what breaks the rule, if anything does."""

    case: Case
    code: int | None
    seconds: float
    megabytes: float
    fault: str = ""
    message: str = ""  # of a refusal


@dataclass
class Count:
    """What many cases did."""

    n_cases: int = 0
    codes: Counter[str] = field(default_factory=Counter)
    faults: list[Ended] = field(default_factory=list)
    slowest: Ended | None = None
    largest: Ended | None = None

    def add(self, ended: Ended) -> None:
        """Count one more."""
        faults = [ended] if ended.fault else []
        self.include(Count(1, Counter([str(ended.code)]), faults, ended, ended))

    def include(self, other: Count) -> None:
        """Count those of another count too."""
        self.n_cases += other.n_cases
        self.codes += other.codes
        self.faults += other.faults
        both = [ended for ended in (self.slowest, other.slowest) if ended is not None]
        self.slowest = max(both, key=lambda ended: ended.seconds, default=None)
        both = [ended for ended in (self.largest, other.largest) if ended is not None]
        self.largest = max(both, key=lambda ended: ended.megabytes, default=None)


def drawn_cases(count: int, seed: int, deep_share: float = DEEP_SHARE) -> list[Case]:
    """Return that many cases, in turn of all subjects; few of those that take long."""
    chance = np.random.default_rng(seed)
    shares = np.array([subject.share for subject in SUBJECTS])
    is_deep = np.array([subject.deep for subject in SUBJECTS])
    for part, chosen in ((deep_share, is_deep), (1.0 - deep_share, ~is_deep)):
        shares[chosen] *= part / shares[chosen].sum()
    drawn = chance.choice(len(SUBJECTS), count, p=shares)
    return [Case(SUBJECTS[k], 1_000_000 * seed + n) for n, k in enumerate(drawn.tolist())]


def cases_of_unequal_claims(count: int, seed: int) -> list[Case]:
    """Return tables of outlines that are valid, of covariances twelve powers of ten apart."""
    (subject,) = (subject for subject in SUBJECTS if subject.file == "observations.csv")
    valid = (made_input(subject.input) / subject.file).read_text()
    cases = []
    for n in range(count):
        chance = np.random.default_rng([seed, n])
        header, *rows = [line.split(",") for line in valid.splitlines()]
        for row in rows:
            if chance.random() < 0.2:
                s00, s11 = (10.0 ** chance.uniform(-8.5, 3.9, 2)).tolist()
                s01 = float(chance.uniform(-0.9, 0.9)) * (s00 * s11) ** 0.5
                for column, value in (("s00", s00), ("s01", s01), ("s11", s11)):
                    row[header.index(column)] = repr(value)
        content = "".join(",".join(line) + "\n" for line in (header, *rows))
        cases.append(Case(subject, n, made=content.encode()))
    return cases


def run_cases(cases: Sequence[Case], *, lone: bool = False) -> Iterator[Ended]:
    """Run cases in a child process, and in another one after each that did not survive.

    What broke a limit is run again alone: the memory of those before it is not its own.
    """
    for case in cases:
        made_input(case.subject.input)
    _shipped()
    max_seconds()
    context = get_context("fork")
    left = list(cases)
    while left:
        batch, left = left[:MOST_OF_CHILD], left[MOST_OF_CHILD:]
        ours, theirs = context.Pipe(duplex=False)
        child = context.Process(target=_work, args=(batch, theirs))
        child.start()
        theirs.close()
        done = 0
        for ended in _received(ours):
            done += 1
            yield ended
        child.join(1.0)
        if done < len(batch):  # the child died, or hangs
            child.kill()
            child.join()
            case = batch[done]
            how = child.exitcode
            if lone or done == 0:
                yield Ended(case, None, max_seconds(), 0.0, _death(how))
            else:
                yield from run_cases([case], lone=True)
            left = batch[done + 1 :] + left


@cache
def max_seconds() -> float:
    """Return how long a slower machine takes for what is done in MAX_SECONDS on a usual one."""
    return MAX_SECONDS * max(1.0, min(_some_work() for _ in range(3)) / _USUAL)


def _some_work() -> float:
    """Do small linear algebra as fits do, and return the processor time [s]."""
    begin = time.process_time()
    A, b = 8.0 * np.eye(6) + np.arange(36.0).reshape(6, 6) / 36.0, np.ones(6)
    for _ in range(8_000):
        solved = np.linalg.solve(A, b)
        b[:] = solved / np.sqrt(solved @ solved)
        A += 1e-9 * np.outer(b, b)
    return time.process_time() - begin


@cache
def _shipped() -> dict[Path, tuple[Source, Machine]]:
    """Read the models that no case damages, and import what commands need: all cases share both."""
    one_of_each = {subject.command.split()[0]: subject for subject in SUBJECTS if not subject.deep}
    for subject in one_of_each.values():
        with tempfile.TemporaryDirectory(prefix="legcal-fuzz-") as top:
            folder = made_input(subject.input)
            run(*words_of(subject.command, {"in": folder, "out": Path(top) / "out"}))
    sources = {path: read_source(path) for path in map(find_model, ("hexapod", "3-rpr"))}
    return {path: (source, loader._load(source)) for path, source in sources.items()}


def _share_what_is_whole() -> None:
    """Let the cases of this process read once what they do not damage: it takes longest."""
    shipped = _shipped()
    load = loader._load
    parse: Callable[..., object] = cache(yaml.load)

    def read(model: str | Path, *stated: str | None) -> Source:
        return shipped[Path(model)][0] if Path(model) in shipped else read_source(model, *stated)

    def loaded(source: Source) -> Machine:
        known = [machine for whole, machine in shipped.values() if whole is source]
        return known[0] if known else load(source)

    def parsed(content: bytes, Loader: type[yaml.SafeLoader]) -> object:
        return deepcopy(parse(content, Loader))

    patch.object(loader, "read_source", read).start()
    patch.object(loader, "_load", loaded).start()
    patch.object(yaml, "load", parsed).start()


def _death(exit_code: int | None) -> str:
    if exit_code == -signal.SIGPROF:
        return f"more than {max_seconds():.3g} s"
    if exit_code == -signal.SIGKILL:
        return f"hangs for {MAX_WAIT:g} s"
    return f"the process died with {exit_code}"


def _received(pipe: Connection) -> Iterator[Ended]:
    while True:
        try:
            if not pipe.poll(MAX_WAIT):
                return
            yield pipe.recv()
        except EOFError:
            return


def _work(cases: Sequence[Case], pipe: Connection) -> None:
    """Run cases in this process, under its limits."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    gc.freeze()  # what the parent left need not be searched again and again
    _share_what_is_whole()
    with tempfile.TemporaryDirectory(prefix="legcal-fuzz-") as top, open(os.devnull, "w") as null:
        os.dup2(null.fileno(), 1)  # what libraries print past Python
        os.dup2(null.fileno(), 2)
        for number, case in enumerate(cases):
            folder = Path(top) / str(number)
            pipe.send(_run_one(case, folder))
            shutil.rmtree(folder, ignore_errors=True)
    pipe.close()
    os._exit(0)


def _run_one(case: Case, folder: Path) -> Ended:
    subject = case.subject
    shutil.copytree(made_input(subject.input), folder / "in", copy_function=os.link)
    case.put(folder / "in" / subject.file)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, max_seconds())
    words = words_of(subject.command, {"in": folder / "in", "out": folder / "out"})
    outcome = run(*words, "--json", inside=folder)
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    seconds = time.process_time() - begin
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
    fault, message = _judged(outcome, folder)
    if case.made is not None and outcome.code == 2:
        fault = fault or "refused, and it is valid"
    return Ended(case, outcome.code, seconds, grown, fault, message)


def _judged(outcome: Outcome, folder: Path) -> tuple[str, str]:
    """Return what breaks the rule, and the message of a refusal."""
    if outcome.code not in (0, 1, 2):
        lines = [line for line in outcome.err.splitlines() if line.strip()]
        return f"exit {outcome.code}: {lines[-1] if lines else ''}", ""
    try:
        document = json.loads(outcome.out)
    except ValueError:
        return "no JSON document on stdout", ""
    if "error" not in document:
        return "", ""
    message = document["error"]["message"]
    control = CONTROL.search(message)
    fault = ""
    if (folder / "out").exists():
        fault = "refused, and the output is there"
    elif len(message) > MAX_TEXT:
        fault = f"a message of {len(message)} characters"
    elif control is not None:
        before = message[: control.start()][-60:]
        fault = f"the character {control[0]!r} in a message: ...{before}"
    return fault, message


def count_cases(cases: Iterable[Case]) -> Count:
    """Run cases and count what they did."""
    count = Count()
    for ended in run_cases(list(cases)):
        count.add(ended)
    return count
