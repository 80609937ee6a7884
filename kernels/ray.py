"""A ray on its way over the cells: where it is, where it leaves, where it goes next.

Places are integer cells and offsets from them, so nothing is lost far from the origin. Cells
follow each other by integer steps, never by an epsilon, and no index ever goes back: a ray ends
after at most as many steps as the terrain has rows and columns of cells.
"""

import warp as wp

from terrasim.kernels.lattice import Lattice

_BLOCK_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_MOST = wp.constant(2**31 - 1)
# Indices of posts stay within 2^30, so that the difference of two fits an int32.
_FARTHEST = wp.constant(wp.float64(2**30 - 1))


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
    """Where it ends, or leaves the terrain or all possible heights [m]."""
    t: wp.float64
    """How far it has come [m]."""
    at_row: int
    """Level-0 cell it has come to."""
    at_col: int
    above: wp.float64
    """Height above the ground there [counts]; only its sign counts."""
    known: int
    """Whether ``above`` is known: there was ground before."""


@wp.struct
class Area:
    """A rectangle of level-0 cells: rows ``row0 <= row < row1``, columns likewise."""

    row0: int
    row1: int
    col0: int
    col1: int


@wp.func
def cell_area(ray: Ray, level: int) -> Area:
    """The cell of a level that a ray has come to."""
    area = Area()
    area.row0 = (ray.at_row >> level) << level
    area.row1 = area.row0 + (1 << level)
    area.col0 = (ray.at_col >> level) << level
    area.col1 = area.col0 + (1 << level)
    return area


@wp.func
def block_area(ray: Ray, level: int) -> Area:
    """The cells with all four posts in the block of a level that a ray has come to."""
    shift = level + _BLOCK_SHIFT
    area = Area()
    area.row0 = (ray.at_row >> shift) << shift
    area.row1 = area.row0 + (_LAST << level)
    area.col0 = (ray.at_col >> shift) << shift
    area.col1 = area.col0 + (_LAST << level)
    return area


@wp.func
def cell_index(x: wp.float64) -> int:
    """The cell of a place along an axis; one too far away for an int32 is taken nearer."""
    return int(wp.floor(wp.clamp(x, -_FARTHEST, _FARTHEST)))


@wp.func
def within(low: wp.float64, high: wp.float64, speed: wp.float64) -> wp.vec2d:
    """Distances between which a ray lies within bounds, given from its start, of an axis [m]."""
    if speed == wp.float64(0.0):
        if low <= wp.float64(0.0) and high >= wp.float64(0.0):
            return wp.vec2d(wp.float64(-wp.inf), wp.float64(wp.inf))
        return wp.vec2d(wp.float64(wp.inf), wp.float64(-wp.inf))
    return wp.vec2d(wp.min(low / speed, high / speed), wp.max(low / speed, high / speed))


@wp.func
def border(start: int, offset: wp.float64, speed: wp.float64, low: int, high: int) -> wp.float64:
    """Distance at which a ray leaves cells ``low`` to ``high - 1`` along one axis [m]."""
    if speed > wp.float64(0.0):
        return (wp.float64(high) - wp.float64(start) - offset) / speed
    if speed < wp.float64(0.0):
        return (wp.float64(low) - wp.float64(start) - offset) / speed
    return wp.float64(wp.inf)


@wp.func
def exits(ray: Ray, area: Area) -> wp.vec2d:
    """Distances at which a ray leaves an area along x and along y [m]."""
    return wp.vec2d(
        border(ray.col, ray.u, ray.du, area.col0, area.col1),
        border(ray.row, ray.v, ray.dv, area.row0, area.row1),
    )


@wp.func
def index_at(
    place: wp.float64, start: int, speed: wp.float64, index: int, low: int, high: int
) -> int:
    """The index at a place, given from ``start``, in ``low`` to ``high - 1`` and never back."""
    if speed == wp.float64(0.0):
        return index
    first = wp.where(speed > wp.float64(0.0), index, low)
    last = wp.where(speed > wp.float64(0.0), high - 1, index)
    return wp.clamp(start + int(wp.floor(place)), first, last)


@wp.func
def moved_on(ray: Ray, area: Area, end: wp.float64, leaves: wp.vec2d) -> Ray:
    """The ray at ``end``: in the next cell along an axis on which it leaves the area by then."""
    moved = ray
    moved.t = end
    moved.at_col = index_at(ray.u + ray.du * end, ray.col, ray.du, ray.at_col, area.col0, area.col1)
    moved.at_row = index_at(ray.v + ray.dv * end, ray.row, ray.dv, ray.at_row, area.row0, area.row1)
    # One axis at a time: through a post the ray goes by way of a neighbour.
    if leaves[0] <= leaves[1]:
        if leaves[0] <= end:
            moved.at_col = wp.where(ray.du > wp.float64(0.0), area.col1, area.col0 - 1)
    elif leaves[1] <= end:
        moved.at_row = wp.where(ray.dv > wp.float64(0.0), area.row1, area.row0 - 1)
    return moved


@wp.func
def leap(ray: Ray, level: int, highest: int) -> Ray:
    """The ray beyond the cells of its block that it clears, or as it is if that is not worth it.

    It stops short of cells with posts in other blocks, and a count above the block's highest post.
    At the end of what an int32 holds that is no bound: detail may lie above it.
    """
    clear = ray.height + ray.dh * ray.t - (wp.float64(highest) + wp.float64(1.0))
    if (
        clear <= wp.float64(0.0)
        or highest == _MOST
        or (ray.known == 1 and ray.above <= wp.float64(0.0))
    ):
        return ray
    area = block_area(ray, level)
    if ray.at_row >= area.row1 or ray.at_col >= area.col1:
        return ray
    leaves = exits(ray, area)
    end = wp.min(ray.end, wp.min(leaves[0], leaves[1]))
    if ray.dh < wp.float64(0.0):
        end = wp.min(end, ray.t - clear / ray.dh)
    # Over two cells, so that an index surely moves.
    cells = (end - ray.t) * wp.max(wp.abs(ray.du), wp.abs(ray.dv))
    if cells < wp.float64(2 << level):
        return ray
    moved = moved_on(ray, area, end, leaves)
    moved.above = wp.float64(1.0)
    moved.known = 1
    return moved


@wp.func
def going_on(lattice: Lattice, ray: Ray) -> bool:
    """Whether a ray has some way left, over the terrain."""
    return (
        ray.t < ray.end
        and ray.at_col >= lattice.col
        and ray.at_col <= lattice.last_col
        and ray.at_row >= lattice.row
        and ray.at_row <= lattice.last_row
    )
