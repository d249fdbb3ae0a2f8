"""Vectors as registers of Modbus TCP: written and read in one function 23."""

import asyncio
import logging
import struct
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ehbench.config.recipe.toml import read_text, table_of, validated
from ehbench.links.responder import Target
from ehbench.links.transport import SEQUENCE, VirtualClock, datagram_of
from ehbench.vocabulary import InputError, message
from ehbench.vocabulary.fields import FileModel

FORMATS = dict(zip(("float32", "float64", "int16", "uint16", "int32", "uint32"), "fdhHiI"))
PATIENCE = 0.2  # [s] of a host until a server answers: a trial has long been stopped then
UP, DOWN, COUNT = 0, 1000, 2000  # where the default map begins; how many there are
logging.getLogger("pymodbus").addHandler(logging.NullHandler())  # else Python prints its warnings


class Register(FileModel):
    """Where a number lies: value = raw · ``scale`` + ``offset`` [SI], high word first."""

    address: int
    type: Literal["float32", "float64", "int16", "uint16", "int32", "uint32"] = "float32"
    scale: float = 1.0
    offset: float = 0.0


class RegisterMap(FileModel):
    """Registers of what comes up and goes down, by name."""

    up: dict[str, Register]
    down: dict[str, Register]


class Block:
    """Some named numbers in consecutive registers; those without a register are nan."""

    def __init__(self, names: Sequence[str], places: dict[str, Register]) -> None:
        self.names, self.places = names, {n: places[n] for n in names if n in places}
        ends = [(r.address, struct.calcsize(FORMATS[r.type]) // 2) for r in self.places.values()]
        self.first = min(at for at, _ in ends)
        self.count = max(at + size for at, size in ends) - self.first

    def encode(self, numbers: np.ndarray) -> list[int]:
        """Registers of numbers.

        Raises:
            InputError: one that its register cannot hold.
        """
        data = bytearray(2 * self.count)
        for name, number in zip(self.names, numbers.tolist(), strict=True):
            if (r := self.places.get(name)) is not None:
                raw, at = (number - r.offset) / r.scale, 2 * (r.address - self.first)
                try:
                    raw = raw if r.type.startswith("float") else round(raw)
                    struct.pack_into(f">{FORMATS[r.type]}", data, at, raw)
                except (struct.error, ValueError, OverflowError) as error:
                    why = f"{number:g} as {r.type} with scale {r.scale:g}"
                    raise InputError(message("links.no_room", name=name, why=why)) from error
        return list(struct.unpack(f">{self.count}H", data))

    def decode(self, registers: Sequence[int]) -> np.ndarray:
        """Numbers of registers."""
        data, numbers = struct.pack(f">{self.count}H", *registers), np.full(len(self.names), np.nan)
        for i, name in enumerate(self.names):
            if (r := self.places.get(name)) is not None:
                at = 2 * (r.address - self.first)
                numbers[i] = struct.unpack_from(f">{FORMATS[r.type]}", data, at)[0]
                numbers[i] = numbers[i] * r.scale + r.offset
        return numbers


def blocks(up: Sequence[str], down: Sequence[str], path: Path | None) -> tuple[Block, Block]:
    """The registers of what comes up and of what goes down, by a map or one float32 after another.

    Raises:
        InputError: a map that cannot be read.
    """
    if path is not None:
        text = read_text(path)
        known = validated(RegisterMap, table_of(text, path), text, path)
        return Block(up, known.up), Block(down, known.down)
    ways = ((up, UP), (down, DOWN))
    upward, downward = (
        Block(names, {name: Register(address=at + 2 * i) for i, name in enumerate(names)})
        for names, at in ways
    )
    return upward, downward


class ModbusLink:
    """A controller or drive as a server of Modbus TCP.

    Args:
        host: name or address.
        port: 502 by the standard.
        names: of all numbers that come up, and of those that go down.
        path: a map of registers.
        virtual: the server runs on a virtual clock.
    """

    def __init__(
        self,
        host: str,
        port: int,
        names: tuple[Sequence[str], Sequence[str]],
        path: Path | None = None,
        virtual: bool = False,
    ) -> None:
        from pymodbus.client import ModbusTcpClient

        self.virtual, (self._up, self._down) = virtual, blocks(*names, path)
        self._client = ModbusTcpClient(host, port=port, timeout=PATIENCE, retries=0)
        self._last, self._came = -1.0, []

    def encode(self, numbers: np.ndarray) -> list[int]:
        """As `Link.encode`; numbers that it lacks are 0."""
        whole = np.zeros(len(self._down.names))
        whole[: numbers.size] = numbers
        return self._down.encode(whole)

    def send(self, numbers: np.ndarray) -> None:
        """As `Link.send`: one round trip."""
        where = {"read_address": self._up.first, "read_count": self._up.count}
        values = self.encode(numbers)
        self._call("readwrite_registers", **where, write_address=self._down.first, values=values)

    def _call(self, name: str, **keys: Any) -> None:
        """Ask the server; what it answers is a sample if it is a new one."""
        from pymodbus.exceptions import ModbusException

        try:
            if not (self._client.connected or self._client.connect()):
                return time.sleep(0.01)  # it is not there yet
            answer = getattr(self._client, name)(device_id=1, **keys)
        except (ModbusException, OSError):
            return self._client.close()  # what it still has to say is late
        numbers = np.empty(0)  # an exception, or registers that were not asked for
        if not answer.isError() and len(answer.registers) == self._up.count:
            numbers = self._up.decode(answer.registers)
            if numbers[SEQUENCE] == self._last:
                return
            self._last = numbers[SEQUENCE]
        self._came.append(numbers)

    def receive(self, timeout: float) -> list[np.ndarray]:
        """As `Link.receive`."""
        until = time.monotonic() + timeout
        while not self._came and not self.virtual and time.monotonic() < until:
            time.sleep(5e-4)
            self._call("read_holding_registers", address=self._up.first, count=self._up.count)
        came, self._came = self._came, []
        return came

    def close(self) -> None:
        """As `Link.close`."""
        self._client.close()


def serve(
    target: Target,
    place: tuple[str, int],
    names: tuple[Sequence[str], Sequence[str]],
    path: Path | None,
    virtual: bool,
    ready: Callable[[], None],
) -> None:
    """Serve a target as a Modbus server, on its own clock or on that of its host; ``ready`` is
    called when it can.

    Raises:
        OSError: the port is in use, or no address of this machine."""
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    up, down = blocks(*names, path)
    newest, clock = [0] * COUNT, VirtualClock(target)

    def show(datagram: bytes) -> None:
        if datagram:
            numbers = np.frombuffer(datagram, "<f8")[: len(up.names)]
            newest[up.first : up.first + up.count] = up.encode(numbers)

    async def act(code, start, address, count, registers, values) -> None:
        if values is not None:
            at = address - down.first
            whole = registers[down.first : down.first + down.count]
            whole[at : at + count] = values
            datagram = datagram_of(down.decode(whole), target)
            if virtual:
                show(clock.answer(datagram))
            else:
                target.receive(datagram, time.monotonic())
        registers[up.first : up.first + up.count] = newest[up.first : up.first + up.count]

    async def ticks() -> None:
        due = time.monotonic()
        while not virtual:
            show(target.tick(time.monotonic()))
            due = max(due + 1.0 / target.rate, time.monotonic() - 0.1)
            await asyncio.sleep(max(due - time.monotonic(), 0.0))

    async def both() -> None:
        data = SimData(0, count=COUNT, values=0, datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(1, [data], action=act), address=place)
        try:
            await server.serve_forever(background=True)
        except RuntimeError as error:  # the address is in use
            raise OSError(*error.args) from None
        ready()
        await asyncio.gather(server.serving, ticks())

    asyncio.run(both())
