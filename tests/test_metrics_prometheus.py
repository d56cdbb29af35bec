"""`slipstream replay metrics`: a real scrape against the stats of a real service."""

import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.parser import text_string_to_metric_families

from launch.main import main
from launch.metrics import (
    COUNTERS,
    GAUGES,
    INFO,
    SPREADS,
    WRITER_COUNTERS,
    WRITER_GAUGES,
    ReplayCollector,
)
from replay.client import Sampler, Writer, fetch_stats
from replay.control import PERCENTILES, StatsReply, WriterStats
from replay.local import ReplayConfig
from tests.replay_parts import KEYS, SPEC, eventually, free_endpoint, make_rows, service

CONFIG = ReplayConfig(capacity=4096, min_size=8, samples_per_insert=1.0, tolerance=8.0)
Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]
CHANGING = {"uptime_s", "lag_s", "insert_rate", "sample_rate", "resident_bytes"}


def scrape(port: int) -> tuple[Samples, dict[str, str]]:
    """The samples by name and labels, and the types by name."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as page:
        families = list(text_string_to_metric_families(page.read().decode()))
    samples = {
        (one.name, frozenset(one.labels.items())): one.value
        for family in families
        for one in family.samples
    }
    return samples, {family.name: family.type for family in families}


def names(
    counters: dict[str, tuple[str, str]], gauges: dict[str, tuple[str, str]]
) -> Iterator[tuple[str, str]]:
    """Each field and its metric's full name."""
    for field, (name, _) in counters.items():
        yield field, f"slipstream_replay_{name}_total"
    for field, (name, _) in gauges.items():
        yield field, f"slipstream_replay_{name}"


def expected(told: dict, shard: str) -> Iterator[tuple[str, str, dict, float]]:
    """(field, name, labels, value) of all that a shard's stats have to become."""
    for field, name in names(COUNTERS, GAUGES):
        value = bool(told[field]) if field == "fault" else told[field]
        yield field, name, {"shard": shard}, float(value)
    for field, (name, _) in SPREADS.items():
        for percent, value in zip(PERCENTILES, told[field], strict=True):
            labels = {"shard": shard, "quantile": f"{percent / 100:g}"}
            yield field, f"slipstream_replay_{name}", labels, value
    for writer in told["writers"]:
        for field, name in names(WRITER_COUNTERS, WRITER_GAUGES):
            labels = {"shard": shard, "writer": str(writer["writer"])}
            yield field, name, labels, float(writer[field])
    labels = {"shard": shard, **{field: str(told[field]) for field in INFO}}
    yield "info", "slipstream_replay_info", labels, 1.0


def test_every_field_of_the_stats_is_exported() -> None:
    own = {*COUNTERS, *GAUGES, *SPREADS, *INFO, "writers"}
    assert own == set(StatsReply.__struct_fields__)
    of_writers = {*WRITER_COUNTERS, *WRITER_GAUGES, "writer", "version"}
    assert of_writers == set(WriterStats.__struct_fields__)
    numbers = {
        field.name
        for field in msgspec.structs.fields(StatsReply)
        if field.name not in INFO and field.type not in (str, list[WriterStats])
    }
    assert numbers <= {*COUNTERS, *GAUGES, *SPREADS}


def test_a_scrape_says_what_the_stats_say_and_zero_once_it_is_gone() -> None:
    registry = CollectorRegistry()
    with service(CONFIG) as running:
        for writer in (3, 5):
            sender = Writer(
                session=running.client,
                keys=KEYS,
                spec=SPEC,
                writer=writer,
                epoch=1,
                batch_rows=4,
            )
            sender.append(make_rows(0, 8, writer=writer))
            assert sender.close(20.0)
        reader = Sampler(
            session=running.client, keys=KEYS, spec=SPEC, batch_size=8, in_flight=1
        )
        sample = reader.sample(20.0)
        reader.update_priorities(sample.ids, np.full(8, 4.0))
        reader.sample(20.0)  # sends the priorities, and asks for batches in advance

        def settled() -> bool:
            """Whether the priorities are there and no batch is under way."""
            first, second = (fetch_stats(running.client, KEYS) for _ in range(2))
            same = first["samples"] == second["samples"] >= 24
            return same and max(first["priorities"]) > 3.9

        assert eventually(settled)
        collector = ReplayCollector(run_id=KEYS.run_id, connect=(running.endpoint,))
        registry.register(collector)
        server, _ = start_http_server(0, "127.0.0.1", registry)
        before = fetch_stats(running.client, KEYS)
        samples, types = scrape(server.server_port)
        after = fetch_stats(running.client, KEYS)
        wanted = zip(expected(before, "0"), expected(after, "0"), strict=True)
        count = 0
        for (field, name, labels, low), (*_, high) in wanted:
            told = samples[name, frozenset(labels.items())]
            count += 1
            if field in CHANGING:
                low, high = sorted((low, high))
                assert low * 0.9 <= told <= high * 1.1, name
            else:
                assert told == low == high, name
        assert count == len(samples) - 1  # and `up`: nothing else is there
        assert samples["slipstream_replay_up", frozenset()] == 1
        assert (before["inserts"], len(before["writers"])) == (16, 2)
        assert types["slipstream_replay_inserts"] == "counter"
        assert types["slipstream_replay_debt"] == "gauge"
    samples, _ = scrape(server.server_port)
    assert samples == {("slipstream_replay_up", frozenset()): 0}
    server.shutdown()
    server.server_close()


@pytest.mark.slow
def test_a_replay_that_is_not_there_is_down_and_ctrl_c_ends_it() -> None:
    words = ["--connect", free_endpoint(), "--run-id", "x", "--port", "0"]
    with subprocess.Popen(
        [sys.executable, "-m", "launch", "replay", "metrics", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            line = process.stdout.readline()
            port = int(line.rsplit(":", 1)[1].removesuffix("/metrics\n"))
            samples, _ = scrape(port)
            assert samples == {("slipstream_replay_up", frozenset()): 0}
            process.send_signal(signal.SIGINT)
            _, error = process.communicate(timeout=5)
        finally:
            process.kill()
    assert (process.returncode, error) == (130, "interrupted\n")


def test_mistakes_are_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["replay", "metrics", "--connect", "tcp/127.0.0.1:1", "--run-id", "x"]
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert main([*words, "--port", port]) == 2
    error = capsys.readouterr().err
    assert (
        f"port {port} of 127.0.0.1 cannot be used" in error and error.count("\n") == 1
    )
    assert main([*words, "--host", "0.0.0.0"]) == 2
    assert "--insecure" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    monkeypatch.delitem(sys.modules, "launch.metrics")
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "pip install 'slipstream[metrics]'" in error and error.count("\n") == 1
