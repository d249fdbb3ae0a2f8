"""Run folders as commands leave them, for tests of the report: their tables stand in
``report_runs.json``."""

import json
import re
import shutil
from dataclasses import asdict
from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from ehbench.config.recipe import load_rig
from ehbench.data.logs import write_log
from ehbench.data.record import Record
from ehbench.physics.flow_map import FlowMap, collect, save_flow_maps
from ehbench.plant.design_point import circuit_of
from ehbench.plant.model import Model
from ehbench.report import draw, style
from ehbench.report.blocks import slug
from ehbench.runs.rundir import write_json
from ehbench.tune.results import functions_of
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si
from tests.settings import answers
from tests.shared import RIGS, shipped

_TABLES = Path(__file__).with_name("report_runs.json").read_text(encoding="utf-8")
VOID = {"meta", "br", "hr", "img", "input", "link"}
FOUR = {"boom.q": 0.5, "boom.qd": 1.0, "boom.p_head": 2e6, "boom.p_rod": 1e6}


def table(name: str, /, **more) -> dict:
    """A table of the file, a copy, with other entries."""
    return json.loads(_TABLES)[name] | more


def facts(folder: Path, stage: str, name: str = "", **more) -> None:
    recipe = {"path": f"{name or 'r'}.toml", "sha256": "1" * 64}
    known = {"stage": stage, "name": name or folder.name, "recipe": recipe}
    write_json(folder / "run.json", table("facts", **known, **more))


def made(root: Path, name: str, rig: str = "thesis_arm") -> Path:
    folder = root / name
    folder.mkdir(parents=True)
    shutil.copy(RIGS / f"{rig}.toml", folder / "rig.toml")
    return folder


def a_map(valve: str, direction: str, deadband: float) -> FlowMap:
    knots = deadband + np.linspace(0.0, 1.0, 6) * (10.0 - deadband)
    increments = np.full((6, 7), 6.0e-5 / 6) * np.linspace(0.4, 1.0, 7)
    commands = np.array([0.0, 1.0, 4.0, 6.0, 8.0, 10.0])
    hull = (commands, np.full(6, 1e5), np.array([7e6, 7e6, 7e6, 6e6, 5e6, 4e6]))
    ends, spread = (deadband - 0.1, deadband + 0.1), np.full((6, 3), 1e-6)
    drops = np.array([0.0, 1000.0, 2700.0])
    first = (valve, direction, deadband, ends, knots, 7e6, 2e4, increments)
    return FlowMap(*first, *hull, knots, drops, spread, 4e-4, 60, (), "x.csv")


def flow_map_run(root: Path) -> Path:
    folder, random = made(root, "maps"), np.random.default_rng(5)
    named = (("hect", "forward", 1.5), ("hect", "reverse", 2.0), ("valve/2 & co", "forward", 1.0))
    maps = [a_map(*row) for row in named]
    save_flow_maps(collect(maps), folder)
    head = "valve,direction,command [V],pressure_drop [bar],flow [L/min],fitted [L/min],method"
    rows, summary = [f"{head},outlier,file,line"], []
    for item in maps:
        pairs = [(u, dp) for u in item.hull_command for dp in np.linspace(1e5, 4e6, 8)]
        for line, (command, drop) in enumerate(pairs, 2):
            flow = item.flow(drop, command)
            out = command == 6.0 and drop == 1e5
            read = 40 * flow if out else flow + 1e-6 * random.standard_normal()
            method = "cylinder" if flow < 1e-5 else "flowmeter"
            shown = [from_si(v, "L/min", VOCABULARY["flow"]) for v in (read, flow)]
            rows.append(
                f"{item.valve},{item.direction},{command:g},{drop / 1e5:.9g},"
                f"{shown[0]:.9g},{shown[1]:.9g},{method},{int(out)},x.csv,{line}"
            )
        known = {"valve": item.valve, "direction": item.direction, "deadband": item.deadband}
        ends = list(item.deadband_interval)
        summary.append(table("map", **known, deadband_interval=ends))
    (folder / "points.csv").write_text("\n".join(rows) + "\n")
    write_json(folder / "summary.json", summary)
    about = {"warnings": ["whole trials differ"], "recorded_on": "virtual bench"}
    facts(folder, "identify", "maps", what="flow_map", title="Flow maps", **about)
    return folder


def write_series(
    folder: Path, log: str, channels: dict[str, float], simulated: bool = True
) -> None:
    t = np.arange(0.0, 2.0, 1e-3)
    columns = {"t [s]": t}
    for name, size in channels.items():
        unit = VOCABULARY[name.rsplit(".", 1)[1]].unit
        columns[f"{name} [{unit}]"] = size * np.sin(6 * t)
        if simulated:
            columns[f"simulated.{name} [{unit}]"] = 1.05 * size * np.sin(6 * t + 0.05)
    (folder / "series").mkdir(exist_ok=True)
    file, text = folder / "series" / f"{log}.csv", ",".join(columns)
    np.savetxt(file, np.column_stack(list(columns.values())), "%.9g", ",", header=text, comments="")


