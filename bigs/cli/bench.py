"""The commands `bigs bench ...`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from bigs.cli.terminal import Preset, fail_for, print_tables, telling, use_threads

# The names of `bench.workloads.KINDS`, `bench.plan.PARTS` and `bench.peers.PEERS`; a test compares them.
Workload = Literal["A", "B", "C", "D"]
Part = Literal["levels", "stages", "memory", "skips", "curve", "peers"]
Peer = Literal["gsplat"]


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
        parts: what to measure besides plain times.
        peers: other renderers to time in the same run, if installed.
        threads: numbers of threads.
        repeats: alternating rounds of everything; medians count.
        budget: seconds after which a variant of a workload is not run again.
        scale: factor on the number of Gaussians and of pixels; 0.01 takes seconds.
        seed: random seed of the workloads.
    """
    from bigs.commands.bench.engine import bench_engine as run

    with telling() as tell:
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
            listen=tell,
        )
    print_tables(tables, out)


def bench_reconstruct(
    clips: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CLIP ...")],
    out: Path = Path("bench"),
    presets: tuple[Preset, ...] = ("fast",),
    without: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    steps_limit: int = 0,
    hand_model: Path | None = None,
    curve_every: float = 10.0,
    clock: Literal["wall", "cpu"] = "wall",
    frames: tuple[int, ...] = (15, 30, 60),
    growth_steps: int = 6,
    picture: bool = True,
    threads: int = 0,
) -> None:
    """Time presets and switches over clips, with errors and where the time goes.

    Args:
        clips: clips; those with gt.npz are scored.
        out: folder for the runs, reconstruct.md, .json and .png; finished runs are kept.
        presets: presets to run.
        without: also run the first preset without this (a name of reconstruct --without, or several joined
            by +); repeatable.
        steps_limit: presets with more steps are cut to about this many, and say so; 0 runs all.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        curve_every: CPU seconds between the points at which a run is scored within its stages; 0 scores the
            ends of stages only.
        clock: seconds of the picture; cpu counts all threads and is steadier where other work runs.
        frames: numbers of frames at which to measure how the cost grows.
        growth_steps: steps of each stage for that; 0 skips it.
        picture: draw the picture, which needs matplotlib.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.bench.run_tables import BRIEF
    from bigs.commands.bench.reconstruct import RunPlan
    from bigs.commands.bench.reconstruct import bench_reconstruct as run

    plan = RunPlan(clips, presets, without, steps_limit, hand_model, curve_every, clock, frames, growth_steps)
    with telling() as tell:
        found = run(plan, out, picture=picture, listen=tell)
    print_tables([table for table in found.tables if table.title in BRIEF], out)
    fail_for(found.failed)


def bench_preprocess(
    clips: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("bench"),
    variants: tuple[str, ...] = (),
    hand_model: Path | None = None,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Preprocess clips from pictures, masks and simulated keypoints, as they are and made harder.

    Args:
        clips: clips with gt.npz, which scores the result and simulates the keypoints.
        out: folder for the clips made, preprocess.md and preprocess.json.
        variants: the harder variants to run; all by default.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        seed: random seed of the noise.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.bench.preprocess import PreprocessPlan
    from bigs.commands.bench.preprocess import bench_preprocess as run
    from bigs.commands.bench.variants import VARIANTS

    plan = PreprocessPlan(clips, variants or tuple(VARIANTS), hand_model, seed)
    with telling() as tell:
        found = run(plan, out, tell)
    print_tables(found.tables, out)
    fail_for(found.failed)


def bench_robustness(
    clips: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CLIP ...")],
    out: Path = Path("bench"),
    damages: tuple[str, ...] = (),
    preset: Preset = "fast",
    hand_model: Path | None = None,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Reconstruct clips as they are and with worse masks, pictures, poses and focal length.

    Args:
        clips: clips with gt.npz; every run is scored against the clean clip.
        out: folder for damaged clips, runs, robustness.md and robustness.json; finished runs are kept.
        damages: what to make worse; by default each, and all together.
        preset: preset to run.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        seed: random seed.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.bench.clip_damage import DAMAGES
    from bigs.commands.bench.robustness import RobustnessPlan
    from bigs.commands.bench.robustness import bench_robustness as run

    plan = RobustnessPlan(clips, damages or tuple(DAMAGES), preset, hand_model, seed)
    with telling() as tell:
        found = run(plan, out, tell)
    print_tables(found.tables, out)
    fail_for(found.failed)


def bench_adjustment(
    out: Path = Path("bench"),
    frames: tuple[int, ...] = (60, 300),
    points: tuple[int, ...] = (1000, 7000),
    seen: tuple[int, ...] = (0, 20),
    iterations: int = 15,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Time bundle adjustment of simulated objects against frames, points, and how many frames see a point.

    Args:
        out: folder for adjustment.md and adjustment.json.
        frames: numbers of frames.
        points: numbers of points.
        seen: number of consecutive frames that see a point; 0 is all.
        iterations: iterations of each adjustment.
        seed: random seed of the objects.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.bench.adjustment import AdjustmentPlan
    from bigs.commands.bench.adjustment import bench_adjustment as run

    plan = AdjustmentPlan(frames, points, seen, iterations, seed)
    with telling() as tell:
        tables = run(plan, out, tell)
    print_tables(tables, out)


def bench_motion(
    clips: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CLIP ...")],
    out: Path = Path("bench"),
    variants: tuple[str, ...] = (),
    hand_model: Path | None = None,
    seed: int = 0,
    threads: int = 0,
) -> None:
    """Track the object of clips from their own poses, as they are and made worse.

    Args:
        clips: clips with gt.npz, which scores the result.
        out: folder for motion.md and motion.json.
        variants: plain, poses (a tenth of them turned by 60 degrees), masks (3 pixels too wide or narrow),
            both; all by default.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        seed: random seed.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.bench.motion import VARIANTS, MotionPlan
    from bigs.commands.bench.motion import bench_motion as run

    plan = MotionPlan(clips, variants or tuple(VARIANTS), hand_model, seed)
    with telling() as tell:
        tables = run(plan, out, tell)
    print_tables(tables, out)


def bench_scale(
    clip: Annotated[Path, tyro.conf.Positional],
    out: Path = Path("bench"),
    frames: tuple[int, ...] = (60, 300),
    enlarge: tuple[float, ...] = (1.0, 2.0),
    preset: Preset = "fast",
    hand_model: Path | None = None,
    threads: int = 0,
) -> None:
    """Time whole runs of a clip with more frames and pixels, and tell their peak memory.

    Args:
        clip: the clip; played to and fro where it has fewer frames, and enlarged.
        out: folder for the clips made, the runs, scale.md and scale.json; finished runs are kept.
        frames: numbers of frames.
        enlarge: factors on the width and height of the pictures.
        preset: preset to run.
        hand_model: folder with MANO_RIGHT and MANO_LEFT (.npz or .pkl); without it the built-in hand is used.
        threads: CPU threads; 0 uses all cores.
    """
    use_threads(threads)
    from bigs.commands.bench.scale import ScalePlan
    from bigs.commands.bench.scale import bench_scale as run

    with telling() as tell:
        table, failed = run(ScalePlan(clip, frames, enlarge, preset, hand_model), out, tell)
    print_tables([table], out)
    fail_for(failed)
