"""A process killed in the middle of anything: what was acknowledged is there, whole, and soon."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import numpy as np
from kill_play import POSTS, Model, ground, turns
from soak import SOAKING

import terrasim as ts
from terrasim.store.create import create_store
from terrasim.store.verify import verify

KILLS = 1000 if SOAKING else 50
LONGEST_S = 0.5 if SOAKING else 0.2
OPENS_IN_S = 2.0


class Stage:
    """The process that forks players."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("kill_play.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._line() == "ready"

    def act(self, path: Path, seed: int, first: int, after_s: float) -> int:
        """Let a player play for a while after its first turn and kill it; turns acknowledged."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{path} {seed} {first}\n")
        self._process.stdin.flush()
        player = int(self._line().split()[1])
        timer = threading.Timer(after_s, os.kill, (player, signal.SIGKILL))
        acknowledged = first
        timer.start()
        while (line := self._line()) != "gone":
            acknowledged = int(line)
        timer.join()
        return acknowledged

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the stage has fallen"
        return line.strip()


@contextmanager
def staged() -> Iterator[Stage]:
    stage = Stage()
    try:
        yield stage
    finally:
        stage.close()


def test_no_acknowledged_turn_is_lost_however_often_it_is_killed(tmp_path: Path) -> None:
    """Whatever it was doing, the ground is that of what was acknowledged, or of one turn more.

    It opens soon, and what is tried again is done once.
    """
    path = tmp_path / "ground.store"
    create_store(path, ts.Flat(ts.Grid(POSTS, POSTS, 1.0)))
    rng = np.random.default_rng(11)
    model, seed, first, slowest, played = Model(5), 5, 0, 0.0, 0
    with staged() as stage:
        for _ in range(KILLS):
            done = stage.act(path, seed, first, float(rng.uniform(0.001, LONGEST_S)))
            played += done - first
            begun = time.perf_counter()
            with ts.open_terrain(path) as terrain:
                slowest = max(slowest, time.perf_counter() - begun)
                found = ground(terrain)
            assert found in (model.after(done), model.after(done + 1))
            first = done
    model.close()
    assert played > KILLS
    assert slowest < OPENS_IN_S
    report = verify(path)
    assert report["sound"], report


def test_the_stage_sees_a_turn_that_is_lost(tmp_path: Path) -> None:
    """The model tells one turn from the next: had a stamp been lost, its hash would be another."""
    model = Model(5)
    hashes = {model.after(count) for count in range(60)}
    stamped = 1 + sum(turn.kind == "stamp" for turn in islice(turns(5), 59))
    # A fill may find the ground higher already.
    assert 0.9 * stamped < len(hashes) <= stamped
    model.close()
