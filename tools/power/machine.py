"""Machines drawn at random, what they record, and the rig file that says so."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tools.power.plant import Numbers, run, stroke_of

EDGES = (("pa", "supply", "head"), ("bt", "rod", "tank"))
EDGES += (("pb", "supply", "rod"), ("at", "head", "tank"))
GRAVITY = 9.81
TICK = 1.0e-3  # [s]
LARGEST = 10.0  # [V]
MINUTES = 1.0e-6 / 60.0 / 1.0e5  # 1 mL/min/bar [m³/(s·Pa)]
QUIET = {"q": 1e-4, "qd": 4e-3, "x": 5e-5, "v": 2e-3, "p_head": 1.5e4, "p_rod": 1.5e4}
QUIET["p_supply"] = 9.0e3
SAFE = 1.5e5  # [Pa]: below it a chamber is near cavitation, which the plant does not have


class NotDriven(ValueError):
    """No amplitude keeps a machine within its stroke and pressures."""


@dataclass(frozen=True)
class Machine:
    """A slide or a crane with its cylinder and valve, as a rig file describes it [SI]."""

    kind: str
    spools: int
    bore: float
    rod: float
    stroke: float
    volume_head: float
    volume_rod: float
    bulk_modulus: float
    supply: float
    tank: float
    mass: float
    damping: float
    omega: float
    zeta: float
    gain: tuple[float, ...]
    deadband: float
    leakage_internal: float = 0.0
    leakage_head: float = 0.0
    coulomb: float = 0.0
    static: float = 0.0
    stribeck_speed: float = 0.01
    arm: float = 0.0
    com: tuple[float, float] = (0.0, 0.0)
    inertia: float = 0.0
    l_a: float = 0.0
    l_b: float = 0.0
    phase: float = 0.0
    retracted: float = 0.0

    @property
    def areas(self) -> tuple[float, float]:
        """Head and rod area [m²]."""
        head = 0.25 * math.pi * self.bore**2
        return head, head - 0.25 * math.pi * self.rod**2

    @property
    def numbers(self) -> Numbers:
        """As the plant takes them."""
        crane = self.kind == "crane"
        along, across = self.arm + self.com[0], self.com[1]
        whole = self.inertia + self.mass * (along**2 + across**2)
        return Numbers(
            crane=int(crane),
            inertia=whole if crane else self.mass,
            damping=self.damping,
            weight=self.mass * GRAVITY * along,
            rise=self.mass * GRAVITY * across,
            **{key: getattr(self, key) for key in ("l_a", "l_b", "phase", "retracted")},
            area_head=self.areas[0],
            area_rod=self.areas[1],
            **{key: getattr(self, key) for key in ("volume_head", "volume_rod", "bulk_modulus")},
            **{key: getattr(self, key) for key in ("supply", "tank")},
            **{key: getattr(self, key) for key in ("leakage_internal", "leakage_head")},
            **{key: getattr(self, key) for key in ("coulomb", "static", "stribeck_speed")},
            **{key: getattr(self, key) for key in ("spools", "omega", "zeta")},
            gain=np.array(self.gain),
            deadband=np.full(4, self.deadband),
        )

    @property
    def joint(self) -> str:
        """Name of what the cylinder moves."""
        return "arm" if self.kind == "crane" else "carriage"

    @property
    def substeps(self) -> int:
        """Steps between samples that follow its friction and valve."""
        steep = max(self.coulomb / 2.0e-3, self.static / 1.0e-3) / self.mass
        return max(20, math.ceil(2.0 * TICK * max(steep, self.omega)))


def draw(rng: np.random.Generator, kind: str, spools: int) -> Machine:
    """A machine with numbers that such machines have."""
    bore = _between(rng, 0.032, 0.08)
    rod = bore * rng.uniform(0.45, 0.72)
    stroke = bore * rng.uniform(5.0, 10.0)
    head = 0.25 * math.pi * bore**2
    area = head, head - 0.25 * math.pi * rod**2
    supply = rng.uniform(9.0e6, 2.0e7)
    bulk = _between(rng, 3.0e8, 1.5e9)
    volumes = [a * stroke * rng.uniform(0.3, 0.8) for a in area]
    volumes[1] += area[1] * stroke
    fast = rng.uniform(0.4, 1.0) * stroke  # [m/s] at full opening and half the supply's drop
    plain = head * fast / (LARGEST * math.sqrt(0.5 * supply))
    share = (1.0, 0.8, 0.8, 0.9) if kind == "slide" else (1.0, 0.9, 0.9, 0.45)
    some = {
        "kind": kind,
        "spools": spools,
        "bore": bore,
        "rod": rod,
        "stroke": stroke,
        "volume_head": volumes[0],
        "volume_rod": volumes[1],
        "bulk_modulus": bulk,
        "supply": supply,
        "tank": rng.uniform(1.0e5, 4.0e5),
        "omega": 2.0 * math.pi * _between(rng, 10.0, 80.0),
        "zeta": rng.uniform(0.6, 1.0),
        "gain": tuple(plain * s * rng.uniform(0.85, 1.15) for s in share),
        "deadband": rng.uniform(0.3, 1.5) if rng.random() < 0.6 else 0.0,
        "stribeck_speed": rng.uniform(0.008, 0.02),
    }
    leaks, rubs, creeps = rng.random(3) < (0.7, 0.7, 0.3)
    some["leakage_internal"] = _between(rng, 5.0, 50.0) * MINUTES if leaks else 0.0
    some["leakage_head"] = _between(rng, 1.0, 10.0) * MINUTES if creeps else 0.0
    some["coulomb"] = head * supply * _between(rng, 0.005, 0.03) if rubs else 0.0
    some["static"] = some["coulomb"]
    oil = (area[0] ** 2 / (volumes[0] + area[0] * stroke / 2),)
    oil += (area[1] ** 2 / (volumes[1] - area[1] * stroke / 2),)
    stiffness, ratio = bulk * sum(oil), rng.uniform(0.03, 0.25)
    if kind == "slide":
        mass = stiffness / (2.0 * math.pi * _between(rng, 8.0, 35.0)) ** 2
        return Machine(mass=mass, damping=2.0 * ratio * math.sqrt(stiffness * mass), **some)
    return _crane(rng, some, supply * head, stiffness, ratio)


def _crane(rng, some: dict, force: float, stiffness: float, ratio: float) -> Machine:
    """A crane whose load takes a part of the cylinder's ``force`` [N] at mid-stroke."""
    l_b = some["stroke"] * rng.uniform(1.1, 1.5)
    l_a, phase = l_b * rng.uniform(1.3, 1.8), math.radians(rng.uniform(70.0, 95.0))
    middle = math.sqrt(l_a**2 + l_b**2 - 2.0 * l_a * l_b * math.cos(phase))
    lever = l_a * l_b * math.sin(phase) / middle
    arm = l_a * rng.uniform(1.5, 3.0)
    com = -arm * rng.uniform(0.2, 0.5), rng.uniform(0.0, 0.05) * arm
    mass = rng.uniform(0.12, 0.4) * force * lever / (GRAVITY * (arm + com[0]))
    inertia = mass * arm**2 / 12.0
    whole = inertia + mass * ((arm + com[0]) ** 2 + com[1] ** 2)
    damping = 2.0 * ratio * math.sqrt(stiffness * lever**2 * whole)
    pins = {"l_a": l_a, "l_b": l_b, "phase": phase, "retracted": middle - 0.5 * some["stroke"]}
    about = {"arm": arm, "com": com, "inertia": inertia}
    return Machine(mass=mass, damping=damping, **about, **pins, **some)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


