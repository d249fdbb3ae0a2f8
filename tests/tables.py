"""Tables of test cases as text."""


def rows(text: str) -> list[tuple[int | str | None, ...]]:
    """Rows of cells between bars: empty is None, digits a number, ``;`` a new line in a cell."""
    table = [[cell.strip() for cell in line.split("|")] for line in text.strip().splitlines()]
    return [
        tuple(int(c) if c.isdigit() else c.replace("; ", "\n") or None for c in line)
        for line in table
    ]
