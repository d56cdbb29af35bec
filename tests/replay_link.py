"""A link between two network namespaces that loses, delays, resets or cuts.

    python -m tests.replay_link NAMESPACE_A NAMESPACE_B

Each namespace gets a TUN device `link0`; this process carries packets between them
and takes orders on its standard input, each answered by a line: `loss P`, `delay
MEAN JITTER` (seconds), `cut 0|1`, `reset` (turns the next TCP packet of every
connection into an RST, both ways). In user space because the kernel's netem is a
module that many machines do not have; what TCP and Zenoh see is the same: packets
that do not come, come late, out of order, or say that the connection is over.
"""

import ctypes
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import sys
import time
from dataclasses import dataclass, field

_TUNSETIFF, _TUN_NO_HEADER = 0x400454CA, 0x1001
_CLONE_NEWNET = 0x40000000
ADDRESSES = ("10.77.0.1", "10.77.0.2")


def open_device(namespace: str, address: str) -> int:
    """A TUN device in the namespace, up; its file stays ours when we leave."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open(f"/run/netns/{namespace}") as inside:
        if libc.setns(inside.fileno(), _CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", b"link0", _TUN_NO_HEADER))
    for words in (f"addr add {address}/24 dev link0", "link set link0 up"):
        subprocess.run(["ip", *words.split()], check=True)
    return device


def checksum(data: bytes) -> int:
    """RFC 1071."""
    padded = data + bytes(len(data) % 2)
    total = sum(struct.unpack(f"!{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def as_reset(packet: bytes) -> bytes:
    """An IPv4 TCP packet as the RST of its connection, at its sequence number."""
    length = 4 * (packet[0] & 15)
    ip, tcp = bytearray(packet[:length]), bytearray(packet[length : length + 20])
    ip[2:4] = struct.pack("!H", length + 20)
    ip[10:12] = bytes(2)
    ip[10:12] = struct.pack("!H", checksum(bytes(ip)))
    tcp[12], tcp[13], tcp[16:20] = 0x50, 0x14, bytes(4)  # no options; RST and ACK
    pseudo = bytes(ip[12:20]) + struct.pack("!BBH", 0, 6, 20)
    tcp[16:18] = struct.pack("!H", checksum(pseudo + bytes(tcp)))
    return bytes(ip + tcp)


@dataclass
class Link:
    """What becomes of a packet."""

    loss: float = 0.0
    delay: tuple[float, float] = (0.0, 0.0)
    is_cut: bool = False
    resetting_until: float = 0.0
    reset: set[bytes] = field(default_factory=set)  # directed connections
    lost: int = 0
    chance: random.Random = field(default_factory=lambda: random.Random(0))

    def order(self, line: str) -> None:
        """Obeys a line of standard input."""
        word, *values = line.split()
        if word == "loss":
            self.loss = float(values[0])
        elif word == "delay":
            self.delay = (float(values[0]), float(values[1]))
        elif word == "cut":
            self.is_cut = values[0] == "1"
        else:
            self.reset, self.resetting_until = set(), time.monotonic() + 1.0

    def carry(self, packet: bytes) -> tuple[float, bytes] | None:
        """When it arrives and as what; None if it does not."""
        if self.is_cut or self.chance.random() < self.loss:
            self.lost += 1
            return None
        now = time.monotonic()
        is_tcp = packet[0] >> 4 == 4 and packet[9] == 6
        if is_tcp and now < self.resetting_until:
            flow = packet[12:24]  # addresses and ports: the header has no options
            if flow not in self.reset and not packet[33] & 2:  # not a SYN
                self.reset.add(flow)
                packet = as_reset(packet)
        mean, jitter = self.delay
        return now + mean + self.chance.uniform(-jitter, jitter), packet


def run(a: int, b: int) -> None:
    """Carries packets until standard input ends."""
    link, other = Link(), {a: b, b: a}
    held: list[tuple[float, int, int, bytes]] = []  # due, number, where to, what
    number = 0
    while True:
        wait = max(0.0, held[0][0] - time.monotonic()) if held else None
        ready, _, _ = select.select([a, b, sys.stdin], [], [], wait)
        for source in ready:
            if source is sys.stdin:
                line = sys.stdin.readline()
                if not line:
                    return
                link.order(line)
                print(link.lost, flush=True)
                continue
            arrival = link.carry(os.read(source, 1 << 16))
            if arrival is not None:
                number += 1
                heapq.heappush(held, (arrival[0], number, other[source], arrival[1]))
        while held and held[0][0] <= time.monotonic():
            _, _, target, packet = heapq.heappop(held)
            try:
                os.write(target, packet)
            except OSError:  # its queue is full: lost, as on any link
                link.lost += 1


if __name__ == "__main__":
    devices = [
        open_device(*pair) for pair in zip(sys.argv[1:3], ADDRESSES, strict=True)
    ]
    print("ready", flush=True)
    run(*devices)
