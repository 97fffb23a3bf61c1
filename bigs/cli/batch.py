"""The command `bigs batch`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import tyro

from bigs.checks import InputError, check_choice
from bigs.cli.terminal import Preset, fail_for, print_table, say, settings_of, telling

if TYPE_CHECKING:
    from bigs.commands.batch.engines import Engine
    from bigs.commands.batch.manifest import Entry
    from bigs.train.plan.config import RunConfig

EngineName = Literal["processes", "slurm", "ray"]


def batch(
    manifest: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MANIFEST")],
    out: Path,
    engine: EngineName = "processes",
    workers: int = 0,
    threads: int = 0,
    retries: int = 1,
    preset: Preset = "full",
    hand_model: Path | None = None,
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    without: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    ray_address: str | None = None,
    slurm: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    slurm_cluster: Literal["slurm", "local"] = "slurm",
) -> None:
    """Reconstruct many clips; finished ones are kept, and one that fails does not stop the others.

    Args:
        manifest: clips and their options: .txt (one clip per line), .csv, .yaml or .json; see docs/batch.md.
        out: folder for one run folder per clip, summary.csv, summary.md and index.html.
        engine: processes on this machine, a Slurm cluster, or a Ray cluster.
        workers: clips at a time; 0 means one per core (processes) or all at once (slurm, ray).
        threads: CPU threads per clip; 0 shares the cores out (processes) or means 2 (slurm, ray).
        retries: further attempts at a failed clip, from its last checkpoint.
        preset: preset of clips that set neither a preset nor a config.
        hand_model: hand model of clips that set none.
        set: change one setting for all clips, as path=value; repeatable.
        without: leave out one ingredient for all clips; repeatable.
        ray_address: a running Ray cluster; without it and RAY_ADDRESS a local one is started.
        slurm: option of submitit as name=value (slurm_partition=cpu, timeout_min=120); repeatable.
        slurm_cluster: local runs submitit's jobs as processes of this machine, for trials.
    """
    from bigs.commands.batch.manifest import read_manifest
    from bigs.commands.batch.run_batch import BatchPlan, plan_batch, run_batch, share_threads
    from bigs.train.plan.presets import PRESETS
    from bigs.train.switches import without_all

    if retries < 0:
        raise InputError(f"--retries: expected 0 or more, found {retries}")
    for name, value, owner in (
        ("--ray-address", ray_address, "ray"),
        ("--slurm", slurm, "slurm"),
        ("--slurm-cluster", slurm_cluster == "local", "slurm"),
    ):
        if value and engine != owner:
            raise InputError(f"{name}: expected --engine {owner}, found {engine}")

    def config_of(entry: Entry) -> RunConfig:
        where = f"{manifest}: {entry.name}: preset"
        if entry.preset is not None:
            check_choice(where, entry.preset, PRESETS)
        if entry.preset is not None and entry.config is not None:
            raise InputError(f"{where}: expected a preset or a config, found both")
        own = cast(Preset | None, entry.preset)
        settings = settings_of(own, entry.config, (*set, *entry.set), default=preset)
        return without_all(settings, (*without, *entry.without))[0]

    entries = read_manifest(manifest)
    if engine == "processes":
        workers, threads = share_threads(workers, threads, len(entries))
    else:
        workers, threads = share_threads(workers or len(entries), threads or 2, len(entries))
    plan = BatchPlan(out, tuple(plan_batch(entries, out, config_of, hand_model)), threads, retries)
    options = dict(map(_option, slurm))

    def start() -> Engine:
        from bigs.commands.batch.engines import Processes, RayCluster, SlurmJobs

        if engine == "slurm":
            return SlurmJobs(out / "slurm", threads, options, slurm_cluster)
        return RayCluster(workers, threads, ray_address) if engine == "ray" else Processes()

    with telling() as tell:
        result = run_batch(plan, start, workers, listen=tell)
    print_table(result.table)
    for name, why in result.failed.items():
        say(f"{name}: {why}")
    say(f"{result.kept} clips were finished before; {result.attempts} attempts at the others")
    say(f"results in {out}: see index.html")
    fail_for(list(result.failed))


def _option(text: str) -> tuple[str, str | int]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise InputError(f"--slurm {text}: expected name=value")
    return name, int(value) if value.isdecimal() else value
