"""A ray on its way over the cells: where it is, where it leaves, where it goes next.

Places are integer cells and offsets from them, so nothing is lost far from the origin, and cells
follow each other by integer steps, never by an epsilon.
"""

import warp as wp

from terrasim.kernels.surface import Lattice


@wp.struct
class Ray:
    """A ray in cells and counts, and how far it has come."""

    row: int
    """Level-0 cell that its start lies in."""
    col: int
    u: wp.float64
    """Start within that cell along x and y, 0 to 1."""
    v: wp.float64
    height: wp.float64
    """Height of the start [counts]."""
    du: wp.float64
    """Motion a metre: cells along x and y, counts upward."""
    dv: wp.float64
    dh: wp.float64
    end: wp.float64
    """Where it ends, or leaves the terrain [m]."""
    t: wp.float64
    """How far it has come [m]."""
    at_row: int
    """Level-0 cell it has come to."""
    at_col: int
    above: wp.float64
    """Height above the ground there [counts]."""
    known: int
    """Whether ``above`` is known: there was ground before."""


@wp.func
def border(start: int, offset: wp.float64, speed: wp.float64, low: int, high: int) -> wp.float64:
    """Distance at which a ray leaves cells ``low`` to ``high - 1`` along one axis [m]."""
    if speed > wp.float64(0.0):
        return (wp.float64(high - start) - offset) / speed
    if speed < wp.float64(0.0):
        return (wp.float64(low - start) - offset) / speed
    return wp.float64(wp.inf)


@wp.func
def cell_index(x: wp.float64) -> int:
    """The cell of a place along an axis; one too far away for an int32 is taken nearer."""
    return int(wp.floor(wp.clamp(x, wp.float64(-1.0e9), wp.float64(1.0e9))))


@wp.func
def within(start: int, offset: wp.float64, speed: wp.float64, first: int, last: int) -> wp.vec2d:
    """Distances between which a ray lies between two indices along an axis [m]."""
    low = wp.float64(first - start) - offset
    high = wp.float64(last - start) - offset
    if speed == wp.float64(0.0):
        if low <= wp.float64(0.0) and high >= wp.float64(0.0):
            return wp.vec2d(wp.float64(-wp.inf), wp.float64(wp.inf))
        return wp.vec2d(wp.float64(wp.inf), wp.float64(-wp.inf))
    return wp.vec2d(wp.min(low / speed, high / speed), wp.max(low / speed, high / speed))


@wp.func
def next_index(index: int, level: int, speed: wp.float64) -> int:
    """The level-0 index beyond a cell of a level, in the direction of motion."""
    cell = index >> level
    return wp.where(speed > wp.float64(0.0), (cell + 1) << level, (cell << level) - 1)


@wp.func
def index_at(
    start: int, offset: wp.float64, speed: wp.float64, t: wp.float64, index: int, level: int
) -> int:
    """The level-0 index at a distance, within the cell of ``index``."""
    low = (index >> level) << level
    found = start + int(wp.floor(offset + speed * t))
    return wp.clamp(found, low, low + (1 << level) - 1)


@wp.func
def moved_on(ray: Ray, level: int, end: wp.float64, x: wp.float64, y: wp.float64) -> Ray:
    """The ray in its next cell, which it enters at ``end``."""
    moved = ray
    moved.t = end
    if x <= y:
        moved.at_col = next_index(ray.at_col, level, ray.du)
        moved.at_row = index_at(ray.row, ray.v, ray.dv, end, ray.at_row, level)
    else:
        moved.at_row = next_index(ray.at_row, level, ray.dv)
        moved.at_col = index_at(ray.col, ray.u, ray.du, end, ray.at_col, level)
    return moved


@wp.func
def inside(lattice: Lattice, ray: Ray) -> bool:
    """Whether a ray is over the terrain."""
    return (
        ray.at_col >= lattice.col
        and ray.at_col <= lattice.last_col
        and ray.at_row >= lattice.row
        and ray.at_row <= lattice.last_row
    )


@wp.func
def cell_exit(ray: Ray, level: int, axis: int) -> wp.float64:
    """Distance at which a ray leaves its cell of a level along x (0) or y (1) [m]."""
    if axis == 0:
        low = (ray.at_col >> level) << level
        return border(ray.col, ray.u, ray.du, low, low + (1 << level))
    low = (ray.at_row >> level) << level
    return border(ray.row, ray.v, ray.dv, low, low + (1 << level))
