"""What the commands share: output, settings from options, threads."""

from __future__ import annotations

import contextlib
import gc
import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import tyro
from rich.console import Console

from bigs.checks import InputError, shown
from bigs.commands.spoken import spoken

# What a command works on, as its help calls it.
ClipPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CLIP")]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]

if TYPE_CHECKING:
    from bigs.bench.page import Table
    from bigs.train.plan.config import RunConfig

# The names of `PRESETS` in `train.plan.presets`, whose import takes seconds; a test compares them.
Preset = Literal["smoke", "demo", "fast", "full", "paper"]

# A file or a pipe has no width, so tables there are as wide as they need to be.
_WIDTH_OF_A_FILE = 240
# Longest line of an error's text.
_LONGEST_LINE = 1500
# More threads than any machine has processors; each takes memory.
_MOST_THREADS = 4096


class _Output(Console):
    """A console whose reader may leave: further output is dropped and the command continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        stream = sys.stderr if self.stderr else sys.stdout
        # Otherwise Python would try to write the stream's buffer once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _open_streams() -> None:
    """Open null streams for a process that was started with closed ones (`>&-`).

    Otherwise the next opened file would take their numbers and receive their output. File names that are
    no valid text are shown escaped on both streams.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
            setattr(sys, name, open(os.devnull, "w" if number else "r"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


_open_streams()
stdout = _Output(width=None if sys.stdout.isatty() else _WIDTH_OF_A_FILE)
stderr = _Output(stderr=True)


def say(text: str) -> None:
    """Print a line on standard output without colours or wrapping."""
    stdout.print(plain(text), markup=False, highlight=False, emoji=False, soft_wrap=True)


def plain(text: str) -> str:
    """Text without control sequences, which names from a file may contain.

    Unprintable characters, except line ends, are shown as Python escapes.
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def until_nobody_reads() -> Iterator[None]:
    """Exit with success if the reader of a help text has left."""
    try:
        yield
    except BrokenPipeError:
        stdout.on_broken_pipe()
        sys.exit(0)


@contextmanager
def telling() -> Iterator[Callable[[str], None]]:
    """Show the block's progress; as lines without a terminal."""
    if stderr.is_terminal:
        with stderr.status("starting") as status:
            yield status.update
    else:
        with spoken(stderr) as lines:
            yield lines.update


def fail(message: str, code: int) -> NoReturn:
    """Exit with one line on standard error, whatever the message contains."""
    line = plain(message.replace("\n", "\\n"))
    if len(line) > _LONGEST_LINE:
        line = f"{line[: _LONGEST_LINE // 2]} ... {line[-_LONGEST_LINE // 2 :]}"
    stderr.print(f"bigs: {line}", markup=False, highlight=False, emoji=False, soft_wrap=True)
    sys.exit(code)


def use_threads(threads: int) -> None:
    """Limit the threads of torch, the engine, COLMAP and `bigs.threads`; 0 does not."""
    if not 0 <= threads <= _MOST_THREADS:
        raise InputError(f"--threads: expected 0 to {_MOST_THREADS}, found {shown(threads)}")
    if threads:
        from bigs.threads import limit_threads

        limit_threads(threads)


@contextmanager
def importing() -> Iterator[None]:
    """Imports of the block, which load torch, without the search for objects that only refer to each other.

    The modules are half a million objects that stay: the search would go through them again and again while
    they load, and once more whenever the command's own objects have grown by a quarter of them. Where torch
    is loaded already the block is an ordinary one.
    """
    if "torch" in sys.modules:
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def settings_of(
    preset: Preset | None, file: Path | None, changes: tuple[str, ...], default: Preset = "full"
) -> RunConfig:
    """The settings of a preset or of a file, with changes; `default` is the preset if neither is given.

    Raises:
        InputError: both are given, or one is invalid.
    """
    if preset is not None and file is not None:
        raise InputError(
            f"--preset {preset}: expected none beside --config, which is a whole plan, found {file}"
        )
    from bigs.train.plan.config_file import load_config, with_changes
    from bigs.train.plan.presets import PRESETS

    return with_changes(PRESETS[preset or default] if file is None else load_config(file), changes)


def print_tables(tables: list[Table], out: Path) -> None:
    for table in tables:
        say(f"\n{table.title}")
        print_table(table.rows)
        say(table.note)
    say(f"results in {out}")


def fail_for(runs: list[str]) -> None:
    """Exit of a series in which some runs failed."""
    if runs:
        fail(f"{len(runs)} failed ({', '.join(runs)}); the others are kept, and a rerun tries these again", 5)


def print_table(rows: list[tuple[str, ...]]) -> None:
    from rich.table import Table

    heading, *body = rows
    table = Table(*heading)
    for index, column in enumerate(table.columns):
        column.overflow = "fold"
        # On narrow terminals headings and long sentences are folded, numbers and names are not.
        column.min_width = min(24, max((len(row[index]) for row in body), default=0))
    for column in table.columns[1:]:
        column.justify = "right"
    for row in body:
        table.add_row(*row)
    stdout.print(table)
