"""Signals that end the process come when nothing is left half done by it, and none gets lost."""

import os
import signal
import sys
import threading

import pytest

from ehbench.app import cli
from ehbench.runtime import interrupts
from ehbench.runtime.interrupts import Terminated, ended, listen, unbroken


@pytest.fixture(autouse=True)
def listening():
    used = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGVTALRM)
    before = {number: signal.getsignal(number) for number in used}
    listen()
    yield
    ended()
    for number, handler in before.items():
        signal.signal(number, handler)


def ask(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_the_process_with_its_number(number):
    with pytest.raises(Terminated) as ended:
        ask(number)
    assert ended.value.code == 128 + number


def test_a_closed_terminal_does_not_end_what_nohup_started():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    listen()
    ask(signal.SIGHUP)


def test_a_block_is_finished_first_whatever_it_calls():
    done = []
    with pytest.raises(Terminated) as ended:
        with unbroken():
            with unbroken():
                ask()
                done.append("inner")
            done.append("outer")
    assert done == ["inner", "outer"] and ended.value.code == 143
    with unbroken():  # and it is told once
        pass


def test_an_error_of_the_block_is_told_with_the_end():
    with pytest.raises(Terminated) as ended:
        with unbroken():
            ask()
            raise ValueError
    assert isinstance(ended.value.__context__, ValueError)


def test_a_block_of_another_thread_holds_nothing():
    begun, leave = threading.Event(), threading.Event()

    def work() -> None:
        with unbroken():
            begun.set()
            leave.wait(60.0)

    thread = threading.Thread(target=work)
    thread.start()
    begun.wait(60.0)
    try:
        with pytest.raises(Terminated):
            ask()
    finally:
        leave.set()
        thread.join()


def swallow() -> None:
    try:
        ask()
    except BaseException:
        pass


def test_an_end_that_was_swallowed_is_asked_for_again_and_again(monkeypatch):
    monkeypatch.setattr(interrupts, "AGAIN", 0.01)
    told = 0
    swallow()
    while told < 2:
        with pytest.raises(Terminated) as again:
            while True:
                pass
        assert again.value.number == signal.SIGTERM
        told += 1
    assert ended() == signal.SIGTERM and ended() == 0
    assert signal.getitimer(signal.ITIMER_VIRTUAL) == (0.0, 0.0)


def test_an_end_that_a_library_turned_into_an_error_is_the_end(monkeypatch, capsys):
    def turned() -> None:
        swallow()
        raise RuntimeError("a function that was called raised Terminated")

    monkeypatch.setattr(cli, "app", turned)
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 143 and not capsys.readouterr().err


def test_a_command_that_was_done_by_then_is_done(monkeypatch):
    def done() -> None:
        swallow()
        sys.exit(0)

    monkeypatch.setattr(cli, "app", done)
    with pytest.raises(SystemExit) as left:
        cli.main()
    assert left.value.code == 0
    assert ended() == 0


def test_a_bug_is_told_as_one(monkeypatch):
    def wrong() -> None:
        raise RuntimeError("wrong")

    monkeypatch.setattr(cli, "app", wrong)
    with pytest.raises(RuntimeError, match="wrong"):
        cli.main()
