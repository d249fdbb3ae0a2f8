"""What a datagram holds: names, units and their order, from a rig."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from shutil import copy
from typing import Literal
from zlib import crc32

import numpy as np

from ehbench.config.rig import Rig
from ehbench.links.responder import HEADER
from ehbench.machines.protocol import Inputs
from ehbench.parts.sample import sample_channels
from ehbench.plant.model import Model
from ehbench.vocabulary import VOCABULARY
from ehbench.vocabulary.quantities import STROKES

Mode = Literal["stream", "setpoint", "buffered"]
MODES: tuple[Mode, ...] = ("stream", "setpoint", "buffered")
REFERENCES = ("x_desired", "v_desired", "a_desired")
FAST = 500.0  # ranges of a driver a second: the clamp on a command's rate, two milliseconds


@dataclass(frozen=True)
class Layout:
    """The values behind the header of a datagram.

    ``channels`` of the sample, then the commands that acted up to it, come up. ``commands``, or the
    ``references`` of a target that closes the loop, go down. All are SI; commands are in volts.
    ``slides``: q and qd are the stroke and the speed of a slide."""

    rig: str
    channels: tuple[str, ...]
    commands: Inputs
    references: tuple[str, ...]
    slides: bool = False

    @classmethod
    def of(cls, rig: Rig) -> Layout:
        """That of a rig."""
        model = Model.of(rig)
        cylinders = model.layout.cylinders
        references = tuple(f"{name}.{word}" for name in cylinders for word in REFERENCES)
        slides = rig.mechanism.kind == "slide"
        return cls(rig.name, sample_channels(cylinders), Inputs.of(model), references, slides)

    def down(self, mode: Mode) -> tuple[str, ...]:
        """Names of what goes down; a row of a table has its number before its commands."""
        commands = tuple(f"{name}.command" for name in self.commands.names)
        return {
            "stream": commands,
            "setpoint": self.references,
            "buffered": ("row", *commands),
        }[mode]

    def names(self, mode: Mode) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of all numbers that come up and go down, the header's among them."""
        return (*HEADER, *self.up), (*HEADER, *self.down(mode))

    @property
    def up(self) -> tuple[str, ...]:
        """Names of what comes up."""
        return (*self.channels, *self.down("stream"))

    def number(self, mode: Mode) -> int:
        """The number of the layout in every header: 24 bits of the names' CRC-32, so that a
        float32 holds it."""
        return crc32("\n".join((mode, *self.up, "", *self.down(mode))).encode()) & 0xFFFFFF

    def clamps(self) -> list[tuple[float, float, float, float]]:
        """(lowest, highest, rest [V], largest change [V/s]) of each command."""
        c = self.commands
        rows = zip(c.lowest, c.highest, c.rest, FAST * (c.highest - c.lowest), strict=True)
        return [tuple(map(float, row)) for row in rows]  # type: ignore[misc]


def csv_text(layout: Layout, rate: float) -> str:
    """The layout as a table: direction, index from 0 in the datagram, name, unit, meaning."""
    lines = ["direction,index,name,unit,meaning"]
    for way, names in (("up", layout.up), ("down", layout.down("stream"))):
        for index, name in enumerate((*HEADER, *names)):
            word = name.rsplit(".", 1)[-1]
            word = STROKES.get(word, word) if layout.slides else word
            row = VOCABULARY.get(word) if index >= len(HEADER) else None
            about = f"{row.unit},{row.meaning.split(',')[0]}" if row else ",header"
            lines.append(f"{way},{index},{name},{about}")
    numbers = ", ".join(f"{mode} {layout.number(mode)}" for mode in MODES)
    return "\n".join([f"# {layout.rig}: layout {numbers}; {rate:g} Hz", *lines, ""])


