"""Hand the program inputs that are wrong, thousands of each kind, and count what it makes of them.

    python -m tools.fuzz.fuzzer                        100 000 inputs, a table, exit 1 on a finding
    python -m tools.fuzz.fuzzer --again "rig TOML:17"  one of them, with its traceback

An input is known by its kind, its number and the seed. A finding is anything but a result or one
sentence: a traceback, an input that takes longer than LONGEST, a user's file that is gone."""

import argparse
import faulthandler
import os
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from ehbench.vocabulary.errors import EhbenchError
from tools.fuzz.kinds import KINDS

LONGEST = 20.0  # [s] of computing that one input may take
PATIENCE = 20  # times as long that it may wait, for a child or the machine
PIECE = 250  # inputs that a process takes at a time
MOST = 1500  # characters of a sentence


class Hang(BaseException):
    """An input took too long."""


class Finding(NamedTuple):
    """What an input of a kind led to: ``what`` in a few words, the same for the same cause."""

    kind: str
    number: int
    what: str
    text: str


class Tally(NamedTuple):
    """What became of inputs: how many were taken and refused, what was found, how long [s]."""

    taken: int
    refused: int
    findings: list[Finding]
    seconds: float


def one(kind: str, number: int, seed: int = 0) -> tuple[bool, Finding | None]:
    """Whether one input was taken, and what was found."""
    rng = Random(f"{seed} {kind} {number}")
    given = KINDS[kind].make(rng)
    begun, renewals = time.process_time(), iter(range(PATIENCE))

    def hang(*_: object) -> None:
        """A machine with other work lets an input wait: what counts is how long it computed."""
        if time.process_time() - begun < LONGEST and next(renewals, None) is not None:
            signal.setitimer(signal.ITIMER_REAL, LONGEST)
        else:
            raise Hang

    signal.signal(signal.SIGALRM, hang)
    with tempfile.TemporaryDirectory(prefix="fuzz_") as folder:
        signal.setitimer(signal.ITIMER_REAL, LONGEST)
        try:
            KINDS[kind].take(given, Path(folder))
        except EhbenchError as error:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            if len(str(error)) > MOST + len(folder) or "\n" in error.message:
                return False, Finding(
                    kind, number, f"no sentence: {_place(error)}", str(error)[:500]
                )
            return False, None
        except (Exception, Hang) as error:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            what = f"{type(error).__name__} at {_place(error)}"
            return False, Finding(kind, number, what, traceback.format_exc()[-3000:])
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
    return True, None


def _place(error: BaseException) -> str:
    """The last line of the package that an error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if f"{os.sep}ehbench{os.sep}" in frame.filename] or frames
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}"


def several(kind: str, numbers: range, seed: int) -> Tally:
    """What became of some inputs of a kind."""
    warnings.simplefilter("ignore")
    faulthandler.dump_traceback_later(PIECE * LONGEST, exit=True)
    begun, taken, findings = time.monotonic(), 0, []
    for number in numbers:
        was_taken, found = one(kind, number, seed)
        taken += was_taken
        findings += [found] if found else []
    faulthandler.cancel_dump_traceback_later()
    refused = len(numbers) - taken - len(findings)
    return Tally(taken, refused, findings, time.monotonic() - begun)


def pieces(count: int) -> Iterator[tuple[str, range]]:
    """All inputs of a fuzz of ``count``, some at a time."""
    for kind, what in KINDS.items():
        total = max(1, round(what.share * count))
        for first in range(0, total, PIECE):
            yield kind, range(first, min(first + PIECE, total))


def fuzz(count: int, seed: int, workers: int) -> dict[str, Tally]:
    """What became of ``count`` inputs, by kind."""
    whole: dict[str, Tally] = {kind: Tally(0, 0, [], 0.0) for kind in KINDS}
    with ProcessPoolExecutor(workers) as pool:
        work = [(kind, pool.submit(several, kind, part, seed)) for kind, part in pieces(count)]
        for kind, future in work:
            # pyrefly: ignore[bad-argument-type, unsupported-operation]
            whole[kind] = Tally(*(a + b for a, b in zip(whole[kind], future.result(), strict=True)))
    return whole


def table(found: dict[str, Tally]) -> str:
    """What became of the inputs, to read."""
    lines = [
        f"{'kind':14} {'inputs':>7} {'refused':>8} {'taken':>7} {'findings':>9} {'ms each':>8}"
    ]
    total = Counter[str]()
    for kind, tally in found.items():
        count = tally.taken + tally.refused + len(tally.findings)
        total["inputs"] += count
        each = 1e3 * tally.seconds / max(count, 1)
        known = f"{kind:14} {count:7} {tally.refused:8} {tally.taken:7}"
        lines.append(f"{known} {len(tally.findings):9} {each:8.2f}")
    lines.append(f"{'all':14} {total['inputs']:7}")
    causes: dict[str, list[Finding]] = {}
    for tally in found.values():
        for finding in tally.findings:
            causes.setdefault(finding.what, []).append(finding)
    for what, those in sorted(causes.items(), key=lambda item: -len(item[1])):
        first = those[0]
        lines.append(f'{len(those):6} × {what}   --again "{first.kind}:{first.number}"')
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the fuzz that the command line asks for; 1 on a finding."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=100_000, help="inputs in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--again", help='one input, such as "rig TOML:17"')
    asked: Any = parser.parse_args(arguments)
    if asked.again:
        kind, _, number = asked.again.partition(":")
        print(KINDS[kind].make(Random(f"{asked.seed} {kind} {int(number)}")))
        taken, found = one(kind, int(number), asked.seed)
        print(found.text if found else "taken" if taken else "refused")
        return int(found is not None)
    begun = time.monotonic()
    found = fuzz(asked.count, asked.seed, asked.workers)
    print(table(found))
    print(f"{time.monotonic() - begun:.0f} s")
    return int(any(tally.findings for tally in found.values()))


if __name__ == "__main__":
    sys.exit(main())
