"""Stopping by a signal: what the command line does about Ctrl-C, SIGTERM and SIGHUP.

Only the command line installs handlers (:func:`stopped_by_signals`); in a program that imports
legcal those of Python and of the program stay. The first signal raises KeyboardInterrupt in the
main thread, and nothing is recorded any more (:func:`raise_if_stopped`), should a library swallow
that on its way. The second one ends the process, whatever it does.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import current_thread, main_thread
from types import FrameType

INTERRUPTED = 130  # exit code of a command that a signal stopped
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # the last is not on every system
_NUMBERS = [signal.Signals[name] for name in _NAMES if hasattr(signal, name)]
_heard: list[int] = []  # the signals that stopped the command
_waiting: list[list[int]] = []  # the signals that wait for the end of each block


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for any signal that asks the block to end; a second ends the process.

    Errors after a signal are those of libraries that turned the interrupt into one. A signal that
    was ignored before, as by ``nohup``, stays so.
    """
    before = {n: signal.getsignal(n) for n in _NUMBERS}
    heard = [n for n in _NUMBERS if before[n] is not signal.SIG_IGN]

    def stop(number: int, _frame: FrameType | None) -> None:
        for each in heard:  # by the system, as Python may be kept from answering
            signal.signal(each, signal.SIG_DFL)
        _heard.append(number)
        raise KeyboardInterrupt

    try:
        for each in heard:
            signal.signal(each, stop)
        yield
    except Exception:
        raise_if_stopped()
        raise
    finally:
        for each in heard:
            signal.signal(each, before[each])
        _heard.clear()


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt if a signal was heard, before anything is recorded."""
    if _heard:
        raise KeyboardInterrupt


@contextmanager
def held_back_signals(*, first_alone: bool = False) -> Iterator[None]:
    """Let signals that Python answers wait for the end of a block, or the first of them alone.

    The block may look at :func:`is_waiting`.
    """
    if current_thread() is not main_thread():  # which is the one that hears
        yield
        return
    waiting: list[int] = []

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def wait(number: int, _frame: FrameType | None) -> None:
        waiting.append(number)
        if first_alone:
            restore()

    _waiting.append(waiting)
    before = {n: handler for n in _NUMBERS if callable(handler := signal.getsignal(n))}
    for number in before:
        signal.signal(number, wait)
    try:
        yield
    finally:
        restore()
        _waiting.pop()
        if waiting and not _heard:
            signal.raise_signal(waiting[0])


def is_waiting() -> bool:
    """Say whether a signal waits for the end of a block."""
    return any(_waiting)


def leave_interrupts_to_parent() -> None:
    """Let a process of a pool ignore Ctrl-C, which its parent answers, and be ended by the others.

    It may be a copy made in :func:`held_back_signals`, so that none was answered before.
    """
    _waiting.clear()
    for number in _NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
