"""How work reports its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]  # (activity, share done from 0 to 1)
