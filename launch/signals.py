"""How a role ends when it is asked to.

A signal sets an event that the role's loop looks at. A role that is inside a long
call (a compilation) would look too late: a thread, woken through the signal's file
descriptor and so not by the interpreter's main thread, ends the process `grace_s`
later. Exit codes are those of shells: 128 plus the signal's number.
"""

import os
import signal
import socket
import threading
from typing import Final, final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@final
class Asked:
    """Set once the process was asked to end; made by `listen`."""

    def __init__(self) -> None:
        """Nothing was asked yet."""
        self.stop = threading.Event()
        self._number = 0

    @property
    def exit_code(self) -> int:
        """0 where no signal came, else 128 plus its number."""
        return 128 + self._number if self._number else 0

    def _on_signal(self, number: int) -> None:
        self._number = self._number or number
        self.stop.set()

    def listen(self, grace_s: float) -> None:
        """From the main thread: signals set `stop`, and end the process at last."""
        reading, writing = socket.socketpair()
        writing.setblocking(False)
        signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: None)

        def watch() -> None:
            # `writing` is named here to keep it from being closed.
            while writing.fileno() >= 0 and (data := reading.recv(1)):
                asked_before = self.stop.is_set()
                self._on_signal(data[0])
                if asked_before:  # a second Ctrl-C does not wait
                    os._exit(self.exit_code)
                timer = threading.Timer(grace_s, lambda: os._exit(self.exit_code))
                timer.daemon = True
                timer.start()

        threading.Thread(target=watch, name="signals", daemon=True).start()
