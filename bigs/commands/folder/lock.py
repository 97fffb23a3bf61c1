"""One writer per run folder: two that resume the same run would overwrite each other."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bigs.checks import InputError


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold the folder while the block runs. The system lets go of it however the process ends.

    No file is left behind. Where folders cannot be locked (Windows, some network disks) nothing is held.

    Raises:
        InputError: another process holds it.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                raise InputError(
                    f"{folder}: expected a run that no other process works on, found one at work"
                ) from None
        yield
    finally:
        os.close(handle)
