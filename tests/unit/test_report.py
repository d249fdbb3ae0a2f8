"""Reports are built from saved folders alone, the same bytes each time, and show what failed."""

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ehbench.config.recipe import load_recipe, load_rig
from ehbench.physics.flow_map import collect, save_flow_maps
from ehbench.report import build, draw, style
from ehbench.report.blocks import Grid, inline, prose
from ehbench.report.compare import compare, intervals_between
from ehbench.report.saved import FigureIndex, Saved, Table, read_points, read_series
from ehbench.report.stages import hydraulics
from ehbench.report.stages import study as studies
from ehbench.report.stages.response import section
from ehbench.report.style import canvas, spread, thin
from ehbench.report.svg import shrink
from ehbench.report.template import Template
from ehbench.report.words import estimate, interval, number, pretty, with_error
from ehbench.vocabulary.errors import InputError
from ehbench.vocabulary.terms import Z95
from tests.shared import RIGS
from tests.unit.report_runs import (
    Page,
    a_map,
    facts,
    fill_reported,
    flow_map_run,
    hydraulics_run,
    made,
    open_loop_run,
)


@pytest.fixture(scope="module")
def runs(made_once) -> list[Path]:
    root = made_once("reported", fill_reported)
    return [root / name for name in ("trial_slide_servo", "judged", "fit", "maps")]


@pytest.fixture(scope="module")
def built(runs) -> str:
    return build(runs, None)


def campaign(root: Path, figures: str):
    path = root / "campaign.toml"
    path.write_text(
        'stage = "campaign"\ntitle = "All <of> it"\nnote = "Nothing was measured."\n'
        'recipes = ["maps.toml"]\n'
        '[[section]]\ntitle = "Two contradictions"\ntext = """One.\n\n- first\n- second"""\n'
        f"[figures]\n{figures}\n"
    )
    return load_recipe(path)


def test_the_page_is_whole_and_needs_no_network(runs, tmp_path):
    text = build(runs, campaign(tmp_path, ""))
    page = Page(text)
    assert not page.bad and not page.open
    assert len(page.ids) == len(set(page.ids)) > 100
    assert page.loads == ["script"] and "@import" not in text
    assert "http" not in text.replace('<meta http-equiv="Content-Security-Policy"', "")
    assert {link for link in page.links if link.startswith("#")} == set(page.links)
    assert {link[1:] for link in page.links} <= set(page.ids)
    assert not re.search(r"\bnan\b|\bNone\b|\binf\b|Undefined", text)
    assert text.startswith("<!DOCTYPE html>") and "<title>All &lt;of&gt; it</title>" in text


def test_runs_stand_in_order_with_their_saved_figures(runs, built):
    heads = re.findall(r"<h2>(.*?) ?(?:<|$)", built, re.M)
    kinds = ["Flow maps", "Bulk modulus", "Held-out logs", "A step"]
    assert heads[:6] == ["At a glance", "Chapters", *kinds] and heads[-1] == "Provenance"
    drawn = [svg for run in runs for svg in run.glob("figures/*.svg")]
    indices = [json.loads((run / "figures/index.json").read_text())["figures"] for run in runs]
    index = [item for items in indices for item in items]
    assert built.count("<svg") - 1 == len(index) == len(drawn)  # the first screen has one again
    for svg in (path.read_text() for path in drawn):
        assert {*re.findall(r'href="#([^"]+)"', svg)} <= {*re.findall(r'id="([^"]+)"', svg)}
        assert "nan" not in svg.lower()
    assert {item["about"]["kind"] for item in index} == {
        *("flow_map", "inverse_map", "parameters", "fit", "validation", "residuals", "trial")
    }


def test_same_files_same_bytes(runs, built, tmp_path):
    copies = [Path(shutil.copytree(run, tmp_path / "elsewhere" / run.name)) for run in runs]
    shutil.rmtree(copies[0] / "figures")
    draw(copies[0])
    before, after = (
        {path.name: path.read_bytes() for path in (folder / "figures").iterdir()}
        for folder in (runs[0], copies[0])
    )
    assert before == after
    assert build(copies, None) == built


