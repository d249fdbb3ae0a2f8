"""``python -m tools.power [--rigs N] [--exact N] [--json FILE] [--write]``: a study that is stopped
goes on with the outcomes in FILE."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from tools.power.machine import WAVES
from tools.power.study import (
    Outcome,
    Trial,
    exact_table,
    exact_trials,
    miss,
    outcomes,
    wrong_table,
    wrong_trials,
)

PAGE = Path(__file__).parents[2] / "docs" / "evidence" / "power.md"
ALIKE = 1.0e-4  # share of a channel's range by which plant and model may differ
TEXT = """# Evidence: power of the verdict

`make power` draws slides and cranes with four-way spools and cartridges from seeds. A plant that
shares no code with the package (`tools/power/plant.py`) records their logs: six kinds of command,
three levels of noise, leakage and creep. With equal numbers the plant and the model agree to 1e-4
of each channel's range. Each model is judged on one log of 3 s with the default thresholds, beside
a black box fitted to two other logs of the machine.

An error *shows* where it moves the log by more than its noise can hide. Noise is white, and each
model has one error: coloured noise and several errors are not in these tables.

## Models with one error

<!-- power wrong -->
{wrong}

## Exact models

<!-- power exact -->
{exact}
"""


def main(arguments: Sequence[str]) -> int:
    """Print both tables; with ``--write`` into the page of the docs."""
    parser = argparse.ArgumentParser(prog="python -m tools.power", description=__doc__)
    parser.add_argument("--rigs", type=int, default=8, help="machines with every single error")
    parser.add_argument("--exact", type=int, default=None, help="machines with exact models")
    parser.add_argument("--json", type=Path, help="outcomes, a line each: goes on with those there")
    parser.add_argument("--workers", type=int, default=0, help="processes, 0 for one a core")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name} of the docs")
    given = parser.parse_args(arguments)
    exact = given.exact if given.exact is not None else 4 * given.rigs
    apart = max(miss(Trial(seed, wave, 0.0)) for seed, wave in enumerate(WAVES))
    if apart > ALIKE:
        parser.error(f"plant and model differ by {apart:.1e} of a channel's range")
    trials = [*wrong_trials(given.rigs), *exact_trials(exact)]
    results = [item for item in _kept(trials, given.workers, given.json) if not item.skipped]
    wrong = wrong_table([item for item in results if item.trial.error])
    right = exact_table([item for item in results if not item.trial.error])
    print(wrong, right, sep="\n\n")
    if given.write:
        PAGE.write_text(TEXT.format(wrong=wrong, exact=right), encoding="utf-8")
    return 0


def _kept(trials: Sequence[Trial], workers: int, path: Path | None) -> Iterator[Outcome]:
    """Outcomes of trials: those that a file has, and the others, which it gets as they come."""
    known: dict[Trial, Outcome] = {}
    if path is not None and path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            table = json.loads(line)
            trial = Trial(**table.pop("trial"))
            known[trial] = Outcome(trial, **table)
    yield from (known[trial] for trial in trials if trial in known)
    rest = [trial for trial in trials if trial not in known]
    for number, result in enumerate(outcomes(rest, workers) if rest else ()):
        if number % 50 == 0:
            print(f"{number} of {len(rest)}", file=sys.stderr, flush=True)
        if path is not None:
            with path.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(asdict(result), ensure_ascii=False) + "\n")
        yield result


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
