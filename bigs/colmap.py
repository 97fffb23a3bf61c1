"""pycolmap, without the handler of SIGTERM that it brings along.

That handler prints a stack trace and can wait for ever on a lock that the interrupted code holds, so that a
run that was told to end neither ends nor says why. Everything that needs COLMAP imports it from here.
"""

from __future__ import annotations

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]


def _give_back_sigterm() -> None:
    """Put back what Python knows to be the handler, which importing pycolmap did not ask about."""
    handler = signal.getsignal(signal.SIGTERM)
    # Only the main thread can set handlers, and it cannot restore a handler that Python did not set.
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


_give_back_sigterm()