def test_what_the_files_hold_is_shown(built):
    page = Page(built).text
    for text in (
        *("The model is rejected.", "fit 20 % is below the 30 % asked", "1 of 1 check failed"),
        "Could not be simulated: the simulation left the finite range",
        *("Recorded only: this log could not be simulated.", "the log carries no motion"),
        "Stopped by a limit: carriage.p_head = 9 MPa passed pressure_max",
        *("whole trials differ", "Recorded on the virtual bench."),
        *("271.3 ± 4.8 MPa 266.5 … 276.1", "at bound", "not excited", "companion lost in the text"),
        "bulk_modulus and boom.joint_damping correlate by −0.97",
        *("joint_damping 400 N·m·s/rad restored", "x.csv:26", "−41.2", "2 ± 0.2", "undecided"),
        *("not measured", "eq_2_12 eq_2_17 error relative to the best 1 1.012"),
        *("1" * 64, "2" * 64, "5" * 64),
        f"{25 / 2 / np.pi:.3f} ± {Z95 * 0.3 / 2 / np.pi:.3f}",  # rad/s shown in Hz
    ):
        assert text in page
    assert "3.98 ± 0.05" not in page


def test_what_hangs_together_is_one_sentence():
    """Three names of which the first and last are joined by the second alone, and one apart."""
    first, second = [1.0, 0.97, 0.9, 0.1], [0.97, 1.0, -0.99, None]
    matrix = [first, second, [0.9, -0.99, 1.0, 0.2], [0.1, None, 0.2, 1.0]]
    said, _ = hydraulics.correlations(["a", "b", "c", "d"], matrix)
    (text,) = said.items
    assert text.startswith("a, b and c correlate by 0.97 to 0.99")


def test_a_campaign_titles_figures_and_adds_sections(runs, tmp_path):
    titles = '"flow_map_hect_forward" = "Fig. A.4"\n"judged/validation_held_boom" = "Fig. A.12"'
    chosen = campaign(tmp_path, titles)
    text = build(runs, chosen)
    assert "<strong>Fig. A.4</strong>" in text and "<strong>Fig. A.12</strong>" in text
    page = Page(text).text
    assert "Two contradictions One. first second" in page and "Nothing was measured." in page
    heads = ("At a glance", "Two contradictions One.", "Inverse map of hect, forward")
    places = [page.index(text) for text in heads]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("which", "file", "keys"),
    [
        (3, "summary.json", ["deadband"]),
        (2, "parameters.json", ["parameters"]),
        (1, "validation.json", ["reasons"]),
        (0, "trial.json", ["on"]),
        (0, "run.json", ["stage", "recipe", "commit"]),
    ],
)
def test_a_missing_key_is_named_with_its_file(runs, tmp_path, which, file, keys):
    for key in keys:
        copy = Path(shutil.copytree(runs[which], tmp_path / key))
        table = json.loads((copy / file).read_text())
        del (table[0] if isinstance(table, list) else table)[key]
        (copy / file).write_text(json.dumps(table))
        with pytest.raises(InputError, match=f"{file}.*{key}"):
            build([copy], None)


def test_a_missing_figure_and_a_title_for_none_are_named(runs, tmp_path):
    copy = Path(shutil.copytree(runs[3], tmp_path / "copy"))
    (copy / "figures" / "flow_map_hect_forward.svg").unlink()
    with pytest.raises(InputError, match=r"flow_map_hect_forward\.svg"):
        build([copy], None)
    with pytest.raises(InputError, match="flow_map_hekt_forward") as caught:
        build(runs, campaign(tmp_path, '"flow_map_hekt_forward" = "Fig. A.4"'))
    assert caught.value.line == 12 and "flow_map_hect_forward" in caught.value.hint


def test_optional_parts_may_be_missing(unpainted, tmp_path):
    folder = hydraulics_run(tmp_path)
    table = json.loads((folder / "parameters.json").read_text())
    for key in ("correlated_names", "correlation", "matches", "dynamics_comparison"):
        del table[key]
    (folder / "parameters.json").write_text(json.dumps(table))
    shutil.rmtree(folder / "series")
    draw(folder)
    page = Page(build([folder], None)).text
    assert "271.3 ± 4.8" in page
    assert "Correlation of the estimates" not in page and "What was matched" not in page


def test_a_stage_of_later_days_is_shown_with_its_files(tmp_path):
    folder = made(tmp_path, "later")
    facts(folder, "dream", "later", title="Something new")
    draw(folder)
    page = Page(build([folder], None)).text
    assert "Something new" in page and "rig.toml" in page


