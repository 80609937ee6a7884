"""Variants in processes of their own, and what is kept of those that are finished.

A result is keyed by a hash of all that decides it: settings, files, version, machine. So a study
that was ended goes on where it was, and one whose code or ground changed begins again.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import terrasim
from terrasim.scenario.scenario import scenario_settings
from terrasim.scenario.schedule import image_files
from terrasim.scenario.terrain import DemGround, StoreGround
from terrasim.study.frames import Frames
from terrasim.study.study_file import Variant
from terrasim.study.variant import frames_file

DONE, REFUSED, STOPPED, FAILED = "done", "refused", "stopped", "failed"


@dataclass(frozen=True)
class Looking:
    """How variants are looked at."""

    frames: int
    """Times at which places are kept."""
    watched_balls: int
    """Balls whose places are kept."""
    every_step: bool
    """Whether energy and depth are looked at after every step."""
    longest_s: float
    """Wall time after which a process is ended [s]."""


@dataclass(frozen=True)
class Result:
    """What came of one process."""

    status: str
    """``done``, ``refused``, ``stopped``, or ``failed`` where the process itself did."""
    reason: str
    """Why it is not done; empty if it is."""
    found: dict[str, Any]
    """What it measured."""
    frames: Path
    """Where its frames lie, if it is done."""
    kept: bool
    """Whether it was finished before this study was begun."""

    def load(self) -> Frames:
        """The frames."""
        return Frames.load(self.frames)


class Runs:
    """A folder of results. One process at a time, so that none spoils the times of another."""

    def __init__(self, folder: Path, place: Path, looking: Looking) -> None:
        """Keep results in ``folder``; paths in scenarios are relative to ``place``."""
        self._folder = folder
        self._place = place
        self._looking = looking

    def result(self, one: Variant, repeat: int = 0, engine: str = "") -> Result:
        """The result of a variant, from before or from a process that is run now."""
        out = self._folder / f"{self._key(one, engine)}-{repeat}.json"
        kept = _read(out, True)
        if kept is not None:
            return kept
        self._folder.mkdir(parents=True, exist_ok=True)
        job = {
            "scenario": one.table,
            "name": one.label or one.scenario.name,
            "folder": str(self._place.resolve()),
            "frames": self._looking.frames,
            "watched_balls": self._looking.watched_balls,
            "every_step": self._looking.every_step,
            "engine": engine,
            "version": version_told(),
        }
        failure = self._run(job, out)
        return _read(out, False) or Result(FAILED, failure, {}, frames_file(out), False)

    def finished(self, one: Variant, repeat: int = 0, engine: str = "") -> bool:
        """Whether a result is there already."""
        return (self._folder / f"{self._key(one, engine)}-{repeat}.json").is_file()

    def _run(self, job: dict[str, Any], out: Path) -> str:
        """Run a process; returns why there is no result, where there is none."""
        with tempfile.TemporaryDirectory() as folder:
            told = Path(folder) / "job.json"
            told.write_text(json.dumps(job, default=str), encoding="utf-8")
            words = [sys.executable, "-m", "terrasim.study.variant", str(told), str(out)]
            # The child finds this very package, from wherever this one was begun.
            own = str(Path(terrasim.__file__).resolve().parents[1])
            paths = os.pathsep.join(filter(None, [own, os.environ.get("PYTHONPATH")]))
            try:
                done = subprocess.run(
                    words,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.PIPE,
                    timeout=self._looking.longest_s,
                    check=False,
                    env={**os.environ, "PYTHONPATH": paths},
                )
            except subprocess.TimeoutExpired:
                return f"took longer than longest_s = {self._looking.longest_s:g} s and was ended"
        if done.returncode < 0:
            return f"the process was ended by signal {-done.returncode}"
        said = done.stderr.decode(errors="replace").strip().splitlines()
        return f"the process ended with status {done.returncode}: {said[-1] if said else ''}"

    def _key(self, one: Variant, engine: str) -> str:
        look = self._looking
        decides = {
            "settings": scenario_settings(one.scenario),
            "files": _files(one, self._place),
            "version": version_told(),
            "machine": machine(),
            "look": [look.frames, look.watched_balls, look.every_step],
            "engine": engine,
        }
        text = json.dumps(decides, sort_keys=True)
        return blake2b(text.encode(), digest_size=10).hexdigest()


def _read(out: Path, kept: bool) -> Result | None:
    try:
        table = json.loads(out.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return None
    return Result(
        table["status"], table.get("reason", ""), table.get("found", {}), frames_file(out), kept
    )


def _files(one: Variant, place: Path) -> list[Any]:
    """Size and time of the files that a scenario reads."""
    ground, names = one.scenario.terrain, [file.path for file in image_files(one.scenario)]
    if isinstance(ground, StoreGround):
        names.append(ground.path)
    if isinstance(ground, DemGround):
        names += ground.files
    found = []
    for name in sorted(set(names)):
        path = place / name
        told = path.stat() if path.is_file() else None
        found.append([name, told and told.st_size, told and told.st_mtime_ns])
    return found


@cache
def version_told() -> str:
    """The version, and a hash of the code itself."""
    try:
        told = version("terrasim")
    except PackageNotFoundError:
        told = "unknown"
    digest = blake2b(digest_size=6)
    package = Path(terrasim.__file__).parent
    for path in sorted({one.resolve() for one in package.rglob("*.py")}):
        digest.update(path.read_bytes())
    for path in sorted((package / "kernels").resolve().glob("*.py")):
        digest.update(path.read_bytes())
    return f"{told}+{digest.hexdigest()}"


@cache
def machine() -> dict[str, Any]:
    """What the study ran on."""
    name = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.split(":", 1)[1].strip()
                break
    except OSError:
        pass
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }
