"""The README's commands: the short ones run, the options of all of them exist."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
SHORT = ("doctor", "scenes", "evaluate")
WORDS = {
    "scenes": 2,
    "train": 2,
    "sweep": 2,
    "bench": 2,
    "replay": 2,
}  # a command's words; 1 otherwise


def commands() -> list[list[str]]:
    """Every `slipstream` line of the README's code, less comments."""
    lines = re.findall(r"^(?: {4})?slipstream (.+)$", README.read_text(), re.M)
    return [re.sub(r"\s#.*", "", line).split() for line in lines]


def run(words: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "launch", *words],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
    )


def test_short_commands_run_in_their_order(tmp_path: Path) -> None:
    ran = 0
    for words in commands():
        own = words[0] in SHORT and not {"SRC", "SRC..."} & set(words)
        if own and "runs/first" not in words:
            result = run(words, tmp_path)
            assert result.returncode == 0, (words, result.stderr)
            ran += 1
    assert ran >= 5
    assert (tmp_path / "scores.json").stat().st_size > 0


@pytest.mark.parametrize(
    "name", sorted({" ".join(w[: WORDS.get(w[0], 1)]) for w in commands()})
)
def test_every_option_of_the_readme_exists(name: str, tmp_path: Path) -> None:
    shown = run([*name.split(), "--help"], tmp_path)
    assert shown.returncode == 0, shown.stderr
    known = set(re.findall(r"--[a-z][a-z.-]*", shown.stdout))
    count = WORDS.get(name.split()[0], 1)
    for words in commands():
        if " ".join(words[:count]) == name:
            assert {word for word in words if word.startswith("--")} <= known
