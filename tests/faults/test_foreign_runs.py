"""Run folders by others go into a report as drawings and text, whatever else is in them."""

import base64
import hashlib
import json
import re
import shutil
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import pytest

from ehbench import report as write_report
from ehbench import workflow
from ehbench.report.blocks import inline
from ehbench.report.style import canvas
from ehbench.report.svg import sound
from ehbench.runs import rundir
from ehbench.vocabulary.errors import InputError
from tests.shared import ROOT

RIG = ROOT / "recipes" / "rigs" / "slide_servo.toml"
OPEN = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10">'
LINK = 'xmlns:xlink="http://www.w3.org/1999/xlink"'
EVIL = [
    "<script>alert(1)</script>",
    '<g onload="alert(1)"/>',
    '<g OnClick="alert(1)"/>',
    '<a href="javascript:alert(1)"><text>x</text></a>',
    '<use href="http://evil/x.svg#a"/>',
    f'<use {LINK} xlink:href="javascript:alert(1)"/>',
    '<image href="http://evil/x.png"/>',
    '<image href="data:text/html;base64,PHNjcmlwdD4="/>',
    '<image href="data:image/svg+xml;base64,PHNjcmlwdD4="/>',
    '<foreignObject><body xmlns="http://www.w3.org/1999/xhtml"><b>x</b></body></foreignObject>',
    "<style>@import url(http://evil)</style>",
    '<path style="fill:url(http://evil/a)" d="M0 0"/>',
    '<path style="a:b}body{background:url(//evil)" d="M0 0"/>',
    '<path fill="url(http://evil/a#b)" d="M0 0"/>',
    '<animate attributeName="href" to="javascript:alert(1)"/>',
    '<set attributeName="onclick" to="alert(1)"/>',
    '<iframe src="http://evil"/>',
    '<x:script xmlns:x="http://www.w3.org/2000/svg">alert(1)</x:script>',
    '<script xmlns="http://www.w3.org/1999/xhtml">alert(1)</script>',
    "<text><![CDATA[</text><script>alert(1)</script>]]></text>",
    "<!-- --><script>alert(1)</script>",
    "<?xml-stylesheet href='http://evil'?><g/>",
]


@pytest.mark.parametrize("evil", EVIL)
def test_what_is_no_drawing_is_taken_out(evil):
    text = inline(f'{OPEN}<path d="M0 0L1 1"/>{evil}</svg>', "f", "a title")
    assert "M0 0L1 1" in text
    low = text.lower().replace("&lt;", "").replace("</text", "")
    for word in "<script onload onclick javascript evil <style iframe foreign".split():
        assert word not in low, text
    ElementTree.fromstring(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<html/>",
        "<svg/>",
        "no svg",
        OPEN,
        '<!DOCTYPE svg [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>' + OPEN + "&b;</svg>",
        OPEN + "<g>" * 200_000,
    ],
)
def test_what_is_no_svg_is_said(text):
    with pytest.raises(ValueError, match="is no SVG|declares"):
        sound(text)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of one trial."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "trial.toml").write_text(
        f"stage = 'trial'\nrig = '{RIG}'\nduration = '0.3 s'\n[[command]]\nvalve = 'press.servo'\n"
        "kind = 'step'\namplitude = '2 V'\n"
    )
    return workflow.run(folder / "trial.toml", workflow.Session(root=folder)).folder


def doctored(made, tmp_path, name, text):
    """A copy of a run with one output that says something else, its hash made right."""
    run = tmp_path / "run"
    shutil.copytree(made, run)
    (run / name).write_text(text, encoding="utf-8")
    facts = json.loads((run / "run.json").read_text())
    facts["outputs"][name] = rundir.sha256(run / name)
    (run / "run.json").write_text(json.dumps(facts))
    return run


def test_our_own_figures_are_sound_as_they_are(made):
    figures = sorted((made / "figures").glob("*.svg"))
    assert figures
    for figure in figures:
        text = figure.read_text(encoding="utf-8")
        whole = ElementTree.tostring(ElementTree.fromstring(text))
        assert ElementTree.tostring(sound(text)) == whole


def test_a_figure_with_a_script_does_not_go_live(made, tmp_path):
    figure = sorted((made / "figures").glob("*.svg"))[0]
    text = figure.read_text(encoding="utf-8")
    evil = text.replace("</svg>", "".join(EVIL[:6]) + "</svg>")
    run = doctored(made, tmp_path, f"figures/{figure.name}", evil)
    page = write_report([run], out=tmp_path / "page").folder / "report.html"
    html = page.read_text(encoding="utf-8")
    assert "alert(1)" not in html and "evil" not in html
    assert "Content-Security-Policy" in html and "default-src 'none'" in html
    # no script runs but the page's own, which the policy knows by its hash
    (allowed,) = re.findall(r"script-src ([^;]*);", html)
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", html, re.S)
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    assert scripts and allowed.split() == [f"'sha256-{one}'" for one in dict.fromkeys(hashes)]


def test_a_figure_that_lies_elsewhere_is_not_read(made, tmp_path):
    index = json.loads((made / "figures" / "index.json").read_text())
    entries = index if isinstance(index, list) else index["figures"]
    entries[0]["file"] = "../../../../etc/passwd"
    run = doctored(made, tmp_path, "figures/index.json", json.dumps(index))
    with pytest.raises(InputError, match="no such file"):
        write_report([run], out=tmp_path / "page")


@pytest.mark.parametrize("name", ["$\\frac{$", "$x$", "a $5 b $6", "$$", "\\$", "$\\mathdefault{$"])
def test_a_name_is_drawn_as_it_was_written(tmp_path, name):
    with canvas(tmp_path / "a.svg") as (_, ax):
        ax.plot([0, 1], [1, 100], label=name)
        ax.set_title(name)
        ax.set_yscale("log")
        ax.set_xticks([0, 1], [name, "b"])
        ax.legend()
        ax.annotate(name, (0.5, 50))
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert text.count(f">{name}<") == 4 and "mathdefault{10" not in text
    assert not plt.get_fignums()
