"""What `import ehbench` gives, in any order of use, and how it shows itself."""

import inspect
import json
import re
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import threadpoolctl

import ehbench
from ehbench.data.record import Record
from ehbench.vocabulary.errors import InputError
from ehbench.workflow import Outcome
from tests.shared import RIGS, ROOT

EXAMPLES = {
    name: found[1]
    for name in ehbench.__all__
    if (found := re.search(r"Example:\n(.*?)\n\n", getattr(ehbench, name).__doc__ + "\n\n", re.S))
}


@pytest.fixture(scope="session")
def identified(slide_runs) -> Outcome:
    (folder,) = slide_runs.glob("hydraulics_*")
    return Outcome(folder, notes=("a note",))


def python(code: str) -> str:
    """What a new process prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_face_is_whole_and_documented():
    for name in ehbench.__all__:
        assert callable(getattr(ehbench, name)) and getattr(ehbench, name).__doc__
    assert dir(ehbench) == sorted(ehbench.__all__)
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        ehbench.simulat  # noqa: B018


@pytest.mark.slow
@pytest.mark.parametrize("name", ehbench.__all__)
def test_every_function_has_an_example_that_runs(name, workspace, kept, undrawn, monkeypatch):
    monkeypatch.chdir(workspace)
    code = textwrap.dedent(inspect.cleandoc(EXAMPLES[name]))
    assert f"ehbench.{name}" in code
    exec(compile(code, f"example of ehbench.{name}", "exec"), {"ehbench": ehbench})


@pytest.fixture(scope="module")
def imported() -> dict:
    """A process that imports every module and simulates: its state before and after, its names."""
    code = """
import json, locale, logging, os, pkgutil, signal, sys, threading, warnings
import control, jinja2, matplotlib, mcap, numba, numpy, pandas, pydantic, rich, scipy.optimize
import scipy.signal, typer
import matplotlib.figure, mcap.writer, mcap.reader, rich.console, threadpoolctl
import rosbags.rosbag2, rosbags.typesys

def state():
    return {
        "environ": dict(os.environ),
        "numba": {k: repr(v) for k, v in vars(numba.config).items() if k.isupper()},
        "warnings": repr(warnings.filters),
        "locale": locale.setlocale(locale.LC_ALL),
        "backend": matplotlib.rcParams["backend"],
        "rc": repr({k: v for k, v in matplotlib.rcParams.items() if k != "backend"}),
        "numpy": [repr(numpy.geterr()), repr(numpy.get_printoptions())],
        "pandas": repr(pandas.options.display.precision),
        "blas": [one["num_threads"] for one in threadpoolctl.threadpool_info()],
        "signals": [repr(signal.getsignal(one)) for one in (signal.SIGINT, signal.SIGTERM)],
        "threads": threading.active_count(),
        "recursion": sys.getrecursionlimit(),
        "handlers": repr(logging.getLogger().handlers),
        "cwd": os.getcwd(), "path": list(sys.path), "hook": repr(sys.excepthook),
    }

before = state()
import ehbench
for module in pkgutil.walk_packages(ehbench.__path__, "ehbench."):
    __import__(module.name)
