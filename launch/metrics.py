"""`slipstream replay metrics`: the replay's counters for Prometheus, by HTTP.

Every number of `replay.control.StatsReply`, of each shard, under the name
`slipstream_replay_...` with its unit: totals since the service started are counters,
all else gauges. The replay is asked when somebody scrapes, by the query that
`replay stats` uses; while nobody does, it is not.

`slipstream_replay_up` is 0, and the only metric, while the replay does not answer.
Two numbers that identify and do not count are labels of `slipstream_replay_info`: the
service's incarnation has 63 bits and a sample of Prometheus, a float64, only 53.
"""

import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from launch.errors import LaunchError
from launch.replay_stats import place_of
from replay.control import PERCENTILES
from replay.keys import RunKeys
from replay.session import check_endpoints, open_session
from replay.shards_tools import fetch_all_stats
from replay.spec import ReplayError
from replay.wire import WireError

try:
    from prometheus_client import CollectorRegistry, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
    from prometheus_client.registry import Collector
except ImportError as error:
    raise LaunchError(
        "replay metrics needs prometheus-client: pip install 'slipstream[metrics]'"
    ) from error

PREFIX: Final = "slipstream_replay"
_TIMEOUT_S: Final = 2.0  # Prometheus gives a scrape ten seconds

# By the field of the stats: the metric's name, less the prefix, and its help.
COUNTERS: Final = {
    "inserts": ("inserts", "Rows inserted."),
    "samples": ("samples", "Rows sampled."),
    "deletes": ("deletes", "Rows removed from the table."),
    "insert_wait_s": ("insert_wait_seconds", "Time that the limiter held batches."),
    "sample_wait_s": ("sample_wait_seconds", "Time that the limiter held samples."),
    "busy_inserts": ("busy_inserts", "Inserts answered busy."),
    "busy_samples": ("busy_samples", "Sample requests answered busy."),
    "duplicates": ("duplicates", "Batches acknowledged again."),
    "gaps": ("gaps", "Batches refused because an earlier one is missing."),
    "refused": ("refused", "Requests that can never be accepted."),
    "stale_updates": ("stale_updates", "Priorities for rows that were gone."),
}
GAUGES: Final = {
    "size": ("size", "Rows in the table."),
    "capacity": ("capacity", "Rows that the table can hold."),
    "min_size": ("min_size", "Rows before anything is sampled."),
    "samples_per_insert": ("samples_per_insert", "Samples per insert so far."),
    "configured_samples_per_insert": (
        "configured_samples_per_insert",
        "Samples per insert asked for.",
    ),
    "debt": ("debt", "Samples that the inserted rows still allow."),
    "tolerance": ("tolerance", "Samples that the debt may be off by."),
    "pending_samples": ("pending_samples", "Sample requests held by the limiter."),
    "mean_priority_mass": ("mean_priority_mass", "Mean mass of the table's rows."),
    "max_times_sampled": ("max_times_sampled", "Draws of a row; 0 is no limit."),
    "insert_rate": ("insert_rate", "Rows inserted per second, over ten seconds."),
    "sample_rate": ("sample_rate", "Rows sampled per second, over ten seconds."),
    "durable": ("durable", "1 if rows outlive the service's process."),
    "fault": ("fault", "1 while nothing can be stored."),
    "recovered": ("recovered", "Rows found when the service started."),
    "uptime_s": ("uptime_seconds", "Time since the service started."),
    "row_bytes": ("row_bytes", "Bytes of a row."),
    "table_bytes": ("table_bytes", "Bytes of table and tree at full capacity."),
    "resident_bytes": ("resident_bytes", "Resident memory of the service's process."),
    "disk_bytes": ("disk_bytes", "Bytes of a durable replay's files."),
}
SPREADS: Final = {
    "ages": ("age", "Age of rows, in rows inserted since."),
    "priorities": ("priority", "Priority of rows."),
}
WRITER_COUNTERS: Final = {
    "rows": ("writer_rows", "Rows stored from a writer."),
}
WRITER_GAUGES: Final = {
    "epoch": ("writer_epoch", "A writer's current life."),
    "next_sequence": ("writer_next_sequence", "Its batch that is accepted next."),
    "pending": ("writer_pending", "Its batches that wait for the limiter."),
    "lag_s": ("writer_lag_seconds", "Time since its last batch was stored."),
}
INFO: Final = ("incarnation", "schema_hash", "sampler", "version")  # as labels

