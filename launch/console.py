"""What a person sees of a run: a table that changes, or a line every few seconds.

The figures come from the roles' own reports, which may be lost, and from the replay
service's counters, which are exact. The last ones are written to `status.json`.
"""

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final

import psutil
from rich.console import Console
from rich.live import Live
from rich.table import Table

from launch.config import UNBOUNDED, ExperimentConfig, write_atomically
from launch.status import actor_rates
from launch.supervisor import Supervisor
from replay.channels import StatusSubscriber, send_stop
from replay.keys import RunKeys
from replay.session import ConnectError, open_session
from replay.shards_tools import fetch_all_stats, total
from replay.spec import ReplayError

if TYPE_CHECKING:
    import zenoh

STATUS: Final = "status.json"
_OF_A_SHARD: Final = (
    *("size", "inserts", "samples", "samples_per_insert", "insert_rate"),
    *("sample_rate", "debt", "incarnation"),
)
_TERMINAL_S: Final = 1.0  # between two refreshes
_PLAIN_S: Final = 10.0  # between two lines where nobody looks at a screen
_STALE_S: Final = 30.0  # a role silent for longer does not count

Status = Mapping[str, float | int | str]


@dataclass
class _Rate:
    """A counter's growth per second, over about the last ten seconds."""

    samples: list[tuple[float, float]] = field(default_factory=list)

    def add(self, now: float, value: float) -> float:
        """The rate once `value` was seen at `now`."""
        self.samples = [s for s in self.samples if now - s[0] < 10.0][-20:]
        self.samples.append((now, value))
        first_time, first = self.samples[0]
        return (value - first) / (now - first_time) if now > first_time else 0.0


def snapshot(
    config: ExperimentConfig,
    roles: Mapping[str, tuple[float, Status]],
    stats: Mapping[str, Any],
    now: float,
) -> dict[str, Any]:
    """The figures of a run, from what its roles said last."""
    fresh = {name: told for name, told in roles.items() if now - told[0] < _STALE_S}
    learner: Status = fresh.get("learner", (0.0, {}))[1]
    actors = [values for name, (_, values) in fresh.items() if name.startswith("actor")]
    figures: dict[str, Any] = {
        "updates": int(learner.get("updates", 0)),
        "elapsed_s": float(learner.get("elapsed_s", 0.0)),
        "steps": int(stats.get("inserts", 0)),
        "samples": int(stats.get("samples", 0)),
        "samples_per_insert": float(stats.get("samples_per_insert", 0.0)),
        "configured_samples_per_insert": config.replay.samples_per_insert
        if config.replay.tolerance < UNBOUNDED
        else None,
        "replay_size": int(stats.get("size", 0)),
        "actors": len(actors),
        **actor_rates(fresh),
    }
    for name in ("loss", "mean_q", "updates_per_s", "waited_share"):
        if name in learner:
            figures[name if name != "waited_share" else "learner_waits"] = learner[name]
    # An evaluation takes longer than others are silent: its last figures stand.
    figures |= roles.get("evaluator", (0.0, {}))[1]
    waits = [
        float(values["waited_s"]) / max(float(values["uptime_s"]), 1e-9)
        for values in actors
        if "uptime_s" in values
    ]
    if waits:
        figures["actors_wait"] = sum(waits) / len(waits)
    left = time_left(config, learner)
    if left is not None:
        figures["left_s"] = left
    return figures


def time_left(config: ExperimentConfig, learner: Status) -> float | None:
    """Seconds until the budget is spent; None before that can be said."""
    ends = []
    if config.budget.minutes:
        elapsed = float(learner.get("elapsed_s", 0.0))
        ends.append(config.budget.minutes * 60 - elapsed)
    rate = float(learner.get("updates_per_s", 0.0))
    if rate > 0:
        ends.append((config.budget.updates - int(learner.get("updates", 0))) / rate)
    return max(0.0, min(ends)) if ends else None


