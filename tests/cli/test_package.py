"""What is given to others: a wheel that works outside a checkout, and the docs as a site."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder into which the wheel of this tree was installed."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("ehbench", "recipes", "datasets"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    offline = ["--no-deps", "--no-build-isolation", "--no-index"]
    subprocess.run([*pip, "wheel", *offline, "-w", folder, source], check=True)
    (wheel,) = folder.glob("*.whl")
    target = folder / "site"
    bare = [*offline, "--no-compile"]
    subprocess.run([*pip, "install", *bare, "--target", target, wheel], check=True)
    return target


@pytest.mark.slow
def test_a_wheel_finds_the_campaigns_that_ship(installed, tmp_path):
    """And says the same version of the code as the checkout that it was made from. Its kernels run
    as Python: to compile them into a folder of their own for one check takes twenty seconds.
    """
    code = (
        "from ehbench import rundir, starter, inspection\n"
        "path = starter.find_campaign('thesis')\n"
        "print(path); print(inspection.check(path).code); print(rundir.code_version())\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(installed), "PATH": "", "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    path, found, version = done.stdout.split()
    assert Path(path).is_relative_to(installed) and found == "0"
    from ehbench.rundir import code_version

    assert version == code_version()


def test_a_wheel_has_its_licence_and_is_typed(installed):
    assert (installed / "ehbench" / "py.typed").is_file()
    (about,) = installed.glob("ehbench-*.dist-info")
    assert "BSD 3-Clause" in (about / "licenses" / "LICENSE").read_text()
    meta = (about / "METADATA").read_text()
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"Version: {version}\n" in meta and "License-Expression: BSD-3-Clause" in meta
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_site_has_every_page_and_no_dead_link(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", tmp_path / "site"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    made = {path.stem for path in (tmp_path / "site").glob("*.html")}
    assert made - {"404"} == {path.stem for path in (ROOT / "docs").glob("*.md")}
    start = (tmp_path / "site" / "index.html").read_text()
    assert all(f'href="{name}.html"' in start for name in made - {"404", "index"})
