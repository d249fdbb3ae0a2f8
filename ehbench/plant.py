"""The plant, compiled: the laws of SPEC 2 put together into derivatives for any rig.

State ``y``: ``q (n), qd (n), [p_head, p_rod] per cylinder, opening per valve, opening rate per
valve, p_supply``, all SI. Nodes of the hydraulic circuit: 0 supply, 1 tank, then head and rod of
each cylinder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ehbench.compiled import kernel
from ehbench.errors import InputError
from ehbench.physics import arm, cylinder, metering
from ehbench.physics.arm import forward, work_size
from ehbench.physics.cylinder import (
    CAVITATION_BAND,
    DIRECT,
    PINS,
    chamber_rate,
    chamber_volume,
    end_stop,
    inflows,
    linkage,
    relief_flow,
)
from ehbench.physics.flow_map import ValveMaps, pack
from ehbench.physics.friction import coulomb_viscous
from ehbench.physics.metering import (
    DEADBAND,
    DROP,
    EDGE_FLOATS,
    EDGE_INTS,
    FROM,
    GAIN,
    SIGN,
    TO,
    VALVE,
    edge_flow,
)
from ehbench.physics.supply import FLOW_LIMIT, SUPPLY_FLOATS, pump_flow
from ehbench.rig import Rig, Slide

# columns of a cylinder's row
(
    GEOMETRY,
    L_A,
    L_B,
    SIDE,
    PHASE,
    RETRACTED,
    STROKE,
    AREA_HEAD,
    AREA_ROD,
    VOLUME_HEAD,
    VOLUME_ROD,
    BULK,
    LEAK_INTERNAL,
    LEAK_HEAD,
    LEAK_ROD,
    VISCOUS,
    COULOMB,
    RELIEF,
    STOP,
    FLOOR,
    MOBILITY,
) = range(21)
CYLINDER_FLOATS = 21
# columns of a valve's row: ω_n², 2 ζ ω_n (both 0: the opening is the command), command range
STIFFNESS, DAMPING, LOWEST, HIGHEST = 0, 1, 2, 3
VALVE_FLOATS = 4

RELIEF_GAIN = 1.0e-9  # [m³/(s·Pa)]: 30 L/min over 5 bar
STOP_DEPTH = 1.0e-3  # [m]: how deep full supply pressure sinks a piston into its end stop
STOP_DISSIPATION = 5.0  # [s/m]
COULOMB_SPEED = 2.0e-3  # [m/s]: over which Coulomb friction turns round
TANK = 1


class Plant(NamedTuple):
    """A rig as flat arrays, the one argument type of every kernel."""

    kind: int
    gravity: np.ndarray
    links: np.ndarray
    joints: np.ndarray
    cylinders: np.ndarray
    valves: np.ndarray
    edges: np.ndarray
    wiring: np.ndarray
    maps: np.ndarray
    supply: np.ndarray


@dataclass(frozen=True)
class Layout:
    """Names of what a plant's arrays hold, in order."""

    joints: tuple[str, ...]
    cylinders: tuple[str, ...]
    valves: tuple[str, ...]
    edges: tuple[str, ...]

    @property
    def states(self) -> int:
        """Length of the state vector."""
        return 2 * len(self.joints) + 2 * len(self.cylinders) + 2 * len(self.valves) + 1

    def state(self, name: str, index: int) -> int:
        """Position in the state of ``q``, ``qd``, ``p_head``, ``p_rod``, ``opening``, ``rate``
        number ``index``, or ``p_supply``.
        """
        n, c, v = len(self.joints), len(self.cylinders), len(self.valves)
        return {
            "q": index,
            "qd": n + index,
            "p_head": 2 * n + 2 * index,
            "p_rod": 2 * n + 2 * index + 1,
            "opening": 2 * n + 2 * c + index,
            "rate": 2 * n + 2 * c + v + index,
            "p_supply": 2 * (n + c + v),
        }[name]


def layout(rig: Rig) -> Layout:
    """The names behind the plant's arrays; valves and edges as ``<cylinder>.<valve>`` and
    ``<cylinder>.<edge>``.
    """
    return Layout(
        joints=rig.joint_names,
        cylinders=tuple(c.name for c in rig.cylinder),
        valves=tuple(f"{c.name}.{v.name}" for c, v in rig.valves()),
        edges=tuple(f"{c.name}.{v.edge_name(e)}" for c, v, e in rig.edges()),
    )


