"""`python -m tests.fuzzing [TARGET ...]`: damaged files before the command line, for seconds or for hours."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

# A process that has started threads cannot be forked. Read when the libraries are first loaded.
os.environ["OMP_NUM_THREADS"] = os.environ["RAYON_NUM_THREADS"] = "1"

from .sandbox import Sandbox, Verdict
from .targets import TARGETS


def main() -> int:
    """The exit code is 1 if any case ended as none may."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzzing", description=__doc__)
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; all if none is named"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="how long, for all targets together")
    parser.add_argument("--cases", type=int, help="how many of each target, instead")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--case", type=int, help="one case, with all that is known of it; its files are kept")
    parser.add_argument(
        "--clip", type=Path, help="a HOLD clip with gt.npz to damage; one is made if not given"
    )
    parser.add_argument("--run", type=Path, help="a finished run of it")
    options = parser.parse_args()
    unknown = set(options.targets) - set(TARGETS)
    if unknown:
        parser.error(f"expected targets of {', '.join(TARGETS)}, found {', '.join(sorted(unknown))}")
    names = options.targets or list(TARGETS)
    root = Path(tempfile.mkdtemp(prefix="bigs-fuzzing-"))
    try:
        sandbox = Sandbox(root, options.clip, options.run)
        if options.case is not None:
            verdict = sandbox.run(names[0], options.case, keep=True)
            _tell(verdict, whole=True)
            print(f"files in {root}")
            return 1 if verdict.faults else 0
        return _series(sandbox, names, options.first, options.cases, options.seconds)
    finally:
        if options.case is None:
            shutil.rmtree(root)


def _series(sandbox: Sandbox, names: list[str], first: int, cases: int | None, seconds: float) -> int:
    began, number = time.monotonic(), first
    found: dict[tuple[str, ...], Verdict] = {}
    times: Counter[tuple[str, ...]] = Counter()
    codes: Counter[int] = Counter()
    while number - first < cases if cases is not None else time.monotonic() - began < seconds:
        for name in names:
            verdict = sandbox.run(name, number)
            codes[verdict.code] += 1
            if verdict.faults:
                times[verdict.key] += 1
                if verdict.key not in found:
                    found[verdict.key] = verdict
                    _tell(verdict)
        number += 1
    total = sum(codes.values())
    ends = ", ".join(f"{count} with exit code {code}" for code, count in sorted(codes.items()))
    print(f"{total} cases ({first} to {number - 1} of {', '.join(names)}): {ends}")
    for key, count in times.most_common():
        first = found[key]
        print(f"{count:6d} x {' | '.join(key)} ({first.target} --case {first.number})")
    return 1 if found else 0


def _tell(verdict: Verdict, *, whole: bool = False) -> None:
    print(f"{verdict.target} {verdict.number}: {'; '.join(verdict.faults) or 'allowed'} {verdict.frame}")
    measured = f"exit code {verdict.code}; {verdict.seconds:.1f} s; {verdict.memory >> 20} MiB"
    print(f"    bigs {shlex.join(verdict.command)[:400]}")
    print(f"    {verdict.damaged}; {measured}")
    if whole:
        print(verdict.said, verdict.trace, sep="\n")
    else:
        print(f"    {verdict.said[:400]}")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
