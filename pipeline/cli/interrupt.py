"""Ctrl-C that is always heard: the first ends the command in order, a second at once, whatever native code is doing then."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

INTERRUPTED = 130


@contextmanager
def exit_on_second_interrupt(kept: Callable[[], str]) -> Iterator[None]:
    """In the block a second SIGINT ends the process with 130 and the words of `kept`.

    Python hears signals between two of its own instructions only, so that native code that waits for memory or for a thread which
    could not be started hears none. Here the number of each signal goes through a socket, written by the kernel's handler, to a
    thread of its own. Does nothing outside of the main thread, where Python allows no such thing.
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
