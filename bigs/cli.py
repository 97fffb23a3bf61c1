"""The command line: demo, info, reconstruct, eval, render, export. Only this file prints or exits."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

from bigs.checks import InputError

if TYPE_CHECKING:
    from bigs.commands.reconstruct import Outcome
    from bigs.train.config import RunConfig

# The names of `train.presets.PRESETS`, spelled out because importing those takes seconds; a test compares.
Preset = Literal["smoke", "demo", "fast", "full", "paper"]
Format = Literal["ply", "poses", "challenge", "mesh", "hand-meshes"]

_out = Console()
_err = Console(stderr=True)


def demo(out: Path = Path("demo_run"), preset: Preset = "demo", threads: int = 0, seed: int = 0) -> None:
    """Make a little clip of two hands and a bottle, reconstruct it, and show how much better it became.

    Args:
        out: folder for the clip and the run; must not hold an earlier demo.
        preset: how much work to put in.
        threads: CPU threads; 0 takes all.
        seed: of the clip and of the reconstruction.
    """
    _use_threads(threads)
    from bigs.commands.demo import demo as run_demo
    from bigs.commands.progress import progress_listener

    config = _config(preset, None, (f"seed={seed}",))
    with progress_listener(_err, config) as listen:
        outcome = run_demo(out, config, seed=seed, listen=listen)
    _show(outcome)


def info(clip: Annotated[Path, tyro.conf.Positional]) -> None:
    """Check a clip and say what it holds.

    Args:
        clip: a HOLD / HANDS-challenge build folder, or the folder that holds it.
    """
    from bigs.commands.inspect import describe_clip

    for name, text in describe_clip(clip):
        _out.print(f"{name:10s} {text}", markup=False, highlight=False, soft_wrap=True)


def reconstruct(
    clip: Annotated[Path, tyro.conf.Positional],
    out: Path,
    preset: Preset = "full",
    hand_model: Path | None = None,
    gt: Path | None = None,
    resume: bool = False,
    config: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    threads: int = 0,
) -> None:
    """Reconstruct the hands and the object of a clip into a run folder.

    Args:
        clip: a HOLD / HANDS-challenge build folder, or the folder that holds it.
        out: the run folder to make.
        preset: smoke (seconds), demo, fast (two minutes), full, or paper (the paper's equations and weights).
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        gt: ground truth (gt.npz) to score against; the reconstruction never sees it.
        resume: continue an interrupted run in the same folder.
        config: a config.yaml of an earlier run, instead of a preset.
        set: change one setting, as path=value (raster.eps2d=0.2, stages.hands-fine.steps=50); repeatable.
        threads: CPU threads; 0 takes all.
    """
    _use_threads(threads)
    from bigs.commands.progress import progress_listener
    from bigs.commands.reconstruct import reconstruct as run

    settings = _config(preset, config, set)
    with progress_listener(_err, settings) as listen:
        outcome = run(
            clip, out, settings, hand_model=hand_model, ground_truth=gt, resume=resume, listen=listen
        )
    _show(outcome)


def evaluate(run: Annotated[Path, tyro.conf.Positional], gt: Path) -> None:
    """Score a finished run against ground truth, with the field's own definitions.

    Args:
        run: the run folder.
        gt: ground truth file (gt.npz) or the clip folder that holds it.
    """
    from bigs.commands.evaluation import evaluate_run

    _print_table(evaluate_run(run, gt))


def render(run: Annotated[Path, tyro.conf.Positional], cameras: Path, out: Path, threads: int = 0) -> None:
    """Render a finished run from the cameras of a transforms.json, as RGBA pictures with straight colour.

    Args:
        run: the run folder.
        cameras: transforms.json (OpenGL camera-to-world; each frame names its frame_index).
        out: folder for 0000.png, 0001.png, ... in the file's order.
        threads: CPU threads; 0 takes all.
    """
    _use_threads(threads)
    from bigs.commands.rendering import render_cameras

    files = render_cameras(run, cameras, out)
    _out.print(f"{len(files)} pictures in {out}", markup=False, highlight=False, soft_wrap=True)


def export(run: Annotated[Path, tyro.conf.Positional], format: Format, out: Path | None = None) -> None:
    """Write a finished run in another program's format.

    Args:
        run: the run folder.
        format: ply (Gaussians), poses (npz), challenge (.pt), mesh (object), or hand-meshes (every frame).
        out: where to write; the run folder if not given.
    """
    from bigs.commands.run_folder import load_run, write_format

    files = write_format(run if out is None else out, load_run(run), format)
    for path in files if len(files) <= 10 else [files[0], "...", files[-1]]:
        _out.print(str(path), markup=False, highlight=False, soft_wrap=True)


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": demo,
    "info": info,
    "reconstruct": reconstruct,
    "eval": evaluate,
    "render": render,
    "export": export,
}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit code is 0 only on success."""
    try:
        _parse(arguments)()
    except InputError as error:
        _fail(str(error), 2)
    except FloatingPointError as error:
        _fail(f"{error}; the last checkpoint is kept", 3)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _fail(f"{place}expected a file or folder that can be read or written, found: {error.strerror}", 4)
    except KeyboardInterrupt:
        _fail("interrupted; --resume continues from the last checkpoint", 130)


def _parse(arguments: list[str] | None) -> Callable[[], None]:
    """The command that the arguments ask for, ready to run; unknown options are refused in one line."""

    def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
        @functools.wraps(command)
        def bind(*args: object, **kwargs: object) -> Callable[[], None]:
            return functools.partial(command, *args, **kwargs)

        return bind

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.extras.subcommand_cli_from_dict(
                {name: deferred(command) for name, command in COMMANDS.items()},
                prog="bigs",
                description="Two hands and the object they hold, as 3D Gaussians, from one video, on a CPU.",
                args=arguments,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        # The parser draws a box of several lines; its words are kept, its frame is not.
        words = " ".join(re.sub(r"[╭╮╰╯│─]+", " ", said.getvalue()).split())
        _fail(words, 2)
        raise


def _fail(message: str, code: int) -> None:
    _err.print(f"bigs: {message}", markup=False, highlight=False, soft_wrap=True)
    sys.exit(code)


def _use_threads(threads: int) -> None:
    """Limit both thread pools; the engine's reads its variable when it is first used."""
    if threads < 0:
        raise InputError(f"--threads: expected 0 or more, found {threads}")
    if threads:
        os.environ["RAYON_NUM_THREADS"] = str(threads)
        import torch

        torch.set_num_threads(threads)


def _config(preset: Preset, file: Path | None, changes: tuple[str, ...]) -> RunConfig:
    from bigs.train.config_file import load_config, with_changes
    from bigs.train.presets import PRESETS

    return with_changes(PRESETS[preset] if file is None else load_config(file), changes)


def _show(outcome: Outcome) -> None:
    for line in outcome.report.skipped:
        _out.print(f"skipped: {line}", markup=False, highlight=False, soft_wrap=True)
    _print_table(outcome.table)
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.report.seconds.items())
    _out.print(f"{outcome.seconds:.0f} s in all: {times}", markup=False, highlight=False, soft_wrap=True)
    _out.print(f"results in {outcome.run}: see preview.png and report.html", markup=False, soft_wrap=True)


def _print_table(rows: list[tuple[str, ...]]) -> None:
    from rich.table import Table

    heading, *body = rows
    table = Table(*heading)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in body:
        table.add_row(*row)
    _out.print(table)


if __name__ == "__main__":
    main()
