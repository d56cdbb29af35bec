"""What must hold of whatever a loader makes of a file, and downstream of it."""

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim import environment
from sim.agents import random_actions
from sim.bank import Bank, BankError, open_bank, verify
from sim.bank_writer import write_bank
from sim.convert import convert
from sim.environment import EnvironmentConfig
from sim.formats import read_outcomes
from sim.scene import Scene, SceneError
from sim.validate import check_scene

SAMPLE = 24  # scenes of a format that an environment is stepped on
STEPS = 4
LONGEST = 700  # characters of a message that is one line
CONFIG = EnvironmentConfig()


@dataclass
class Verdict:
    """What came of a case."""

    errors: int = 0
    scenes: int = 0
    refused: int = 0
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0
    memory: float = 0.0  # bytes by which the process's peak rose
    detail: str = ""


class Checker:
    """Checks cases and keeps a sample of the sound scenes."""

    def __init__(self) -> None:
        """Starts with no scene."""
        self._sample: list[Scene] = []
        self._seen = 0

    def check(self, path: Path, *, is_bank: bool) -> Verdict:
        """Reads a file and judges every outcome."""
        return self._check_bank(path) if is_bank else self._check_scenes(path)

    def _check_scenes(self, path: Path) -> Verdict:
        verdict = Verdict()
        for outcome in read_outcomes([path]):
            if isinstance(outcome, SceneError):
                verdict.errors += 1
                verdict.violations += message_problems(outcome, path)
            else:
                verdict.scenes += 1
                check_scene(outcome)
                self._convert(outcome, verdict)
        if not verdict.errors + verdict.scenes:
            verdict.violations.append("neither a scene nor an error")
        return verdict

    def _check_bank(self, path: Path) -> Verdict:
        """A bank opens whole or not: what passes `verify` is what was written."""
        verdict = Verdict()
        try:
            verify(open_bank(path))
        except BankError as error:
            verdict.errors += 1
            verdict.violations += message_problems(error, path)
        else:
            verdict.scenes += 1
        return verdict

    def _convert(self, scene: Scene, verdict: Verdict) -> None:
        """Converts a scene; keeps every so many-th for `step`."""
        try:
            converted = convert(scene)
        except SceneError as error:
            verdict.refused += 1
            verdict.violations += message_problems(error, None)
            return
        verdict.violations += not_finite(converted)
        if abs(scene.dt - CONFIG.dt) > 1e-9:
            return
        self._seen += 1
        if len(self._sample) < SAMPLE:
            self._sample.append(scene)
        else:
            # A different one every time, without a generator that cases would share.
            self._sample[self._seen % SAMPLE] = scene

    def check_large(self, path: Path) -> Verdict:
        """Reads a large file, then converts it, and tells what each took."""
        verdict = Verdict()
        begun = time.process_time()
        (scene,) = read_outcomes([path])
        if isinstance(scene, SceneError):
            raise scene
        loaded = time.process_time()
        self._convert(scene, verdict)
        verdict.scenes = 1
        points = sum(len(road.points) for road in scene.roads)
        verdict.detail = (
            f"{scene.objects} objects, {points} road points: read in "
            f"{loaded - begun:.1f} s, converted in {time.process_time() - loaded:.1f} s"
        )
        if verdict.refused:
            verdict.violations.append("a large scene is refused")
        return verdict

    def step(self) -> Verdict:
        """Steps an environment on the sample, which is forgotten then."""
        sample, self._sample, self._seen = self._sample, [], 0
        verdict = Verdict(scenes=len(sample))
        if not sample:
            return verdict
        with tempfile.TemporaryDirectory() as name:
            path = Path(name) / "sample.bank"
            write_bank(sample, path)
            bank = open_bank(path).bank
            verdict.violations += stepped(bank, len(sample))
        return verdict


def message_problems(error: Exception, path: Path | None) -> list[str]:
    """Whether an error's message is one clear line that names the file."""
    text = str(error)
    problems = []
    if not text.isprintable():
        problems.append(f"a message that is not one printable line: {text[:300]!r}")
    if len(text) > LONGEST:
        problems.append(f"a message of {len(text)} characters: {text[:200]!r}")
    if path is not None and str(path.parent) not in text:
        problems.append(f"a message without the file: {text[:300]!r}")
    return problems


def not_finite(arrays: dict[str, Any]) -> list[str]:
    """The arrays of numbers with NaN or infinity."""
    return [
        f"{name} is not finite"
        for name, values in arrays.items()
        if np.asarray(values).dtype.kind == "f" and not np.isfinite(values).all()
    ]


def stepped(bank: Bank, scenes: int) -> list[str]:
    """What an environment with random actions gives that is not finite."""
    agent = random_actions(CONFIG)

    def one(scene: Any, key: Any) -> dict[str, Any]:
        controlled = bank.sdc[scene][None]
        start = environment.reset(bank, scene, controlled, CONFIG)

        def forward(state: Any, step_key: Any) -> Any:
            decision = agent(step_key, bank, state)
            state, outcome = environment.advance(bank, state, decision.moved, CONFIG)
            seen = environment.observe_state(bank, state, CONFIG)
            return state, {
                "state": state.history,
                "along": state.along,
                "reward": outcome.reward,
                **{f"observed {k}": v for k, v in seen._asdict().items()},
            }

        _, result = jax.lax.scan(forward, start, jax.random.split(key, STEPS))
        return result

    keys = jax.random.split(jax.random.key(0), scenes)
    results = jax.jit(jax.vmap(one))(jnp.arange(scenes, dtype=jnp.int32), keys)
    return not_finite(results)