after = state()
from ehbench.tune.gains import tune_pressure_feedback
from ehbench.report import build
rig = ehbench.load_rig("recipes/rigs/slide_servo.toml")
[ehbench.simulate(rig, {"press.servo": 2.0}, duration=0.1) for _ in range(2)]
kinds = {name: callable(getattr(ehbench, name)) for name in ehbench.__all__}
print(json.dumps({"state": {name: [before[name], after[name]] for name in before}, "face": kinds}))
"""
    return json.loads(python(code))


def test_importing_changes_nothing_and_is_light(imported):
    assert set(imported["face"]) == set(ehbench.__all__) and all(imported["face"].values())
    # Nor does any module of the package; what others do when imported is theirs
    found = imported["state"]
    assert set(found) >= {"environ", "numba", "warnings", "locale", "backend", "blas"}
    for name, (before, after) in found.items():
        assert before == after, name
    # Nothing heavy is loaded before it is used
    loaded = python("import ehbench, sys; print(*sys.modules)").split()
    assert "ehbench" in loaded and not {"numpy", "numba", "pandas", "pydantic"} & set(loaded)


def test_a_run_has_one_blas_thread_and_gives_the_others_back(workspace, undrawn):
    def threads():
        return {one["num_threads"] for one in threadpoolctl.threadpool_info()}

    seen = []
    with threadpoolctl.threadpool_limits(2):
        ehbench.run_trial(
            workspace / "my_rig/recipes/step_small.toml",
            out=workspace / "one_thread",
            progress=lambda *_: seen.append(threads()),
        )
        assert seen and all(one == {1} for one in seen), seen
        assert threads() == {2}


def test_simulate_gives_a_frame_with_units():
    rig = ehbench.load_rig(RIGS / "slide_servo.toml")
    command = np.zeros(201)
    command[100:] = 2.0
    frame = ehbench.simulate(
        rig, {"press.servo": command}, duration=0.2, posture={"press": "100 mm"}
    ).frame()
    assert frame.attrs["units"]["press.p_head"] == "Pa"
    assert frame["press.x"].iloc[0] == pytest.approx(0.1) and frame["press.x"].iloc[-1] > 0.1


def test_rigs_and_records_show_themselves_in_one_line_and_as_a_table():
    rig = ehbench.load_rig(RIGS / "thesis_arm.toml")
    assert repr(rig) == str(rig)
    assert repr(rig).startswith("<Rig 'thesis_arm': 3 joints, 3 cylinders, 7 valves, ")
    page = rig._repr_html_()
    bulk = rig.parameters()["bulk_modulus"]
    unit = rig.unit_of("bulk_modulus")
    assert f"<td>bulk_modulus</td><td>{float(bulk) / 1e6:.4g}</td>" in page and unit == "MPa"
    assert page.count("<tr>") == len(rig.parameters()) + 1
    odd = rig.model_copy(update={"title": "<b> & co"})
    assert "<caption>&lt;b&gt; &amp; co</caption>" in odd._repr_html_()
    t = np.linspace(0.0, 2.0, 5)
    record = Record(t, {"boom.p_head": 1e6 * t, "boom.q": np.zeros(5)})
    assert repr(record) == "<Record: 5 samples from 0 to 2 s, 2 channels: boom.p_head, boom.q>"
    page = record._repr_html_()
    assert "<td>boom.p_head</td><td>kPa</td><td>0</td><td>2000</td>" in page
    assert "<caption>0 … 2 s, 5 samples</caption>" in page
    many = Record(t, {f"c{i}.q": t for i in range(40)})
    assert len(repr(many)) < 120
    assert repr(Record(t[:0], {})) == "<Record: 0 samples, 0 channels>"
    assert "0 samples" in Record(t[:0], {"boom.q": t[:0]})._repr_html_()


def test_an_outcome_shows_its_folder_notes_and_parameters(identified, tmp_path):
    frame = identified.parameters
    saved = identified.json("parameters")["parameters"]
    assert list(frame.index) == [one["name"] for one in saved]
    bulk = frame.loc["bulk_modulus"]
    assert bulk["low"] < bulk["value"] < bulk["high"] and bulk["unit"] == "Pa"
    assert bulk["status"] == "estimated" and bulk["std"] > 0
    rig = ehbench.load_rig(identified.folder)
    shown = f"<td>bulk_modulus</td><td>{bulk['value'] / 1e6:.4g}</td>"
    assert rig.unit_of("bulk_modulus") == "MPa" and shown in identified._repr_html_()
    count = len(identified.notes)
    notes = f"{count} note" + "s" * (count != 1)
    assert repr(identified) == f"<Outcome '{identified.folder}': code 0, {notes}>"
    other = Outcome(tmp_path, 3, ("a < b",))
    assert "code 3" in repr(other) and "<li>a &lt; b</li>" in other._repr_html_()
    with pytest.raises(InputError, match=r"has no parameters\.json"):
        other.parameters  # noqa: B018
