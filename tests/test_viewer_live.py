"""The viewer role: what it plays, what it drops, and that nobody waits for it."""

import itertools
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from actors.frames import FrameBatch, encode_frames, make_frames
from launch.recording import record_evaluation
from launch.scene_view import ViewScene
from launch.view import Endpoint, is_up, recording_of
from launch.view import view as view_target
from launch.viewer import LiveView, Playlist, Viewer, ViewerConfig, play
from launch.web import FileServer, ViewError, WebConfig, WebViewer
from replay.channels import FramePublisher, FrameSubscriber
from replay.keys import RunKeys
from replay.session import ConnectError, open_session
from sim.scene import ObjectType, RoadKind

rr.set_strict_mode(True)  # a warning of Rerun's is an entity that is not shown


def tiny_scene(scene: int) -> ViewScene:
    """Two cars on a road; the first one is controlled."""
    if scene > 8:
        raise IndexError(scene)
    steps = 91
    position = np.zeros((2, steps, 3), np.float32)
    position[0, :, 0] = np.arange(steps)
    position[1, :, 1] = 4.0
    road = np.array([[0, -4, 0], [90, -4, 0]], np.float32)
    up = np.array([0, 4, 0], np.float32)
    return ViewScene(
        scenario_id=f"tiny-{scene}",
        dt=0.1,
        polylines=((RoadKind.EDGE_BOUNDARY, road), (RoadKind.LANE_STREET, road + up)),
        position=position,
        yaw=np.zeros((2, steps), np.float32),
        speed=np.full((2, steps), 10.0, np.float32),
        size=np.full((2, steps, 3), 2.0, np.float32),
        valid=np.ones((2, steps), bool),
        object_types=np.full(2, int(ObjectType.VEHICLE)),
        light_points=np.zeros((1, 3), np.float32),
        light_states=np.full((1, steps), 4),
    )


def frames_of(
    steps: range, *, scene: int = 0, actor: int = 0, environment: int = 0
) -> FrameBatch:
    """Frames of the given steps; the state tells the step."""
    count = len(steps)
    state = np.zeros((count, 5), np.float32)
    state[:, 0] = steps
    frames = make_frames(
        count,
        scene=scene,
        step=np.arange(steps.start, steps.stop),
        controlled=0,
        state=state,
        action=1,
        reward=0.0,
        progress=0.0,
        overlap=0,
        offroad=0,
    )
    return FrameBatch(
        actor=actor,
        environment=environment,
        actor_steps=steps.stop,
        weights_version=1,
        frames=frames,
        q_values=np.zeros((count, 3), np.float32),
    )


def taken(playlist: Playlist, count: int) -> list[tuple[bool, list[int]]]:
    """What comes next: whether it begins an episode, and its steps."""
    return [
        (part.begins, part.batch.frames["step"].tolist())
        for part in playlist.take(count)
    ]


def test_frames_come_in_order_and_in_any_portion() -> None:
    playlist = Playlist(backlog=100)
    playlist.offer(frames_of(range(10, 18)))
    playlist.offer(frames_of(range(18, 26)))
    assert taken(playlist, 5) == [(True, [10, 11, 12, 13, 14])]
    assert taken(playlist, 5) == [(False, [15, 16, 17]), (False, [18, 19])]
    assert taken(playlist, 50) == [(False, [20, 21, 22, 23, 24, 25])]
    assert playlist.waiting == 0 and taken(playlist, 5) == []


def test_episodes_are_shown_whole_or_not_at_all() -> None:
    playlist = Playlist(backlog=10)
    for _ in range(3):
        for first in range(10, 90, 8):
            playlist.offer(frames_of(range(first, first + 8)))
    assert (playlist.waiting, playlist.skipped) == (80, 160)
    parts = playlist.take(1000)
    steps = np.concatenate([part.batch.frames["step"] for part in parts])
    np.testing.assert_array_equal(steps, np.arange(10, 90))
    playlist.offer(frames_of(range(10, 12)))
    assert taken(playlist, 9) == [(True, [10, 11])]


def test_a_reset_within_a_message_begins_an_episode() -> None:
    first, second = frames_of(range(85, 90)), frames_of(range(11, 14))
    batch = FrameBatch(
        actor=0,
        environment=0,
        actor_steps=1,
        weights_version=1,
        frames=np.concatenate([first.frames, second.frames]),
        q_values=np.concatenate([first.q_values, second.q_values]),
    )
    playlist = Playlist(backlog=100)
    playlist.offer(batch)
    assert taken(playlist, 9) == [(True, [*range(85, 90)]), (True, [11, 12, 13])]


@pytest.mark.parametrize(
    ("scene", "steps", "begins"),
    [(0, range(14, 16), False), (0, range(20, 22), False), (1, range(14, 16), True)],
)
def test_another_scene_begins_an_episode_a_gap_does_not(
    scene: int, steps: range, begins: bool
) -> None:
    playlist = Playlist(backlog=100)
    playlist.offer(frames_of(range(10, 14)))
    playlist.take(9)
    playlist.offer(frames_of(steps, scene=scene))
    assert playlist.take(9)[0].begins == begins


