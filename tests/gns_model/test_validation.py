"""The solver against the paper: the same run that `gns-model validate` prints."""

import json
import os

import pytest

from gns_model import paper
from gns_model.scene import Scene
from gns_model.validation import validate

EXAMPLES = os.path.join(os.path.dirname(__file__), "..", "..", "examples")


def test_example_files_are_the_papers_scenes():
    assert Scene.from_toml(f"{EXAMPLES}/flume.toml") == paper.flume_scene()
    for column in paper.COLUMNS:
        path = f"{EXAMPLES}/columns/a-{column.aspect:.1f}.toml"
        assert Scene.from_toml(path) == paper.column_scene(column)
    upscaled = Scene.from_toml(f"{EXAMPLES}/columns/a-0.8-upscaled.toml")
    expected = paper.column_scene(paper.UPSCALED)
    assert upscaled.releases == expected.releases
    assert upscaled.domain == expected.domain


@pytest.mark.slow
def test_columns_and_flume_agree_with_the_paper():
    result = validate(workers=min(2, os.cpu_count() or 1))
    json.dumps(result)
    for row in result["columns"]:
        assert abs(row["error"]) <= 0.08, row
    flume = result["flume"]
    for key, (low, high) in paper.FLUME_FACTS.items():
        assert low <= flume[key] <= high, (key, flume[key])
    assert flume["points_inside_baffles"] == 0
    assert result["passed"]
