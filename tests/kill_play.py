"""A play that is killed again and again: what is done to a store, and what the ground must be.

Run as a script it is the stage: it loads everything once and then forks a player for every line
``PATH SEED FIRST`` on its input, answers with the player's number, and passes on the number of each
thing done as soon as it is acknowledged.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b
from itertools import count, islice
from pathlib import Path

import numpy as np

import terrasim as ts
from terrasim.counts import Counts
from terrasim.deform.edits import edits_of
from terrasim.deform.operations import Stamping
from terrasim.deform.window import read_window
from terrasim.store.collect import collect
from terrasim.warp_start import start_warp

POSTS = 600
"""Posts along a side: nine blocks at level 0, and corners of four to stamp on."""


@dataclass(frozen=True)
class Turn:
    """One thing to do."""

    kind: str
    """``stamp``, ``checkpoint``, ``snapshot``, ``reset`` or ``collect``."""
    stamps: tuple[ts.Stamp, ...] = ()
    """What to stamp."""
    name: str = ""
    """Of which snapshot."""


def turns(seed: int) -> Iterator[Turn]:
    """What to do, in order, without end: stamps on corners mostly, and what stores do."""
    rng = np.random.default_rng(seed)
    names: list[str] = []
    for number in count():
        draw = rng.random()
        if draw < 0.06:
            names.append(f"s{number}")
            yield Turn("snapshot", name=names[-1])
        elif draw < 0.12:
            yield Turn("checkpoint")
        elif draw < 0.15 and names:
            yield Turn("reset", name=names[int(rng.integers(len(names)))])
        elif draw < 0.18:
            yield Turn("collect")
        else:
            yield Turn("stamp", _stamps(rng))


def _stamps(rng: np.random.Generator) -> tuple[ts.Stamp, ...]:
    corner = rng.choice([256.0, 512.0], size=2)
    x, y = (corner + rng.uniform(-6.0, 6.0, 2)).tolist()
    height = float(rng.uniform(-2.0, 2.0))
    if rng.random() < 0.3:
        return (ts.Crater(x, y, float(rng.uniform(3.0, 20.0)), 1.0, 0.3),)
    if rng.random() < 0.2:
        return (ts.Gaussian(x, y, height, 4.0, mode="fill", z=height),)
    return (ts.Gaussian(x, y, height, float(rng.uniform(2.0, 12.0))),)


def take(terrain: ts.Terrain, path: Path, number: int, turn: Turn) -> None:
    """Do one thing, as one who does not know whether it was done before."""
    edits = edits_of(terrain)
    if turn.kind == "stamp":
        edits.commit(Stamping(turn.stamps), idem=f"turn-{number}", wait=number % 3 == 0)
    elif turn.kind == "checkpoint":
        edits.checkpoint()
    elif turn.kind == "reset":
        edits.reset(turn.name)
    elif turn.kind == "collect":
        collect(edits.require_branch())
    elif turn.name not in edits.require_branch().snapshots():
        edits.snapshot(turn.name)


def ground(terrain: ts.Terrain) -> bytes:
    """A hash of every post of level 0."""
    return blake2b(read_window(terrain, 0, 0, POSTS, POSTS).tobytes()).digest()


class Model:
    """What the ground must be after so many turns, worked out without a store."""

    def __init__(self, seed: int) -> None:
        """Begin with flat ground."""
        self._turns = turns(seed)
        self._terrain = ts.Terrain(ts.Flat(ts.Grid(POSTS, POSTS, 1.0)))
        self._named: dict[str, Counts] = {}
        self.hashes = [ground(self._terrain)]
        """The ground's hash after 0, 1, 2 ... turns."""

    def after(self, done: int) -> bytes:
        """The ground's hash after some turns."""
        while len(self.hashes) <= done:
            self._take(next(self._turns))
            self.hashes.append(ground(self._terrain))
        return self.hashes[done]

    def close(self) -> None:
        """End its threads."""
        self._terrain.close()

    def _take(self, turn: Turn) -> None:
        if turn.kind == "stamp":
            ts.apply(self._terrain, turn.stamps)
        elif turn.kind == "snapshot":
            heights = read_window(self._terrain, 0, 0, POSTS, POSTS)
            self._named[turn.name] = heights.astype(np.int32)
        elif turn.kind == "reset":
            self._terrain.close()
            source = ts.ArraySource(self._named[turn.name], ts.Grid(POSTS, POSTS, 1.0))
            self._terrain = ts.Terrain(source)


def play(path: Path, seed: int, first: int) -> None:
    """Take turns from one on, telling each on standard output when it is acknowledged."""
    with ts.open_terrain(path) as terrain:
        for number, turn in islice(enumerate(turns(seed)), first, None):
            take(terrain, path, number, turn)
            os.write(1, f"{number + 1}\n".encode())


def main() -> None:
    """Fork a player for each line of the input."""
    start_warp()
    with ts.Terrain(ts.Flat(ts.Grid(POSTS, POSTS, 1.0))) as warm:
        for stamps in (turn.stamps for turn in islice(turns(1), 40)):
            ts.apply(warm, stamps)
        ground(warm)
    os.write(1, b"ready\n")
    for line in sys.stdin:
        path, seed, first = line.split()
        player = os.fork()
        if player == 0:
            play(Path(path), int(seed), int(first))
            os._exit(0)
        os.write(1, f"player {player}\n".encode())
        os.waitpid(player, 0)
        os.write(1, b"gone\n")


if __name__ == "__main__":
    main()