def build(rig: Rig, maps: Mapping[str, ValveMaps] | None = None) -> Plant:
    """The compiled form of a rig.

    Args:
        rig: with its payload already applied (``rig.with_payload``).
        maps: measured flow maps by edge name (``edge`` or ``cylinder.edge``); they replace the
            edge's analytic law.

    Raises:
        InputError: an edge asks for a map that is not given.
    """
    maps = maps or {}
    if isinstance(rig.mechanism, Slide):
        body = rig.mechanism
        kind, links = (
            arm.SLIDE,
            [arm.pack_slide(float(body.mass), float(body.damping), float(body.incline))],
        )
        up = (0.0, 0.0, 1.0)
    else:
        kind, links = arm.CHAIN, []
        up = (0.0, 0.0, 1.0) if rig.mechanism.first_axis == "vertical" else (0.0, 1.0, 0.0)
        for joint in rig.mechanism.joint:
            xx, yy, zz, xy, xz, yz = joint.inertia.value
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            if np.linalg.eigvalsh(inertia).min() < 0 or float(joint.mass) < 0:
                raise InputError(
                    f"the inertia of link '{joint.name}' is that of no body: it has a negative principal moment"
                )
            links.append(
                arm.pack_link(
                    float(joint.dh_a),
                    float(joint.dh_d),
                    float(joint.dh_alpha),
                    float(joint.dh_theta),
                    float(joint.mass),
                    joint.com.value,
                    inertia,
                    float(joint.joint_damping),
                )
            )
    links = np.ascontiguousarray(links, dtype=float)
    gravity = float(rig.gravity) * np.array(up)
    names = rig.joint_names
    joints = np.array([names.index(c.joint) for c in rig.cylinder], dtype=np.int64)

    cylinders = np.zeros((len(rig.cylinder), CYLINDER_FLOATS))
    for row, item in zip(cylinders, rig.cylinder, strict=True):
        head, rod = item.areas()
        pins = item.pins
        row[GEOMETRY] = DIRECT if pins is None else PINS
        if pins is not None:
            row[[L_A, L_B, SIDE, PHASE, RETRACTED]] = (
                float(pins.l_a),
                float(pins.l_b),
                pins.sign,
                float(pins.phase),
                float(pins.retracted_length),
            )
        row[[STROKE, AREA_HEAD, AREA_ROD]] = float(item.stroke), head, rod
        row[[VOLUME_HEAD, VOLUME_ROD]] = float(item.volume_head), float(item.volume_rod)
        row[BULK] = float(
            item.bulk_modulus if item.bulk_modulus is not None else rig.oil.bulk_modulus
        )
        row[[LEAK_INTERNAL, LEAK_HEAD, LEAK_ROD]] = (
            float(item.leakage_internal),
            float(item.leakage_head),
            float(item.leakage_rod),
        )
        row[[VISCOUS, COULOMB]] = float(item.friction_viscous), float(item.friction_coulomb)
        row[RELIEF] = math.inf if item.relief_pressure is None else float(item.relief_pressure)
        row[STOP] = float(rig.supply.pressure) * head / STOP_DEPTH
        row[FLOOR] = float(rig.oil.cavitation_pressure)
    for index, row in enumerate(cylinders):
        row[MOBILITY] = _mobility(kind, links, row, int(joints[index]))

    valves = np.zeros((sum(1 for _ in rig.valves()), VALVE_FLOATS))
    edges, wiring, packed = [], [], []
    for index, (_, valve) in enumerate(rig.valves()):
        if valve.dynamics is not None:
            omega, zeta = rig.dynamics[valve.dynamics].frequency_and_damping()
            valves[index, [STIFFNESS, DAMPING]] = omega**2, 2 * zeta * omega
        valves[index, [LOWEST, HIGHEST]] = float(valve.command_min), float(valve.command_max)
    ends = {
        c.name: {"supply": 0, "tank": TANK, "head": 2 + 2 * i, "rod": 3 + 2 * i}
        for i, c in enumerate(rig.cylinder)
    }
    order = [f"{c.name}.{v.name}" for c, v in rig.valves()]
    for item, valve, edge in rig.edges():
        floats, ints = np.zeros(EDGE_FLOATS), np.full(EDGE_INTS, -1, dtype=np.int64)
        name = valve.edge_name(edge)
        given = maps.get(f"{item.name}.{name}") or maps.get(name)
        if edge.law == "map" and given is None:
            raise InputError(
                f"edge '{name}' of rig '{rig.name}' follows a flow map, and none is given for it",
                hint="name a run with flow_maps",
            )
        law = (
            metering.MAP
            if given is not None
            else {"orifice": metering.ORIFICE, "compensated": metering.COMPENSATED}[edge.law]
        )
        gain = edge.flow_gain if edge.law == "orifice" else edge.compensated_gain
        floats[[SIGN, GAIN, DEADBAND, DROP]] = (
            edge.sign,
            0.0 if gain is None else float(gain),
            float(edge.deadband),
            float(edge.compensation_drop),
        )
        ints[[FROM, TO, VALVE]] = (
            ends[item.name][edge.from_],
            ends[item.name][edge.to],
            order.index(f"{item.name}.{valve.name}"),
        )
        ints[metering.LAW] = law
        ints[metering.BLOCKED] = edge.reverse == "blocked"
        if given is not None:
            for column, one in (
                (metering.FORWARD, given.forward),
                (metering.REVERSE, given.reverse),
            ):
                if one is not None:
                    ints[column] = len(packed)
                    packed.append(one)
        edges.append(floats)
        wiring.append(ints)
    edges, wiring = np.ascontiguousarray(edges), np.ascontiguousarray(wiring)
    data, offsets = pack(packed) if packed else (np.zeros(1), np.zeros(0, dtype=np.int64))
    for column in (metering.FORWARD, metering.REVERSE):
        chosen = wiring[:, column] >= 0
        wiring[chosen, column] = np.asarray(offsets)[wiring[chosen, column]]
    supply = np.zeros(SUPPLY_FLOATS)
    supply[:] = (
        float(rig.supply.pressure),
        float(rig.supply.tank_pressure),
        float(rig.supply.flow_limit),
        float(rig.supply.volume),
        float(rig.oil.bulk_modulus),
    )
    return Plant(kind, gravity, links, joints, cylinders, valves, edges, wiring, data, supply)