@pytest.mark.parametrize("rig", sorted(path.stem for path in RIGS.glob("*.toml")))
def test_every_rig_lists_all_its_parameters(tmp_path, rig):
    folder = open_loop_run(tmp_path, rig, stopped="")
    FigureIndex(folder).save()  # without any: none is looked at
    page = Page(build([folder], None)).text
    tail = page[page.index("All parameters") :]
    for name, value in load_rig(folder).parameters().items():
        assert name.rpartition(".")[2] in tail and value.sure in tail
    assert "stopped" not in page


def test_no_two_figures_share_a_file(unpainted, tmp_path):
    folder = made(tmp_path, "twins")
    maps = [a_map("a b", "forward", 1.0), a_map("a_b", "forward", 1.0)]
    save_flow_maps(collect(maps), folder)
    units = "command [V],pressure_drop [Pa],flow [m^3/s],fitted [m^3/s]"
    (folder / "points.csv").write_text(f"valve,direction,{units},method,outlier\n")
    facts(folder, "identify", "twins", what="flow_map")
    draw(folder)
    assert len(list((folder / "figures").glob("*.svg"))) == 4


@pytest.mark.parametrize(
    ("read", "text", "key", "line"),
    [
        (read_points, "valve,direction,command [V],flow [gpm],method\n", "data.no_column", 1),
        (read_series, "t [s],boom.wobble\n0,1\n", "data.unknown_channel", 1),
        (read_series, "boom.q [rad]\n1\n", "data.no_time_or_channel", 1),
        (read_series, "t [s],boom.q [rad]\n0,1\n1\n", None, 3),
    ],
)
def test_saved_tables_say_what_is_wrong(tmp_path, read, text, key, line):
    path = tmp_path / "s.csv"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read(path)
    assert (key is None or caught.value.key == key) and caught.value.line == line


def test_series_are_read_in_si_and_a_missing_entry_is_named(tmp_path):
    with pytest.raises(InputError, match=r"'a\.b'") as caught:
        Table({"a": {"c": 1}}, tmp_path)["a"]["b"]
    assert caught.value.key == "report.no_key"
    path = tmp_path / "s.csv"
    head = "t [ms],boom.q [deg],simulated.boom.q [rad],boom.hect.command [V]"
    path.write_text(f"{head}\n0,180,3,1\n500,90,2,1\n")
    series = read_series(path)
    assert series.t.tolist() == [0.0, 0.5]
    # rounding of the unit's factor
    assert series.recorded["boom.q"] == pytest.approx([np.pi, np.pi / 2], rel=1e-12)
    assert series.simulated["boom.q"].tolist() == [3.0, 2.0]
    assert series.cylinders() == {"boom": ["boom.q"]}


def test_thinning_keeps_every_extreme_and_both_ends():
    t = np.linspace(0.0, 1.0, 100_000)
    y = np.sin(40 * t)
    y[54_321], y[77_777] = 9.0, -7.0
    few_t, few_y = thin(t, y, 300)
    assert few_t.size <= 602 and few_y.max() == 9.0 and few_y.min() == -7.0
    assert (few_t[0], few_t[-1]) == (0.0, 1.0) and np.all(np.diff(few_t) > 0)
    assert thin(t[:100], y[:100], 300)[0].size == 100


def test_labels_are_moved_apart_in_order_and_stay_where_there_is_room():
    for count in (1, 2, 7, 40, 400):
        places = np.random.default_rng(count).normal(0.5, 0.05, count)
        moved = np.array(spread(places, 0.03, 0.0, 1.0))
        gap = min(0.03, 1.0 / count)
        assert np.all(np.diff(moved[np.argsort(places, kind="stable")]) >= gap - 1e-9), count
        assert moved.min() >= 0.5 * gap - 1e-9 and moved.max() <= 1.0 - 0.5 * gap + 1e-9, count
    assert spread([0.9, 0.1, 0.5], 0.05, 0.0, 1.0) == pytest.approx([0.9, 0.1, 0.5])
    assert spread([0.5, 0.5], 0.1, 0.0, 1.0) == pytest.approx([0.45, 0.55])
    assert spread([0.6, 0.5, 0.9], [0.4, 0.2, 0.2], 0.0, 1.0) == pytest.approx([0.6, 0.3, 0.9])


