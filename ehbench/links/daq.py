"""Cards that clock outputs and inputs together: NI by nidaqmx, LabJack T-series by ljm.

Both are tested against a substitute of the vendor's library alone, never on a card."""

from collections.abc import Sequence
from importlib import import_module

import numpy as np


class NiCard:
    """A card of National Instruments: analogue inputs share the clock of the outputs.

    Args:
        device: such as ``Dev1``.
        inputs: terminals, such as ``ai0``, in the order of the columns.
        outputs: such as ``ao0``.
        rest: volts [V] of the outputs at rest.
    """

    def __init__(
        self, device: str, inputs: Sequence[str], outputs: Sequence[str], rest: np.ndarray
    ) -> None:
        self.device, self.inputs, self.outputs, self.rest = device, inputs, outputs, rest

    def play(self, table: np.ndarray, rate: float) -> np.ndarray:
        """As `Card.play`."""
        nidaqmx = import_module("nidaqmx")

        rows, clock = len(table), f"/{self.device}/ao/SampleClock"
        with nidaqmx.Task() as out, nidaqmx.Task() as into:
            for name in self.outputs:
                out.ao_channels.add_ao_voltage_chan(f"{self.device}/{name}")
            for name in self.inputs:
                into.ai_channels.add_ai_voltage_chan(f"{self.device}/{name}")
            out.timing.cfg_samp_clk_timing(rate, samps_per_chan=rows)
            into.timing.cfg_samp_clk_timing(rate, source=clock, samps_per_chan=rows)
            out.write(np.squeeze(table.T).tolist(), auto_start=False)
            into.start()  # it waits for the outputs' clock
            out.start()
            volts = into.read(rows, timeout=rows / rate + 10.0)
        return np.atleast_2d(np.array(volts)).T

    def close(self) -> None:
        """As `Card.close`."""
        nidaqmx = import_module("nidaqmx")

        with nidaqmx.Task() as out:
            for name in self.outputs:
                out.ao_channels.add_ao_voltage_chan(f"{self.device}/{name}")
            out.write(self.rest.tolist() if len(self.rest) > 1 else float(self.rest[0]))


class LabJackCard:
    """A LabJack of the T series: its stream puts outputs out and reads inputs at each scan.

    Args:
        device: serial number, address or ``ANY``.
        inputs: such as ``AIN0``.
        outputs: such as ``DAC0``.
        rest: volts [V] of the outputs at rest.
    """

    def __init__(
        self, device: str, inputs: Sequence[str], outputs: Sequence[str], rest: np.ndarray
    ) -> None:
        ljm = import_module("labjack.ljm")

        self._ljm, self.inputs, self.outputs, self.rest = ljm, inputs, outputs, rest
        self._handle = ljm.openS("ANY", "ANY", device)

    def play(self, table: np.ndarray, rate: float) -> np.ndarray:
        """As `Card.play`."""
        ljm, names = self._ljm, [*self.inputs]
        for number, (output, column) in enumerate(zip(self.outputs, table.T, strict=True)):
            target = ljm.nameToAddress(output)[0]
            ljm.periodicStreamOut(self._handle, number, target, rate, len(column), column.tolist())
            names.append(f"STREAM_OUT{number}")
        scans = ljm.namesToAddresses(len(names), names)[0]
        ljm.eStreamStart(self._handle, len(table), len(names), scans, rate)
        try:
            volts = ljm.eStreamRead(self._handle)[0]
        finally:
            ljm.eStreamStop(self._handle)
        return np.array(volts).reshape(len(table), -1)[:, : len(self.inputs)]

    def close(self) -> None:
        """As `Card.close`."""
        for name, volts in zip(self.outputs, self.rest.tolist(), strict=True):
            self._ljm.eWriteName(self._handle, name, volts)
        self._ljm.close(self._handle)
