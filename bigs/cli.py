"""The command line: demo, info, reconstruct, eval, ... Only this file prints or exits."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import io
import os
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import tyro
from rich.console import Console

from bigs import __version__
from bigs.checks import InputError

if TYPE_CHECKING:
    from bigs.bench.page import Table
    from bigs.commands.reconstruct import Outcome
    from bigs.train.config import RunConfig

# The names of `train.presets.PRESETS`, spelled out because importing those takes seconds; a test compares.
Preset = Literal["smoke", "demo", "fast", "full", "paper"]
Format = Literal["ply", "poses", "challenge", "mesh", "hand-meshes"]
# Likewise those of `bench.workloads.KINDS`, `bench.plan.PARTS` and `bench.peers.PEERS`.
Workload = Literal["A", "B", "C", "D"]
Part = Literal["levels", "stages", "memory", "skips", "curve", "peers"]
Peer = Literal["gsplat"]

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
    without: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    perceptual_weights: tuple[Path, ...] = (),
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
        without: leave out one ingredient (share, smooth, contact, lighting, ...) or loss term; repeatable.
        perceptual_weights: VGG-16 as torchvision publishes it (.pth or .safetensors), for the term
            "perceptual" of the preset paper; with a second file of LPIPS's channel weights the term is LPIPS.
        threads: CPU threads; 0 takes all.
    """
    _use_threads(threads)
    from bigs.commands.progress import progress_listener
    from bigs.commands.reconstruct import reconstruct as run
    from bigs.train.switches import without_all

    settings, unused = without_all(_config(preset, config, set), without)
    if perceptual_weights:
        files = tuple(str(path.resolve()) for path in perceptual_weights)
        settings = dataclasses.replace(settings, perceptual_weights=files)
    with progress_listener(_err, settings) as listen:
        outcome = run(
            clip, out, settings, hand_model=hand_model, ground_truth=gt, resume=resume, listen=listen
        )
    for name in unused:
        _out.print(f"--without {name}: this plan has nothing of it", markup=False, highlight=False)
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


def ablate(
    clip: Annotated[Path, tyro.conf.Positional],
    out: Path,
    preset: Preset = "fast",
    rows: tuple[str, ...] | None = None,
    hand_model: Path | None = None,
    gt: Path | None = None,
    config: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    threads: int = 0,
) -> None:
    """Score the method with and without its ingredients on a clip, beside the paper's Table 3.

    Args:
        clip: a HOLD / HANDS-challenge build folder, or the folder that holds it.
        out: folder for one run per row, ablation.md and ablation.json; rows that it holds are not run again.
        preset: the full method.
        rows: what to leave out, each a name of reconstruct --without or several joined by +; the paper's if
            not given.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        gt: ground truth (gt.npz) to score against; the clip's own if not given.
        config: a config.yaml of an earlier run, instead of a preset.
        set: change one setting, as path=value; repeatable.
        threads: CPU threads; 0 takes all.
    """
    _use_threads(threads)
    from bigs.commands.ablate import ablate as run
    from bigs.commands.ablate import default_rows

    settings = _config(preset, config, set)
    with _err.status("starting") as status:
        found = run(
            clip,
            out,
            settings,
            default_rows() if rows is None else rows,
            hand_model=hand_model,
            ground_truth=gt,
            listen=status.update,
        )
    _print_tables([found.table], out)
    _fail_for(found.failed)


def bench_engine(
    out: Path = Path("bench"),
    workloads: tuple[Workload, ...] = ("A", "B", "C", "D"),
    parts: tuple[Part, ...] = ("levels", "stages", "memory", "skips", "curve", "peers"),
    peers: tuple[Peer, ...] = ("gsplat",),
    threads: tuple[int, ...] = (1, 2),
    repeats: int = 15,
    budget: float = 20.0,
    scale: float = 1.0,
    seed: int = 0,
) -> None:
    """Time the splatting engine and its peers, with errors, and draw the curve of time against error.

    Args:
        out: folder for engine.md, engine.json and engine.png.
        workloads: hand and object isotropic (A) and flat (B), dense scene (C), faint pile (D); taken from the
            folder that BIGS_BENCH names if it is set.
        parts: what to measure beside plain times.
        peers: other renderers to time in the same run, where they are installed.
        threads: numbers of threads.
        repeats: alternating runs of everything, of which the median counts.
        budget: seconds after which one variant of a workload is not run again.
        scale: of the number of Gaussians and of pixels; 0.01 takes seconds.
        seed: of the workloads.
    """
    from bigs.commands.bench import bench_engine as run

    with _err.status("starting") as status:
        tables = run(
            out,
            workloads,
            seed=seed,
            scale=scale,
            threads=threads,
            parts=parts,
            peers=peers,
            repeats=repeats,
            budget=budget,
            listen=status.update,
        )
    _print_tables(tables, out)


