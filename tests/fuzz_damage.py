"""Ways to break bytes, trees and messages, drawn from a random generator."""

import copy
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Rng = np.random.Generator

ODD_NUMBERS = (
    *(0, 1, -1, 2, 9, 77, 1000, 2**31 - 1, -(2**31), 2**53, 2**63 - 1, -(2**63)),
    *(0.5, -0.0, 1e-320, 1e4, 1e6, 1e7, -1e8, 1e9, 1e30, 1e308, -1e308),
    *(math.nan, math.inf, -math.inf),
)
ODD_TEXTS = ("", "x", "AV", "vehicle", "stop", "-1", "NaN", "\n\x1b[31m", "é" * 600)
ODD = (*ODD_NUMBERS, *ODD_TEXTS, None, True, False, [], {}, [[]], 2**64, 10**400)


def pick(rng: Rng, choices: Sequence[Any]) -> Any:
    """One of the choices, as it is (numpy's own would convert it)."""
    return choices[int(rng.integers(len(choices)))]


def broken_bytes(rng: Rng, data: bytes) -> bytes:
    """The bytes with one kind of damage."""
    first, second = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    near = min(second, first + int(rng.integers(1, 64)))
    kind = int(rng.integers(7))
    if kind == 0:
        return data[:first]
    if kind == 1:
        return data[:first] + data[near:]
    if kind == 2:
        return data[:near] + data[first:]
    if kind == 3:
        return data[second:] + data[first:second] + data[:first]
    if kind == 4:
        return data[:first] + rng.bytes(near - first) + data[near:]
    if kind == 5:
        return data + rng.bytes(int(rng.integers(1, 64)))
    flipped = bytearray(data)
    for bit in rng.integers(0, 8 * len(data), int(rng.integers(1, 9))).tolist():
        flipped[bit // 8] ^= 1 << (bit % 8)
    return bytes(flipped)


def broken_tree(rng: Rng, tree: Any) -> Any:
    """A copy of a tree of dictionaries and lists, broken in one to three places."""
    root = [copy.deepcopy(tree)]
    for _ in range(int(rng.integers(1, 4))):
        _break_node(rng, root)
    return root[0] if root else None


def _break_node(rng: Rng, owner: Any) -> None:
    """Goes down from a container at random and breaks what it comes to."""
    while True:
        keys = list(owner) if isinstance(owner, dict) else list(range(len(owner)))
        if not keys:
            return
        key = pick(rng, keys)
        child = owner[key]
        if not isinstance(child, dict | list) or not child or rng.random() < 0.15:
            break
        owner = child
    kind = int(rng.integers(6))
    if kind == 0:
        del owner[key]
    elif kind == 1 and isinstance(owner, list):
        owner.insert(int(rng.integers(len(owner) + 1)), copy.deepcopy(child))
    elif kind == 2 and isinstance(child, list):
        rng.shuffle(child)
    elif kind == 3 and isinstance(child, list | dict):
        child.clear()
    else:
        owner[key] = pick(rng, ODD)


def broken_message(rng: Rng, message: Any) -> None:
    """Breaks one field of a protocol buffer, at any depth."""
    field, value = pick(rng, message.ListFields())
    is_message = field.message_type is not None
    if not field.is_repeated:
        if is_message and rng.random() < 0.9 and value.ListFields():
            broken_message(rng, value)
        elif is_message or rng.random() < 0.1:
            message.ClearField(field.name)
        else:
            setattr(message, field.name, _odd_scalar(rng, value))
        return
    _break_repeated(rng, message, field.name, value)


def _break_repeated(rng: Rng, message: Any, name: str, values: Any) -> None:
    """Breaks a repeated field, or one of its elements."""
    at, kind = int(rng.integers(len(values))), rng.random()
    if kind < 0.1:
        del values[at]
    elif kind < 0.3:
        kept = list(values)
        # Shuffled, or one element doubled.
        rng.shuffle(kept) if kind < 0.2 else kept.append(kept[at])
        message.ClearField(name)
        getattr(message, name).extend(kept)
    elif kind < 0.35:
        message.ClearField(name)
    elif isinstance(values[at], int | float | bytes):
        values[at] = _odd_scalar(rng, values[at])
    elif values[at].ListFields():
        broken_message(rng, values[at])


def _odd_scalar(rng: Rng, old: Any) -> Any:
    """A value that protobuf accepts in the old one's place."""
    if isinstance(old, bool):
        return not old
    if isinstance(old, bytes):
        return pick(rng, (b"", b"\xff\xfe", b"x" * 2000, b"a\nb"))
    if isinstance(old, int):
        return pick(rng, (0, 1, -1, 2, 5, 9, 77, 12, 100, 2**31 - 1, -(2**31)))
    return float(pick(rng, ODD_NUMBERS))


def reordered_fields(rng: Rng, payload: bytes) -> bytes:
    """A message's fields in another order on the wire, which parsers must accept."""
    parts, at = [], 0
    while at < len(payload):
        start = at
        tag, at = _varint(payload, at)
        if tag & 7 == 0:
            _, at = _varint(payload, at)
        elif tag & 7 == 1:
            at += 8
        elif tag & 7 == 5:
            at += 4
        else:
            length, at = _varint(payload, at)
            at += length
        parts.append(payload[start:at])
    rng.shuffle(parts)
    return b"".join(parts)


def _varint(payload: bytes, at: int) -> tuple[int, int]:
    """A number of variable length, and where the next thing starts."""
    value = shift = 0
    while True:
        byte = payload[at]
        value |= (byte & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if byte < 0x80:
            return value, at
