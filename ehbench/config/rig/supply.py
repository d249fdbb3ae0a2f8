"""Where the oil comes from, and the oil."""

from typing import Annotated, Any, Self

from pydantic import model_validator

from ehbench.config.rig.names import Misplaced
from ehbench.vocabulary import message
from ehbench.vocabulary.fields import FileModel, Q, Value


class Accumulator(FileModel):
    """A gas-charged accumulator on the supply line: ``p V_gas^n`` stays, p absolute; ``gas_volume``
    at ``precharge``, without oil."""

    gas_volume: Annotated[Value, Q("gas_volume")]
    precharge: Annotated[Value, Q("precharge")]
    polytropic_exponent: Annotated[Value, Q("polytropic_exponent")] = Value(1.2)


class LoadSensing(FileModel):
    """The pump's pressure follows the highest chamber that an open edge feeds: its pressure and
    ``load_margin``, up to the supply's ``pressure``, with a first-order lag."""

    load_margin: Annotated[Value, Q("load_margin")]
    load_lag: Annotated[Value, Q("load_lag")] = Value(0.05)


class LowRail(FileModel):
    """A second line, of constant ``rail_pressure``: an edge from the supply takes from it while
    that is ``rail_margin`` or more above the chamber which it feeds."""

    rail_pressure: Annotated[Value, Q("rail_pressure")]
    rail_margin: Annotated[Value, Q("rail_margin")]


class Supply(FileModel):
    """Constant-pressure supply: holds ``pressure`` up to ``flow_limit``, above which the pressure
    falls. With an accumulator and no ``flow_limit`` it is a charge line, at ``pressure`` when a
    motion begins. With ``load_sensing`` the pressure follows the load, with ``low_rail`` there is a
    second, lower one."""

    pressure: Annotated[Value, Q("pressure")]
    tank_pressure: Annotated[Value, Q("tank_pressure")] = Value(0.0)
    flow_limit: Annotated[Value, Q("flow_limit")]
    volume: Annotated[Value, Q("volume")] = Value(2.0e-3)
    accumulator: Accumulator | None = None
    load_sensing: LoadSensing | None = None
    low_rail: LowRail | None = None

    @property
    def constant(self) -> bool:
        """Whether there is one pressure, whatever the load."""
        return self.load_sensing is None and self.low_rail is None

    @property
    def kind(self) -> str:
        """What it is, in words."""
        if self.load_sensing is not None:
            return "load sensing"
        return "constant pressure" if self.low_rail is None else "two rails"

    def facts(self) -> dict[str, Any]:
        """Its kind in words and what makes its pressure, SI."""
        results: dict[str, Any] = {"kind": self.kind, "pressure": float(self.pressure)}
        for item in (self.load_sensing, self.low_rail):
            if item is not None:
                results |= {name: float(getattr(item, name)) for name in type(item).model_fields}
        return results

    def check_following(self) -> None:
        """Refuse a way to follow the load that does not go with the rest.

        Raises:
            Misplaced: says what would."""
        load, low = self.load_sensing, self.low_rail
        maximum = float(self.pressure) - float(self.tank_pressure)
        if load is not None and not 0.0 < float(load.load_margin) < maximum:
            raise Misplaced(message("config.load_margin_range"), *("load_sensing", "load_margin"))
        if load is not None and not float(load.load_lag) > 0.0:
            raise Misplaced(message("config.load_lag_range"), "load_sensing", "load_lag")
        if low and not 0.0 < float(low.rail_margin) < float(low.rail_pressure) < maximum:
            raise Misplaced(message("config.rail_range"), *("low_rail", "rail_pressure"))
        if load is not None and (low is not None or self.accumulator is not None):
            other = "low_rail" if low is not None else "accumulator"
            raise Misplaced(message("config.holds_pressure", other=other), other)

    @model_validator(mode="after")
    def _pressures_fit(self) -> Self:
        self.check_following()
        if float(self.pressure) <= float(self.tank_pressure):
            raise Misplaced(message("config.supply_below_tank"), "pressure")
        gas = self.accumulator
        if gas is not None and float(self.pressure) <= float(gas.precharge):
            raise Misplaced(message("config.precharge_high"), *("accumulator", "precharge"))
        return self


class Oil(FileModel):
    """The oil. ``bulk_modulus`` is effective: oil, entrained air and hose together; with
    ``air_fraction`` it is of what the air leaves over, and softens as the pressure falls."""

    bulk_modulus: Annotated[Value, Q("bulk_modulus")]
    air_fraction: Annotated[Value, Q("air_fraction")] | None = None
    polytropic_exponent: Annotated[Value, Q("polytropic_exponent")] | None = None
    cavitation_pressure: Annotated[Value, Q("cavitation_pressure")] = Value(-9.0e4)

    @model_validator(mode="after")
    def _air_is_whole(self) -> Self:
        if self.polytropic_exponent is not None and self.air_fraction is None:
            raise Misplaced(message("config.exponent_without_air"), "polytropic_exponent")
        return self
