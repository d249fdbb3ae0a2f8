"""What work would take, said before it begins."""

import os

from ehbench.vocabulary import InputError, message

SHARE = 0.5  # of the memory that one piece of work may fill
UNSAID = 8e9  # [bytes] where a system does not say how much memory it has
MOST_ROWS = 10_000_000  # of a trial
MOST_STEPS = 5e9  # of the integration: hours


def used_memory() -> float:
    """Address space [bytes] that this process has taken, 0 where the system does not say."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return float(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0.0


def available() -> float:
    """Memory [bytes] that this process may hold: of the machine, or less where it is given less."""
    try:
        sizes = [float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")]
    except (AttributeError, OSError, ValueError):  # a system that does not say
        sizes = [UNSAID]
    try:
        with open("/sys/fs/cgroup/memory.max", encoding="ascii") as file:
            sizes.append(float(file.read()))
    except (OSError, ValueError):  # no such thing here, or "max"
        pass
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        sizes += [limit - used_memory()] if limit != resource.RLIM_INFINITY else []
    except ImportError:
        pass
    return min(sizes)


def refuse_beyond(needed: float, what: str = "") -> None:
    """Refuse work, by default to read a file, that would fill more than SHARE of the memory;
    ``needed`` in bytes.

    Raises:
        InputError: says how much it would take."""
    if needed > SHARE * available():
        sizes = {"needed": needed / 1e9, "maximum": SHARE * available() / 1e9}
        work = what or message("runtime.reading")
        raise InputError(message("runtime.memory", what=work, **sizes))


def rows_of(seconds: float, rate: float) -> int:
    """How many samples a time [s] has at a rate [Hz], without the first.

    Raises:
        InputError: more than any trial has."""
    rows = seconds * rate
    if not rows <= MOST_ROWS:
        fields = {"seconds": seconds, "rate": rate, "rows": rows, "most": MOST_ROWS}
        raise InputError(message("runtime.rows", **fields))
    return round(rows)
