"""How short the answer of a command is."""

import re
from itertools import takewhile

from ehbench.report.terminal import MOST_STEPS, MOST_WORDS

LINE = re.compile(r'ehbench |[\w"] = |^ +".+",$', re.MULTILINE)


def without_tables(text: str) -> list[str]:
    """The lines that are part of no table: one reaches from its head to the next blank line."""
    lines, rest = text.splitlines(), []
    while lines:
        block = list(takewhile(str.strip, lines))
        lines = lines[len(block) + 1 :]
        rest += [] if any(line.startswith("─") for line in block) else block
    return rest


def short(text: str) -> list[str]:
    """The steps of an output, after its words are counted."""
    lines = without_tables(text)
    assert len(" ".join(lines).split()) <= MOST_WORDS, lines
    steps = re.split(r"(?m)^(?=\d\. )", "\n".join(lines))[1:]
    assert len(steps) <= MOST_STEPS
    for number, step in enumerate(steps, 1):
        assert step.startswith(f"{number}. ") and LINE.search(step), step
    return steps