def hydraulics_run(root: Path) -> Path:
    folder = made(root, "fit")
    write_json(folder / "parameters.json", table("fit"))
    write_series(folder, "boom_step", FOUR | {"boom.x": 0.1})
    facts(folder, "identify", "fit", what="hydraulics", title="Bulk modulus", warnings=[])
    return folder


def validation_run(root: Path) -> Path:
    folder, judged = made(root, "judged"), table("judged")
    correlation = {"of": "boom.q", "lag": [0.01 * i for i in range(1, 30)], "band": [0.2] * 29}
    correlation |= {"value": [0.9**i for i in range(29)], "outside_percent": 48.0}
    crossed = [correlation | {"of": "boom.hect.command"}]
    for name, size in FOUR.items():
        errors = {"max_error": 0.02 * size, "bias": 0.001 * size, "rms_error": 0.01 * size}
        own = correlation if name != "boom.p_rod" else None
        more = {"channel": name, "autocorrelation": own, "cross_correlation": crossed}
        judged["logs"][0]["channels"].append(table("channel", **errors, **more))
    write_json(folder / "validation.json", judged)
    write_series(folder, "held", FOUR)
    write_series(folder, "broken", {"boom.q": 0.5}, simulated=False)
    about = {"what": "validation", "title": "Held-out logs", "accepted": False, "warnings": []}
    facts(folder, "validate", "judged", **about)
    return folder


def open_loop_run(
    root: Path,
    rig: str = "slide_servo",
    stopped: str = "carriage.p_head = 9 MPa passed pressure_max at t = 0.8 s",
) -> Path:
    folder = made(root, f"trial_{rig}", rig)
    cylinder, valve = next(load_rig(folder).valves())
    t, base = np.arange(0.0, 1.0, 1e-3), cylinder.name
    channels = {"x": 0.1 * t, "v": np.full_like(t, 0.1), "p_rod": np.full_like(t, 5e5)}
    channels |= {"p_head": 1e6 + 1e5 * np.sin(20 * t)}
    channels |= {f"{valve.name}.command": np.where(t > 0.3, 2.0, 0.0)}
    channels = {f"{base}.{name}": values for name, values in channels.items()}
    channels |= {"p_supply": np.full_like(t, 7e6)}
    write_log(folder / "log.mcap", Record(t, channels, {"stopped": stopped} if stopped else {}))
    about = {"duration": 0.999, "samples": 1000, "seed": 7, "stopped": stopped}
    known = {"on": "virtual bench", "payload": "none", "posture": {}}
    write_json(folder / "trial.json", known | about)
    more = {"title": "A step", "stopped": stopped, "warnings": []}
    facts(folder, "trial", f"trial_{rig}", what="trial", **more)
    return folder


def fill_reported(root: Path) -> None:
    """A run of each kind without a controller, drawn."""
    for made_run in (open_loop_run, validation_run, hydraulics_run, flow_map_run):
        draw(made_run(root))


