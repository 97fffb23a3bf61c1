"""The command line: all commands, and how their failures are reported."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Union

import tyro

from bigs import __version__
from bigs.checks import InputError, nearest, shown
from bigs.cli import batch, bench, clips, preprocess, prior, runs, scores
from bigs.cli.terminal import fail, say, until_nobody_reads
from bigs.cli.typos import check_words

Commands = Mapping[str, "Callable[..., None] | Commands"]

COMMANDS: Commands = {
    "demo": runs.demo,
    "doctor": runs.doctor,
    "info": runs.info,
    "preprocess": {
        "all": preprocess.preprocess,
        "frames": preprocess.frames,
        "masks": preprocess.masks,
        "object": preprocess.object_motion,
        "hands": preprocess.hands,
        "align": preprocess.align,
        "build": preprocess.build,
    },
    "convert": clips.convert,
    "reconstruct": runs.reconstruct,
    "eval": scores.evaluate,
    "submission": scores.submission,
    "render": runs.render,
    "export": runs.export,
    "view": runs.view,
    "batch": batch.batch,
    "ablate": runs.ablate,
    "prior": {"fit": prior.prior_fit, "train": prior.prior_train},
    "bench": {
        "adjustment": bench.bench_adjustment,
        "engine": bench.bench_engine,
        "motion": bench.bench_motion,
        "preprocess": bench.bench_preprocess,
        "reconstruct": bench.bench_reconstruct,
        "robustness": bench.bench_robustness,
        "scale": bench.bench_scale,
    },
}
# Help texts of commands that have subcommands.
GROUPS = {
    "preprocess": "Make a clip from a video or images: all steps (bigs preprocess VIDEO --out CLIP) or one.",
    "prior": "Train a prior for the sides of an object that a clip never shows.",
    "bench": "Measure speed and accuracy.",
}

# Texts of torch, FFmpeg and the system where Python would raise MemoryError.
_NO_MEMORY = re.compile(
    r"can't allocate memory|cannot allocate memory|std::bad_alloc|out of memory", re.IGNORECASE
)
# Length of an unexpected error's text in the message.
_REASON = 200

# Groups that may be called without a subcommand.
IMPLIED = {"preprocess": "all"}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit code is 0 only on success.

    With --debug, before or after the command, the traceback of any error is printed too.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in given
    given = [argument for argument in given if argument != "--debug"]
    try:
        if given == ["--version"]:
            say(f"bigs {__version__}")
        else:
            words = _in_full(given)
            check_words(COMMANDS, words)
            _parse(words)()
    except KeyboardInterrupt:
        fail("interrupted; --resume continues from the last checkpoint", 130)
    except Exception as error:
        if debug:
            traceback.print_exc()
        fail(*_told(error))


def _told(error: Exception) -> tuple[str, int]:
    """One sentence on the error that ended a command, and its exit code."""
    if isinstance(error, InputError):
        return str(error), 2
    if isinstance(error, FloatingPointError):
        return f"{error}; the last checkpoint is kept", 3
    if isinstance(error, OSError) and error.errno != errno.ENOMEM:
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or shown(error)
        return f"{place}expected a file or folder that can be read or written, found: {reason}", 4
    if isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
        return (
            "expected enough memory for this command, found none left; try smaller or fewer pictures, "
            "or close other programs",
            6,
        )
    reason = " ".join(str(error).split())
    told = f"{type(error).__name__}{f' ({reason[:_REASON]})' if reason else ''}"
    return (
        f"an unexpected error: {told}; please report it with the command and its traceback "
        "(--debug shows it)",
        1,
    )


def _in_full(arguments: list[str]) -> list[str]:
    """Insert a group's default command, unless one of its commands or a near miss follows."""
    if len(arguments) < 2 or arguments[0] not in IMPLIED or arguments[1] in ("--help", "-h"):
        return arguments
    group, *others = arguments
    commands = COMMANDS[group]
    assert not callable(commands)
    misspelt = nearest(others[0], commands) and not Path(others[0]).exists()
    return arguments if others[0] in commands or misspelt else [group, IMPLIED[group], *others]


def _parse(arguments: list[str]) -> Callable[[], None]:
    """The command of the arguments, ready to run; unknown options are refused in one line."""

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), until_nobody_reads():
            return tyro.cli(
                _choice_of(COMMANDS),
                prog="bigs",
                description="Two hands and the object they hold, as 3D Gaussians, from one video, on a CPU. "
                "--version prints the version; --debug shows the traceback of an error.",
                args=arguments,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        # The parser draws a box of several lines; only its words are kept.
        lines = [line for line in said.getvalue().splitlines() if not line.startswith("╭")]
        words = " ".join(re.sub(r"[╰╯│─]+", " ", " ".join(lines)).split())
        fail(words, 2)
        raise


def _choice_of(commands: Commands) -> Any:
    """The type from which the parser builds one of the commands, ready to run."""

    def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
        @functools.wraps(command)
        def bind(*args: object, **kwargs: object) -> Callable[[], None]:
            return functools.partial(command, *args, **kwargs)

        return bind

    # A union needs at least two members; the empty one is hidden.
    options: list[Any] = [Annotated[None, tyro.conf.Suppress]]
    for name, command in commands.items():
        if callable(command):
            choice = tyro.conf.subcommand(name=name, constructor=deferred(command))
        else:
            inner = functools.partial(_choice_of, command)
            choice = tyro.conf.subcommand(name=name, description=GROUPS[name], constructor_factory=inner)
        options.append(Annotated[Any, choice])
    return Union[tuple(options)]  # noqa: UP007
