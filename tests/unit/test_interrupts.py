"""Signals that end the process come when nothing is left half done by it, and none gets lost."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest

from ehbench.interrupts import Terminated, listen, unbroken


@pytest.fixture(autouse=True)
def listening(monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    listen()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def ask(number: int = signal.SIGTERM) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_with_its_number(number):
    with pytest.raises(Terminated) as ended:
        ask(number)
    assert ended.value.code == 128 + number


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


def test_an_end_that_a_finaliser_swallowed_is_asked_for_again():
    class Last:
        def __del__(self) -> None:
            ask()
            time.sleep(0.0)

    with pytest.raises(Terminated):
        one = Last()
        del one
        time.sleep(60.0)


def test_what_else_a_finaliser_raises_goes_where_it_went(monkeypatch):
    told = []
    monkeypatch.setattr(sys, "unraisablehook", lambda found: told.append(found.exc_type))
    listen()

    class Last:
        def __del__(self) -> None:
            raise KeyError

    one = Last()
    del one
    assert told == [KeyError]
