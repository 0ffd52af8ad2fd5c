from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from crashhunt import __main__, cli
from crashhunt.base import signals
from crashhunt.base.signals import (
    InterruptedCodeError,
    block_signals,
    blocked_signals,
    describe_death,
    ended_by_signals,
    interrupted_after,
    interruptible,
    is_interrupt,
    is_sent_from_outside,
    stop_requests,
)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_request_that_comes_twice_at_once_is_one(number):
    before = signal.signal(number, signal.SIG_DFL)  # a shell has what runs in the background ignore Ctrl-C
    try:
        with stop_requests() as asked:
            assert asked == []
            signal.raise_signal(number)
            signal.raise_signal(number)
            assert asked == [number]
    finally:
        signal.signal(number, before)


def test_a_second_request_a_while_later_ends_the_process_at_once(monkeypatch):
    monkeypatch.setattr(signals, "_SAME_REQUEST_S", -1.0)
    ended: list[int] = []
    before = signal.getsignal(signal.SIGTERM)
    with stop_requests() as asked:
        signal.raise_signal(signal.SIGTERM)
        with monkeypatch.context() as patch:  # instead of the end of this process
            patch.setattr(os, "kill", lambda _, number: ended.append(number))
            signal.raise_signal(signal.SIGTERM)
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert (asked, ended) == ([signal.SIGTERM], [signal.SIGTERM])
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_one_that_ignores_hang_ups_continues_ignoring_them_and_threads_are_left_alone():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_requests() as asked:
            signal.raise_signal(signal.SIGHUP)
            assert asked == []
    finally:
        signal.signal(signal.SIGHUP, before)

    def elsewhere() -> None:
        with stop_requests() as asked:
            assert asked == []

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_command_that_is_asked_to_end_stops_at_once_and_ends_by_the_signal(monkeypatch, number):
    ended, ran = [], []
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "kill", lambda pid, sent: ended.append((pid, sent, signal.getsignal(number))))
            with ended_by_signals():
                signal.raise_signal(number)
                ran.append("the rest")
            assert ended.pop() == (os.getpid(), number, signal.SIG_DFL)
            with ended_by_signals():
                assert signal.getsignal(number) is not signal.SIG_DFL
            assert signal.getsignal(number) is signal.SIG_DFL
            signal.signal(number, signal.SIG_IGN)  # as of a command that nohup has started
            with ended_by_signals():
                signal.raise_signal(number)
                ran.append("although ignored")
    finally:
        signal.signal(number, before)
    assert (ended, ran) == ([], ["although ignored"])


def test_code_that_takes_too_long_is_interrupted_even_where_it_catches_every_exception():
    before, passed = signal.getsignal(signal.SIGALRM), []

    def endless():
        while True:
            try:
                signal.pause()
            except Exception as error:
                passed.append(error)

    timer = signal.setitimer(signal.ITIMER_REAL, 500.0, 7.0)  # of code that has one of its own
    try:
        with pytest.raises(InterruptedCodeError), interrupted_after(0.01):
            endless()
        with interrupted_after(60.0):
            assert signal.getitimer(signal.ITIMER_REAL)[1] == 1.0
        assert (signal.getitimer(signal.ITIMER_REAL)[1], signal.getsignal(signal.SIGALRM)) == (7.0, before)
    finally:
        signal.setitimer(signal.ITIMER_REAL, *timer)

    def elsewhere():
        with interrupted_after(0.01):
            passed.append("in a thread")

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert passed == ["in a thread"]


def test_ctrl_c_at_a_question_is_raised_and_later_ones_are_collected():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with stop_requests() as asked:
            with pytest.raises(KeyboardInterrupt), interruptible():
                signal.raise_signal(signal.SIGINT)
            assert asked == []
            signal.raise_signal(signal.SIGINT)
            assert asked == [signal.SIGINT]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("exit_code", "words", "is_from_outside"),
    [
        (0, "exited with 0", False), (9, "exited with 9", False), (-9, "was killed by SIGKILL", True),
        (-15, "was killed by SIGTERM", True), (-11, "was killed by SIGSEGV", False),
        (-40, "was killed by signal 40", False),
    ],
)  # fmt: skip
def test_death_of_a_process_has_the_name_of_its_signal(exit_code, words, is_from_outside):
    assert describe_death(exit_code) == words
    assert is_sent_from_outside(exit_code) is is_from_outside


