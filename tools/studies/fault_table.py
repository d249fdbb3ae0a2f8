"""The table of single faults of a run of `recipes/faults/single.toml`, for docs/evidence/faults.md:
what stopped a trial and how long after the fault, or how far the true stroke was from the desired.

ehbench reproduce faults --out DIR
python -m tools.studies.fault_table DIR/01_single"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ehbench.machines.rows import LIMITS

START, POSTURE, PAYLOAD = 0.8, "recipe.motion.waypoints", "recipe.payload"


def limit_of(message: str) -> str:
    """The limit that a sentence on a stop is about."""
    found = re.search("|".join(LIMITS), message.replace("was not a number", "finite"))
    assert found is not None, message
    return found[0]


def cell(row: pd.Series) -> str:
    """``0.12 s · 3.4`` of a trial that stopped, ``3.4`` of one that went on; errors in mm."""
    error = f"{row['largest true error [mm]']:.1f}"
    if str(row["status"]) == "done":
        return error
    return f"{max(row['stopped at [s]'] - START, 0.0):.2f} s · {error}"


def table(path: Path) -> str:
    """The table as Markdown: a row a fault, a column a posture and payload."""
    numbers = dict.fromkeys(("stopped at [s]", "largest true error [mm]"), "")
    samples = pd.read_csv(path, keep_default_na=False, na_values=numbers)
    columns = list(dict.fromkeys(zip(samples[POSTURE], samples[PAYLOAD], strict=True)))
    postures = dict(zip(dict.fromkeys(p for p, _ in columns), ("low", "high"), strict=True))
    heads = [f"{postures[posture]}, {payload}" for posture, payload in columns]
    lines = ["fault", *heads, "stopped by"], ["---"] * (len(heads) + 2)
    for name, rows in samples.groupby("case", sort=False):
        by = {(r[POSTURE], r[PAYLOAD]): cell(r) for _, r in rows.iterrows()}
        stops = Counter(limit_of(text) for text in rows["message"][rows["status"] == "stopped"])
        reasons = ", ".join(f"{limit} {n}" for limit, n in stops.most_common())
        lines += ([str(name), *(by[column] for column in columns), reasons],)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(arguments: Sequence[str]) -> None:
    """Print the table of a run folder of the study."""
    print(table(Path(arguments[0]) / "samples.csv"))


if __name__ == "__main__":
    main(sys.argv[1:])