class Page(HTMLParser):
    """Balance, ids, links and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open, self.ids, self.links, self.loads, self.words, self.bad = [], [], [], [], [], []
        self.feed(text)
        self.close()

    # pyrefly: ignore[bad-override-param-name]
    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.ids += [named["id"]] if "id" in named else []
        self.links += [value for key, value in attributes if key in ("href", "xlink:href")]
        loading = ("src", "srcset", "data", "action")
        self.loads += [value for key, value in attributes if key in loading]
        self.loads += [tag] * (tag in ("script", "link", "iframe"))
        for value in named.values():
            self.links += re.findall(r"url\((#[^)]+)\)", value or "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.bad.append((tag, self.getpos()))

    # pyrefly: ignore[bad-override-param-name]
    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


# --- tunings and trials under a controller ---

GAINS = [0.0, *np.geomspace(1e-12, 1e-9, 20).tolist()]


def point(function: str, payload: str, x: float, counts: bool, **more) -> dict:
    item = table("point")
    speed = 0.05 if function.startswith("extend") else -0.05
    item["point"] |= {"function": function, "payload": payload, "x": x, "v": speed}
    item["point"]["mass"] = 1e3 + 1e4 * x
    curve = [0.6 - 0.2 * abs(np.log10(g / 1e-10)) if g else 0.1 for g in GAINS]
    name = f"{function}, {payload}, x = {x:g}"
    return item | {"name": name, "counts": counts, "curve": curve} | more


def locus(name: str, parameter: str, crossing: float | None) -> dict:
    """A pair from (−4, ±40) that crosses the axis at ±60, a real pole, and a slow one."""
    values = sorted({0.0, 1e-10, 8e-10, *np.geomspace(1e-12, 2e-9, 30).tolist()})
    shares = [(g, g / 1e-10) for g in values]
    pairs = [complex(-4 - 60 * s + 7.58 * s**2, 40 + 2.5e10 * g) for g, s in shares]
    slow = [complex(-200 - 1e11 * g) for g in values]
    poles = [[p, p.conjugate(), s, complex(-0.01)] for p, s in zip(pairs, slow, strict=True)]

    def at(value: float) -> list[list[float]]:
        return [[p.real, p.imag] for p in poles[values.index(value)]]

    edge = [[0.0, 60.0], [0.0, -60.0], [-280.0, 0.0], [-0.01, 0.0]]
    given = {"name": name, "parameter": parameter, "values": values, "chosen": 1e-10}
    given |= {"real": [[p.real for p in row] for row in poles]}
    given |= {"imag": [[p.imag for p in row] for row in poles]}
    given |= {"chosen_poles": at(1e-10), "crossing": crossing, "frame": [-120.0, 30.0, 100.0]}
    return given | {"crossing_poles": edge if crossing else []}


RIG = shipped("thesis_arm")
USES = [asdict(item) for item in functions_of(RIG, circuit_of(Model.of(RIG), 1))]


def tuning(**more) -> dict:
    loads = ("none", "50 lb")
    points = [point("extend_resistive", load, x, True) for load in loads for x in (0.05, 0.2)]
    none = {"gain_limit": None, "bias": None, "damping_ratio_plain": None}
    points += [point("retract_resistive", "none", 0.1, False, **none)]
    points[1]["damping_ratio_closed"] = 0.55
    points[2]["margins"] = {"gain_margin": None, "phase_margin": None, "bandwidth": 3.5}
    shown = [points[1], points[2], points[4]]
    t = np.linspace(0.0, 25 * np.pi / 40, 400)  # v_open then ends at 1
    x = np.linspace(0.0, 0.254, 15)
    opened, closed = 1 - np.exp(-2 * t) * np.cos(20 * t), 1 - np.exp(-15 * t)
    result = table("tuning", gains=GAINS, worst_curve=points[0]["curve"], functions=USES)
    result["robustness"]["damping_ratios"] = np.linspace(0.46, 0.62, 40).tolist()
    kinds = ("feedback_gain", "washout")
    limit = {"feedback_gain": "gain_limit"}
    result["loci"] = [locus(p["name"], k, p.get(limit.get(k))) for p in shown for k in kinds]
    speeds = {"t": t.tolist(), "v_open": opened.tolist(), "v_closed": closed.tolist()}
    result["steps"] = [{"name": p["name"]} | speeds for p in shown]
    result |= {"points": points, "equivalents": []}
    for s, load in ((1.0, "none"), (2.0, "50 lb")):
        one = {"payload": load, "x": x.tolist(), "q": (0.7 - 4 * x).tolist(), "damping": [6e3] * 15}
        one |= {"mass": (s * (1e3 + 1e4 * x)).tolist(), "gravity_force": [s * 2e3] * 15}
        result["equivalents"].append(one)
    return result | more


def table_run(root: Path, kind: str, rig: str, file: str = "") -> Path:
    """A run of which a terminal reads a single table."""
    folder = made(root, kind, rig)
    write_json(folder / f"{file or kind}.json", table(kind))
    facts(folder, kind, what=kind, title=kind, warnings=[])
    return folder


def tune_run(root: Path, name: str = "tuning", rig: str = "thesis_arm", **more) -> Path:
    folder = made(root, name, rig)
    write_json(folder / "tuning.json", tuning(**more))
    facts(folder, "tune", what="tuning", title="Pressure feedback", warnings=[])
    return folder


LEAN: dict = {"functions": USES[:1], "loci": [], "steps": []}


def log(
    path: Path,
    *,
    own: str = "boom",
    gain: float = 1.0,
    notes: bool = True,
    learns: bool = False,
    stopped: str = "",
) -> None:
    t = np.arange(3001) * 1e-3
    on = (t >= 0.5) & (t < 2.0)
    v_d = np.where(on, 0.1, 0.0)
    v = np.where(on, 0.1 * (1 - gain * np.exp(-3 * (t - 0.5)) * np.cos(25 * (t - 0.5))), 0.0)
    x_d = 0.05 + np.cumsum(v_d) * 1e-3
    channels = {"x": x_d + gain * 1e-3 * on, "v": v, "x_desired": x_d, "v_desired": v_d}
    channels |= {"p_head": 1e6 + 1e6 * v, "p_rod": np.full_like(t, 3e5)}
    channels |= {"hepc.command": np.where(on, 5.0, 0.0), "rect.command": np.zeros_like(t)}
    if notes:
        limits = np.where((t > 0.6) & (t < 0.7), 17.0, 0.0)
        channels |= {"function": on * 1.0, "limits": limits, "v_shaped": v_d}
    if learns:
        channels |= {"payload_estimate": 26.0 * (1 - np.exp(-t))}
        channels |= {"inverse_bulk": 1.0 + 0.1 * on, "disturbance": 5 * np.sin(t)}
    channels = {f"{own}.{name}": values for name, values in channels.items()}
    channels |= {"p_supply": np.full_like(t, 7e6)}
    text = (
        b'[[motion]]\nname = "70 %"\nlevels = ["70 %"]\n[[controller]]\nkind = "arc"\n'
        b"gains = { adapt = false }\n"
    )
    meta = {"stopped": stopped} if stopped else {}
    write_log(path, Record(t, channels, meta, {"recipe.toml": text}))


STEP = table("step")


def measures(energy: float, error: float, steps: list[dict]) -> dict:
    errors = {"max_error": error, "rms_error": 0.3 * error, "final_error": -0.1 * error}
    result = table("measures", steps=steps, tracking=errors)
    result["energy"]["pump"] = energy
    return result


def trials_run(
    root: Path,
    name: str,
    controllers: dict[str, dict],
    on: str = "model",
    payloads=("none", "50 lb"),
    **more,
) -> Path:
    folder, rows = made(root, name), []
    for inside in ("logs", "ledgers"):
        (folder / inside).mkdir()
    for payload, law in ((payload, law) for payload in payloads for law in controllers):
        result, stem = controllers[law], slug(f"{payload} {law}", "_")
        path = f"logs/{stem}.mcap"
        log(folder / path, gain=result["tracking"]["max_error"] / 1e-3, **more)
        row = {"case": f"{payload} 70 % {law}", "payload": payload, "controller": law, "on": on}
        rows.append(table("trial_row", log=path, **row) | result)
        write_json(folder / "ledgers" / f"{stem}.json", ledger(result["energy"]["pump"]))
    write_json(folder / "table.json", {"rows": rows})
    facts(folder, "trials", what="trials", title="Steps", on=on, stopped="", warnings=[])
    return folder


DAMPED = STEP | {"overshoot": 0.2, "damping_ratio": None, "settling_time": 0.3}
DAMPED |= {"ringing": "only 0.9 cycles in the window"}
PAIR = {
    "open loop": measures(2000.0, 2e-3, [STEP]),
    "pressure feedback": measures(1900.0, 5e-3, [DAMPED]),
}
ERRORS = {"arc": (2100.0, 1e-4), "frozen": (2050.0, 4e-3), "four-way": (3300.0, 3e-4)}
TRACKED = {name: measures(energy, error, []) for name, (energy, error) in ERRORS.items()}


def trial_run(root: Path, name: str = "arc", stopped: str = "", **more) -> Path:
    folder = made(root, name)
    log(folder / "log.mcap", learns=True, stopped=stopped)
    known = {"measures": measures(2100.0, 1e-4, []), "stopped": stopped}
    write_json(folder / "trial.json", table("trial", **known) | more)
    facts(folder, "trial", what="trial", title="ARC, slow, 50 lb", warnings=[])
    return folder


def ledger(pump: float) -> dict:
    parts = [
        ("pump", pump, "supply", "pump", None),
        ("pump_compression", 0.0, "supply", "compression", None),
        ("boom.hepc.throttling", 0.7 * pump, "valve", "boom.hepc, supply → head", "boom"),
        ("boom.damping", 0.3 * pump, "loss", "joint damping", "boom"),
        ("potential", 0.0, "load", "potential", None),
        ("residual", 0.0, "residual", "residual", None),
        ("boom.drawn", pump, "cylinder", "drawn", "boom"),
        ("boom.drawn_compression", 0.0, "cylinder", "compression", "boom"),
        ("boom.work", 0.3 * pump, "cylinder", "work", "boom"),
    ]
    names = ("name", "energy", "group", "label", "cylinder")
    rows = [dict(zip(names, one, strict=True), interval=None) for one in parts]
    about = {"source": "model", "rig": "thesis_arm", "payload": "none", "duration": 3.0}
    return about | {"rows": rows, "residual_share": 2e-6, "notes": []}


def fill_control(root: Path) -> None:
    """A tuning and trials of each kind, drawn; blank where others have figures of such kinds."""
    folders = [
        tune_run(root),
        trials_run(root, "cycles", TRACKED, "virtual bench", ["50 lb"], learns=True),
        trial_run(root),
    ]
    for folder in folders:
        draw(folder)
    with answers(style, painted='<svg xmlns="http://www.w3.org/2000/svg"/>\n'):
        draw(trials_run(root, "steps", PAIR))
