"""A wheel carries the recipes and datasets of the repository, so that `ehbench reproduce thesis`
works outside a checkout. All else of the package stands in pyproject.toml.
"""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent


class WithRecipes(build_py):
    """Copies recipes and datasets to ``ehbench/shipped`` of what is built."""

    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for name in ("recipes", "datasets"):
                target = Path(self.build_lib) / "ehbench" / "shipped" / name
                shutil.copytree(ROOT / name, target, dirs_exist_ok=True)


setup(cmdclass={"build_py": WithRecipes})