def c_text(layout: Layout, rate: float) -> str:
    """The layout as a C header."""

    def table(values: np.ndarray) -> str:
        return "{" + ", ".join(f"{value!r}" for value in values.tolist()) + "}"

    clamps, lines = np.array(layout.clamps()), [f"/* {layout.rig}: ehbench wire */"]
    sizes = {"SAMPLE": len(layout.channels), "COMMANDS": len(layout.commands.names)}
    sizes |= {f"LAYOUT_{mode.upper()}": layout.number(mode) for mode in MODES}
    lines += [f"#define EHB_{name} {value}" for name, value in sizes.items()]
    lines += [f"#define EHB_RATE {rate!r}"]
    for prefix, names in (("EHB_UP", layout.up), ("EHB_DOWN", layout.down("stream"))):
        entries = (f"{prefix}_{name.replace('.', '_').upper()}" for name in names)
        lines += [f"enum {{ {', '.join(entries)} }};"]
    for name, column in zip(("LOWEST", "HIGHEST", "REST", "CHANGE"), clamps.T, strict=True):
        lines += [f"static const double EHB_{name}[] = {table(column)};"]
    return "\n".join([*lines, ""])


def m_text(layout: Layout, rate: float) -> str:
    """The layout as a MATLAB script, for Simulink's UDP blocks."""
    lines = [f"% {layout.rig}: ehbench wire; all entries are double, little-endian"]
    lines += [f"ehb.layout = {layout.number('stream')}; ehb.rate = {rate:g};"]
    for way, names in (("up", layout.up), ("down", layout.down("stream"))):
        quoted = ", ".join(f"'{name}'" for name in (*HEADER, *names))
        lines += [f"ehb.{way} = {{{quoted}}};"]
    clamps = zip(("lowest", "highest", "rest", "change"), zip(*layout.clamps()), strict=True)
    lines += [f"ehb.{name} = [{' '.join(map(repr, column))}];" for name, column in clamps]
    return "\n".join([*lines, ""])


def py_text(layout: Layout, rate: float) -> str:
    """The layout as a Python module, for the responder."""
    lines = [f"# {layout.rig}: ehbench wire", f"LAYOUT, RATE = {layout.number('stream')}, {rate!r}"]
    lines += [f"SAMPLE = {len(layout.channels)}", f"COMMANDS = {layout.clamps()!r}"]
    lines += [f"UP = {layout.up!r}", f"DOWN = {layout.down('stream')!r}"]
    return "\n".join([*lines, ""])


FRAMES = {"up": 0x100, "down": 0x200}  # first number of a frame


def dbc_text(layout: Layout, rate: float) -> str:
    """The layout as a DBC file: two float32 in a frame, the header in the last ones, which close
    the vector."""
    lines, kinds = ['VERSION ""', "NS_ :", "BS_:", "BU_: host target"], []
    for way, sender in (("up", "target"), ("down", "host")):
        names = [*(layout.up if way == "up" else layout.down("stream")), *HEADER]
        for k in range(0, len(names), 2):
            number = FRAMES[way] + k // 2
            lines += ["", f"BO_ {number} {way}_{k // 2}: 8 {sender}"]
            for i, name in enumerate(names[k : k + 2]):
                signal = f"{way}_{name.replace('.', '_')}"
                unit = '"" Vector__XXX'
                lines += [f" SG_ {signal} : {32 * i}|32@1- (1,0) [0|0] {unit}"]
                kinds += [f"SIG_VALTYPE_ {number} {signal} : 1;"]
    return "\n".join([*lines, "", *kinds, ""])


WRITERS = {  # by option: the file's name, its text, the responder that reads it
    "csv": ("ehb_wire.csv", csv_text, None),
    "c": ("ehb_wire.h", c_text, "responder.c"),
    "m": ("ehb_wire.m", m_text, None),
    "dbc": ("ehb_wire.dbc", dbc_text, None),
    "py": ("ehb_wire.py", py_text, "responder.py"),
}


def write_files(layout: Layout, rate: float, kind: str, folder: Path) -> list[Path]:
    """Write the layout into a folder, with the responder that reads it, where there is one; a
    responder that stands there may be filled in, and stays."""
    name, text, responder = WRITERS[kind]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text(layout, rate), encoding="utf-8")
    files = [folder / name]
    if responder is not None and not (folder / responder).exists():
        files.append(Path(copy(Path(__file__).with_name(responder), folder / responder)))
    return files