WAVES = ("steps", "short steps", "multisine", "chirp", "sine", "ramps")


def wave(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A command of size one that begins and ends at rest, 3 s at 1 kHz."""
    t = np.arange(3001) * TICK
    late = rng.uniform(0.0, 0.1)
    if kind in ("steps", "short steps"):
        shrink = 1.0 if kind == "steps" else 0.5
        levels = 1.0, 0.0, -rng.uniform(0.7, 1.0), 0.0, rng.uniform(0.4, 0.8), 0.0
        u = np.zeros_like(t)
        for i, level in enumerate(levels):
            u[t >= 0.2 + late + shrink * 0.45 * i] = level
        return u
    if kind == "ramps":
        corners = np.array([0.2, 0.8, 1.3, 2.0, 2.6]) + late
        return np.interp(t, corners, [0.0, 0.7, -0.6, 0.5, 0.0])
    on, s = (t >= 0.2 + late) & (t < 2.7), t - 0.2 - late
    if kind == "sine":
        return np.where(on, np.sin(2.0 * math.pi * rng.uniform(0.8, 1.6) * s), 0.0)
    if kind == "chirp":
        high = rng.uniform(10.0, 20.0)
        return np.where(on, np.sin(2.0 * math.pi * (0.5 * s + (high - 0.5) / 5.0 * s**2)), 0.0)
    parts = [
        np.sin(2.0 * math.pi * f * s + rng.uniform(0.0, 2.0 * math.pi))
        for f in (0.8, 1.3, 2.1, 3.4, 5.5, 8.9, 14.4)
    ]
    u = np.where(on, np.sum(parts, axis=0), 0.0)
    return u / np.max(np.abs(u))


class Test(NamedTuple):
    """Commands [V], shape (samples, spools), and the state at the first sample."""

    commands: np.ndarray
    start: np.ndarray


def valve_commands(machine: Machine, u: np.ndarray) -> np.ndarray:
    """Commands by spool of a signed command: cartridges take one sign each."""
    if machine.spools == 1:
        return u[:, np.newaxis]
    out, back = np.maximum(u, 0.0), np.maximum(-u, 0.0)
    return np.column_stack([out, out, back, back])


def start_of(machine: Machine, rng: np.random.Generator) -> np.ndarray:
    """The state after it has stood for a while at mid-stroke with shut valves: it creeps, if it
    leaks."""
    n, q = machine.numbers, 0.5 * machine.stroke * (machine.kind == "slide")
    _, lever = stroke_of(n, q)
    rod = rng.uniform(0.15, 0.4) * machine.supply
    head = (rod * n.area_rod + (n.weight / lever if n.crane else 0.0)) / n.area_head
    y = np.zeros(4 + 2 * machine.spools)
    y[0], y[2], y[3] = q, head, rod
    still = np.zeros((1 + int(1000 * rng.uniform(0.2, 1.0)), machine.spools))
    return run(n, y, still, TICK, machine.substeps)[-1]


def test_of(machine: Machine, kind: str, rng: np.random.Generator) -> tuple[Test, np.ndarray]:
    """(a test, the machine's states in it). It keeps off the stops, and its chambers off cavitation
    and below the supply: no oil flows back into the pump's line, whose pressure is constant here.

    Raises:
        NotDriven: none does."""
    start, u = start_of(machine, rng), wave(kind, rng)
    size = rng.uniform(0.4, 0.7) * LARGEST
    for _ in range(12):
        test = Test(valve_commands(machine, size * u), start)
        states = simulated(machine, test)
        x = strokes(machine, states[:, 0])
        low, high = states[:, 2:4].min(), states[:, 2:4].max()
        inside = 0.05 < x.min() / machine.stroke and x.max() / machine.stroke < 0.95
        if inside and low > SAFE and high < 0.98 * machine.supply:
            if np.ptp(x) < 0.01 * machine.stroke:
                break
            return test, states
        size *= 0.8
    raise NotDriven(f"{machine.kind}: {kind}")


def simulated(machine: Machine, test: Test) -> np.ndarray:
    """States of a machine in a test."""
    return run(machine.numbers, test.start, test.commands, TICK, machine.substeps)


def strokes(machine: Machine, q: np.ndarray) -> np.ndarray:
    """Strokes [m] at the joint's coordinates."""
    if machine.kind == "slide":
        return q
    l_a, l_b, theta = machine.l_a, machine.l_b, q + machine.phase
    return np.sqrt(l_a**2 + l_b**2 - 2.0 * l_a * l_b * np.cos(theta)) - machine.retracted


def channels(machine: Machine, states: np.ndarray, rate: bool = True) -> dict[str, np.ndarray]:
    """What sensors measure, without noise, by quantity."""
    place, speed = ("q", "qd") if machine.kind == "crane" else ("x", "v")
    signals = {place: states[:, 0], speed: states[:, 1]}
    signals |= {"p_head": states[:, 2], "p_rod": states[:, 3]}
    signals["p_supply"] = np.full(len(states), machine.supply)
    return {name: y for name, y in signals.items() if rate or name != speed}


def log_text(
    machine: Machine, test: Test, signals: Mapping[str, np.ndarray], noise: Mapping[str, np.ndarray]
) -> str:
    """A log as CSV."""
    units = {"q": "rad", "qd": "rad/s", "x": "m", "v": "m/s"}
    names = ["t [s]"]
    columns = [np.arange(len(test.commands)) * TICK]
    for name, y in signals.items():
        owner = "" if name == "p_supply" else "ram."
        names.append(f"{owner}{name} [{units.get(name, 'Pa')}]")
        columns.append(y + noise[name])
    valves = ["spool"] if machine.spools == 1 else [name for name, _, _ in EDGES]
    names += [f"ram.{valve}.command [V]" for valve in valves]
    columns += list(test.commands.T)
    rows = "\n".join(",".join(f"{v:.9g}" for v in row) for row in np.column_stack(columns))
    return ",".join(names) + "\n" + rows + "\n"


def rig_text(m: Machine) -> str:
    """Its rig file."""
    edges = []
    for i, (name, start, end) in enumerate(EDGES):
        sign = -1 if m.spools == 1 and i > 1 else 1
        edges.append(
            f'{{ name = "{name}", from = "{start}", to = "{end}", sign = {sign}, law = "orifice", '
            f'flow_gain = {{ value = "{m.gain[i]!r} m^3/(s*V*Pa^0.5)", source = "datasheet" }}, '
            f'deadband = "{m.deadband!r} V" }}'
        )
    valves = [("spool", edges)] if m.spools == 1 else zip("pa bt pb at".split(), map(_only, edges))
    low = -LARGEST if m.spools == 1 else 0.0
    valve_tables = "\n".join(
        f'[[cylinder.valve]]\nname = "{name}"\ndynamics = "spool"\ncommand_min = "{low!r} V"\n'
        f'command_max = "{LARGEST!r} V"\nedge = [{", ".join(group)}]'
        for name, group in valves
    )
    friction = ""
    if m.static > m.coulomb:
        friction = (
            f'[cylinder.friction]\nlaw = "stribeck"\nfriction_static = "{m.static!r} N"\n'
            f'stribeck_speed = "{m.stribeck_speed!r} m/s"\n'
        )
    return f"""name = "power_rig"
gravity = "{GRAVITY} m/s^2"
[oil]
bulk_modulus = {{ value = "{m.bulk_modulus!r} Pa", lower = "50 MPa", upper = "3 GPa" }}
[supply]
pressure = "{m.supply!r} Pa"
flow_limit = "2000 L/min"
tank_pressure = "{m.tank!r} Pa"
[dynamics.spool]
natural_frequency = "{m.omega!r} rad/s"
damping_ratio = "{m.zeta!r}"
{_mechanism(m)}
[[cylinder]]
name = "ram"
joint = "{m.joint}"
bore = "{m.bore!r} m"
rod = "{m.rod!r} m"
stroke = "{m.stroke!r} m"
volume_head = "{m.volume_head!r} m^3"
volume_rod = "{m.volume_rod!r} m^3"
friction_coulomb = "{m.coulomb!r} N"
leakage_internal = "{m.leakage_internal!r} m^3/(s*Pa)"
leakage_head = "{m.leakage_head!r} m^3/(s*Pa)"
{friction}{_pins(m)}{valve_tables}
"""


def _only(edge: str) -> list[str]:
    return [edge]


def _mechanism(m: Machine) -> str:
    if m.kind == "slide":
        return (
            f'[mechanism]\nkind = "slide"\nname = "{m.joint}"\nmass = "{m.mass!r} kg"\n'
            f'damping = "{m.damping!r} N*s/m"'
        )
    own = [0.5 * m.inertia, m.inertia, m.inertia, 0.0, 0.0, 0.0]
    inertia = ", ".join(f'"{value!r} kg*m^2"' for value in own)
    return (
        f'[mechanism]\nkind = "chain"\nfirst_axis = "horizontal"\n[[mechanism.joint]]\n'
        f'name = "{m.joint}"\ndh_a = "{m.arm!r} m"\nmass = "{m.mass!r} kg"\n'
        f'com = ["{m.com[0]!r} m", "{m.com[1]!r} m", "0 m"]\ninertia = [{inertia}]\n'
        f'joint_damping = "{m.damping!r} N*m*s/rad"'
    )


def _pins(m: Machine) -> str:
    if m.kind == "slide":
        return ""
    return (
        f'[cylinder.pins]\nl_a = "{m.l_a!r} m"\nl_b = "{m.l_b!r} m"\n'
        f'retracted_length = "{m.retracted!r} m"\nsign = 1\nphase = "{m.phase!r} rad"\n'
    )


def scaled(machine: Machine, **by: float) -> Machine:
    """A machine with numbers multiplied."""
    return replace(machine, **{name: getattr(machine, name) * k for name, k in by.items()})
