"""From a URL to the machine behind it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from ehbench.config.recipe.toml import read_text, table_of, validated
from ehbench.links.buffered import BufferedLink, CardMachine
from ehbench.links.client import TOKENS, LinkMachine
from ehbench.links.daq import LabJackCard, NiCard
from ehbench.links.layout import Layout, Mode
from ehbench.links.responder import HEADER
from ehbench.links.transport import LAYOUT, SEQUENCE, TOKEN, Link, UdpLink
from ehbench.machines.protocol import Machine
from ehbench.trial.preparation import Prepared
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.fields import FileModel

PORTS = {"udp": 47000, "modbus": 502, "can": 0}
CARDS = {"nidaq": NiCard, "labjack": LabJackCard}


class Terminal(FileModel):
    """A terminal of a card: value = volts · ``scale`` + ``offset`` [SI]; volts of an output are
    command · ``scale`` + ``offset``."""

    terminal: str
    scale: float = 1.0
    offset: float = 0.0


class CardMap(FileModel):
    """Terminals of a card by the names of channels and valves."""

    inputs: dict[str, Terminal]
    outputs: dict[str, Terminal]


@dataclass(frozen=True)
class Address:
    """What a URL says: ``udp://host:port?mode=stream&clock=virtual&map=file``."""

    url: str
    scheme: str
    host: str
    port: int
    channel: str
    mode: Mode
    virtual: bool
    map: Path | None

    @classmethod
    def of(cls, url: str) -> Address:
        """Read a URL.

        Raises:
            InputError: no such scheme, mode or option.
        """
        known = ", ".join((*PORTS, *CARDS))
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            why = message("links.url_scheme", known=known)
            raise InputError(message("links.url", url=url, why=why)) from error
        given = dict(parse_qsl(parts.query, keep_blank_values=True))
        card = parts.scheme in CARDS
        mode: Any = given.pop("mode", "buffered" if card else "stream")
        clock, place = given.pop("clock", "real"), given.pop("map", None)
        mapped, scheme = place is not None, parts.scheme
        sound = {
            "links.url_scheme": scheme in (*PORTS, *CARDS) and bool(parts.hostname),
            "links.url_option": not given,
            "links.url_mode": mode in get_args(Mode) and clock in ("real", "virtual"),
            "links.url_map": mapped or scheme in ("udp", "modbus"),
            "links.url_buffered": mode != "buffered" or card or scheme == "udp",
        }
        for key in (key for key, is_sound in sound.items() if not is_sound):
            raise InputError(message("links.url", url=url, why=message(key, known=known)))
        return cls(
            url,
            parts.scheme,
            parts.netloc.partition(":")[0],
            port or PORTS.get(parts.scheme, 0),
            parts.path.strip("/"),
            mode,
            clock == "virtual",
            None if place is None else Path(place),
        )

    def link(self, layout: Layout | None = None) -> Link:
        """The way to the target; without a layout the header alone goes over it.

        Raises:
            InputError: a card; a package is not installed; no such host, bus or map.
        """
        if self.scheme in CARDS:
            raise InputError(message("links.card", url=self.url))
        names = (HEADER, HEADER) if layout is None else layout.names(self.mode)
        try:
            if self.scheme == "udp":
                return UdpLink(self.host, self.port, self.virtual)
            if self.scheme == "modbus":
                from ehbench.links.modbus import ModbusLink

                return ModbusLink(self.host, self.port, names, self.map, self.virtual)
            from ehbench.links.can import CanLink

            assert self.map is not None  # `of` sees to it
            return CanLink(self.host, self.channel, names, self.map)
        except ImportError as error:
            raise InputError(message("links.extra", extra=self.scheme)) from error
        except OSError as error:
            raise InputError(
                message("links.system", url=self.url, why=error.strerror or error)
            ) from error


def open_machine(prepared: Prepared, url: str) -> Machine:
    """The machine at the other end of a URL, for a prepared trial.

    Raises:
        InputError: as `Address.of` and `Address.link`; a command of the trial's valves, or its
            length, that the link cannot hold.
    """
    address, layout, name = Address.of(url), Layout.of(prepared.rig), f"machine at {url}"
    if address.scheme not in CARDS:
        kind = BufferedLink if address.mode == "buffered" else LinkMachine
        link, header, commands = address.link(layout), np.zeros(len(HEADER)), layout.commands
        header[[LAYOUT, TOKEN, SEQUENCE]] = TOKENS - 1, TOKENS - 1, prepared.t.size
        ends = (commands.lowest, commands.highest) if address.mode == "stream" else ()
        try:  # before anything moves
            for values in (np.empty(0), *ends):
                link.encode(np.concatenate([header, values]))
        except InputError:
            link.close()
            raise
        return kind(prepared, layout, link, address.mode, name)
    assert address.map is not None  # `Address.of` sees to it
    text, machine = read_text(address.map), prepared.machine
    known = validated(CardMap, table_of(text, address.map), text, address.map)
    outputs = [known.outputs.get(name) for name in machine.commands.names]
    missing = [n for n, o in zip(machine.commands.names, outputs, strict=True) if o is None]
    if missing:
        raise InputError(message("links.no_terminal", names=", ".join(missing)), file=address.map)
    inputs = [known.inputs.get(name) for name in machine.channels]
    names = [item.terminal for item in inputs if item is not None]
    into = np.array([(i.scale, i.offset) if i else (np.nan, 0.0) for i in inputs])
    out = np.array([(o.scale, o.offset) for o in outputs if o is not None])
    rest = out[:, 0] * machine.commands.rest + out[:, 1]
    try:
        terminals = [o.terminal for o in outputs if o is not None]
        card = CARDS[address.scheme](address.host, names, terminals, rest)
    except ImportError as error:
        raise InputError(message("links.extra", extra="daq")) from error
    return CardMachine(prepared, card, (into, out), name)
