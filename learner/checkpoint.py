"""Checkpoints: directories that are whole or absent, and resume to the same bits.

    checkpoints/000001200/   one per save, named by the number of updates
        policy.npz           what acting needs, readable without torch
        learner.pt           network, target, optimiser, counter (weights_only)
        meta.json            format, layout, sizes in bytes and SHA-256 of both
    checkpoints/latest       a text file with the name of the newest

`policy.npz` holds `vector` (float32, `state_dict` order), `layout_hash`, `network`,
`sizes` and `extra` as JSON, `actions` (outputs) and `mixture` (its components, or 0).
`extra` belongs to the caller: it comes back as it was given.

A save writes into a temporary directory beside, flushes files and directory to the
disk, renames it, and only then points `latest` at it: killed at any moment, it leaves
the older checkpoint in force. A load checks lengths and hashes before it reads, and
the layout before it restores; what is wrong is a `CheckpointError` of one line.
"""

import hashlib
import io
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float

from actors.network import Layout, NetworkConfig, layout_hash
from learner.config import CloningConfig, LearnerConfig
from sim.observation import ObservationSizes

FORMAT = 1
LATEST = "latest"
POLICY = "policy.npz"
LEARNER = "learner.pt"
META = "meta.json"
PARTIAL = ".partial-"


@runtime_checkable
class Trained(Protocol):
    """What is saved: double DQN's learner, or behaviour cloning's."""

    updates: int
    sizes: ObservationSizes
    network_config: NetworkConfig
    actions: int  # outputs of the network

    @property
    def config(self) -> LearnerConfig | CloningConfig:
        """Its settings."""

    @property
    def mixture(self) -> int:
        """Components of the mixture that the outputs are; 0: one of each action."""

    @property
    def layout(self) -> Layout:
        """Names and shapes of the weight vector."""

    def policy_vector(self) -> Float[np.ndarray, " parameters"]:
        """The weights to drive with."""

    def state(self) -> dict[str, object]:
        """All that `restore` takes."""

    def restore(self, state: Mapping[str, object]) -> None:
        """Goes on from there."""


class CheckpointError(Exception):
    """A checkpoint cannot be used; the message says what, where and what to do."""


def save_checkpoint(
    folder: Path, *, learner: Trained, extra: Mapping[str, Any], keep: int = 3
) -> Path:
    """Writes the learner's state below `folder` and points `latest` at it.

    Args:
        folder: the run's `checkpoints`; made if it is missing.
        learner: whose state.
        extra: anything JSON can hold, for whoever reads the policy.
        keep: newest checkpoints to keep; older ones are removed.

    Returns:
        The checkpoint's directory.
    """
    if keep < 1:
        raise ValueError(f"keep={keep} must be at least 1")
    final = folder / f"{learner.updates:09d}"
    files = {POLICY: _policy_bytes(learner, extra), LEARNER: _learner_bytes(learner)}
    meta = {
        "format": FORMAT,
        "updates": learner.updates,
        "layout_hash": layout_hash(learner.layout),
        "network": asdict(learner.network_config),
        "sizes": learner.sizes._asdict(),
        "actions": learner.actions,
        "learner": asdict(learner.config),
        "extra": dict(extra),
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in files.items()
        },
    }
    files[META] = json.dumps(meta, indent=1).encode()
    try:
        _write_directory(final, files)
        _write_file(folder / f"{PARTIAL}{LATEST}", final.name.encode())
        os.replace(folder / f"{PARTIAL}{LATEST}", folder / LATEST)
        _flush_directory(folder)
        _remove_old(folder, keep=keep, current=final.name)
    except OSError as error:
        raise CheckpointError(
            f"{final}: cannot write the checkpoint ({error.strerror}); "
            "free space or choose another run folder"
        ) from error
    return final


def latest_checkpoint(folder: Path) -> Path | None:
    """The checkpoint in force below `folder`, or None before the first save."""
    try:
        name = (folder / LATEST).read_text().strip()
    except FileNotFoundError:
        return None
    aside = folder / f"{PARTIAL}{name}-old"
    if name.isdigit() and aside.is_dir() and not (folder / name).exists():
        os.rename(aside, folder / name)  # killed between the renames of a replacement
    if not name.isdigit() or not (folder / name).is_dir():
        raise CheckpointError(
            f"{folder / LATEST}: names no checkpoint here ({name[:40]!r}); "
            "write the name of one of the directories beside it into it"
        )
    return folder / name


