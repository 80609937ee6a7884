"""What the cache did, in numbers for the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Counters:
    """Counted since the terrain was opened. Times are wall times."""

    hits: int = 0
    """Required blocks that were resident when a step asked for them."""
    misses: int = 0
    """Required blocks that were not."""
    stalls: int = 0
    """Steps that had to wait for required blocks."""
    stall_ms: float = 0.0
    """Time those steps waited [ms]."""
    late: int = 0
    """Required blocks that a step did without, because its terrain does not wait for them."""
    fallbacks: int = 0
    """Points that a view or query answered from a coarser level than it asked for."""
    coarsened: int = 0
    """Needs of a step that were answered one level coarser because the pool was too small; a need
    raised by several levels counts several times."""
    coarsened_error: int = 0
    """Largest error bound [counts] of a block that stood in for a finer one by coarsening."""
    fallback_error: int = 0
    """Largest error bound [counts] of a block that answered a query for a finer one."""
    loads: int = 0
    """Blocks brought into the pool."""
    load_bytes: int = 0
    """Bytes written into the pool by loads."""
    read_ms: float = 0.0
    """Time spent reading and decoding blocks, over all threads [ms]."""
    evictions: int = 0
    """Blocks that left the pool to make room."""
    written_back: int = 0
    """Edited blocks saved when they left the pool."""
    queue_ms: float = 0.0
    """Time the job queue took out of steps [ms]."""
    queue_over: int = 0
    """Steps in which the job queue overran its budget."""
    off_terrain: int = 0
    """Queried points beyond the edge, answered at the nearest edge point."""
    in_hole: int = 0
    """Queried points without ground."""