SPELLED = [
    (with_error, (271.34, 2.44), "271.3 ± 2.4"),
    (with_error, (12346.0, 240.0), "12350 ± 240"),
    (with_error, (5.0, 50.0), "5 ± 50"),
    (with_error, (0.0, 0.01), "0.000 ± 0.010"),
    (with_error, (-3.2, 0.0996), "−3.20 ± 0.10"),
    (with_error, (3.59e-8, 1e-10), "(3.590 ± 0.010) × 10⁻⁸"),
    (with_error, (2.0, None), "2"),
    (with_error, (None, None), "–"),
    (with_error, (2.0, 0.0), "2"),
    (number, (0.0,), "0"),
    (number, (99999.6,), "100000"),
    (number, (1234567.0,), "1.235 × 10⁶"),
    (number, (0.00012346,), "1.235 × 10⁻⁴"),
    (number, (-0.5,), "−0.5"),
    (number, (99.996,), "100"),
    (number, (float("nan"),), "–"),
    (number, (float("-inf"),), "−∞"),
    (number, (None,), "–"),
    (estimate, (271.34, 266.5, 276.1), "271.3 ± 4.8"),  # only about the middle of an interval
    (estimate, (2.3867, 2.2412, 2.3931), "2.387"),
    (estimate, (513.2, 348.9, 754.9), "510"),
    (estimate, (513.2, None, None), "513.2"),
    (interval, (266.52, 276.13), "266.5 … 276.1"),
    (interval, (None, 2.0), "–"),
    (interval, (2.0, 2.0), "2 … 2"),
    (pretty, ("m^3/(s*Pa)",), "m³/(s·Pa)"),
    (pretty, ("gpm/V/MPa^0.5",), "gpm/V/√MPa"),
    (pretty, ("degC",), "°C"),
    (pretty, ("deg/s",), "°/s"),
    (pretty, ("us",), "µs"),
    (pretty, ("dimensionless",), ""),
]


@pytest.mark.parametrize(("spell", "given", "said"), SPELLED)
def test_numbers_are_spelled(spell, given, said):
    """An error sets the digits of its value; numbers are short."""
    assert spell(*given) == said


def test_inlined_figures_keep_to_themselves():
    svg = (
        '<?xml version="1.0"?><!DOCTYPE svg><svg viewBox="0 0 300 150" '
        'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"><metadata>x</metadata>'
        '<defs><path id="a"/></defs><use xlink:href="#a"/><g clip-path="url(#a)"/></svg>'
    )
    text = inline(svg, "f1-", 'A "title"')
    assert all(word in text for word in ('id="f1-a"', 'href="#f1-a"', "url(#f1-a)"))
    assert "metadata" not in text and "http" not in text
    assert "A &quot;title&quot;" in text and "max-width:400px" in text


def points(path: str) -> list[tuple[float, float]]:
    """Every point of a path, absolute or relative, control points too."""
    found, x, y, start = [], 0.0, 0.0, (0.0, 0.0)
    for command, text in re.findall(r"([MmLlQqCcz])([^MmLlQqCcz]*)", path):
        if command == "z":
            x, y = start
            continue
        numbers = [float(n) for n in re.findall(r"-?(?:\d+\.?\d*|\.\d+)(?:e-?\d+)?", text)]
        many = {"M": 1, "L": 1, "Q": 2, "C": 3}[command.upper()]
        for first in range(0, len(numbers), 2 * many):
            ends = [(numbers[i], numbers[i + 1]) for i in range(first, first + 2 * many, 2)]
            found += [(x + a, y + b) if command.islower() else (a, b) for a, b in ends]
            x, y = found[-1]
            if command in "Mm" and first == 0:
                start = (x, y)
    return found


def test_a_study_says_of_each_case_how_it_ended(tmp_path):
    lines = ["sample,status,case,error [mm],message", "0,done,sound,1.5,", "1,stopped,stuck,9.0,"]
    lines[2] += '"no sample, at 0.9 s; at rest"'
    folder = made(tmp_path, "study")
    study = {"measures": [{"name": "error", "unit": "mm"}], "inputs": [{"key": "case"}]}
    (folder / "samples.csv").write_text("\n".join([*lines, "2,stopped,stuck,7.0,later"]))
    facts(folder, "study", title="Faults", warnings=[])
    run = Saved(folder)
    (grid,) = studies._case_tables(run, Template("study"), study)
    sound, stuck = ([getattr(cell, "text", cell) for cell in row] for row in grid.rows)
    assert sound == ["sound", "done 1", "1.5", "1.5", ""]
    assert stuck == ["stuck", "stopped 2", "8", "9", "no sample, at 0.9 s"]
    assert studies._case_tables(run, Template("study"), study | {"inputs": []}) == []


