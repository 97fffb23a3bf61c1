"""Programs that answer as Slurm's do, for a cluster of this machine: jobs start at once, one step each."""

from __future__ import annotations

from pathlib import Path

_SBATCH = """#!/bin/sh
job=$$
echo "$1" >> "$FAKE_SLURM/submitted"
export SLURM_JOB_ID=$job SLURM_NTASKS=1 SLURM_LOCALID=0 SLURM_NODEID=0 SLURM_PROCID=0
export SLURM_JOB_NODELIST=node1 SLURMD_NODENAME=node1
at="$FAKE_SLURM/$job"
cp "$1" "$at.sh"
nohup sh -c 'bash "$1.sh"; echo $? > "$1.ended"' - "$at" > "$at.out" 2>&1 < /dev/null &
echo "Submitted batch job $job"
"""
# Runs the step's command; the options before it go by pairs, but for one.
_SRUN = """#!/bin/sh
while [ "${1#--}" != "$1" ]; do
  [ "$1" = --unbuffered ] || shift
  shift
done
exec "$@"
"""
_SACCT = """#!/bin/sh
echo "JobID|State|NodeList"
while [ $# -gt 0 ]; do
  if [ "$1" = -j ]; then
    state=RUNNING
    if [ -f "$FAKE_SLURM/$2.ended" ]; then
      if [ "$(cat "$FAKE_SLURM/$2.ended")" = 0 ]; then state=COMPLETED; else state=FAILED; fi
    fi
    echo "$2|$state|node1"
    shift
  fi
  shift
done
"""
_SCANCEL = """#!/bin/sh
echo "$@" >> "$FAKE_SLURM/cancelled"
"""


def install(folder: Path) -> dict[str, str]:
    """Write the programs into `folder`; returns the variables they need, without PATH.

    Afterwards `folder` has `submitted`, a line for each job, and the script of each job as `NUMBER.sh`.
    """
    folder.mkdir()
    programs = {"sbatch": _SBATCH, "srun": _SRUN, "sacct": _SACCT, "scancel": _SCANCEL}
    for name, text in programs.items():
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    return {"FAKE_SLURM": str(folder)}
