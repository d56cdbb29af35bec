"""Files over Zenoh (banks, configurations), verified by their hash.

A file is asked for in parts; every answer carries the size and SHA-256 of the whole,
taken when it was offered. The copy is written beside its destination and moved there
only if the hash is right, so a file that exists is whole.
"""

import hashlib
import os
import tempfile
from pathlib import Path
from typing import BinaryIO, final

import zenoh

from replay.control import FileReply, FileRequest, decode, encode
from replay.keys import RunKeys, plain_chunk
from replay.session import ask, undeclare
from replay.spec import ReplayError
from replay.wire import WireError

_CHUNK_BYTES = 4 << 20


class FileError(ReplayError):
    """A file cannot be fetched or offered; one line says which and why."""


@final
class FileServer:
    """Offers files by name."""

    def __init__(
        self, *, session: zenoh.Session, keys: RunKeys, files: dict[str, Path]
    ) -> None:
        """Hashes the files, which must not change afterwards, and starts to answer."""
        self._files: dict[str, tuple[Path, int, str]] = {}
        for name, path in files.items():
            plain_chunk(name, what="file name")
            try:
                with path.open("rb") as stream:
                    digest = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise FileError(
                    f"{path}: cannot be offered: {error.strerror}"
                ) from None
            self._files[name] = (path, path.stat().st_size, digest)
        self._queryable = session.declare_queryable(keys.all_files, self._answer)

    def close(self) -> None:
        """Stops answering."""
        undeclare(self._queryable)

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            name = str(query.key_expr).rsplit("/", 1)[1]
            if name not in self._files or query.payload is None:
                return
            try:
                request = decode(query.payload.to_bytes(), FileRequest)
            except WireError:
                return
            path, size, digest = self._files[name]
            with path.open("rb") as stream:
                stream.seek(min(request.offset, size))
                data = stream.read(min(request.length, _CHUNK_BYTES))
            reply = FileReply(size=size, sha256=digest, data=data)
            query.reply(query.key_expr, encode(reply))


def fetch_file(
    session: zenoh.Session,
    keys: RunKeys,
    name: str,
    destination: Path,
    *,
    timeout: float = 10.0,
) -> str:
    """Fetches a file, verifies and keeps it; returns its SHA-256.

    `timeout` is per part, in seconds.
    """
    try:
        destination.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(
            dir=destination.parent, prefix=f".{destination.name}."
        )
    except OSError as error:
        raise FileError(f"{destination}: cannot write: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as stream:
            digest = _fetch_into(stream, session, keys.file(name), timeout)
        os.replace(temporary, destination)
    finally:
        Path(temporary).unlink(missing_ok=True)
    return digest


def _fetch_into(
    stream: BinaryIO, session: zenoh.Session, key: str, timeout: float
) -> str:
    """Writes all parts; raises if they are not the file that was announced."""
    whole = _part(session, key, 0, 0, timeout)
    hashed, offset = hashlib.sha256(), 0
    while offset < whole.size:
        part = _part(session, key, offset, _CHUNK_BYTES, timeout)
        if not part.data or part.sha256 != whole.sha256:
            raise FileError(f"{key}: the file changed while it was fetched; try again")
        stream.write(part.data)
        hashed.update(part.data)
        offset += len(part.data)
    if hashed.hexdigest() != whole.sha256:
        raise FileError(
            f"{key}: received SHA-256 {hashed.hexdigest()}, announced {whole.sha256}; "
            "the file changed after it was offered"
        )
    stream.flush()
    os.fsync(stream.fileno())
    return whole.sha256


def _part(
    session: zenoh.Session, key: str, offset: int, length: int, timeout: float
) -> FileReply:
    request = encode(FileRequest(offset=offset, length=length))
    payload = ask(session, key, request, timeout_s=timeout)
    if payload is None:
        raise FileError(f"{key}: nobody serves this file; is the run up?")
    return decode(payload, FileReply)