def test_figures_are_made_small_and_stay_the_same_picture(tmp_path, monkeypatch):
    """Text stays text, lines and markers stay to a tenth of a point, links lead somewhere."""
    whole = []
    monkeypatch.setattr(style, "shrink", lambda svg: whole.append(svg) or shrink(svg))
    t = np.linspace(0.0, 9.0, 400)
    with canvas(tmp_path / "a.svg") as (_, ax):
        walk = np.cumsum(np.random.default_rng(1).standard_normal(400))
        ax.plot(t, 1e-3 * walk, label="a < b & c")
        ax.plot(t[::40], np.cos(t[::40]), "o", label="marks")
        ax.fill_between(t, -np.sin(t), np.sin(t), alpha=0.2)
        ax.imshow([[0.0, 1.0]], extent=(0.0, 1.0, 0.0, 1.0), aspect="auto")
        ax.annotate("turned\nthrice", (3.0, 0.5), rotation=30)
        ax.legend()
    short = (tmp_path / "a.svg").read_text()
    assert len(short) < 0.5 * len(whole[0]) and 'href="data:image/png;base64,iVBOR' in short
    words, want = (re.findall(r">([^<>\s][^<>]*)</text>", one) for one in (short, whole[0]))
    assert words == want
    assert short.count("<use ") == whole[0].count("<use ") and "font-family=" in short
    assert "DejaVu Sans, Verdana, sans-serif" in short
    for pattern in (r'<use [^>]*?x="([^"]*)" y="([^"]*)"', r'<text [^>]*?x="([^"]*)" y="([^"]*)"'):
        old, new = (np.array(re.findall(pattern, one), float) for one in (whole[0], short))
        assert np.abs(old - new).max() <= 0.051
    old, new = (re.findall(r'<path[^>]*? d="([^"]*)"', one) for one in (whole[0], short))
    assert len(old) == len(new)
    for a, b in zip(map(points, old), map(points, new), strict=True):
        moves = [np.abs(np.round(p, 1) - np.round(q, 1)).max() > 1e-6 for p, q in zip(a[1:], a)]
        kept = [p for p, far in zip(a, [True, True, *moves[1:]]) if far]
        assert len(b) <= len(a) and (len(b) < len(a) or np.abs(np.array(a) - b).max() <= 0.051)
        # no point is lost, and errors do not add up
        assert max(min(np.hypot(x - u, y - v) for u, v in b) for x, y in kept) < 0.08
    links, ids = (re.findall(p, short) for p in (r'(?:href="|url\()#([^")]+)', r' id="([^"]+)"'))
    assert set(links) == set(ids)


SVG = '<svg viewBox="0 0 3 1" xmlns="http://www.w3.org/2000/svg">'


def test_styles_of_a_page_are_said_once():
    looks: dict[str, str] = {}
    svg = f'{SVG}<path style="fill:none"/><path style="fill:red"/></svg>'
    first, second = (inline(svg, f"f{i}-", "t", looks) for i in range(2))
    assert looks == {"fill:none": "k0", "fill:red": "k1"} and first == second
    assert first.count('class="k0"') == first.count('class="k1"') == 1 and "fill" not in first


@pytest.mark.parametrize(
    "inside",
    [
        '<text> style="} .warn {display:none} .x{"</text>',
        "<g id='a style=\"} .warn {display:none} .x{\"'/>",
        '<text>&lt;g style="} .warn {display:none} .x{"&gt;</text>',
    ],
)
def test_only_styles_of_elements_become_rules_of_the_page(inside):
    looks: dict[str, str] = {}
    drawn = inline(f'{SVG}<path style="fill:none"/>{inside}</svg>', "f", "t", looks)
    assert looks == {"fill:none": "k0"} and drawn.count("class=") == 1


def test_prose_makes_paragraphs_and_lists():
    kinds = [
        (type(one).__name__, getattr(one, "text", None) or list(one.items))
        for one in prose("One\ntwo.\n\nBefore:\n- a\n  b\n- c")
    ]
    assert kinds == [("Text", "One two."), ("Text", "Before:"), ("Bullets", ["a b", "c"])]


# --- what differs between two runs


