"""Stopping by a signal: what the command line does about Ctrl-C, SIGTERM and SIGHUP.

Only the command line installs handlers (:func:`stopped_by_signals`); in a program that imports
legcal those of Python and of the program stay. The first signal raises KeyboardInterrupt in the
main thread. Libraries may swallow it on its way (in imports, destructors, callbacks of solvers): it
is raised again until it gets through, and nothing is recorded any more (:func:`raise_if_stopped`).
The second signal ends the process, whatever it does. In blocks whose work so far is worth its end
(:func:`first_signal_waits`) there is one signal more.
"""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last is not on every system
_NUMBERS = [signal.Signals[name] for name in _NAMES if hasattr(signal, name)]
_AGAIN = 1.0  # [s] until an interrupt that was swallowed is raised again
_HAS_TIMER = hasattr(signal, "setitimer")
_HAS_MASK = hasattr(signal, "pthread_sigmask")


class _SignalState:
    """What the handlers know; one process has one main thread."""

    handling = False  # inside stopped_by_signals
    stopped = False  # a signal was heard
    holding = 0  # depth of held_back_signals
    first_waits = False  # inside first_signal_waits
    waiting = 0  # the number of the signal that was heard there


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for any signal that asks the block to end; a second ends the process.

    A block that heard a signal ends with KeyboardInterrupt, whatever became of the first one. A
    signal that was ignored before, as by ``nohup``, stays so. Blocks in the block do nothing.
    """
    if _SignalState.handling:
        yield
        return
    before = {number: signal.getsignal(number) for number in _NUMBERS}
    heard = [number for number in _NUMBERS if before[number] is not signal.SIG_IGN]

    def stop(found: int, _frame: FrameType | None) -> None:
        if _SignalState.first_waits and not _SignalState.waiting:
            _SignalState.waiting = found
            return
        for number in heard:  # by the system, as Python may be kept from answering
            signal.signal(number, signal.SIG_DFL)
        _SignalState.stopped = True
        if _HAS_TIMER:
            signal.signal(signal.SIGALRM, _raise_again)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
        if not _SignalState.holding:
            raise KeyboardInterrupt

    def report(unraisable: "sys.UnraisableHookArgs") -> None:
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):  # it is raised again
            report_before(unraisable)

    alarm = signal.getsignal(signal.SIGALRM) if _HAS_TIMER else None
    report_before = sys.unraisablehook
    try:
        _SignalState.handling = True
        sys.unraisablehook = report
        for number in heard:
            signal.signal(number, stop)
        yield
        raise_if_stopped()
    except BaseException as error:
        if not isinstance(error, KeyboardInterrupt):
            raise_if_stopped()
        raise
    finally:
        if _SignalState.stopped and _HAS_TIMER:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, alarm)
        for number in heard:
            signal.signal(number, before[number])
        sys.unraisablehook = report_before
        _SignalState.handling = _SignalState.stopped = False


def forget_stop() -> None:
    """Forget the signal that was heard: what it was to end has ended as it should."""
    _SignalState.stopped = False
    if _HAS_TIMER:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _raise_again(_number: int, _frame: FrameType | None) -> None:
    """Raise the interrupt, unless it is on its way and cleans up."""
    error = sys.exception()
    while error is not None:
        if isinstance(error, KeyboardInterrupt | GeneratorExit):
            return
        error = error.__context__
    if not _SignalState.holding:
        raise KeyboardInterrupt


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt if a signal was heard, before anything is recorded.

    Signals that are held back wait.
    """
    if _SignalState.stopped and not _SignalState.holding:
        raise KeyboardInterrupt


@contextmanager
def held_back_signals() -> Iterator[None]:
    """Let signals wait for the end of a short block.

    Threads and processes that are started in the block hear none either: they inherit that.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _NUMBERS) if _HAS_MASK else ()
    _SignalState.holding += 1
    try:
        yield
    finally:
        _SignalState.holding -= 1
        if _HAS_MASK:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    raise_if_stopped()  # another thread may have taken it


@contextmanager
def first_signal_waits() -> Iterator[None]:
    """Let the first signal wait for the end of a long block, which looks at :func:`is_waiting`.

    A second signal stops the block at once, as the first one does elsewhere, and a third ends the
    process.
    """
    _SignalState.first_waits = True
    try:
        yield
    finally:
        number, _SignalState.waiting = _SignalState.waiting, 0
        _SignalState.first_waits = False
        if number and not _SignalState.stopped:
            signal.raise_signal(number)


def is_waiting() -> bool:
    """Say whether a signal waits for the end of a block."""
    return (
        _SignalState.stopped
        or _SignalState.waiting != 0
        or (_HAS_MASK and not signal.sigpending().isdisjoint(_NUMBERS))
    )


def leave_interrupts_to_parent() -> None:
    """Let a process of a pool ignore Ctrl-C, which its parent answers, and be ended by the others.

    It was started with :func:`held_back_signals`, so that none came before.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in _NUMBERS:
        if number is not signal.SIGINT:
            signal.signal(number, signal.SIG_DFL)
    if _HAS_MASK:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _NUMBERS)
