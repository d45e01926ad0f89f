"""Stopping by a signal: the handling of Ctrl-C, SIGTERM and SIGHUP by the command line.

Only the command line installs handlers (:func:`stopped_by_signals`); a program that imports legcal
keeps the handlers of Python and its own. The first signal raises KeyboardInterrupt in the main
thread; if a library swallows it, nothing is recorded any more (:func:`raise_if_stopped`). The
second signal ends the process unconditionally.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer, current_thread, main_thread
from types import FrameType

INTERRUPTED = 130  # exit code of a command stopped by a signal
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")  # SIGHUP does not exist on every system
_NUMBERS = [signal.Signals[name] for name in _NAMES if hasattr(signal, name)]
_AGAIN = 0.01  # [s]
_heard: list[int] = []  # signals that stopped the command


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt for a signal to end the block; a second signal ends the process.

    Errors after a signal come from libraries that converted the interrupt. A signal that was
    ignored before, such as by ``nohup``, stays ignored.
    """
    before = {n: signal.getsignal(n) for n in _NUMBERS}
    heard = [n for n in _NUMBERS if before[n] is not signal.SIG_IGN]

    def stop(number: int, frame: FrameType | None) -> None:
        code = None if frame is None else frame.f_code
        if code and (code.co_filename, code.co_name) == ("<frozen importlib._bootstrap>", "cb"):
            # Python drops what this callback of an import raises: the signal comes again.
            Timer(_AGAIN, os.kill, (os.getpid(), number)).start()
            return
        for heard_number in heard:  # by the system, as Python may be kept from answering
            signal.signal(heard_number, signal.SIG_DFL)
        _heard.append(number)
        raise KeyboardInterrupt

    try:
        for heard_number in heard:
            signal.signal(heard_number, stop)
        yield
    except Exception:
        raise_if_stopped()
        raise
    finally:
        for heard_number in heard:
            signal.signal(heard_number, before[heard_number])
        _heard.clear()


def raise_if_stopped() -> None:
    """Raise KeyboardInterrupt if a signal was heard, before anything is recorded."""
    if _heard:
        raise KeyboardInterrupt


@contextmanager
def held_back_signals() -> Iterator[None]:
    """Let signals that Python answers wait for the end of a block."""
    if current_thread() is not main_thread():  # signals are handled in the main thread
        yield
        return
    waiting: list[int] = []

    def wait(number: int, _frame: FrameType | None) -> None:
        waiting.append(number)

    before = {n: handler for n in _NUMBERS if callable(handler := signal.getsignal(n))}
    for number in before:
        signal.signal(number, wait)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if waiting and not _heard:
            signal.raise_signal(waiting[0])


def leave_interrupts_to_parent() -> None:
    """Let a process of a pool ignore Ctrl-C, which its parent handles; other signals end it."""
    for number in _NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
