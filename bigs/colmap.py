"""pycolmap without its SIGTERM handler.

That handler prints a stack trace and can wait for ever on a lock of the interrupted code. Import COLMAP from
here.
"""

from __future__ import annotations

import signal
import threading

import pycolmap

__all__ = ["pycolmap"]


def _give_back_sigterm() -> None:
    """Restore the handler that Python knows, which importing pycolmap replaced."""
    handler = signal.getsignal(signal.SIGTERM)
    # Only the main thread can set handlers, and it cannot restore a handler that Python did not set.
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


_give_back_sigterm()
