"""A sample of a study, and where samples are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from ehbench.vocabulary import InputError, message, shortened

ENCRYPTED = ("tls", "wss")  # protocols of Dask


class Certificates(NamedTuple):
    """PEM files of an encrypted connection: a cluster's authority, this user's certificate and
    key."""

    ca: Path
    cert: Path
    key: Path


@dataclass(frozen=True)
class Workers:
    """Where a study's samples are made.

    Args:
        scheduler: address of a Dask scheduler, '' for this machine. Without a protocol it is
            ``tcp://`` on this machine and ``tls://`` on any other.
        count: of workers on this machine, 0 for one a core.
        certificates: for ``tls://``; without them those of Dask's configuration.
        insecure: let pickles go to another machine unencrypted, and run those that come back.

    Raises:
        InputError: a certificate that is not there, or plain ``tcp://`` to another machine."""

    scheduler: str = ""
    count: int = 0
    certificates: Certificates | None = None
    insecure: bool = False

    def __post_init__(self) -> None:
        for path in self.certificates or ():
            if not path.is_file():
                raise InputError(message("sampling.no_certificate"), file=path)
        if not self.scheduler:
            return
        protocol, _, place = self.scheduler.rpartition("://")
        try:
            host = urlsplit(f"//{place}").hostname or ""
            is_here = host == "localhost" or ip_address(host).is_loopback
        except ValueError:
            is_here = False
        protocol = protocol or ("tcp" if is_here and self.certificates is None else "tls")
        if protocol not in ENCRYPTED and not (is_here or self.insecure):
            raise InputError(message("sampling.not_encrypted", address=self.scheduler))
        object.__setattr__(self, "scheduler", f"{protocol}://{place}")

    @property
    def is_encrypted(self) -> bool:
        """Whether the connection to the scheduler is encrypted and checked by certificates."""
        return self.scheduler.partition("://")[0] in ENCRYPTED

    @classmethod
    def of(
        cls, text: str, certificates: Sequence[Path | None] = (), insecure: bool = False
    ) -> Workers:
        """Those of the command line.

        Args:
            text: how many here, or a scheduler's address; '' is one a core.
            certificates: of authority and user, and the key; all or none.
            insecure: as of `Workers`.

        Raises:
            InputError: it is neither, or as `Workers`."""
        given = [path for path in certificates if path is not None]
        if given and len(given) < len(Certificates._fields):
            raise InputError(message("sampling.some_certificates"))
        if ":" in text:
            return cls(text, 0, Certificates(*given) if given else None, insecure)
        if text and not (text.isdecimal() and int(text) > 0):
            raise InputError(message("sampling.no_workers", text=shortened(text, 40)))
        return cls(count=int(text or 0))


# status word by exit code
STATUS = dict(enumerate(("done", "failed", "refused", "incomplete", "rejected", "stopped")))
LATE = "late"  # beyond its time limit, exit code 5
WHOLE = (0, 3, 4)  # exit codes of samples that came to their end


class Sample(NamedTuple):
    """The result of a sample: number, exit code, status, message, measures [SI] (nan for none),
    time [s]."""

    index: int
    code: int
    status: str
    message: str
    measures: tuple[float, ...]
    seconds: float = 0.0

    @classmethod
    def lost(cls, index: int, message: str, measures: int, late: bool = False) -> Sample:
        """A sample that left nothing."""
        code, status = (5, LATE) if late else (1, STATUS[1])
        return cls(index, code, status, message, (math.nan,) * measures)


Task = tuple[int, Mapping[str, Any]]  # a sample's number and what it sets
Make = Callable[[int, Mapping[str, Any]], Sample]
Run = Callable[[Iterable[Task]], Iterator[list[Sample]]]  # some samples at a time, in any order
Open = Callable[[], Make]  # makes ready what makes samples, in the process where it is called