def test_no_handler_runs_while_signals_are_blocked():
    heard = []
    before = signal.signal(signal.SIGUSR2, lambda *_: heard.append(1))
    try:
        with blocked_signals():
            signal.raise_signal(signal.SIGUSR2)
            assert heard == []
        assert heard == [1]
        with blocked_signals(), blocked_signals():
            signal.raise_signal(signal.SIGUSR2)  # to this thread, and not to one of the test runner's
        assert heard == [1, 1]
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_blocking_drops_what_a_handler_raises(monkeypatch):
    calls = []

    def set_mask(*given):
        calls.append(given)
        if len(calls) == 1:
            raise ValueError("of a handler that runs meanwhile")

    monkeypatch.setattr(signals, "_set_mask", set_mask)
    block_signals()
    assert len(calls) == 2
    assert signal.SIGALRM in calls[1][1]


_DROPPED = """
import os, signal, weakref
from crashhunt.base.signals import remember_interrupts, stop_requests

class Module: pass

remember_interrupts()
module = Module()
reference = weakref.ref(module, lambda _: os.kill(os.getpid(), signal.SIGINT))
del module  # runs the callback, in which Python drops the KeyboardInterrupt
with stop_requests() as asked:
    print(*asked)
"""


def test_an_interrupt_that_python_drops_still_stops():
    done = subprocess.run([sys.executable, "-c", _DROPPED], capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(int(signal.SIGINT))]
    assert "KeyboardInterrupt" in done.stderr  # what Python says when it drops one


def test_an_ignored_interrupt_stays_ignored():
    program = "import crashhunt.base.signals as s, signal; s.remember_interrupts(); print(repr(signal.getsignal(2)))"
    ignoring = ["sh", "-c", 'trap "" INT; exec "$@"', "-", sys.executable, "-c", program]
    done = subprocess.run(ignoring, capture_output=True, text=True, check=True)
    assert "SIG_IGN" in done.stdout


def raise_from(*kinds):
    """Raise an error of the last type, caused by one of the type before it, and so on."""
    caught = None
    for kind in kinds:
        try:
            raise kind("what") from caught
        except BaseException as error:
            caught = error
    raise caught


@pytest.mark.parametrize(
    ("kinds", "is_one"),
    [
        ((KeyboardInterrupt,), True),
        ((KeyboardInterrupt, RuntimeError), True),  # of a class that was being created
        ((KeyboardInterrupt, RuntimeError, ImportError), True),
        ((RuntimeError,), False),
        ((ValueError, RuntimeError), False),
    ],
)
def test_a_ctrl_c_during_the_imports_of_the_command_ends_it_with_130(monkeypatch, kinds, is_one):
    class Imports:
        def __getattr__(self, name):
            raise_from(*kinds)

    monkeypatch.setitem(sys.modules, "crashhunt.cli", Imports())
    monkeypatch.setattr(__main__, "remember_interrupts", lambda: None)
    with pytest.raises(SystemExit if is_one else kinds[-1]) as caught:
        __main__.main()
    assert not is_one or caught.value.code == 130


@pytest.mark.parametrize(("kinds", "code"), [((KeyboardInterrupt, RuntimeError), 130), ((RuntimeError,), 2)])
def test_a_ctrl_c_during_the_imports_of_a_command_ends_it_with_130(monkeypatch, kinds, code):
    monkeypatch.setattr(cli, "_run", lambda words: raise_from(*kinds))
    with pytest.raises(SystemExit) as caught:
        cli.main(["list"])
    assert caught.value.code == code


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_error_that_is_its_own_cause_is_an_interrupt_only_by_its_class(kind):
    error = kind()
    error.__cause__ = error
    caused = RuntimeError()
    caused.__cause__ = error
    assert is_interrupt(caused) is (kind is KeyboardInterrupt)
