"""Trials under a controller as run folders hold them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ehbench.config.rig import Rig, Slide
from ehbench.data.record import Record
from ehbench.report.saved import Saved, Table
from ehbench.report.words import load_name
from ehbench.runs.rundir import read_json
from ehbench.vocabulary import grouped
from ehbench.vocabulary.codes import STATUS_MEANS

SLOW = 0.2  # share by which a steady speed may miss what was asked and still be compared


@dataclass(frozen=True)
class Case:
    """One trial under a controller: its row of the table, its log, its energy ledger if any."""

    row: Table
    stem: str
    log: Path
    ledger: Path

    def record(self) -> Record:
        """Its log."""
        from ehbench.data import read

        return read(self.log)

    @property
    def cylinder(self) -> str:
        """The controlled cylinder."""
        return self.row["cylinder"]

    @property
    def steps(self) -> list[Table]:
        """Its steps of desired speed, if it has any."""
        return self.row["steps"]

    @property
    def fit(self) -> bool:
        """Whether it may be compared: not stopped, and no step far slower than desired."""
        return not self.row.get("stopped") and all(
            abs(step["steady_error"]) < SLOW for step in self.steps
        )

    @property
    def where(self) -> str:
        """What it ran with and on: ``no load, on the virtual bench``."""
        return f"{load_name(self.row['payload'])}, on the {self.row['on']}"

    def energy(self) -> Table | None:
        """Its energy ledger."""
        return Table(read_json(self.ledger), self.ledger) if self.ledger.is_file() else None


def cases_of(run: Saved) -> list[Case]:
    """The controlled trials of a run; of one ``trial``, one for each cylinder."""
    if run.stage == "trials":
        rows = run.json("table.json")["rows"]
        return [
            Case(
                row,
                Path(row["log"]).stem,
                run.folder / row["log"],
                run.folder / "ledgers" / f"{Path(row['log']).stem}.json",
            )
            for row in rows
        ]
    path = run.folder / "trial.json"
    facts = read_json(path)
    if not facts.get("controller"):
        return []
    also = facts["measures"].get("also", {})
    cases = []
    for cylinder, measures in {facts["cylinder"]: facts["measures"], **also}.items():
        about = {"case": run.title, "motion": "", "cylinder": cylinder}
        if also:
            about["controller"] = f"{measures.get('law', facts['controller'])}, {cylinder}"
        row = Table({**facts, **measures, **about}, path)
        cases.append(Case(row, cylinder, run.folder / "log.mcap", run.folder / "ledger.json"))
    return cases


def groups_of(cases: Sequence[Case]) -> dict[tuple[str, str, str], list[Case]]:
    """Cases that differ in their controller only, by (payload, motion, cylinder)."""
    return grouped(cases, lambda case: (case.row["payload"], case.row["motion"], case.cylinder))


def by_controller(cases: Sequence[Case]) -> dict[str, list[Case]]:
    """Cases by their controller."""
    return grouped(cases, lambda case: case.row["controller"])


def damping(item: Table) -> tuple[float | None, str]:
    """(damping ratio of a step's decay, doubt); of a speed that hardly rings that of the fit."""
    return item.get("damping_ratio_fitted", item.get("damping_ratio")), item["ringing"]


def limits_of(row: Table) -> dict[str, float]:
    """Shares of the time at limits of the valve level, or without a function for the load."""
    functions = row.get("functions", {})
    return dict(row.get("limits", {})) | {
        name: functions[name] for name in STATUS_MEANS if name in functions
    }


def payloads_carried(rig: Rig, row: Table) -> list[tuple[float, float]] | None:
    """(time [s], payload from then on [kg]); None where one is not at the last link's end."""
    names = [(0.0, row["payload"]), *(row.get("payload_change") or ())]
    masses = [(float(at), payload_at_end(rig, name)) for at, name in names]
    known = [(at, mass) for at, mass in masses if mass is not None]
    return known if len(known) == len(masses) else None


def payload_at_end(rig: Rig, payload: str) -> float | None:
    """Mass [kg] at the end of the last link with the moment that a payload adds about the last
    joint.

    ``(m'(a + r') − m(a + r))/a``, r along the link from its end to the centre of mass. On a slide
    the added mass. Zero without a payload, None where it changes another link than the last."""
    if payload == "none":
        return 0.0
    changes, mechanism = rig.payload.get(payload, {}), rig.mechanism
    last = mechanism if isinstance(mechanism, Slide) else mechanism.joint[-1]
    if set(changes) != {last.name}:
        return None
    change, mass = changes[last.name], float(last.mass)
    loaded = mass if change.mass is None else float(change.mass)
    if isinstance(last, Slide):
        return loaded - mass
    length = float(last.dh_a)
    before, after = (com.value[0] for com in (last.com, change.com or last.com))
    return (loaded * (length + after) - mass * (length + before)) / length if length else None
