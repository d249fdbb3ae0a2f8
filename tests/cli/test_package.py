"""What is given to others: a wheel that works outside a checkout, and the docs as a site."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.shared import ROOT


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
    # the hook that pip calls, without a pip around it that only prepares and cleans up
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    made = [sys.executable, "-W", "ignore", "-c", build, folder]
    subprocess.run(made, cwd=source, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    target = folder / "site"
    bare = [*offline, "--no-compile"]
    subprocess.run([*pip, "install", *bare, "--target", target, wheel], check=True)
    return target


def files(folder: Path) -> dict[str, bytes]:
    """What lies in a folder, by its path there."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    }


@pytest.mark.slow
def test_a_wheel_finds_the_campaigns_that_ship(installed, tmp_path):
    """Every recipe and all data are in it, to the byte. The slide's campaign is checked with
    kernels that run as Python: to compile them takes twenty seconds."""
    code = (
        "from ehbench.app import inspection, starter\n"
        "print(starter.find_campaign('thesis'))\n"
        "path = starter.find_campaign('slide_servo')\n"
        "print(path); print(inspection.check(path).code)\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(installed), "PATH": "", "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    thesis, slide, found = done.stdout.split()
    assert found == "0"
    for path, name in ((thesis, "thesis"), (slide, "slide_servo")):
        shipped = Path(path).parents[1]
        assert shipped.is_relative_to(installed)
        assert Path(path) == shipped / name / "campaign.toml"
    assert files(shipped) == files(ROOT / "recipes")
    assert files(shipped.parent / "datasets") == files(ROOT / "datasets")


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
    site, docs = tmp_path / "site", ROOT / "docs"
    pages = {path.relative_to(site).with_suffix("").as_posix() for path in site.rglob("*.html")}
    sources = {path.relative_to(docs).with_suffix("").as_posix() for path in docs.rglob("*.md")}
    assert pages - {"404"} == sources
    start = (site / "index.html").read_text()
    assert all(f'href="{name}.html"' in start for name in sources - {"index"})
