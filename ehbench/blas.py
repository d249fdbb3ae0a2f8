"""One thread for the linear algebra of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums of one BLAS thread have one order, so the same input gives the same bytes; small systems
    are quicker that way too. The process has its own number of threads back at the end.
    """
    # a library that is loaded later would keep its threads
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1, user_api="blas"):
        yield
