"""Tunings and trials in the report: drawn from files alone, sentences follow the numbers."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ehbench.config.recipe import load_recipe, load_rig
from ehbench.data.record import Record
from ehbench.report import build, draw, energy_tables
from ehbench.report.cases import Case, cases_of, groups_of, payload_at_end
from ehbench.report.comparisons import lasting
from ehbench.report.figures import root_locus
from ehbench.report.figures.trial import (
    FUNCTION_SHADES,
    LIMIT_SHADES,
    plot_errors,
    stretches,
    wide_panels,
)
from ehbench.report.saved import FigureIndex, Saved, Series, Table
from ehbench.report.stages.tuning import findings, overshoot_of
from ehbench.report.terminal import answer
from ehbench.report.trial_captions import (
    ESTIMATES,
    compared_caption,
    energy_caption,
    estimates_caption,
    standstill_caption,
    swing_after,
)
from ehbench.report.trial_tables import valves_note
from ehbench.runs.rundir import write_json
from ehbench.vocabulary.codes import FUNCTIONS, LIMITS, LIMITS_MEAN
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.quantities import VOCABULARY
from ehbench.vocabulary.units import from_si
from tests.shared import shipped
from tests.unit.report_runs import (
    DAMPED,
    LEAN,
    PAIR,
    STEP,
    TRACKED,
    USES,
    fill_control,
    measures,
    trial_run,
    trials_run,
    tune_run,
    tuning,
)


@pytest.fixture(scope="module")
def runs(made_once) -> list[Path]:
    root = made_once("control", fill_control)
    return [root / name for name in ("tuning", "steps", "cycles", "arc")]


def figures_of(folder: Path) -> list[dict]:
    return json.loads((folder / "figures/index.json").read_text())["figures"]


def captions(folder: Path) -> dict[str, str]:
    return {one["key"]: one["caption"] for one in figures_of(folder)}


def depth(html: str, text: str) -> int:
    """How many folds a text lies in."""
    before = html[: html.index(text)]
    return before.count("<details") - before.count("</details")


def plain(html: str) -> str:
    """The text of a page."""
    bare = re.sub(r"<svg.*?</svg>", " ", html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", bare)).replace("&gt;", ">")


def lacks(text: str, *parts: str) -> list[str]:
    """The parts that a text has not."""
    return [part for part in parts if part not in text]


def test_every_function_and_limit_has_its_own_colour_and_estimates_are_quantities():
    assert len(FUNCTION_SHADES) == len(set(FUNCTION_SHADES)) == len(FUNCTIONS)
    assert set(LIMIT_SHADES) == set(LIMITS)
    assert len(set(LIMIT_SHADES.values())) == len(LIMITS)
    assert set(LIMITS.values()) == set(LIMITS_MEAN)
    assert set(ESTIMATES) <= set(VOCABULARY)


def test_keys_are_the_stable_ones(runs):
    tune, steps, cycles, arc = map(captions, runs)
    functions, leads = ("extend_resistive", "retract_resistive"), ("locus", "locus_washout")
    assert list(tune) == [
        *(f"function_{item['name']}" for item in USES),
        *("equivalent_mass", "equivalent_gravity", "damping_over_gain"),
        *(f"{lead}_{name}" for name in functions for lead in (*leads, "step_response")),
        "draws",
    ]
    names = ("open_loop", "pressure_feedback")
    assert list(steps) == [
        *("compare_no_load_70", "compare_50_lb_70", "energy_70"),
        *(
            f"{kind}_{load}_{name}"
            for load in ("none", "50_lb")
            for name in names
            for kind in ("trial", "sankey")
        ),
    ]
    assert {"sankey_50_lb_arc", "estimates_50_lb_four_way", "energy_70"} <= set(cycles)
    assert list(arc) == ["trial_boom", "estimates_boom", "load"]


@pytest.fixture(scope="module")
def built(runs) -> str:
    return build(runs)


def test_trials_of_a_machine_without_pressure_sensors_are_shown(unpainted, tmp_path):
    """They have no energy ledger; a page of two compares the rest."""
    unknown = measures(0.0, 1e-4, [])
    unknown["energy"] |= {"pump": None, "cylinder_work": None, "source": "no energy ledger"}
    folders = [trial_run(tmp_path, name, measures=unknown) for name in ("arc", "again")]
    for folder in folders:
        draw(folder)
    assert "the pump gave" not in answer(folders[0]).verdict
    text = plain(build(folders))
    assert "largest error 0.1 mm" in text and not re.search(r"\bNone\b|Undefined", text)


def test_the_page_is_whole(runs, built):
    ids = re.findall(r'\bid="([^"]+)"', built)
    links = {*re.findall(r'href="#([^"]+)"', built), *re.findall(r"url\(#([^)]+)\)", built)}
    assert len(ids) == len(set(ids)) and links <= set(ids)
    bad = r"\bnan\b|\bNone\b|\binf\b|Undefined|_boom|e-\d\d"
    assert not re.search(bad, plain(built.split('<section id="rig')[0]))
    assert built.count("<svg") == sum(len(captions(folder)) for folder in runs) + 1
    figures = map(figures_of, runs)
    assert {item["about"]["kind"] for items in figures for item in items} == {
        *("function", "equivalents", "damping", "locus", "step_response", "draws", "compare"),
        *("energy", "trajectories", "trial", "estimates", "sankey", "load"),
    }
    drawn = (path for folder in runs for path in (folder / "figures").glob("*.svg"))
    assert max(path.stat().st_size for path in drawn) < 200_000


OVERSHOOT = 100 * np.exp(-0.1 * (np.pi - np.arctan(0.1))) / np.hypot(1.0, 0.1)  # tan 20t = −0.1
PUMPED = "pressure feedback, 1900 J (ended −0.5 mm from the desired stroke)"
# (which run, its page or the caption of a figure, numbers and names that it has)
SHOWN = [
    (0, "page", "K_p = 600 mL/min/bar", "0.398 Hz", "0.55 over 4 operating points of boom"),
    (0, "page", "0.1 to 0.15 with no gain", "0.12 to 0.25; target 0.5", "92.5 % of 40 draws"),
    (0, "page", "by this number: no washout.", "gain margin ≥ 2 6", "bandwidth Hz ≥ 0.5 0.557"),
    (0, "page", "phase margin ° ≥ 45 57.3"),
    (0, "damping_over_gain", "extend resistive, no load, x = 200 mm"),  # the worst that counts
    (0, "locus_extend_resistive", "0.12 at K_p = 0, 0.55 at K_p = 600 mL/min/bar", "above 8 times"),
    (0, "locus_retract_resistive", "stable over the whole range", "No load calls for"),
    (0, "equivalent_mass", "50 lb: 2000 to 7080 kg"),
    (0, "step_response_extend_resistive", f"{OVERSHOOT:.0f} % without any feedback, 0 % with"),
    (1, "compare_no_load_70", "Best by overshoot: pressure feedback; worst: open loop, 3 times"),
    (1, "trial_none_open_loop", "not settled", "damping ratio 0.08 at 4 Hz", "saturated 3.3 %"),
    (1, "trial_none_pressure_feedback", "no damping ratio: only 0.9 cycles in the window"),
    (1, "page", "steady error −2 %, overshoot 60 %, damping ratio 0.08. Pressure feedback:"),
    (1, "page", "no damping ratio to read", "only 0.9 cycles in the window"),
    (1, "page", "Trajectories.", "motion: 70 %", "adapt = no"),
    (1, "energy_70", f"no load: {PUMPED}; 5 % less than the most, open loop, 2000 J"),
    (1, "energy_70", "Source: edge flows of the model."),
    (3, "estimates_boom", "the moment of 26 kg at the end", "payload estimate 24.7 kg"),
]


@pytest.fixture(scope="module")
def shown(runs) -> list[dict[str, str]]:
    return [captions(run) | {"page": plain(build([run]))} for run in runs]


@pytest.mark.parametrize("row", SHOWN, ids=lambda row: f"{row[0]} {row[1]} {row[2][:20]}")
def test_what_files_hold_is_shown(shown, row):
    which, where, *parts = row
    assert not lacks(shown[which][where], *parts)


def test_limits_that_were_not_met_are_not_named(shown):
    assert "against" not in shown[1]["trial_none_open_loop"]


def test_what_a_damped_tuning_misses_is_asked_for(tmp_path):
    worst = min(one["margins"]["bandwidth"] or 1e9 for one in tuning()["points"] if one["counts"])
    given = {"met": False, "damping_ratio": 0.9, "constraints": {"bandwidth": 2 * worst}}
    folder = tune_run(tmp_path, "slow", **given, **LEAN)
    (step,) = findings(Saved(folder)).next
    assert step.key == "steps.smaller_margins" and step.hint.startswith('bandwidth = "')
    # all that is missed at once: pasted, it is met
    folder = tune_run(tmp_path, "both", **given | {"damping_ratio": 0.123, "target": 0.5}, **LEAN)
    (step,) = findings(Saved(folder)).next
    damping, bandwidth = step.hint.splitlines()
    assert damping == 'damping_ratio = "0.12"' and bandwidth.startswith('bandwidth = "')
    # a loop that swings has no damping to ask for
    folder = tune_run(tmp_path, "swings", **given | {"damping_ratio": -0.1, "target": 0.5}, **LEAN)
    (step,) = findings(Saved(folder)).next
    assert step.hint == ""


def test_a_tuning_that_fails_says_so(unpainted, tmp_path):
    few = {"draws": 0, "parameters": [], "points": 0, "share": None, "quantiles": []}
    few |= {"damping_ratios": []}
    gains = {"extend_resistive": 1e-10, "retract_resistive": 3e-10}
    loci = [one for one in tuning()["loci"] if one["parameter"] != "washout"]
    given = {"met": False, "damping_ratio": 0.3, "washout": 0.0, "robustness": few, "loci": loci}
    given |= {"functions": USES[:1], "feedback_gain": gains}
    folder = tune_run(tmp_path, "missed", **given)
    draw(folder)
    assert not {"draws", "locus_washout_extend_resistive"} & set(captions(folder))
    text = plain(build([folder]))
    gains = "2 gains K_p = 600 to 1800 mL/min/bar, no washout"
    assert not lacks(text, "Target and demands are not met", gains, "No draws were made.")
    assert "draws." not in text.split("Operating points")[0]


def test_a_second_washout_is_told(unpainted, tmp_path):
    others = [dict(one) for one in tuning()["alternatives"]]
    for one in others:
        one["ramp_washout"] = 2.5 * (one["what"] == "chosen law")
    folder = tune_run(tmp_path, "two", ramp_washout=2.5, alternatives=others, **LEAN)
    draw(folder)
    text = plain(build([folder]))
    parts = ("two washouts 0.398 Hz: worst damping ratio", "second washout f_r 0.3979 Hz")
    assert not lacks(text, *parts, "second washout [Hz]", "chosen law metered chamber 0.398 0.398")


def test_units_are_those_of_the_rig_file(unpainted, tmp_path):
    folder = tune_run(tmp_path, "other", "slide_servo", **LEAN)
    draw(folder)
    rig = load_rig(folder)
    unit = rig.unit_of("p_head")
    assert unit == "bar"
    assert re.search(rf"head-end pressure \[{unit}\]", build([folder]))
    assert '<td class="number">3.4</td>' in build([folder])  # low pressure, 0.34 MPa


def changed(case: Case, **entries) -> Case:
    """A case with other entries of its row."""
    return replace(case, row=Table(dict(case.row) | entries, case.log))


def test_captions_follow_the_numbers_and_say_where_they_are_from(runs):
    pairs = zip(cases_of(Saved(runs[1]))[:2], (0.1, 0.2), strict=True)
    cases = [changed(one, steps=[dict(one.steps[0]) | {"overshoot": over}]) for one, over in pairs]
    text = compared_caption(load_rig(runs[1]), cases)
    best = "Best by overshoot: open loop; worst: pressure feedback, 2 times as much."
    assert "Open loop: overshoot 10 %" in text and text.endswith(best)
    first, second = cases_of(Saved(runs[1]))[:2]
    cases, rig = [first, changed(second, stopped="a limit")], load_rig(runs[1])
    text = compared_caption(rig, cases)
    assert "Best" not in text and "stopped by a limit" in text
    text = energy_caption(rig, cases)
    assert not lacks(text, "no load: open loop, 2000 J", "left out") and "less than" not in text
    titles = [one["title"] for folder in runs[1:3] for one in figures_of(folder)]
    assert all(re.search("on the (model|virtual bench)", title) for title in titles)
    assert "measured" not in plain(build(runs[2:])).lower()


@pytest.mark.parametrize(
    ("rig", "payload", "mass"),
    [
        ("thesis_arm", "50 lb", (52.51 * (0.95 - 0.195) - 27.958 * (0.95 - 0.416)) / 0.95),
        ("slide_servo", "100 kg", 100.0),
        ("thesis_arm", "none", 0.0),
    ],
)
def test_payload_at_the_end_of_the_last_link(rig, payload, mass):
    found = payload_at_end(shipped(rig), payload)
    assert found == (None if mass is None else pytest.approx(mass, rel=1e-12))


def test_a_stopped_trial_and_one_of_the_users_own(unpainted, tmp_path):
    sentence = "boom.p_head = 9 MPa passed pressure_max, which sets in at 8 MPa, at t = 1.2 s"
    stopped = trial_run(tmp_path, "stopped", sentence, on="model")
    alike = {"a": TRACKED["arc"], "b": TRACKED["arc"]}
    own = trials_run(tmp_path, "own", alike, payloads=["none"], notes=False)
    for folder in (stopped, own):
        draw(folder)
    text = plain(build([stopped, own]))
    assert "stopped" in text and f"Stopped by a limit: {sentence}." in text
    assert captions(stopped)["trial_boom"].startswith(f"Stopped: {sentence}. ")
    assert "run the same on the machine" not in plain(build([stopped])).lower()  # nor stop there
    assert "Best" not in captions(own)["compare_no_load_70"]  # a draw has no winner


def test_tables_and_figures_take_a_campaigns_titles(runs, built, tmp_path):
    path = tmp_path / "campaign.toml"

    def campaign(**titles):
        lead = 'stage = "campaign"\nrecipes = ["a.toml"]\n[figures]\n'
        path.write_text(lead + "".join(f'"{key}" = "{title}"\n' for key, title in titles.items()))
        return load_recipe(path)

    titles = {"steps/steps": "Table B.4", "operating_points": "Table B.1"}
    titles |= {"locus_extend_resistive": "Fig. B.11"}
    text = build(runs, campaign(**titles))
    assert all(f"<strong>{title}</strong>" in text for title in titles.values())
    titles = {"locus_retract_resistive": "Fig. B.13", "steps/trial_none_open_loop": "Alone"}
    named = build(runs, campaign(**titles))
    for title, own in (
        ("Fig. B.13", "Root locus over the feedback gain: boom, retract resistive"),
        ("Alone", "none 70 % open loop, on the model"),
    ):  # what a campaign names stands open
        assert depth(named, f"<figcaption><strong>{title}") == 0
        assert depth(built, f"<figcaption><strong>{own}") > 0
    with pytest.raises(InputError, match="'figures' names 'step'") as caught:
        build(runs, campaign(step="Table B.4"))
    assert caught.value.line == 4


def test_a_file_without_what_a_section_needs_is_named(unpainted, tmp_path):
    folder = tune_run(tmp_path)
    table = json.loads((folder / "tuning.json").read_text())
    del table["points"][0]["curve"]
    write_json(folder / "tuning.json", table)
    with pytest.raises(InputError, match=r"points\[0\].curve") as caught:
        draw(folder)
    assert Path(caught.value.file) == folder / "tuning.json"


def test_runs_cover_what_holds_and_close_small_gaps():
    t = np.arange(0.0, 1.0, 1e-3)
    random = np.random.default_rng(3)
    mask = np.repeat(random.random(100) > 0.5, 10)
    found = stretches(t, mask, 9990)
    inside = np.zeros(t.size, bool)
    for start, length in found:
        inside |= (t >= start - 1e-9) & (t < start + length - 1e-9)
    inside[-1] = mask[-1]  # the last sample has no length
    assert np.array_equal(inside, mask)
    assert len(stretches(t, mask, 1)) == 1
    blink = np.zeros(t.size, bool)
    blink[500] = True
    assert stretches(t, blink, 100) == [(t[500], pytest.approx(0.00999))]  # still seen


def test_a_locus_has_its_crossing_and_its_zeros():
    slow = [[-0.05, 0.4], [-0.05, -0.4], [1e-6, 70.0], [1e-6, -70.0]]
    for poles, pair in (
        ([[0.0, -60.0], [-280.0, 0.0], [-0.01, 0.0], [0.0, 60.0]], [[0.0, -60.0], [0.0, 60.0]]),
        ([[-5.0, 3.0], [1e-9, 0.0]], [[1e-9, 0.0]]),
        (slow, slow[2:]),
    ):
        assert root_locus.crossing(poles, 100.0) == pair
    # (s + 2)(s + 5 ± 3j) + K (s + 1)(s + 4): the branches end at −1 and −4
    values = np.linspace(0.0, 20.0, 41)
    start = np.poly([-2.0, -5.0 + 3.0j, -5.0 - 3.0j]).real
    poles = np.array([np.roots(start + k * np.array([0.0, 1.0, 5.0, 4.0])) for k in values])
    assert np.sort(root_locus.zeros(values, poles).real) == pytest.approx([-4.0, -1.0])
    squared = np.array([np.roots(start + k**2 * np.array([0.0, 1.0, 5.0, 4.0])) for k in values])
    assert root_locus.zeros(values, squared).size == 0


def test_rays_of_the_grid_have_their_damping_ratio():
    import matplotlib.pyplot as plt

    figure, ax = plt.subplots()
    root_locus.damping_grid(ax, -120.0, 100.0)
    for ratio, line in zip(np.arange(1, 10) / 10, ax.lines, strict=True):
        (x0, y0), (x1, y1) = np.asarray(line.get_xydata())
        assert (x0, y0) == (0.0, 0.0) and x1 >= -120.0 and y1 <= 100.0 + 1e-9
        assert -x1 / np.hypot(x1, y1) == pytest.approx(ratio, rel=1e-12)
    assert [float(text.get_text()) for text in ax.texts] == [i / 10 for i in range(1, 10)]
    plt.close(figure)


@pytest.mark.parametrize(
    ("values", "overshoot"),
    [([0, 1.5, 1.0], 0.5), ([0, -1.2, -1.0], 0.2), ([0, 0.5, 1.0], 0.0), ([0, 1.0, 0.0], None)],
)
def test_overshoot_over_the_last_value(values, overshoot):
    assert overshoot_of(values) == (None if overshoot is None else pytest.approx(overshoot))


def test_errors_far_apart_have_a_strip_each(runs):
    """Largest errors of 0.1 and 4 mm: in one panel the small one could not be read."""
    import matplotlib.pyplot as plt

    cases = cases_of(Saved(runs[2]))
    rig = load_rig(runs[2])
    named = [(case.row["controller"], case, case.record()) for case in cases]
    strips = [panel for panel in wide_panels(named[:2]) if panel.startswith("error ")]
    assert len(strips) == 2 and "error" in wide_panels(named[:1])
    for one, most in zip(named[:2], (0.1, 4.0), strict=True):
        figure, ax = plt.subplots()
        plot_errors(ax, rig, [one], [{}])
        assert ax.get_title(loc="center").endswith(f"at most {most:g} [mm]")
        drawn = max(float(np.abs(line.get_ydata()).max()) for line in ax.lines)
        assert drawn == pytest.approx(most)
        plt.close(figure)


def test_cases_know_their_files_and_need_a_controller(runs, unpainted, tmp_path):
    (case,) = cases_of(Saved(runs[3]))
    assert case.cylinder == "boom" and case.energy() is None
    assert case.row["tracking"]["max_error"] == 1e-4
    cases = cases_of(Saved(runs[2]))
    assert all(one.energy() is not None for one in cases) and len(groups_of(cases)) == 1
    folder = Path(shutil.copytree(runs[3], tmp_path / "plain"))
    file = folder / "trial.json"
    write_json(file, json.loads(file.read_text()) | {"controller": "", "measures": {}})
    assert cases_of(Saved(folder)) == []
    draw(folder)
    assert captions(folder) == {"trial_boom": "Commands, motion and pressures."}


def cycle_ledger(
    drawn: dict[str, tuple[float, float, float, float]],
    source: str = "model",
    four_way: bool = False,
) -> dict:
    """A ledger of a closed cycle: way [m], drawn, bound and compression [J] by function."""
    half, spool = (20.0 if source == "log" else None), "spool, " if four_way else ""
    total = sum(item[1] for item in drawn.values())
    edges = {"hepc": "supply → head", "rect": "rod → tank"}
    edges |= {"hect": "head → tank", "repc": "supply → rod"}
    left = "unexplained" if source == "log" else "residual"
    label = {name: (spool or f"{name}, ") + ends for name, ends in edges.items()}
    parts = [("pump", total, "supply", "pump", None)]
    parts += [("boom.drawn", total, "cylinder", "drawn", "boom")]
    parts += [(f"boom.{n}.throttling", 0.2 * total, "valve", label[n], "boom") for n in edges]
    parts += [("boom.damping", 0.2 * total - 7.0, "loss", "joint damping", "boom")]
    parts += [("rest", 7.0, "residual", left, None)]
    names = ("name", "energy", "group", "label", "cylinder")
    rows = [
        dict(zip(names, item, strict=True))
        | {"interval": None if half is None else [item[1] - half, item[1] + half]}
        for item in parts
    ]
    functions = {
        name: {"boom.drawn": drawn, "boom.rect.throttling": 0.1 * drawn, "boom.damping": 1.0}
        for name, (_, drawn, _, _) in drawn.items()
    }
    bounds = {"standard": 3200.0, "six": 2096.0, "seventh": 992.0}
    bound = sum(item[2] for item in drawn.values())
    names = ("way", "drawn", "bound", "compression")
    beyond = [dict(zip(names, item), function=name) for name, item in drawn.items()]
    limits = {"cylinder": "boom", "closed": True, "used": total, **bounds, "beyond": beyond}
    limits |= {"saving": 1 - total / 3200.0, "against": {v: k for k, v in bounds.items()}[bound]}
    about = {"source": source, "rows": rows, "functions": {"boom": functions}, "notes": []}
    return about | {"bounds": [limits]}


SIX = {
    "hold": (0.0, 4.0, 0.0, 1.0),
    "extend_resistive": (0.15, 2120.0, 2096.0, 20.0),
    "retract_overrunning": (-0.02, 170.0, 0.0, 5.0),
    "retract_overrunning_regeneration": (-0.13, 6.0, 0.0, -40.0),
}
SPOOL = {
    "extend_resistive": (0.15, 2130.0, 2096.0, 40.0),
    "retract_overrunning": (-0.15, 1230.0, 1104.0, 150.0),
}


def cycles(root: Path, **made_of: dict) -> tuple:
    """(rig, cases) of a set with a ledger a controller, none of them drawn."""
    made = dict.fromkeys(made_of, measures(2000.0, 1e-4, []))
    folder = trials_run(root, "energies", made, payloads=["none"])
    for row in json.loads((folder / "table.json").read_text())["rows"]:
        file = folder / "ledgers" / f"{Path(row['log']).stem}.json"
        write_json(file, made_of[row["controller"]])
    run = Saved(folder)
    return run.rig, cases_of(run)


def test_the_functions_of_a_circuit_are_tables_and_figures(runs):
    rig, tables = load_rig(runs[0]), captions(runs[0])
    assert [one["name"] for one in USES] == list(FUNCTIONS[1 : len(USES) + 1]) and len(USES) == 7
    text = plain(build(runs[:1]))
    head, rod = rig.cylinder_named("boom").areas()
    regenerates, opens = "extend overrunning regeneration extend along the motion", "Valve 1: HECT"
    parts = (
        f"{regenerates} p_rod > p_head + margin, and the edge between them carries A₂ |v| "
        f"{1e4 * (head - rod):.4g}",
        f"retract overrunning regeneration {opens}, Valve 3: REGEN (PC and CT) {opens} (head end)",
        "(A₁ − A₂) |v| Valve 3: REGEN (PC and CT), A₂ |v|",
    )
    assert not lacks(text, *parts)
    text = tables["function_retract_resistive"]
    assert not lacks(text, f"Open: {opens}, Valve 4: REPC; Valve 4: REPC (red)", "shut, dashed: ")


def test_valves_that_are_not_equally_fast_are_told(tmp_path):
    quick, slow = ({"valves": {"natural_frequency": [w, w]}} for w in (345.0, 62.8))
    rows = {"six": quick, "fast spool": quick, "spool": slow}
    made = {name: measures(2000.0, 1e-4, []) | valves for name, valves in rows.items()}
    run = Saved(trials_run(tmp_path, "speeds", made, payloads=["none"]))
    cases = cases_of(run)
    told = "Natural frequency of the valves: 54.9 Hz: six, fast spool; 9.99 Hz: spool. "
    assert valves_note(run.rig, cases).startswith(told)
    assert valves_note(run.rig, cases[:2]) == ""


def test_why_a_cycle_saves_more_than_its_bound_is_said(tmp_path):
    spool = {"extend_resistive": (0.15, 2296.0, 2096.0, 150.0)}
    spool |= {"retract_overrunning": (-0.15, 1304.0, 1104.0, 0.0)}
    rig, cases = cycles(tmp_path, six=cycle_ledger(SIX), spool=cycle_ledger(spool, four_way=True))
    told = energy_tables.passes_caption(rig, energy_tables.savings_of(cases))
    assert told.startswith("Some save more than the bound's 34.5 %: the four-way valve is above")
    assert "by 400 J a cycle. It draws 150 J to press the oil" in told
    assert energy_tables.passes_caption(rig, energy_tables.savings_of(cases[:1])) == ""


def test_a_way_that_ends_with_other_oil_saves_nothing(tmp_path):
    ledger = cycle_ledger(SIX)
    (limits,) = ledger["bounds"]
    limits |= {"closed": False, "retained": 52.3, "travel_out": 0.15, "travel_in": 0.15}
    rig, cases = cycles(tmp_path, six=ledger)
    (text,) = energy_tables.saving_blocks(rig, cases)
    assert "1 trial that came back with the oil in another state, 52.3 J more pressed" in text.text
    limits["travel_in"] = 0.05
    rig, cases = cycles(tmp_path / "open", six=ledger)
    assert energy_tables.saving_blocks(rig, cases) == []


def test_what_was_saved_and_what_ate_the_rest(tmp_path):
    """Against the four-way valve, against the bound, and by cause, which add up."""
    rig, cases = cycles(tmp_path, six=cycle_ledger(SIX), spool=cycle_ledger(SPOOL, four_way=True))
    six, spool = energy_tables.savings_of(cases)
    assert six.reference == spool.reference == spool.used == 3360.0
    assert six.used == 2300.0 and six.bound == 2096.0
    causes = {"compression": 20.0 + 5.0 + 1.0, "hold": 3.0, "extend_resistive": 4.0}
    causes |= {"retract_overrunning": 165.0, "retract_overrunning_regeneration": 6.0}
    assert six.causes == causes
    assert sum(six.causes.values()) == six.used - six.bound
    assert sum(spool.causes.values()) == spool.used - spool.bound == 160.0
    assert spool.causes["compression"] == 34.0 + 126.0
    sentences, _, table, _, lost, losses = energy_tables.saving_blocks(rig, cases)[1:]
    parts = ("31.5 % less than the four-way valve", "six functions is 34.5 % less", "Drawn 2300 J")
    causes = "retract overrunning (up to 165 J, no load, 70 %), oil compressed (up to 26 J"
    assert not lacks(sentences.items[0], *parts, "204 J above its bound", causes)
    parts = ("Spool: 5 % more than a four-way valve must draw", "3360 J, 160 J above its bound")
    assert not lacks(sentences.items[1], *parts, "the difference is oil")
    texts = [[getattr(cell, "text", cell) for cell in row][3:] for row in table.rows]
    assert texts[0] == ["2300", "31.5", "34.5", "2100", "204", "26", "4", "171", "3"]
    assert texts[1] == ["3360", "0", "0", "3200", "160", "160", "0", "0", "0"]
    assert "pressure left in the off-side chamber of resistive motion 9.2 %" in lost.items[0]
    row = dict(zip(losses.head, losses.rows[0], strict=True))
    expected = {"supply → head": "460", "not accounted for": "7", "of all this holding": "1.4"}
    expected["of all this pressure of the off-side"] = "212"
    assert {name: row[name].text for name in expected} == expected


def test_a_log_tells_its_unexplained_row_with_its_interval(tmp_path):
    """Without a four-way valve to compare with: against what such a valve must draw."""
    rig, cases = cycles(tmp_path, six=cycle_ledger(SIX, "log"))
    (item,) = energy_tables.savings_of(cases)
    assert item.reference is None and item.half == pytest.approx(20.0)
    blocks = energy_tables.saving_blocks(rig, cases)
    parts = ("28.1 % less than a four-way valve", "six functions is 34.5 % less", "± 20 J")
    assert not lacks(blocks[1].items[0], *parts)
    losses = blocks[-1]
    assert losses.rows[0][losses.head.index("unexplained")].text == "7\u00a0±\u00a020"
    assert "95 % interval" in losses.caption
    ledger = cycle_ledger(SIX)
    ledger["bounds"][0]["closed"] = False  # a bound is that of a cycle
    assert energy_tables.saving_blocks(*cycles(tmp_path / "open", six=ledger)) == []


def test_gains_and_bounds_are_those_that_ran_with_their_units(tmp_path):
    low = 344737.865
    gains = {"low_pressure": low, "adapt": 1.0, "extend_resistive.feedback_gain": 1e-10}
    known = {"gains": gains, "estimate_bounds": {"disturbance": [-419.0, 419.0]}}
    lean = {"gains": {"low_pressure": 5e5, "adapt": 0.0}}
    both = {"a": TRACKED["arc"] | known, "b": TRACKED["arc"] | lean}
    folder = trials_run(tmp_path, "gains", both)
    rows = json.loads((folder / "table.json").read_text())["rows"]
    rows[2]["gains"] = rows[2]["gains"] | {"low_pressure": 2 * low}  # a's other payload
    write_json(folder / "table.json", {"rows": rows})
    FigureIndex(folder).save()  # tables are all that is asked for
    text = plain(build([folder]))
    gain = from_si(1e-10, "mL/min/bar", VOCABULARY["feedback_gain"])
    parts = ("p_low set-point of the off-side chamber above tank 345 to 689 500 kPa",)
    parts += (f"K_p extend resistive: pressure feedback: flow per pressure {gain:g} – mL/min/bar",)
    assert not lacks(text, *parts, "n_a 1 where the estimates follow")
    assert re.search(r"Bounds of the estimates\. .* −419 … 419 N", text)
    lead = 'stage = "campaign"\nrecipes = ["a.toml"]\n[figures]\n'
    (tmp_path / "c.toml").write_text(f'{lead}"settings_controller" = "Table C.1"\n')
    assert "<strong>Table C.1</strong>" in build([folder], load_recipe(tmp_path / "c.toml"))


def test_estimates_outside_and_at_their_bounds_are_said(runs):
    (case,) = cases_of(Saved(runs[3]))
    record, rig = case.record(), load_rig(runs[3])
    top = float(record["boom.inverse_bulk"].max())
    for bounds, text in (
        ({"disturbance": [-9.0, 9.0]}, "All estimates stay within their bounds."),
        ({"disturbance": [-9.0, 4.0], "inverse_bulk": [0.5, 2.0]}, "all the time: disturbance."),
        ({"inverse_bulk": [1.0, top]}, "at its bound in the end: inverse bulk."),
    ):
        item = changed(case, estimate_bounds=bounds)
        assert estimates_caption(rig, item, record).endswith(text)
    assert "The estimate ends 1.31 kg from it." in estimates_caption(rig, case, record)
    assert "show an oil" not in estimates_caption(rig, case, record)
    record.channels["boom.bulk_measured"] = np.linspace(276e6, 168e6, record.t.size)
    assert not lacks(estimates_caption(rig, case, record), "of 168 MPa", "has 276 MPa")


def test_three_controllers_stand_in_one_comparison_with_error_and_damping_each(unpainted, tmp_path):
    """A rough damping ratio is marked; what misses the request by far wins nothing."""
    hardly = DAMPED | {"ringing": "damped too well to ring", "damping_ratio_fitted": 0.68}
    stuck = STEP | {"steady_error": -1.0, "steady_speed": 1e-15, "overshoot": None}
    laws = {
        "open loop": PAIR["open loop"],
        "pressure feedback": measures(1900.0, 5e-3, [hardly]),
        "no washout": measures(1.0, 5e-3, [stuck | {"damping_ratio": 0.3}]),
    }
    folder = trials_run(tmp_path, "three", laws, payloads=["none"])
    draw(folder)
    known = captions(folder)
    assert not lacks(
        known["compare_no_load_70"],
        "Open loop: overshoot 60 %, steady error −2 %, not settled, damping ratio 0.08.",
        "settled after 0.3 s, damping ratio about 0.68 (damped too well to ring).",
        "No washout: overshoot unknown, steady error −100 %, not settled, damping ratio 0.3.",
        "Best by overshoot: pressure feedback; worst: open loop, 3 times as much.",
    )
    parts = ("no load: pressure feedback, 1900 J", "20 % off the requested speed: no wash")
    assert not lacks(known["energy_70"], *parts)
    assert not lacks(
        plain(build([folder])),
        *("damping ratio about 0.68 where it hardly rings", "0.68 (1)", "(1) damped too well"),
        "No washout: steady error −100 %, no overshoot to read, damping ratio 0.3.",
        "no load 70 % no washout 100 0 −100",  # not a speed of 1e-13 mm/s
    )


def test_a_root_locus_is_filled_in_exactly():
    """``s (s + 1)(s + 4) + K (s + 0.2)``, over K and K²: every point between is a root."""
    for power in (1, 2):
        values = np.geomspace(0.1, 60.0, 25)
        poles = np.array([np.roots([1.0, 5.0, 4.0 + k**power, 0.2 * k**power]) for k in values])
        rolls = [np.random.default_rng(i).permutation(3) for i in range(25)]
        shuffled = np.take_along_axis(poles, np.array(rolls), 1)
        fine, branches = root_locus.refined(values, shuffled)
        assert fine.size == 24 * (7 + 1) + 1 and np.all(np.diff(fine) > 0.0)
        for k, row in zip(fine, branches, strict=True):
            left = row * (row + 1.0) * (row + 4.0) + k**power * (row + 0.2)
            assert np.abs(left).max() < 1e-7 * (1.0 + k**power) * (1.0 + np.abs(row).max())
        step = np.abs(np.diff(branches, axis=0)).max(axis=0)
        other = min(np.abs(branches[-1, i] - branches[-1, j]) for i in range(3) for j in range(i))
        assert step.max() < 0.5 * other  # no branch jumps to another


# --- what captions say of trials after a stop and at rest

RIG = load_rig(Path(__file__).parents[2] / "recipes" / "rigs" / "thesis_arm.toml")
T = np.arange(0.0, 4.0, 0.001)
MOVING = (T >= 0.5) & (T < 2.0)


def trial(
    swing: float = 0.0, changes: int = 0, chatter: float = 0.0, steps: bool = True
) -> tuple[Case, Record]:
    v = np.where(MOVING, 0.1, swing * np.exp(-(T - 2.0)) * np.cos(20.0 * (T - 2.0)) * (T >= 2.0))
    function = np.where(MOVING, 1.0, 0.0)
    for place in range(changes):
        function[(T >= 2.5 + 0.1 * place) & (T < 2.55 + 0.1 * place)] = 1.0
    command = np.where(MOVING, 4.0 + chatter * np.sin(2.0 * np.pi * 40.0 * T), 0.0)
    channels = {"boom.v": v, "boom.v_desired": 0.1 * MOVING, "boom.function": function}
    channels |= {"boom.hect.command": command}
    row = {
        "cylinder": "boom",
        "controller": "six_functions",
        "steps": [{"speed": 0.1, "steady_error": 0.0}] if steps else [],
        "stopped": "",
    }
    return Case(Table(row, Path("x")), "x", Path("x"), Path("x")), Record(T, channels)


def caption(*trials: tuple[Case, Record]) -> str:
    return standstill_caption(RIG, [case for case, _ in trials], [log for _, log in trials])


@pytest.mark.parametrize(
    ("trials", "numbers"),
    [
        ([{}], []),
        ([{"swing": 0.05}], ["43"]),
        ([{"changes": 6}], ["12"]),
        ([{"chatter": 1.0, "steps": False}, {}], ["2", "0.1"]),
        ([{"chatter": 0.1, "steps": False}], []),
    ],
    ids=["quiet", "swings after the stop", "function changes", "command chatters", "calm"],
)
def test_what_happens_at_standstill_is_reported_with_its_size(trials, numbers):
    text = caption(*(trial(**given) for given in trials))
    assert all(re.search(rf"\b{number}\b", text) for number in numbers)
    assert bool(text) == bool(numbers)


def test_a_swing_and_a_channel_that_lies_off_are_reported():
    first, last = swing_after(*trial(swing=0.05)) or (0.0, 0.0)
    assert first == pytest.approx(0.05 * np.exp(-0.16), rel=0.03)
    assert last == pytest.approx(0.05 * np.exp(-1.83), rel=0.1)
    recorded = np.where(T < 2.0, 0.0, 1e6)
    off = recorded + np.where((T > 1.0) & (T < 2.5), 2e5, 0.0)
    series = Series(
        T, {"a.p_rod": recorded, "a.p_head": recorded}, {"a.p_rod": off, "a.p_head": recorded}
    )
    assert lasting(series, ["a.p_rod", "a.p_head"]) == [("a.p_rod", pytest.approx(1.5, abs=0.01))]
