"""Every shipped rig loads, survives being written and read, and says where its numbers come
from.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import tomli_w

from ehbench.recipe import load_rig
from ehbench.rig import SURENESS

RIGS = sorted((Path(__file__).parents[2] / "recipes" / "rigs").glob("*.toml"))


@pytest.mark.parametrize("path", RIGS, ids=lambda p: p.stem)
def test_round_trip(path, tmp_path):
    rig = load_rig(path)
    copy = tmp_path / "rig.toml"
    copy.write_text(tomli_w.dumps(rig.as_toml()))
    assert load_rig(copy) == rig
    assert all(value.sure in SURENESS for value in rig.parameters().values())


@pytest.mark.parametrize("path", RIGS, ids=lambda p: p.stem)
def test_every_parameter_can_be_replaced(path):
    rig = load_rig(path)
    for name, value in rig.parameters().items():
        other = float(value) * 1.01 + 1e-6
        assert float(rig.with_values({name: other}).parameters()[name]) == pytest.approx(
            other, rel=1e-12
        ), name
