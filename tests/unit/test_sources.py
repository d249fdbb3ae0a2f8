"""What results and compiled code are named by."""

import os

from ehbench.runs.rundir import PACKAGE
from ehbench.runtime.sources import sources


def test_only_own_files_of_these_kinds_in_one_order(tmp_path):
    for name in ("b.py", "a.py", "a/z.py", "a.html", "__pycache__/c.py", "a/shipped/d.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    found = [path.relative_to(tmp_path).as_posix() for path in sources(tmp_path, ".py", ".html")]
    assert found == ["a/z.py", "a.html", "a.py", "b.py"]


def test_what_another_process_clears_away_is_not_looked_into(monkeypatch):
    """A cache of older sources may go while one looks."""
    looked, scan = [], os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: looked.append(str(path)) or scan(path))
    assert PACKAGE / "workflow.py" in sources(PACKAGE, ".py")
    assert looked and not any("__pycache__" in path for path in looked)