@pytest.fixture
def pair(tmp_path):
    first = hydraulics_run(tmp_path)
    second = tmp_path / "other"
    shutil.copytree(first, second)
    table = json.loads((second / "parameters.json").read_text())
    table["parameters"][0] |= {"value": 2.9e8, "interval": [2.87e8, 2.93e8]}
    (second / "parameters.json").write_text(json.dumps(table))
    facts = json.loads((second / "run.json").read_text())
    facts["inputs"][0]["sha256"] = "9" * 64
    (second / "run.json").write_text(json.dumps(facts))
    return first, second


def test_what_differs_is_told_and_by_how_many_intervals(pair):
    answer = compare(*pair)
    (changed,), (one,) = answer.values["inputs"], answer.values["parameters"]
    assert changed["what"] == "data readings.csv" and changed["second"] == "9" * 64
    assert one["name"] == "bulk_modulus" and answer.values["same"] == 2
    # the halves that point to one another: 4.8 MPa up from the first, 3 MPa down from the second
    assert one["intervals"] == pytest.approx(18.7 / math.hypot(4.8, 3.0))
    told = "\n".join(answer.lines(200, whole=True))
    assert "271.3 ± 4.8" in told and "290.0 ± 3.0" in told
    assert re.search(r"bulk_modulus .* MPa .* 3\.3\b", told)
    assert "99999999" in told and "MPa" in told
    found = compare(pair[0], pair[0])
    assert not found.tables and found.values["same"] == 3 and found.verdict.fields["inputs"] == 0


def test_what_cannot_be_compared_is_named(pair, tmp_path, monkeypatch):
    maps = flow_map_run(tmp_path)
    with pytest.raises(InputError, match="is a run of 'flow map', the other of 'hydraulics'"):
        compare(pair[0], maps)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="no run folder") as refused:
        compare(Path("."), Path("."))
    assert refused.value.file == str(tmp_path)


@pytest.mark.parametrize(
    ("first", "second", "apart"),
    [
        ((1.0, (0.9, 1.3)), (2.0, (1.6, 2.1)), 1.0 / math.hypot(0.3, 0.4)),
        ((2.0, (1.6, 2.1)), (1.0, (0.9, 1.3)), 1.0 / math.hypot(0.3, 0.4)),
        ((1.0, None), (2.0, (1.5, 2.5)), 2.0),
        ((1.0, None), (2.0, None), None),
        ((1.0, (1.0, 1.0)), (1.0, None), 0.0),
        ((None, None), (1.0, (0.0, 2.0)), None),
    ],
)
def test_distance_in_intervals(first, second, apart):
    found = intervals_between(first, second)
    assert found == (apart if apart is None else pytest.approx(apart))


def test_a_quantile_stands_within_its_interval_and_its_unit_beside_it():
    """Ends in fewer digits than the value lay below a quantile whose end is no higher."""
    ends = {"share": 0.05, "value": 3472.8, "low": None, "high": 3473.1}
    row = {"name": "energy.pump", "unit": "J", "samples": 24, "mean": 3485.0, "quantiles": [ends]}
    row |= {"minimum": 3470.0, "maximum": 3494.0}
    grid = Template("study").table("measures", [row])
    assert grid.head[:2] == ["measure", "unit"]
    cell = grid.rows[0][5]
    assert re.findall(r"[\d.]+", cell if isinstance(cell, str) else cell.text) == ["3473", "3473"]


def test_forms_that_were_asked_for_come_first_of_a_response(tmp_path):
    """A terminal shows one table, and the sentence has the other's numbers."""
    form = {"form": "first order", "preferred": True, "poles": [76.0], "pole_stds": [1.2]}
    form |= {"delay": None, "fit_percent": [70.1]}
    table = {"output": "boom.v", "input": "boom.hect.command", "logs": ["a"], "averages": 8.0}
    table |= {"coherent_range": [1.0, 80.0], "coherent": 80, "frequencies": 100, "segment": 1.0}
    table |= {"coherence_noise": 0.3, "warnings": []}
    nothing: Any = lambda **_: []  # noqa: E731
    for forms, first in (([], ["", "value"]), ([form], ["form", "poles [rad/s]"])):
        folder = made(tmp_path, f"forms_{len(forms)}")
        (folder / "response.json").write_text(json.dumps(table | {"transfers": forms}))
        facts(folder, "response", title="Response", warnings=[])
        parts = {part.title: part.inside for part in section(Saved(folder), nothing).parts}
        assert [grid.head[:2] for grid in parts["Numbers"] if isinstance(grid, Grid)][0] == first
