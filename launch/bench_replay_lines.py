"""How the processes of `slipstream bench replay` speak with it: a line each way.

A process is started with its request as JSON on the command line. It says `ready` once
it works, answers every line on standard input by a line with its counters, and ends
when its standard input does. Only the standard library: the peer Reverb runs it in an
environment of its own.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, final

Counters = Mapping[str, float]


@final
class Line:
    """One process's end; its work goes on in the main thread."""

    def __init__(self, counters: Callable[[], Counters]) -> None:
        """`counters` is called on another thread whenever the bench looks."""
        # Whatever prints must not end up among the answers.
        self._answers = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
        self._counters = counters
        self.ended = threading.Event()
        # From the start: the bench may end before this process is ready.
        threading.Thread(target=self._listen, daemon=True).start()

    def ready(self) -> None:
        """The process works from now on."""
        self._say({"ready": True})

    def _listen(self) -> None:
        for _ in sys.stdin:
            self._say({"at": time.monotonic(), **self._counters()})
        self.ended.set()

    def _say(self, answer: Mapping[str, Any]) -> None:
        try:
            print(json.dumps(answer), file=self._answers, flush=True)
        except BrokenPipeError:
            self.ended.set()  # nobody listens any more


@final
class Counts:
    """Counters of a process's main thread, read by the thread that answers."""

    def __init__(self) -> None:
        """Nothing was done yet."""
        self.rows = 0
        self.queries = 0.0

    def add(self, rows: int, queries: float = 1.0) -> None:
        """Counts rows, and the share of a query that brought them."""
        self.rows += rows
        self.queries += queries

    def all(self) -> dict[str, float]:
        """For `Line`."""
        return {"rows": self.rows, "queries": self.queries}


def request() -> dict[str, Any]:
    """What this process was asked to do."""
    wanted: dict[str, Any] = json.loads(sys.argv[1])
    return wanted