def bench_reconstruct(
    clips: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("bench"),
    presets: tuple[Preset, ...] = ("fast",),
    without: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    steps_limit: int = 0,
    hand_model: Path | None = None,
    frames: tuple[int, ...] = (15, 30, 60),
    growth_steps: int = 6,
    picture: bool = True,
    threads: int = 0,
) -> None:
    """Time presets and switches over clips, with errors and where the time goes.

    Args:
        clips: clips; one that has its gt.npz is scored.
        out: folder for the runs, reconstruct.md, .json and .png; finished runs are kept.
        presets: what to run.
        without: run the first preset without this, too (a name of reconstruct --without, or several joined
            by +); repeatable.
        steps_limit: presets with more steps are cut to about so many, and say so; 0 runs all.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        frames: numbers of frames for which the growth of the cost is measured.
        growth_steps: steps of each stage for that; 0 measures no growth.
        picture: draw the picture, which needs matplotlib.
        threads: CPU threads; 0 takes all.
    """
    _use_threads(threads)
    from bigs.bench.run_tables import BRIEF
    from bigs.commands.bench_reconstruct import RunPlan
    from bigs.commands.bench_reconstruct import bench_reconstruct as run

    plan = RunPlan(clips, presets, without, steps_limit, hand_model, frames, growth_steps)
    with _err.status("starting") as status:
        found = run(plan, out, picture=picture, listen=status.update)
    _print_tables([table for table in found.tables if table.title in BRIEF], out)
    _fail_for(found.failed)


Commands = Mapping[str, "Callable[..., None] | Commands"]

COMMANDS: Commands = {
    "demo": demo,
    "info": info,
    "reconstruct": reconstruct,
    "eval": evaluate,
    "render": render,
    "export": export,
    "ablate": ablate,
    "bench": {"engine": bench_engine, "reconstruct": bench_reconstruct},
}
# What the help says of commands that have commands of their own.
GROUPS = {"bench": "Measure how fast and how exact this is."}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; the exit code is 0 only on success."""
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        _out.print(f"bigs {__version__}", markup=False, highlight=False)
        return
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

    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                _choice_of(COMMANDS),
                prog="bigs",
                description="Two hands and the object they hold, as 3D Gaussians, from one video, on a CPU. "
                "The only option without a command is --version.",
                args=arguments,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        # The parser draws a box of several lines; its words are kept, its frame is not.
        words = " ".join(re.sub(r"[╭╮╰╯│─]+", " ", said.getvalue()).split())
        _fail(words, 2)
        raise


def _choice_of(commands: Commands) -> Any:
    """The type from which the parser makes one of the commands, ready to run."""

    def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
        @functools.wraps(command)
        def bind(*args: object, **kwargs: object) -> Callable[[], None]:
            return functools.partial(command, *args, **kwargs)

        return bind

    # A union has at least two members; the one that says nothing is hidden.
    options: list[Any] = [Annotated[None, tyro.conf.Suppress]]
    for name, command in commands.items():
        if callable(command):
            choice = tyro.conf.subcommand(name=name, constructor=deferred(command))
        else:
            inner = functools.partial(_choice_of, command)
            choice = tyro.conf.subcommand(name=name, description=GROUPS[name], constructor_factory=inner)
        options.append(Annotated[Any, choice])
    return Union[tuple(options)]  # noqa: UP007


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
    for line in outcome.report.retreats:
        _out.print(f"recovered: {line}", markup=False, highlight=False, soft_wrap=True)
    _print_table(outcome.table)
    times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in outcome.report.seconds.items())
    _out.print(f"{outcome.seconds:.0f} s in all: {times}", markup=False, highlight=False, soft_wrap=True)
    _out.print(f"results in {outcome.run}: see preview.png and report.html", markup=False, soft_wrap=True)


def _print_tables(tables: list[Table], out: Path) -> None:
    for table in tables:
        _out.print(f"\n{table.title}", markup=False, highlight=False)
        _print_table(table.rows)
        _out.print(table.note, markup=False, highlight=False)
    _out.print(f"results in {out}", markup=False, highlight=False, soft_wrap=True)


def _fail_for(runs: list[str]) -> None:
    """The exit of a series of which some runs came to nothing."""
    if runs:
        _fail(
            f"{len(runs)} failed ({', '.join(runs)}); the others are kept, and a rerun tries these again", 5
        )


def _print_table(rows: list[tuple[str, ...]]) -> None:
    from rich.table import Table

    heading, *body = rows
    table = Table(*heading)
    for column in table.columns:
        column.overflow = "fold"
    for column in table.columns[1:]:
        column.justify = "right"
    for row in body:
        table.add_row(*row)
    _out.print(table)


if __name__ == "__main__":
    main()
