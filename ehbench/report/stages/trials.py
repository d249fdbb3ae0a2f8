"""A set of trials: controllers compared, one table over all, energies, and each trial alone."""

from collections.abc import Sequence

import numpy as np

from ehbench.config.rig import Rig
from ehbench.report import trial_captions as captions
from ehbench.report.blocks import Block, Bullets, Fold, Part, Picture, Text, slug
from ehbench.report.cases import Case, cases_of, groups_of
from ehbench.report.content import Pictures, SectionContent, folded
from ehbench.report.energy_tables import saving_blocks, supply_blocks
from ehbench.report.figures import trial as figures
from ehbench.report.figures.energy import bars
from ehbench.report.saved import FigureIndex, Saved
from ehbench.report.stages.trial import draw_case, draw_sankey, trials_findings
from ehbench.report.trial_tables import measure_tables, settings_blocks
from ehbench.report.words import capital, load_name, pretty, shown, unit_of, words

findings = trials_findings


def draw(run: Saved, index: FigureIndex) -> None:
    """Every controller of a payload and motion in one, energies, then each trial alone."""
    rig, cases = run.rig, cases_of(run)
    for group in groups_of(cases).values():
        if len(group) > 1:
            first = group[0]
            payload, motion = first.row["payload"], first.row["motion"]
            records = [case.record() for case in group]
            lasting = captions.standstill_caption(rig, group, records)
            caption = f"{captions.compared_caption(rig, group)} {lasting}".rstrip()
            path = index.add(
                f"compare_{slug(load_name(payload), '_')}_{slug(motion, '_')}",
                f"{words(first.cylinder).capitalize()}: {words(motion)}, {first.where}",
                caption,
                "compare",
                payload=payload,
                motion=motion,
            )
            names = [case.row["controller"] for case in group]
            figures.compare_controllers(path, rig, list(zip(names, group, records, strict=True)))
    first = {case.row["motion"]: case for case in reversed(cases) if not case.steps}
    if first:  # what is desired of the cylinder in each motion that is no steps of speed
        drawn = [(name, first[name], first[name].record()) for name in reversed(first)]
        spans = "; ".join(
            f"{words(name)} {captions.trajectory_caption(rig, case, log)}"
            for name, case, log in drawn
        )
        title, caption = f"Trajectories, on the {cases[0].row['on']}", capital(spans)
        path = index.add("trajectories", title, f"Desired motion. {caption}.", "trajectories")
        figures.trajectories(path, rig, drawn)
    for motion in dict.fromkeys(case.row["motion"] for case in cases):
        of_motion = [case for case in cases if case.row["motion"] == motion]
        named = [f"{c.row['controller']}, {load_name(c.row['payload'])}" for c in of_motion]
        title = f"Energy: {words(motion)}, on the {of_motion[0].row['on']}"
        key, caption = f"energy_{slug(motion, '_')}", captions.energy_caption(rig, of_motion)
        path = index.add(key, title, caption, "energy", motion=motion)
        ledgers = [ledger for case in of_motion if (ledger := case.energy()) is not None]
        limits = [[b for b in led.get("bounds", []) if b["closed"]] for led in ledgers]
        bars(path, list(zip(named, ledgers, strict=True)), limits)
    _draw_map(rig, index, cases)
    for case in cases:
        name = case.row["case"]
        title = f"{name}, on the {case.row['on']}"
        draw_case(run, index, case, case.record(), title)
        draw_sankey(index, case, f"sankey_{case.stem}", title, case=name)


def _draw_map(rig: Rig, index: FigureIndex, cases: Sequence[Case]) -> None:
    """Energy over load and speed, where trials without steps have several of both."""
    loads, motions, laws = (
        list(dict.fromkeys(case.row[key] for case in cases))
        for key in ("payload", "motion", "controller")
    )
    if any(case.steps for case in cases) or min(len(loads), len(laws)) < 2 or len(motions) < 3:
        return
    known = {
        tuple(case.row[key] for key in ("controller", "payload", "motion")): shown(
            rig, "energy", case.row["energy"]["pump"]
        )
        for case in cases
        if case.fit
    }
    panels = [
        (words(law), np.array([[known.get((law, p, m), np.nan) for m in motions] for p in loads]))
        for law in laws
    ]
    title = f"Pump energy over load and speed, on the {cases[0].row['on']}"
    caption = captions.map_caption(panels)
    path = index.add("energy_map", title, caption, "energy_map")
    unit = pretty(unit_of(rig, "energy"))
    figures.energy_map(
        path, panels, [load_name(p) for p in loads], [words(m) for m in motions], unit
    )


def section(run: Saved, pictures: Pictures) -> SectionContent:
    """A set of trials: controllers compared, a table, energies, each trial folded."""
    rig, cases = run.rig, cases_of(run)
    stopped = [case for case in cases if case.row.get("stopped")]
    first: list[Block] = []
    if stopped:
        reasons = [f"{case.row['case']}: {case.row['stopped']}" for case in stopped]
        first = [Text("Stopped by a limit:", "bad"), Bullets(reasons)]
    named: list[Picture] = []  # those that a campaign names, in its order; the others folded
    folds: list[Block] = []
    for case in cases:
        name = case.row["case"]
        drawn = [
            picture
            for kind in ("tip", "trial", "estimates")
            for picture in pictures(kind=kind, case=name)
        ]
        named += [picture for picture in drawn if picture.named is not None]
        if others := [picture for picture in drawn if picture.named is None]:
            folds.append(Fold(f"{name}, on the {case.row['on']}", others))
    named.sort(key=lambda item: item.named or 0)
    energy = [
        *saving_blocks(rig, cases),
        *supply_blocks(rig, cases),
        *pictures(kind="energy_map"),
        *pictures(kind="energy"),
        *folded(pictures(kind="sankey"), "where the energy of each trial went"),
    ]
    parts = [
        Part("Each trial" if named else "", named),
        Part("Compared", [*first, *pictures(kind="compare")]),
        Part("Trajectories", pictures(kind="trajectories")),
        Part("Measures", measure_tables(rig, cases)),
        Part("Energy", energy),
        Part("Other trials" if named else "Each trial", folds),
        Part("Settings", settings_blocks(rig, cases), paper=False),
    ]
    more = tuple(captions.controller_captions(rig, cases))
    status = "stopped" if stopped else "done"
    return SectionContent(status, captions.trials_caption(cases), parts, more)
