"""One case in a process of its own, which may neither write elsewhere nor take more than its share.

The process is forked from one that has imported everything and never started a thread.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from .corpus import build_corpus
from .targets import TARGETS, Target, command_of, damage

CPU_SECONDS = 20
MEMORY = 1 << 30
# Beyond what a case may take, so that it is measured before it is stopped.
ADDRESS_SPACE = 3 << 30
# A process that neither works nor ends for so long is waiting for something that never comes.
IDLE_SECONDS = 10
LONGEST_SENTENCE = 2000

# Events of the interpreter that write, and which of their arguments are paths.
_WRITES = {
    "os.mkdir": (0,),
    "os.rename": (0, 1),
    "os.remove": (0,),
    "os.rmdir": (0,),
    "os.symlink": (1,),
    "os.link": (1,),
    "os.truncate": (0,),
    "shutil.rmtree": (0,),
    "subprocess.Popen": (0,),
    "os.system": (0,),
}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


@dataclass(frozen=True)
class Verdict:
    """How a case ended."""

    target: str
    number: int
    command: list[str]
    damaged: str
    code: int  # of the exit; minus the signal
    said: str  # on standard error
    frame: str  # innermost place in bigs/ where something was raised that should not have been
    trace: str
    faults: tuple[str, ...]  # what is not allowed; nothing if all is well
    seconds: float
    memory: int  # bytes beyond what the process had before

    @property
    def key(self) -> tuple[str, ...]:
        """The same for what is probably the same fault."""
        kinds = tuple(fault.split(":")[0] for fault in self.faults)
        return (*kinds, self.frame) if self.frame else (self.target, *kinds)


class Sandbox:
    """Runs cases below a folder of its own."""

    def __init__(self, root: Path, clip: Path | None = None, run: Path | None = None) -> None:
        self.root = root
        self.corpus = root / "corpus"
        import_everything()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                build_corpus(self.corpus, clip, run)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        if os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]):
            raise RuntimeError(f"{self.corpus}: expected the valid files to be made, found an error")

    def run(self, name: str, number: int, keep: bool = False) -> Verdict:
        """Run one case."""
        target, rng = TARGETS[name], random.Random(f"{name} {number}")
        place = self.root / f"{name}-{number}"
        shutil.rmtree(place, ignore_errors=True)
        case, out, cwd = place / "corpus" / target.copied, place / "out", place / "cwd"
        _link_tree(self.corpus, place / "corpus")
        for folder in (out, cwd, place / "tmp"):
            folder.mkdir()
        shutil.copytree(self.corpus / "pictures", out / "pictures")
        report = place / "report.json"
        began = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _child(target, rng, number % 20 == 19, place, case, report)
        code, usage = _wait(pid)
        seen = json.loads(report.read_text()) if report.exists() else {}
        said = _text(place / "stderr")
        faults = [*_faults(target, code, said, _text(place / "stdout"), seen), *_strays(place, target)]
        if usage.ru_utime + usage.ru_stime > CPU_SECONDS and not seen:
            faults.append("too long")
        verdict = Verdict(
            name,
            number,
            seen.get("command", []),
            seen.get("damaged", ""),
            code,
            said,
            seen.get("frame", ""),
            seen.get("trace", ""),
            tuple(dict.fromkeys(faults)),
            seen.get("seconds", time.monotonic() - began),
            seen.get("memory", 0),
        )
        if not keep:
            shutil.rmtree(place, ignore_errors=True)
        return verdict


def import_everything() -> None:
    """Once, so that no case pays for it."""
    import importlib
    import pkgutil

    import PIL.Image
    import trimesh.exchange.load  # noqa: F401

    import bigs.cli
    import bigs.commands
    from bigs.hand import load_hand_models

    for module in pkgutil.walk_packages(bigs.commands.__path__, "bigs.commands."):
        importlib.import_module(module.name)
    PIL.Image.init()
    load_hand_models(None)  # kept from then on


def _link_tree(source: Path, target: Path) -> None:
    """The corpus as hard links: its files are replaced, by damage as by commands, and never written into."""
    shutil.copytree(source, target, copy_function=os.link, ignore=shutil.ignore_patterns("whole"))


def _child(
    target: Target, rng: random.Random, costly: bool, place: Path, case: Path, report: Path
) -> NoReturn:
    """Damage, call the command line, tell how it ended. Never returns."""
    code, seen = 70, {}
    try:
        with warnings.catch_warnings(action="ignore"):
            damaged = damage(rng, target, place / "corpus", case)
        command = command_of(rng, target, costly, place / "corpus", case, place / "out")
        seen = {"command": command, "damaged": str(damaged.relative_to(place)) if damaged else ""}
        report.write_text(json.dumps(seen))
        code = _call(command, place, seen)
        seen["done"] = True
    except BaseException:
        seen["harness"] = traceback.format_exc()
    finally:
        report.write_text(json.dumps(seen))
        os._exit(code)


def _call(command: list[str], place: Path, seen: dict[str, Any]) -> int:
    from bigs.cli import app

    for stream, name in ((1, "stdout"), (2, "stderr")):
        file = os.open(place / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(file, stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False, errors="backslashreplace")  # noqa: SIM115
    sys.stderr = open(2, "w", encoding="utf-8", closefd=False, errors="backslashreplace")  # noqa: SIM115
    os.chdir(place / "cwd")
    os.environ["TMPDIR"] = os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(place / "tmp")
    strays: list[str] = []
    seen["strays"] = strays
    _watch_writes(place, strays)
    fail = app.fail

    def failing(message: str, code: int) -> NoReturn:
        """What was raised is remembered before it becomes a sentence."""
        _remember(sys.exc_info()[1], seen)
        fail(message, code)

    app.fail = failing
    before = _peak_memory(reset=True)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + ADDRESS_SPACE,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    used = time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(used) + CPU_SECONDS + 1,) * 2)
    code = 0
    try:
        app.main(command)
    except SystemExit as leave:
        code = leave.code if isinstance(leave.code, int) else 1
    except BaseException as error:
        _remember(error, seen)
        traceback.print_exc()
        code = 1
    seen["seconds"] = time.process_time() - used
    seen["memory"] = _peak_memory() - before
    sys.stdout.flush()
    sys.stderr.flush()
    return code


def _remember(error: BaseException | None, seen: dict[str, Any]) -> None:
    from bigs.checks import InputError

    if error is None or isinstance(error, (InputError, FloatingPointError, SystemExit)):
        return
    seen["error"] = type(error).__name__
    seen["frame"] = f"{type(error).__name__} at {_innermost(error.__traceback__)}"
    seen["trace"] = "".join(traceback.format_exception(error))[-6000:]


def _innermost(trace: TracebackType | None) -> str:
    found = "nowhere"
    for frame, line in traceback.walk_tb(trace):
        path = Path(frame.f_code.co_filename)
        if "bigs" in path.parts and "site-packages" not in path.parts and "fuzzing" not in path.parts:
            found = f"{'/'.join(path.parts[-2:])}:{line} {frame.f_code.co_name}"
    return found


def _watch_writes(place: Path, strays: list[str]) -> None:
    inside = (f"{place}/", "/dev/null", "/proc/self/")

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if not flags & _WRITING:
                return
            paths = [path]
        elif event in _WRITES:
            paths = [arguments[i] for i in _WRITES[event]]
        else:
            return
        for path in paths:
            if isinstance(path, (str, bytes, os.PathLike)):
                whole = os.path.abspath(os.fsdecode(path))
                if not whole.startswith(inside):
                    strays.append(f"{event} {whole}"[:300])

    sys.addaudithook(hook)


def _wait(pid: int) -> tuple[int, resource.struct_rusage]:
    """The exit code, or minus the signal. A process that waits without working is ended."""
    worked, since = -1, time.monotonic()
    pause = 0.002
    while True:
        ended, status, usage = os.wait4(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), usage
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        state, ticks = fields[0], int(fields[11]) + int(fields[12])
        if ticks != worked or state == "R":
            worked, since = ticks, time.monotonic()
        elif time.monotonic() - since > IDLE_SECONDS:
            os.kill(pid, signal.SIGKILL)
        time.sleep(pause)
        pause = min(0.05, 1.2 * pause)


def _faults(target: Target, code: int, said: str, out: str, seen: dict[str, Any]) -> list[str]:
    """What of the end of a process is not allowed."""
    faults = []
    if "harness" in seen:
        return [f"harness: {seen['harness']}"]
    if not seen.get("done"):
        faults.append(f"died: by signal {-code}")
    elif code not in target.codes:
        faults.append(f"exit code {code}")
    if seen.get("error") and not (seen["error"].endswith("Error") and code in target.codes and code == 4):
        faults.append(f"escaped: {seen['error']}")
    if "Traceback" in said or "Traceback" in out:
        faults.append("traceback")
    if "Warning" in said:
        faults.append(f"warning: {said[:300]}")
    lines = said.splitlines()
    # Where there is no terminal, a command says before how far it is.
    if code > 0 and [line.startswith("bigs: ") for line in lines] != [False] * (len(lines) - 1) + [True]:
        faults.append(f"no single sentence: {said[:300]}")
    if any(len(line) > LONGEST_SENTENCE for line in lines):
        faults.append(f"{max(map(len, lines))} characters")
    if any(not (c.isprintable() or c == "\n") for c in said):
        faults.append(f"unprintable: {said[:300]!r}")
    if seen.get("seconds", 0) > CPU_SECONDS:
        faults.append("too long")
    if seen.get("memory", 0) > MEMORY:
        faults.append(f"too much memory: {seen['memory'] >> 20} MiB")
    faults += [f"written outside: {stray}" for stray in seen.get("strays", ())]
    return faults


def _strays(place: Path, target: Target) -> list[str]:
    """Files that were not there before, and are not where they may be."""
    known = {"corpus", "out", "cwd", "tmp", "report.json", "stdout", "stderr"}
    found = [path.name for path in place.iterdir() if path.name not in known]
    found += [f"cwd/{path.name}" for path in (place / "cwd").iterdir()]
    return [f"written outside: {name!r}" for name in found]


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""


def _peak_memory(reset: bool = False) -> int:
    """The most that the process ever had, or has had since the last reset."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmHWM")


def _address_space() -> int:
    return _status("VmSize")


def _status(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(field))
