"""Engines that run the clips of a batch: local processes, a Slurm cluster, a Ray cluster.

An engine takes jobs and reports how each ended; `run_batch.py` decides what to do next.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import platform
import signal
import time
from collections.abc import Mapping
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

from bigs.checks import InputError
from bigs.commands.batch.job import Job, run_job

# Seconds between polls of a scheduler.
_POLL = 0.5


# Longer messages of schedulers are cut.
_LONGEST_NOTICE = 60


class Engine(Protocol):
    """Jobs in, jobs out, in any order."""

    def submit(self, job: Job) -> None: ...

    def next_ended(self) -> tuple[Job, str]:
        """Wait for a job to end; returns the job and how its worker died, or ""."""
        ...

    def close(self) -> None:
        """Stop all running jobs."""
        ...


class Processes:
    """A new process for each attempt, so that a crash affects nothing else."""

    def __init__(self) -> None:
        # Not forked from here: torch's and the engine's threads do not survive a fork. On Linux a server that
        # imports what a job needs, and uses none of it, is forked instead: that spares each attempt seconds.
        forks = platform.system() == "Linux"
        self._context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            self._context.set_forkserver_preload([run_job.__module__])
        self._running: dict[int, tuple[Any, Job]] = {}

    def submit(self, job: Job) -> None:
        process = self._context.Process(target=run_job, args=(job,), name=job.name)
        process.start()
        self._running[process.sentinel] = (process, job)

    def next_ended(self) -> tuple[Job, str]:
        ended = wait(list(self._running))[0]
        assert isinstance(ended, int)
        process, job = self._running.pop(ended)
        process.join()
        return job, _death(process.exitcode)

    def close(self) -> None:
        for process, _ in self._running.values():
            process.terminate()
            process.join()


class SlurmJobs:
    """Slurm through submitit, whose own files go to `folder`.

    Args:
        folder: shared with the nodes.
        threads: CPUs of each job.
        options: of submitit, such as slurm_partition or timeout_min.
        cluster: "slurm", or "local", which runs the jobs as processes of this machine.

    Raises:
        InputError: submitit is not installed, there is no such cluster, or an option is unknown.
    """

    def __init__(self, folder: Path, threads: int, options: Mapping[str, Any], cluster: str) -> None:
        try:
            import submitit
        except ImportError as error:
            raise InputError(
                "--engine slurm: expected the extra 'slurm' (pip install 'bigs[slurm]'), found no submitit"
            ) from error
        self._unknown = submitit.core.utils.UncompletedJobError
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
            self._executor.update_parameters(**{"name": "bigs", "cpus_per_task": threads} | dict(options))
        except (RuntimeError, NameError, TypeError, ValueError) as error:
            raise InputError(f"--engine slurm: expected a cluster that takes jobs, found: {error}") from None
        self._running: list[tuple[Any, Job]] = []

    def submit(self, job: Job) -> None:
        self._running.append((self._executor.submit(run_job, job), job))

    def next_ended(self) -> tuple[Job, str]:
        while True:
            for entry in self._running:
                task, job = entry
                if task.done():
                    self._running.remove(entry)
                    try:
                        error = task.exception()
                    except self._unknown as lost:
                        error = lost
                    return job, "" if error is None else _notice(error)
            time.sleep(_POLL)

    def close(self) -> None:
        for task, _ in self._running:
            task.cancel(check=False)


class RayCluster:
    """A Ray cluster: the one at `address` (or that RAY_ADDRESS names), or one of this machine alone.

    Args:
        workers: how many jobs this machine takes at once, when it is the cluster.
        threads: CPUs of each job.
        address: of a running cluster.

    Raises:
        InputError: ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, workers: int, threads: int, address: str | None) -> None:
        try:
            import ray
        except ImportError as error:
            raise InputError(
                "--engine ray: expected the extra 'ray' (pip install 'bigs[ray]'), found no ray"
            ) from error
        self._ray = ray
        address = address or os.environ.get("RAY_ADDRESS")
        try:
            ray.init(
                address=address,
                # A running cluster decides its own size.
                num_cpus=None if address else workers * threads,
                include_dashboard=None if address else False,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        except (ConnectionError, ValueError) as error:
            raise InputError(f"--ray-address {address}: expected a cluster, found: {error}") from None
        # The batch decides about retries; Ray's own would not be counted.
        self._run = ray.remote(num_cpus=threads, max_retries=0)(run_job)
        self._running: dict[Any, Job] = {}

    def submit(self, job: Job) -> None:
        self._running[self._run.remote(job)] = job

    def next_ended(self) -> tuple[Job, str]:
        (done,), _ = self._ray.wait(list(self._running), num_returns=1)
        job = self._running.pop(done)
        try:
            self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            return job, _notice(error)
        return job, ""

    def close(self) -> None:
        for task in self._running:
            self._ray.cancel(task, force=True)
        self._ray.shutdown()


def _death(code: int | None) -> str:
    if not code:
        return ""
    if code > 0:
        return f"its process ended with code {code}"
    return f"its process was killed ({signal.Signals(-code).name})"


def _notice(error: BaseException) -> str:
    """A short version of a scheduler's report of a dead worker."""
    sentence = " ".join(str(error).split()).partition(". ")[0].rstrip(".")
    reason = sentence if len(sentence) <= _LONGEST_NOTICE else type(error).__name__
    return f"its worker was killed or crashed ({reason or type(error).__name__})"
