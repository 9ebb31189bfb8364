"""Handle Ctrl-C: the first one ends the command in an orderly way, the second one at once, even inside native code."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

INTERRUPTED = 130
"""Exit status of an interrupted command."""


@contextmanager
def exit_on_second_interrupt(kept: Callable[[], str]) -> Iterator[None]:
    """Within the `with` block, end the process with status 130 when the user presses Ctrl-C (SIGINT) a second time.

    kept: returns the sentence that is then printed, which says what results are kept.

    Python handles signals only between two of its own instructions, so native code that waits for memory or a thread cannot be
    interrupted. Here the kernel's signal handler writes each signal's number to a socket, and a separate thread reads it.
    Outside the main thread, where Python allows no signal handling, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    ours, signals = socket.socketpair()
    signals.setblocking(False)
    before = signal.set_wakeup_fd(signals.fileno(), warn_on_full_buffer=False)

    def listen() -> None:
        heard = 0
        while numbers := ours.recv(1):
            heard += numbers[0] == signal.SIGINT
            if heard == 2:
                os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"error: interrupted twice; {kept()}\n".encode())
                os._exit(INTERRUPTED)

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        signals.close()
        thread.join()
        ours.close()