def load_checkpoint(path: Path, *, learner: Trained) -> dict[str, Any]:
    """Restores the learner from a checkpoint and returns its `meta.json`.

    Args:
        path: one checkpoint, or the folder of them (then the latest).
        learner: of the same network; left as it was if anything is wrong.
    """
    if (path / LATEST).is_file():
        path = latest_checkpoint(path) or path
    meta = read_meta(path)
    expected = layout_hash(learner.layout)
    if meta["layout_hash"] != expected:
        raise CheckpointError(
            f"{path}: checkpoint of another network ({_difference(meta, learner)}); "
            "give the configuration that it was trained with"
        )
    data = _read_checked(path, LEARNER, meta)
    try:
        state = torch.load(io.BytesIO(data), weights_only=True, map_location="cpu")
        learner.restore(state)
    except (RuntimeError, ValueError, KeyError, TypeError, EOFError) as error:
        raise CheckpointError(
            f"{path / LEARNER}: not a learner's state; take another checkpoint"
        ) from error
    return meta


def read_meta(path: Path) -> dict[str, Any]:
    """The checked `meta.json` of one checkpoint."""
    try:
        meta = json.loads((path / META).read_bytes())
    except FileNotFoundError as error:
        raise CheckpointError(
            f"{path}: no checkpoint here ({META} is missing); "
            "give a directory below a run's checkpoints"
        ) from error
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path / META}: cannot be read as JSON; take another checkpoint"
        ) from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else None
        raise CheckpointError(
            f"{path / META}: checkpoint format {found}, this version reads {FORMAT}; "
            "use the version that wrote it"
        )
    missing = {"layout_hash", "network", "sizes", "actions", "files"} - meta.keys()
    if missing:
        raise CheckpointError(
            f"{path / META}: lacks {', '.join(sorted(missing))}; "
            "take another checkpoint"
        )
    return meta


def _policy_bytes(learner: Trained, extra: Mapping[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        vector=learner.policy_vector(),
        layout_hash=np.array(layout_hash(learner.layout)),
        network=np.array(json.dumps(asdict(learner.network_config))),
        sizes=np.array(json.dumps(learner.sizes._asdict())),
        actions=np.array(learner.actions),
        mixture=np.array(learner.mixture),
        extra=np.array(json.dumps(dict(extra))),
    )
    return buffer.getvalue()


def _learner_bytes(learner: Trained) -> bytes:
    buffer = io.BytesIO()
    torch.save(learner.state(), buffer)
    return buffer.getvalue()


def _read_checked(path: Path, name: str, meta: Mapping[str, Any]) -> bytes:
    expected = meta["files"].get(name, {})
    try:
        data = (path / name).read_bytes()
    except OSError as error:
        raise CheckpointError(
            f"{path / name}: {error.strerror}; take another checkpoint"
        ) from error
    if len(data) != expected.get("bytes"):
        raise CheckpointError(
            f"{path / name}: {len(data)} of {expected.get('bytes')} bytes, truncated; "
            "take another checkpoint"
        )
    if hashlib.sha256(data).hexdigest() != expected.get("sha256"):
        raise CheckpointError(
            f"{path / name}: its content is not what was saved (SHA-256 differs); "
            "take another checkpoint"
        )
    return data


def _difference(meta: Mapping[str, Any], learner: Trained) -> str:
    """The settings that differ, as `name there, here`."""
    there = {**meta["network"], **meta["sizes"], "actions": meta["actions"]}
    here = {
        **asdict(learner.network_config),
        **learner.sizes._asdict(),
        "actions": learner.actions,
    }
    parts = [
        f"{name} {there.get(name)} there, {here.get(name)} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name) != here.get(name)
    ]
    return "; ".join(parts) or "its layers differ"


def _write_directory(final: Path, files: Mapping[str, bytes]) -> None:
    folder = final.parent
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(f"{PARTIAL}*"):
        if leftover.is_dir():  # of a save that was killed
            shutil.rmtree(leftover)
    partial = folder / f"{PARTIAL}{final.name}"
    partial.mkdir()
    for name, data in files.items():
        _write_file(partial / name, data)
    _flush_directory(partial)
    if final.exists():
        # A resumed run saves at the same count again. A directory cannot be replaced
        # by a rename: the old one steps aside first.
        aside = folder / f"{PARTIAL}{final.name}-old"
        os.rename(final, aside)
        os.rename(partial, final)
        shutil.rmtree(aside)
    else:
        os.rename(partial, final)
    _flush_directory(folder)


def _write_file(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _flush_directory(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_old(folder: Path, *, keep: int, current: str) -> None:
    names = sorted(
        entry.name
        for entry in folder.iterdir()
        if entry.name.isdigit() and entry.name != current
    )
    # The current one stays even where a run that went back left higher counts.
    for name in names[: max(0, len(names) - (keep - 1))]:
        shutil.rmtree(folder / name)
