"""How work reports its progress."""

from collections.abc import Callable

Progress = Callable[[str, float], None]  # (activity, share done from 0 to 1)