def _cells(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Headings and values, for the table and for the line."""

    def percent(name: str) -> str:
        return f"{100 * figures[name]:.1f}%" if name in figures else "-"

    def number(name: str, form: str) -> str:
        return format(figures[name], form) if name in figures else "-"

    left = figures.get("left_s")
    return [
        ("steps", f"{figures['steps']:,} ({figures.get('steps_per_s', 0):,.0f}/s)"),
        ("updates", f"{figures['updates']:,} ({number('updates_per_s', ',.1f')}/s)"),
        (
            "samples/insert",
            f"{figures['samples_per_insert']:.3f} "
            f"(of {_ratio(figures['configured_samples_per_insert'])})",
        ),
        ("learner waits", percent("learner_waits")),
        ("actors wait", percent("actors_wait")),
        ("loss", number("loss", ".4g")),
        ("mean Q", number("mean_q", ".3f")),
        ("return", number("return", ".2f")),
        ("failure rate", percent("failure_rate")),
        ("progress", percent("progress")),
        ("held out", held_out(figures)),
        ("left", "-" if left is None else f"{left // 60:.0f}:{left % 60:02.0f}"),
    ]


def _ratio(asked: float | None) -> str:
    return "any" if asked is None else f"{asked:g}"


def held_out(figures: Mapping[str, Any]) -> str:
    """How the checkpoint judged last drove, and the best so far."""
    if "evaluated_updates" not in figures:
        return "-"
    parts = [
        f"failures {figures['held_out_failure_rate']:.1%}",
        f"log ADE {figures['held_out_log_displacement']:.2f} m",
    ]
    if "held_out_log_likelihood" in figures:
        parts.append(f"log p {figures['held_out_log_likelihood']:.3f}")
    parts.append(f"at {figures['evaluated_updates']:,}")
    if "best_updates" in figures:
        best = f"{figures['best_failure_rate']:.1%} at {figures['best_updates']:,}"
        parts.append(f"(best {best})")
    return " ".join(parts)


def line_of(figures: Mapping[str, Any]) -> str:
    """The figures in one line."""
    return "  ".join(f"{heading} {value}" for heading, value in _cells(figures))


def shard_line(told: Mapping[str, Any]) -> str:
    """A shard's figures in one line."""
    return (
        f"{told['size']:,} rows  {told['insert_rate']:,.0f} inserts/s  "
        f"{told['sample_rate']:,.0f} samples/s  {told['samples_per_insert']:.3f} "
        "samples/insert"
    )


@final
class RunConsole:
    """Follows a run that a supervisor runs."""

    def __init__(
        self,
        *,
        config: ExperimentConfig,
        keys: RunKeys,
        endpoint: str,
        folder: Path,
        supervisor: Supervisor,
        console: Console,
        on_look: Callable[[Mapping[str, Any]], None],
    ) -> None:
        """Connects when `follow` runs."""
        self._config = config
        self._keys = keys
        self._endpoint = endpoint
        self._folder = folder
        self._supervisor = supervisor
        self._console = console
        self._on_look = on_look
        self._session: zenoh.Session | None = None
        self._statuses: StatusSubscriber | None = None
        self._rate = _Rate()
        self._stats: dict[str, Any] = {}  # of all shards together
        self._shards: dict[int, dict[str, Any]] = {}
        self.figures: dict[str, Any] = {}
        """What was shown last."""

    async def follow(self) -> None:
        """Shows the run until cancelled."""
        with await self._connect() as session:
            self._session = session
            self._statuses = StatusSubscriber(session, self._keys)
            try:
                await (self._live() if self._console.is_terminal else self._plain())
            finally:
                self._session = None

    async def last_look(self) -> None:
        """The final counters, while the replay service is still up.

        Then the run is called off, for roles that other machines started.
        """
        if self._session is not None:
            await self._look()
            send_stop(self._session, self._keys, "the run has ended")

    async def _connect(self) -> "zenoh.Session":
        while True:
            try:
                # Short attempts: a thread cannot be cancelled, and Ctrl-C waits for it.
                return await asyncio.to_thread(
                    open_session, connect=[self._endpoint], timeout_s=0.2
                )
            except ConnectError:
                continue  # the supervisor says so when the service cannot start

    async def _live(self) -> None:
        with Live(console=self._console, auto_refresh=False) as live:
            while True:
                await self._look()
                live.update(self._table(), refresh=True)
                await asyncio.sleep(_TERMINAL_S)

    async def _plain(self) -> None:
        print("the processes start and compile", flush=True)
        due = time.monotonic() + _PLAIN_S
        while True:
            await self._look()
            if time.monotonic() >= due and self.figures["steps"]:
                due = time.monotonic() + _PLAIN_S
                print(line_of(self.figures), flush=True)
            await asyncio.sleep(_TERMINAL_S)

    async def _look(self) -> None:
        assert self._session is not None and self._statuses is not None
        try:
            self._shards = await asyncio.to_thread(
                fetch_all_stats, self._session, self._keys, timeout=1.0
            )
            self._stats = total(self._shards)
        except ReplayError:
            pass  # not up yet, or busy: the last counters stand
        now = time.monotonic()
        roles = self._statuses.latest()
        figures = snapshot(self._config, roles, self._stats, now)
        figures["steps_per_s"] = self._rate.add(now, figures["steps"])
        figures["looked_s"] = now
        figures["shards"] = {
            str(shard): {name: told[name] for name in _OF_A_SHARD}
            for shard, told in self._shards.items()
        }
        figures["restarts"] = sum(self._supervisor.restarts.values())
        figures["cpu"] = self._processors()
        figures["roles"] = {name: dict(values) for name, (_, values) in roles.items()}
        self.figures = figures
        self._on_look(figures)

    def _processors(self) -> dict[str, float]:
        """Share of a processor that each role has used, over its life so far.

        Of a role that has ended, the last share known.
        """
        shares = dict(self.figures.get("cpu", {}))
        for name, pid in self._supervisor.pids.items():
            with contextlib.suppress(psutil.Error):
                process = psutil.Process(pid)
                used, lived = process.cpu_times(), time.time() - process.create_time()
                shares[name] = (used.user + used.system) / max(lived, 1.0)
        return shares

    def _table(self) -> Table:
        table = Table(title=str(self._folder), show_header=False)
        for heading, value in _cells(self.figures):
            table.add_row(heading, value)
        shares = self.figures["cpu"].items()
        table.add_row("cores", "  ".join(f"{n} {share:.2f}" for n, share in shares))
        shards = self.figures["shards"]
        for shard, told in shards.items() if self._config.shards > 1 else ():
            table.add_row(f"shard {shard}", shard_line(told))
        if self.figures["restarts"]:
            table.add_row("restarts", str(self.figures["restarts"]))
        return table

    def write(self, outcome: str, reason: str) -> None:
        """Writes the last figures into the run folder."""
        content = {
            "outcome": outcome,
            "reason": reason,
            **self.figures,
            "restarts": dict(self._supervisor.restarts),
            "replay": {n: v for n, v in self._stats.items() if n != "schema_hash"},
        }
        text = json.dumps(content, indent=1, default=str) + "\n"
        write_atomically(self._folder / STATUS, text.encode())