Shards = Mapping[int, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class MetricsConfig:
    """Serves the counters of a run's replay to Prometheus until Ctrl-C."""

    run: Path | None = None
    """The folder of a run in progress on this machine; it knows the rest."""
    run_id: str = ""
    """The run's name in its Zenoh keys, where its folder is elsewhere."""
    connect: tuple[str, ...] = ()
    """Endpoints to connect to, e.g. tcp/127.0.0.1:7447."""
    host: str = "127.0.0.1"
    """Address to serve on."""
    port: int = 9464
    """Port to serve on; 0 is any that is free."""
    insecure: bool = False
    """Allows addresses other than loopback; nothing is encrypted."""


def _values(
    kind: type[CounterMetricFamily] | type[GaugeMetricFamily],
    table: Mapping[str, tuple[str, str]],
    rows: list[tuple[list[str], Mapping[str, Any]]],
    labels: list[str],
) -> Iterator[Metric]:
    """A metric for each name of the table, with a sample for each row of fields."""
    for field, (name, text) in table.items():
        family = kind(f"{PREFIX}_{name}", text, labels=labels)
        for values, fields in rows:
            value = fields[field]
            family.add_metric(values, bool(value) if field == "fault" else value)
        yield family


def metrics_of(shards: Shards) -> Iterator[Metric]:
    """All metrics, from the stats of each shard."""
    each = [([str(number)], told) for number, told in shards.items()]
    yield from _values(CounterMetricFamily, COUNTERS, each, ["shard"])
    yield from _values(GaugeMetricFamily, GAUGES, each, ["shard"])
    for field, (name, text) in SPREADS.items():
        spread = GaugeMetricFamily(
            f"{PREFIX}_{name}", text, labels=["shard", "quantile"]
        )
        for labels, told in each:
            for percent, value in zip(PERCENTILES, told[field], strict=False):
                spread.add_metric([*labels, f"{percent / 100:g}"], value)
        yield spread
    writers = [
        ([*labels, str(writer["writer"])], writer)
        for labels, told in each
        for writer in told["writers"]
    ]
    names = ["shard", "writer"]
    yield from _values(CounterMetricFamily, WRITER_COUNTERS, writers, names)
    yield from _values(GaugeMetricFamily, WRITER_GAUGES, writers, names)
    info = GaugeMetricFamily(
        f"{PREFIX}_info", "What a shard is.", labels=["shard", *INFO]
    )
    for labels, told in each:
        info.add_metric([*labels, *(str(told[field]) for field in INFO)], 1)
    yield info


@final
class ReplayCollector(Collector):
    """Asks the replay at each scrape. Scrapes wait for each other."""

    def __init__(self, *, run_id: str, connect: tuple[str, ...]) -> None:
        """Connects at the first scrape: the replay need not be up yet."""
        self._keys = RunKeys(run_id)
        self._connect = connect
        self._session: Any = None  # Zenoh's, which is not imported here
        self._lock = threading.Lock()

    def collect(self) -> Iterator[Metric]:
        """See the module's docstring."""
        shards = self._ask()
        up = bool(shards)
        yield GaugeMetricFamily(f"{PREFIX}_up", "1 if the replay answers.", value=up)
        if shards:
            yield from metrics_of(shards)

    def _ask(self) -> Shards | None:
        """Each shard's stats; None if one of them does not answer."""
        with self._lock:
            try:
                if self._session is None:
                    self._session = open_session(
                        connect=self._connect, timeout_s=_TIMEOUT_S
                    )
                return fetch_all_stats(self._session, self._keys, timeout=_TIMEOUT_S)
            except (ReplayError, WireError):
                return None  # the session finds a service that comes back by itself


def metrics_command(options: MetricsConfig) -> int:
    """`slipstream replay metrics`; it ends by Ctrl-C."""
    run_id, connect = place_of(options.run, options.run_id, options.connect)
    host = f"[{options.host}]" if ":" in options.host else options.host
    check_endpoints((*connect, f"tcp/{host}:{options.port}"), options.insecure)
    registry = CollectorRegistry()
    registry.register(ReplayCollector(run_id=run_id, connect=connect))
    try:
        server, _ = start_http_server(options.port, options.host, registry)
    except OSError as error:
        raise LaunchError(
            f"port {options.port} of {options.host} cannot be used "
            f"({error.strerror}): choose another with --port"
        ) from error
    print(f"serving http://{host}:{server.server_port}/metrics", flush=True)
    threading.Event().wait()  # for ever: Ctrl-C ends it
    return 0
