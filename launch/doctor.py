"""`slipstream doctor`: what works on this machine, and what to do about what does not.

Each check is tried and not guessed: the Zenoh ones make a round trip over loopback,
with and without shared memory. Exit code 0 when a run can be made here.
"""

import importlib.metadata
import json
import os
import shutil
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from launch.devices import find_devices

Verdict = Literal["ok", "warning", "error"]
PACKAGES: Final = {
    "numpy": "base",
    "jax": "base",
    "jaxlib": "base",
    "msgspec": "base",
    "eclipse-zenoh": "base",
    "torch": "learner",
    "torchrl": "learner",
    "tensorboard": "learner",
    "matplotlib": "learner",
    "rerun-sdk": "viewer",
    "prometheus-client": "metrics",
}
_VALUES: Final = 1 << 18  # float32, large enough to go by shared memory


@dataclass(frozen=True)
class Finding:
    """What one check found, and what to do."""

    check: str
    verdict: Verdict
    found: str
    advice: str = ""


@dataclass(frozen=True, kw_only=True)
class DoctorConfig:
    """Says what works on this machine."""

    json: bool = False
    """Prints JSON and no table."""


def python_version() -> Finding:
    """Which Python this is; an older one than 3.11 is refused at installation."""
    found = ".".join(map(str, sys.version_info[:3]))
    return Finding("python", "ok", f"{found}, {sys.executable}")


def packages() -> Finding:
    """What the roles need."""
    found, missing = [], {}
    for name, extra in PACKAGES.items():
        try:
            found.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            missing[name] = extra
    if not missing:
        return Finding("packages", "ok", ", ".join(found))
    verdict: Verdict = "error" if "base" in missing.values() else "warning"
    extras = ",".join(sorted(set(missing.values()) - {"base"}))
    advice = (
        f"pip install 'slipstream[{extras}]'" if extras else "pip install slipstream"
    )
    return Finding("packages", verdict, f"missing: {', '.join(missing)}", advice)


def cores() -> Finding:
    """Processors that this process may use."""
    count = len(os.sched_getaffinity(0))
    if count < 2:
        return Finding(
            "cores", "warning", str(count), "actors and learner share it: expect half"
        )
    return Finding("cores", "ok", str(count))


def memory() -> Finding:
    """Memory that is free; a quick run takes about 3 GB."""
    free = psutil.virtual_memory().available / 1e9
    if free < 4:
        return Finding(
            "memory",
            "warning",
            f"{free:.1f} GB free",
            "use fewer --actors, or --serial",
        )
    return Finding("memory", "ok", f"{free:.1f} GB free")


def shared_memory() -> Finding:
    """Memory that a replay service on this machine answers into (`replay.arena`)."""
    from replay.arena import Arenas, make_arena

    name, advice = "shared memory", "samples go by TCP, which is slower"
    arena = make_arena(parts=1, part_bytes=_VALUES)
    place = arena.take() if arena is not None else None
    if place is None:
        return Finding(name, "warning", "no sealed anonymous files here", advice)
    if Arenas().part(place, _VALUES) is None:
        return Finding(name, "warning", "/proc hides other processes' files", advice)
    return Finding(name, "ok", "a service of this machine answers into it")


def disk() -> Finding:
    """Room for runs where this was started, and permission to write there."""
    folder = Path.cwd()
    free = shutil.disk_usage(folder).free / 1e9
    if not os.access(folder, os.W_OK):
        advice = "start it in a folder of yours, or give --run"
        return Finding("disk", "error", f"{folder} cannot be written", advice)
    if free < 2:
        return Finding("disk", "warning", f"{free:.1f} GB free", "free some space")
    return Finding("disk", "ok", f"{free:.1f} GB free in {folder}")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def ports() -> Finding:
    """A free port of loopback, and the viewer's usual ones."""
    taken = []
    for port in (9090, 9876):
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                taken.append(str(port))
    if taken:
        advice = "give the viewer others: --web-port, --data-port"
        return Finding("ports", "warning", f"in use: {', '.join(taken)}", advice)
    return Finding("ports", "ok", f"{_free_port()} is free, so are 9090 and 9876")


