"""From a URL to the machine behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args
from urllib.parse import parse_qsl, urlsplit

from ehbench.links.client import LinkMachine
from ehbench.links.layout import Layout, Mode
from ehbench.links.transport import Link, UdpLink
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.messages import message

SCHEMES = ("udp",)
PORT = 47000


@dataclass(frozen=True)
class Address:
    """What a URL says: ``udp://host:port?mode=stream&clock=virtual``."""

    url: str
    scheme: str
    host: str
    port: int
    mode: Mode
    virtual: bool
    options: dict[str, str]

    @classmethod
    def of(cls, url: str) -> Address:
        """Read a URL.

        Raises:
            InputError: no such scheme, mode or option.
        """
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise InputError(message("links.url", url=url, known="udp://host:port")) from error
        options = dict(parse_qsl(parts.query, keep_blank_values=True))
        mode, clock = options.pop("mode", "stream"), options.pop("clock", "real")
        known = (
            mode in get_args(Mode) and clock in ("real", "virtual") and not options.keys() - {"map"}
        )
        if parts.scheme not in SCHEMES or not parts.hostname or not known:
            raise InputError(message("links.url", url=url, known=", ".join(SCHEMES)))
        return cls(
            *(url, parts.scheme, parts.hostname, port or PORT, mode, clock == "virtual", options)  # type: ignore[arg-type]
        )

    def link(self) -> Link:
        """The way to the target."""
        return UdpLink(self.host, self.port, self.virtual)


def open_machine(prepared: Prepared, url: str) -> LinkMachine:
    """The machine at the other end of a URL, for a prepared trial.

    Raises:
        InputError: as `Address.of`.
    """
    address = Address.of(url)
    return LinkMachine(prepared, Layout.of(prepared.rig), address.link(), address.mode, url)
