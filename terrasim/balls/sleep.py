"""Balls that rest sleep, and those that are awake may be stepped in an order that is quicker.

A ball sleeps when it is at rest where it was when it was last looked at: a step would leave it as
it is, so leaving the step out changes no bit. It wakes when a block within its reach is edited,
or somebody says so. Only balls that are awake are stepped, and only for them is ground required:
a ball that sleeps costs nothing until the ground changes (a million at rest: 0.03 ns a ball and
step instead of 250). After an edit their cells are looked at once, about 0.1 us a ball.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.cache.watch import Watch
from terrasim.errors import InputError
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.launch import launch
from terrasim.terrain import Terrain

if TYPE_CHECKING:
    from terrasim.balls.balls import Balls
    from terrasim.balls.order import Part

LOOK_EVERY = 16
"""Steps from one look for balls that rest to the next."""
SORT_EVERY = 128
"""Steps from one sorting to the next that serve well."""
WORTH = 16
"""Balls are put to sleep where they are at least one in so many that are awake."""
MAP_BLOCKS = 1 << 22
"""Blocks around all changes that are looked at one by one; over more of them, all balls wake."""

Flags = npt.NDArray[np.bool_]


@dataclass
class Awake:
    """Which balls are stepped, and in what order. For one ``Balls`` only: ``balls.awake``."""

    sleeps: bool = True
    """Whether balls that rest sleep."""
    sort_every: int = 0
    """Steps after which balls are sorted by block anew; 0 leaves them in the order given."""
    still: float = 0.0
    """Speed [m/s] and way between two looks [m] up to which a ball rests. 0 for contact that
    brings balls to rest for good; then a sleeping ball is what it would be, to the bit."""
    asleep: Flags | None = None
    """Which balls sleep, shape ``(count,)``; None as long as none has."""
    part: Part | None = None
    """Those that are awake, where they are not all as they are."""
    steps: int = 0
    """Steps that were made."""
    settled: bool = True
    """Whether the balls' own arrays say what became of that part."""
    seen: Any = None
    """Each ball at the last look at it, ``kernels.ball_sleep.Seen``; None before the first."""
    watch: Watch = field(default_factory=Watch)
    """Where the ground changed since the last step."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense.

        Raises:
            InputError: With the number.
        """
        if self.sort_every < 0:
            raise InputError(f"sort_every must be at least 0 steps, got {self.sort_every}")
        if not 0.0 <= self.still < np.inf:
            raise InputError(f"still must be at least 0 and finite, got {self.still}")

    @property
    def sleeping(self) -> int:
        """How many balls sleep."""
        return 0 if self.asleep is None else int(np.count_nonzero(self.asleep))


def stepped(terrain: Terrain, balls: Balls) -> Balls:
    """The balls that a step moves: all, or those of them that are awake, in an order of their own.

    Balls wake first where the ground changed since the last step.
    """
    awake = balls.awake
    if awake is None:
        return balls
    _wake_where_changed(terrain, balls, awake)
    if awake.part is None:
        awake.part = _part_of(terrain, balls, awake)
    return balls if awake.part is None else awake.part.balls


def after_step(terrain: Terrain, balls: Balls) -> None:
    """Put balls to sleep that rest, and sort them anew when it is time."""
    awake = balls.awake
    if awake is None:
        return
    balls.moved = None
    awake.settled = awake.part is None
    awake.steps += 1
    if awake.sleeps and awake.steps % LOOK_EVERY == 0:
        _put_to_sleep(terrain, balls, awake)
    if awake.sort_every and awake.steps % awake.sort_every == 0:
        rejoin(balls)


def settle(balls: Balls) -> None:
    """Make the arrays of balls what they should be, where some are stepped apart from them.

    Whoever reads the arrays of balls with ``awake`` calls this first.
    """
    awake = balls.awake
    if awake is None or awake.part is None or awake.settled:
        return
    from terrasim.balls.order import put_back

    put_back(awake.part, balls)
    awake.settled = True


def rejoin(balls: Balls) -> None:
    """Settle, and step none apart until the next step.

    Whoever changes the arrays of balls with ``awake`` calls this first, and wakes those it changed.
    """
    settle(balls)
    if balls.awake is not None and balls.awake.part is not None:
        balls.awake.part = None
        balls.reach = None


def wake(balls: Balls, which: Any = slice(None)) -> None:
    """Wake balls: all, or those with some numbers or flags. No harm to those awake."""
    awake = balls.awake
    if awake is None or awake.asleep is None or not awake.asleep[which].any():
        return
    rejoin(balls)
    awake.asleep[which] = False


