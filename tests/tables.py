"""Tables of test cases as text."""


def rows(text: str) -> list[tuple[int | str | None, ...]]:
    """The rows of a table whose cells stand between bars: an empty cell is None, digits are a
    number, a ``;`` begins a new line within a cell.
    """
    table = [[cell.strip() for cell in line.split("|")] for line in text.strip().splitlines()]
    return [
        tuple(int(c) if c.isdigit() else c.replace("; ", "\n") or None for c in line)
        for line in table
    ]
