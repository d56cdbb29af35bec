"""The tutorial's code runs as it is printed, and draws what it says."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread

DOCS = Path(__file__).parent.parent / "docs"


def test_the_tutorial_runs(tmp_path: Path, monkeypatch) -> None:
    blocks = re.findall(
        r"```python\n(.*?)```", (DOCS / "tutorial.md").read_text(), re.S
    )
    assert len(blocks) == 5
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "tutorial"}
    for block in blocks:
        exec(compile(block, "tutorial.md", "exec"), names)
    # The policy holds its speed and stays near its route for most of the scene.
    speeds = np.hypot(*np.asarray(names["driven"])[-20:, 3:].T)
    assert np.isfinite(names["driven"]).all() and abs(speeds.mean() - 8.0) < 1.0
    picture = imread(tmp_path / "tutorial.png")
    assert picture.shape[0] > 500 and len(np.unique(picture)) > 50
    assert set(names["observation"]) == set(names["envs"].single_observation_space)