def _part_of(terrain: Terrain, balls: Balls, awake: Awake) -> Part | None:
    """The balls that are awake, in their order; None if those are all as they are."""
    if not awake.sort_every and not awake.sleeping:
        return None
    from terrasim.balls.moved import Moved
    from terrasim.balls.order import in_order, take, taken_of

    count = balls.count
    asleep = np.zeros(count, dtype=np.bool_) if awake.asleep is None else awake.asleep
    chosen = np.flatnonzero(~asleep).astype(np.int32)
    if awake.sort_every:
        number = in_order(terrain, balls, chosen)
    else:
        number = wp.array(chosen, dtype=wp.int32, device=terrain.device)
    part = take(balls, number, terrain.threads)
    if balls.moved is not None:
        rises = taken_of(balls.moved.rises, number, terrain.threads)
        part.balls.moved = Moved(rises, balls.moved.most)
    return part


def _put_to_sleep(terrain: Terrain, balls: Balls, awake: Awake) -> None:
    """Look for balls that rest, and let them sleep if they are enough."""
    from terrasim.kernels.ball_sleep import Seen, doze

    now = balls if awake.part is None else awake.part.balls
    if now.count == 0:
        return
    first = awake.seen is None
    if first:
        awake.seen = wp.zeros(balls.count, dtype=Seen, device=terrain.device)
    number = np.arange(balls.count, dtype=np.int32)
    if awake.part is not None:
        number = awake.part.number.numpy()
    rests = wp.empty(now.count, dtype=wp.uint8, device=terrain.device)
    launch(
        doze,
        now.count,
        shared=[awake.still, awake.seen],
        items=[
            wp.array(number, dtype=wp.int32, device=terrain.device),
            now.z,
            now.velocity,
            now.tally,
            rests,
        ],
        device=terrain.device,
        threads=terrain.threads,
    )
    found = rests.numpy().astype(np.bool_)
    if now.spin is not None:
        found &= (np.abs(now.spin.numpy()) <= awake.still).all(axis=1)
    if first or np.count_nonzero(found) * WORTH < now.count:
        return
    if awake.asleep is None:
        awake.asleep = np.zeros(balls.count, dtype=np.bool_)
    awake.asleep[number[found]] = True
    rejoin(balls)


def _wake_where_changed(terrain: Terrain, balls: Balls, awake: Awake) -> None:
    """Wake balls that reach a block that was edited."""
    if not awake.sleeps:
        return
    terrain.settle()
    watch = awake.watch
    if watch not in terrain.cache.watches:
        # Another terrain, or the first one: whatever was known of the ground is not of this one.
        terrain.cache.watches.add(watch)
        watch.everything = True
    if watch.everything:
        wake(balls)
    elif watch.blocks and awake.asleep is not None and awake.sleeping:
        sleeping = np.flatnonzero(awake.asleep)
        wake(balls, sleeping[_reaches(terrain, balls, sleeping, watch)])
    watch.clear()


def _reaches(
    terrain: Terrain, balls: Balls, which: npt.NDArray[np.int64], watch: Watch
) -> npt.NDArray[np.bool_]:
    """Which of some balls reach a block that changed, or one whose detail did."""
    changed = {
        key if key.level == 0 else terrain.detail.base_of(key)
        for key in watch.blocks
        if key.level <= 0
    }
    if not changed:
        return np.zeros(len(which), dtype=np.bool_)
    at = np.array([(key.row, key.col) for key in changed], dtype=np.int64)
    low, high = at.min(axis=0), at.max(axis=0)
    rows, cols = (high - low + 1).tolist()
    if rows * cols > MAP_BLOCKS:
        return np.ones(len(which), dtype=np.bool_)
    # A margin of one block is where all that lie outside are looked up.
    marked = np.zeros((rows + 2, cols + 2), dtype=np.bool_)
    marked[tuple((at - low + 1).T)] = True
    cell = balls.cell.numpy()[which].astype(np.int64)
    way = np.ceil(balls.material.numpy()["radius"][which] / terrain.grid.spacing).astype(np.int64)
    ends = []
    for step in (-way, way + 1):
        block = (cell + step[:, None]) >> BLOCK_SHIFT
        ends.append(np.clip(block - low + 1, 0, [rows + 1, cols + 1]))
    first, last = ends
    found = (last - first > 1).any(axis=1)
    for row in (first, last):
        for col in (first, last):
            found |= marked[row[:, 0], col[:, 1]]
    return np.asarray(found)