def test_an_endless_episode_is_bounded() -> None:
    playlist = Playlist(backlog=2)
    for first in range(0, 4000, 10):
        playlist.offer(frames_of(range(first, first + 10)))
    assert playlist.waiting <= 64 * 2 + 10
    assert playlist.waiting + playlist.skipped == 4000


@pytest.fixture
def view(tmp_path: Path) -> Iterator[tuple[LiveView, rr.RecordingStream, Path]]:
    """A live view that writes to a file."""
    path = tmp_path / "live.rrd"
    recording = rr.RecordingStream("slipstream")
    recording.save(path)
    config = ViewerConfig(environments=2)
    live = LiveView(
        recording=recording, scene_of=tiny_scene, actions=None, config=config
    )
    yield live, recording, path
    recording.disconnect()


def rows_by_entity(path: Path) -> dict[str, list[int]]:
    """Rows of the timeline of every entity that is not static."""
    rows: dict[str, list[int]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        record = chunk.to_record_batch()
        if "step" in record.schema.names:
            steps = record.column("step").to_numpy(zero_copy_only=False)
            rows.setdefault(chunk.entity_path, []).extend(steps.astype(int).tolist())
    return rows


def test_the_first_environments_are_shown_side_by_side(
    view: tuple[LiveView, rr.RecordingStream, Path],
) -> None:
    live, recording, path = view
    for actor, environment in itertools.product((0, 1), (0, 1)):
        batch = frames_of(range(10, 16), actor=actor, environment=environment)
        live.offer(encode_frames(batch))
    assert live.show(4) == 4
    assert live.show(4) == 2
    assert live.show(4) == 0
    recording.disconnect()
    rows = rows_by_entity(path)
    assert rows["/environment_1/ego"] == [*range(6)]
    assert rows["/environment_2/ego"] == [*range(6)]
    assert rows["/environment_1/map/road_edges"] == [0]
    assert not any(entity.startswith("/environment_3") for entity in rows)
    assert live.refused == 0


def test_what_cannot_be_shown_is_counted(
    view: tuple[LiveView, rr.RecordingStream, Path],
) -> None:
    live, *_ = view
    live.offer(b"noise")
    assert live.refused == 1
    live.offer(encode_frames(frames_of(range(10, 12), scene=99)))
    assert live.show(9) == 0
    assert live.refused == 2
    batch = frames_of(range(10, 12))
    batch.frames["controlled"] = 7
    live.offer(encode_frames(batch))
    assert live.show(9) == 0
    assert live.refused == 3
    live.offer(encode_frames(frames_of(range(10, 12))))
    assert live.show(9) == 2


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [int(server.getsockname()[1]) for server in sockets]
    for server in sockets:
        server.close()
    return ports


def web_config() -> WebConfig:
    """Ports of its own for a test."""
    web, data = free_ports(2)
    return WebConfig(web_port=web, data_port=data)


def test_the_viewer_plays_what_an_actor_publishes_over_zenoh() -> None:
    """And the actor never waits, though far more is sent than can be shown."""
    (port,) = free_ports(1)
    keys = RunKeys("viewer-test")
    stop, started = threading.Event(), threading.Event()
    with (
        open_session(listen=[f"tcp/127.0.0.1:{port}"], router=True) as router,
        open_session(connect=[f"tcp/127.0.0.1:{port}"]) as actor,
    ):
        publisher = FramePublisher(actor, keys, 0)
        assert not publisher.wanted
        source = FrameSubscriber(router, keys, depth=16)
        viewer = Viewer(
            source=source,
            scene_of=tiny_scene,
            actions=None,
            config=ViewerConfig(buffer_s=0.1, web=web_config()),
            name="test",
        )
        failures: list[BaseException] = []

        def serve() -> None:
            try:
                viewer.run(stop, started)
            except BaseException as error:
                failures.append(error)
                started.set()

        thread = threading.Thread(target=serve)
        thread.start()
        assert started.wait(30) and not failures
        wait_until(lambda: publisher.wanted)
        payloads = [
            encode_frames(frames_of(range(first, first + 8)))
            for first in range(10, 90, 8)
        ]
        began = time.monotonic()
        for payload in itertools.islice(itertools.cycle(payloads), 3000):
            publisher.put(payload)
        assert time.monotonic() - began < 5.0
        with urllib.request.urlopen(viewer.url, timeout=10) as page:
            assert b"<html" in page.read().lower()
        stop.set()
        thread.join(20)
        assert not thread.is_alive() and not failures
        source.close()
        publisher.close()


def wait_until(condition: object, timeout: float = 10.0) -> None:
    """Polls; fails after `timeout` seconds."""
    deadline = time.monotonic() + timeout
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.01)


