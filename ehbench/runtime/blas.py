"""One thread for the linear algebra of a run."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any


@cache
def _libraries() -> Any:
    """The linear algebra of numpy and scipy, found once: to look through what is loaded takes
    longer than a short run."""
    import scipy.linalg  # noqa: F401 - scipy's comes with it
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums of one BLAS thread have one order, so the same input gives the same bytes; small systems
    are quicker that way too. The process has its own number of threads back at the end."""
    with _libraries().limit(limits=1, user_api="blas"):
        yield