def _mobility(kind: int, links: np.ndarray, row: np.ndarray, joint: int) -> float:
    """Largest acceleration at the cylinder per force on it [1/kg] over its stroke, the other joints
    at zero and free.
    """
    n = links.shape[0]
    mass, work, most = np.empty((n, n)), np.empty(work_size(n)), 0.0
    for x in np.linspace(0.0, row[STROKE], 5):
        q = np.zeros(n)
        q[joint] = cylinder.joint_angle(
            int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], x
        )
        arm.mass_matrix(kind, links, q, mass, work)
        _, lever, _ = linkage(
            int(row[GEOMETRY]), *row[[L_A, L_B, SIDE, PHASE, RETRACTED]], q[joint]
        )
        most = max(most, lever**2 * float(np.linalg.inv(mass)[joint, joint]))
    return most


@kernel
def workspace_size(n, cylinders, edges):
    """Length of the float64 workspace of `derivatives`."""
    return work_size(n) + n + 2 * (2 + 2 * cylinders) + edges + 1


@kernel
def derivatives(y, command, plant, dy, work):
    """Write ẏ into ``dy``; return the fastest rate [1/s] of the pressure, valve and friction
    blocks.

    ``D(q) q̈ + h + c + B q̇ = Jᵀ P_load`` (thesis 2.1, 2.2), chambers (2.4, 2.5), valve flows
    summed over the metering edges (2.10, 2.11), second-order valves (2.12). After the call
    ``work[edge_offset:]`` holds the edge flows, then the pump flow.

    Args:
        y: state, shape (states,).
        command: valve commands [V], shape (valves,), limited here to each driver's range.
        dy: out, shape (states,).
        work: workspace of `workspace_size`.
    """
    n, nc, nv, ne = (
        plant.links.shape[0],
        plant.cylinders.shape[0],
        plant.valves.shape[0],
        plant.edges.shape[0],
    )
    at_p = 2 * n
    at_open = at_p + 2 * nc
    at_rate = at_open + nv
    at_supply = at_rate + nv
    torque_at = work_size(n)
    net_at = torque_at + n
    slope_at = net_at + 2 + 2 * nc
    flow_at = slope_at + 2 + 2 * nc
    fastest = 0.0

    for i in range(nv):
        u = min(max(command[i], plant.valves[i, LOWEST]), plant.valves[i, HIGHEST])
        k = plant.valves[i, STIFFNESS]
        rate = y[at_rate + i]
        dy[at_open + i] = rate
        dy[at_rate + i] = k * (u - y[at_open + i]) - plant.valves[i, DAMPING] * rate
        fastest = max(fastest, k)
    fastest = math.sqrt(fastest)

    for i in range(net_at, flow_at):
        work[i] = 0.0
    for e in range(ne):
        a, b, i = plant.wiring[e, FROM], plant.wiring[e, TO], plant.wiring[e, VALVE]
        if plant.valves[i, STIFFNESS] == 0.0:
            opening = min(max(command[i], plant.valves[i, LOWEST]), plant.valves[i, HIGHEST])
        else:
            opening = y[at_open + i]
        flow = 0.0
        if plant.edges[e, SIGN] * opening > 0.0:
            p_a = y[at_supply] if a == 0 else (plant.supply[1] if a == TANK else y[at_p + a - 2])
            p_b = y[at_supply] if b == 0 else (plant.supply[1] if b == TANK else y[at_p + b - 2])
            drop = p_a - p_b
            flow = edge_flow(drop, opening, plant.edges[e], plant.wiring[e], plant.maps)
            if flow != 0.0:
                slope = flow / drop
                work[net_at + a] -= flow
                work[net_at + b] += flow
                work[slope_at + a] += slope
                work[slope_at + b] += slope
        work[flow_at + e] = flow

    for i in range(n):
        dy[i] = y[n + i]
        work[torque_at + i] = 0.0
    p_tank = plant.supply[1]
    for c in range(nc):
        row = plant.cylinders[c]
        j = plant.joints[c]
        p_head, p_rod = y[at_p + 2 * c], y[at_p + 2 * c + 1]
        x, lever, _ = linkage(
            int(row[GEOMETRY]), row[L_A], row[L_B], row[SIDE], row[PHASE], row[RETRACTED], y[j]
        )
        v = lever * y[n + j]
        volumes = (
            chamber_volume(row[VOLUME_HEAD], row[AREA_HEAD] * x),
            chamber_volume(row[VOLUME_ROD], -row[AREA_ROD] * x),
        )
        head_in = work[net_at + 2 + 2 * c] - relief_flow(p_head, row[RELIEF], RELIEF_GAIN)
        rod_out = relief_flow(p_rod, row[RELIEF], RELIEF_GAIN) - work[net_at + 3 + 2 * c]
        inflow = inflows(
            v,
            head_in,
            rod_out,
            p_head,
            p_rod,
            p_tank,
            row[AREA_HEAD],
            row[AREA_ROD],
            row[LEAK_INTERNAL],
            row[LEAK_HEAD],
            row[LEAK_ROD],
        )
        for side in range(2):
            p = y[at_p + 2 * c + side]
            dy[at_p + 2 * c + side] = chamber_rate(
                inflow[side], p, volumes[side], row[BULK], row[FLOOR]
            )
            slope = work[slope_at + 2 + 2 * c + side]
            # what a chamber would run into within the step counts as soon as it is that near
            if inflow[side] < 0.0:
                slope -= inflow[side] / max(p - row[FLOOR], CAVITATION_BAND)
            elif p < row[RELIEF]:
                slope += min(inflow[side] / (row[RELIEF] - p), RELIEF_GAIN)
            if p > row[RELIEF]:
                slope += RELIEF_GAIN
            fastest = max(fastest, row[BULK] / volumes[side] * slope)
        force = p_head * row[AREA_HEAD] - p_rod * row[AREA_ROD]
        if row[COULOMB] != 0.0 or row[VISCOUS] != 0.0:
            force -= coulomb_viscous(v, row[VISCOUS], row[COULOMB], COULOMB_SPEED)
            steep = 0.0 if abs(v) > 4.0 * COULOMB_SPEED else row[COULOMB] / COULOMB_SPEED
            fastest = max(fastest, row[MOBILITY] * (steep + row[VISCOUS]))
        if x < 0.0 or x > row[STROKE]:
            force += end_stop(x, v, row[STROKE], row[STOP], STOP_DISSIPATION)
            fastest = max(fastest, 2.0 * math.sqrt(row[MOBILITY] * row[STOP]))
        work[torque_at + j] = lever * force
    forward(
        plant.kind,
        plant.links,
        plant.gravity,
        y[:n],
        y[n : 2 * n],
        work[torque_at : torque_at + n],
        dy[n : 2 * n],
        work,
    )

    demand = -work[net_at]
    pump = pump_flow(y[at_supply], demand, plant.supply)
    work[flow_at + ne] = pump
    stiffness = plant.supply[4] / plant.supply[3]
    dy[at_supply] = stiffness * (pump - demand)
    held = 0.0 < pump < plant.supply[FLOW_LIMIT]
    return fastest if held else max(fastest, stiffness * work[slope_at])
