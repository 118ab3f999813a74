"""What kept outcomes depend on: the code that makes them, and none of that above it."""

import tomllib
from pathlib import Path

from toolkit.experiment import code_version

PROJECT = Path(__file__).parents[2]


def test_all_parts_above_the_experiment_and_no_others_change_no_result():
    contracts = tomllib.loads((PROJECT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(one["layers"] for one in contracts if one["type"] == "layers")
    above = [part for layer in layers[: layers.index("experiment")] for part in layer.split(" | ")]
    there = {part if (PROJECT / "toolkit" / part).is_dir() else f"{part}.py" for part in above}
    assert set(code_version._ABOVE) == there