def zenoh_loopback() -> Finding:
    """Weights of 1 MB published by one session and had by another."""
    from replay.keys import RunKeys
    from replay.session import open_session
    from replay.weights import WeightsPublisher, WeightsSubscriber

    name = "zenoh"
    endpoint, keys = f"tcp/127.0.0.1:{_free_port()}", RunKeys("doctor")
    with (
        open_session(listen=[endpoint], router=True) as router,
        open_session(connect=[endpoint]) as client,
    ):
        publisher = WeightsPublisher(session=router, keys=keys)
        publisher.publish(version=0, layout_hash="doctor", vector=np.zeros(_VALUES))
        began = time.perf_counter()
        arrived = WeightsSubscriber(session=client, keys=keys).wait(timeout=5.0)
        took = time.perf_counter() - began
    if arrived is None:
        advice = "check that loopback is up and no firewall filters it"
        return Finding(name, "error", "no message arrived within 5 s", advice)
    return Finding(name, "ok", f"1 MB arrived within {took * 1e3:.0f} ms")


def jax_devices() -> Finding:
    """Where JAX computes."""
    import jax

    devices = ", ".join(str(device) for device in jax.devices())
    return Finding("jax", "ok", f"{jax.default_backend()}: {devices}")


def torch_devices() -> Finding:
    """Where torch computes."""
    try:
        import torch
    except ImportError:
        advice = "only the learner needs it: pip install 'slipstream[learner]'"
        return Finding("torch", "warning", "not installed", advice)
    built = torch.version.cuda
    count = torch.cuda.device_count()
    words = [torch.cuda.get_device_name(index) for index in range(count)]
    if not words:
        words = [f"no CUDA device (built for {built})" if built else "no CUDA build"]
    return Finding("torch", "ok", f"cpu: {_precisions()}; {', '.join(words)}")


def _precisions() -> str:
    """What the processor multiplies fast."""
    import torch

    fast = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return "float32 and bfloat16" if fast else "float32, bfloat16 slowly"


def devices() -> Finding:
    """What a run would use."""
    found = find_devices()
    advice = found.advice()
    return Finding("devices", "warning" if advice else "ok", found.use(), advice)


def rerun() -> Finding:
    """The viewer's program."""
    try:
        import rerun_cli  # type: ignore[import-untyped]
    except ImportError:
        advice = "only the viewer needs it: pip install 'slipstream[viewer]'"
        return Finding("rerun", "warning", "not installed", advice)
    program = Path(rerun_cli.__file__).parent / "rerun"
    if not os.access(program, os.X_OK):
        return Finding(
            "rerun", "warning", f"{program} cannot be run", "install rerun-sdk again"
        )
    return Finding("rerun", "ok", str(program))


CHECKS: Final[tuple[tuple[str, Callable[[], Finding]], ...]] = (
    ("python", python_version),
    ("packages", packages),
    ("cores", cores),
    ("memory", memory),
    ("shared memory", shared_memory),
    ("disk", disk),
    ("ports", ports),
    ("zenoh", zenoh_loopback),
    ("jax", jax_devices),
    ("torch", torch_devices),
    ("devices", devices),
    ("rerun", rerun),
)


def examine(name: str, check: Callable[[], Finding]) -> Finding:
    """A check's finding; one that breaks has found something too."""
    try:
        return check()
    except Exception as error:  # whatever it is, it is what the user needs to know
        line = " ".join(str(error).split())[:200]
        return Finding(name, "error", f"{type(error).__name__}: {line}", "see above")


def doctor_command(options: DoctorConfig) -> int:
    """`slipstream doctor`."""
    findings = [examine(name, check) for name, check in CHECKS]
    broken = any(finding.verdict == "error" for finding in findings)
    if options.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=1))
        return int(broken)
    colours = {"ok": "green", "warning": "yellow", "error": "red"}
    table = Table("check", "", "found", "what to do")
    for finding in findings:
        colour = colours[finding.verdict]
        table.add_row(
            finding.check,
            f"[{colour}]{finding.verdict}[/{colour}]",
            finding.found,
            finding.advice,
        )
    Console().print(table)
    return int(broken)