class Burst:
    """A source that always has a frame at once."""

    def __init__(self, stop: threading.Event) -> None:
        """Sets `stop` after half a second."""
        self.given = 0
        self.stop = stop
        self.until = time.monotonic() + 0.5

    def get(self, timeout: float | None = None) -> tuple[int, bytes] | None:
        self.given += 1
        if time.monotonic() > self.until:
            self.stop.set()
        first = 10 + 8 * (self.given % 10)
        return 0, encode_frames(frames_of(range(first, first + 8)))


def test_the_pace_is_kept_whatever_comes(
    view: tuple[LiveView, rr.RecordingStream, Path],
) -> None:
    live, *_ = view
    stop = threading.Event()
    source = Burst(stop)
    config = ViewerConfig(frames_per_second=40.0, buffer_s=0.1)
    play(live, source, config, stop)
    assert 12 <= live.shown <= 24  # 0.5 s at 40 a second
    assert 8 * source.given > 10 * live.shown


def test_a_port_in_use_is_one_line() -> None:
    config = web_config()
    with (
        socket.create_server(("127.0.0.1", config.web_port)),
        pytest.raises(ViewError, match=f"port {config.web_port} .*--web-port"),
    ):
        WebViewer(config)
    with (
        socket.create_server(("127.0.0.1", config.data_port)),
        pytest.raises(ViewError, match=f"port {config.data_port} .*--data-port"),
    ):
        WebViewer(config)


def test_bad_ports_and_hosts_are_one_line() -> None:
    with pytest.raises(ViewError, match="both 9090"):
        WebViewer(WebConfig(data_port=9090))
    with pytest.raises(ViewError, match="a port is 1 to 65535"):
        WebViewer(WebConfig(web_port=70_000))
    with pytest.raises(ConnectError, match="--insecure"):
        WebViewer(WebConfig(host="0.0.0.0"))


def test_a_viewer_whose_page_ended_says_so() -> None:
    with WebViewer(web_config()) as web:
        web.check()
        assert web._process is not None
        web._process.kill()
        web._process.wait()
        with pytest.raises(ViewError, match="has ended with code -9"):
            web.check()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "evaluation.rrd"
    record_evaluation(
        path, scene_of=tiny_scene, rollouts=[("expert", frames_of(range(10, 20)))]
    )
    return path


def test_the_recording_of_a_run_that_ended_is_served_to_the_page_alone(
    recording: Path,
) -> None:
    config = web_config()
    (ended,) = free_ports(1)
    Endpoint("ended", (f"tcp/127.0.0.1:{ended}",)).write(recording.parent)
    stop, urls = threading.Event(), []
    failures: list[BaseException] = []

    def serve() -> None:
        try:
            view_target(
                recording.parent,
                ViewerConfig(web=config),
                stop=stop,
                announce=urls.append,
            )
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=serve)
    thread.start()
    wait_until(lambda: urls or failures, 30)
    assert not failures
    data = f"http://127.0.0.1:{config.data_port}"
    assert urls[0].startswith(f"http://127.0.0.1:{config.web_port}/?url=http%3A%2F%2F")
    with urllib.request.urlopen(urls[0], timeout=10) as page:
        assert b"<html" in page.read().lower()
    with urllib.request.urlopen(f"{data}/evaluation.rrd", timeout=10) as reply:
        assert reply.read() == recording.read_bytes()
        allowed = reply.headers["Access-Control-Allow-Origin"]
        assert allowed == f"http://127.0.0.1:{config.web_port}"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{data}/../evaluation.rrd", timeout=10)
    with pytest.raises(ViewError, match="--data-port"):
        FileServer(recording, config)
    stop.set()
    thread.join(20)
    assert not thread.is_alive() and not failures


def test_what_can_be_viewed(recording: Path) -> None:
    run = recording.parent
    assert recording_of(recording) == recording
    assert recording_of(run) == recording
    recording.rename(run / "other.rrd")
    with pytest.raises(ViewError, match=r"holds no evaluation\.rrd"):
        recording_of(run)
    with pytest.raises(ViewError, match="no such file"):
        recording_of(run / "nothing")
    (run / "notes.txt").write_text("no recording, but long enough to be one")
    with pytest.raises(ViewError, match="no Rerun recording"):
        recording_of(run / "notes.txt")


def test_the_endpoint_of_a_run(tmp_path: Path) -> None:
    assert Endpoint.read(tmp_path) is None
    endpoint = Endpoint("run-1", ("tcp/127.0.0.1:7447",))
    endpoint.write(tmp_path)
    assert Endpoint.read(tmp_path) == endpoint
    for content in ("{", "[]", json.dumps({"run_id": 1, "connect": []})):
        (tmp_path / "endpoint.json").write_text(content)
        with pytest.raises(ViewError, match="delete it"):
            Endpoint.read(tmp_path)


def test_whether_an_endpoint_answers() -> None:
    (port,) = free_ports(1)
    assert not is_up(f"tcp/127.0.0.1:{port}")
    with socket.create_server(("127.0.0.1", port)):
        assert is_up(f"tcp/127.0.0.1:{port}")
    assert not is_up("nonsense")
