"""Height, normal, level and error bound at world points."""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool
from terrasim.kernels.facet import Facet, facet_of, normal_of
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.surface import surface_at

NOT_A_NUMBER = 8
"""A coordinate is NaN or infinite."""

PENDING = 128
"""The quick pass left the point to the general one."""

_NO_SIGN = wp.constant(0x7FFFFFFF)
_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_PITCH = wp.constant(256)
_PENDING = wp.constant(PENDING)
_OFF = wp.constant(1)
_IN_HOLE = wp.constant(2)
_NOT_A_NUMBER = wp.constant(NOT_A_NUMBER)


@wp.func
def facet_at(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    point: wp.vec2d,
) -> Facet:
    """The facet under a world point; a point off the terrain is moved to its edge."""
    x = (point[0] - lattice.x) / lattice.spacing
    y = (point[1] - lattice.y) / lattice.spacing
    # Clamped as floats: a far point would overflow an integer.
    u = wp.clamp(x, wp.float64(lattice.col), wp.float64(lattice.last_col + 1))
    v = wp.clamp(y, wp.float64(lattice.row), wp.float64(lattice.last_row + 1))
    # The last post belongs to the last cell, so that its upper neighbour exists.
    col = wp.min(int(wp.floor(u)), lattice.last_col)
    row = wp.min(int(wp.floor(v)), lattice.last_row)
    facet = surface_at(
        pool,
        table,
        lattice,
        level,
        row,
        col,
        u - wp.float64(col),
        v - wp.float64(row),
    )
    if x != u or y != v:
        facet.state += _OFF
        # Comparing with itself finds NaN; infinity is the only other value without a difference.
        if x - x != wp.float64(0.0) or y - y != wp.float64(0.0):
            facet.state = _NOT_A_NUMBER
    return facet


@wp.func
def world_height(lattice: Lattice, facet: Facet) -> wp.float64:
    """World z of a facet at its point [m]; NaN in a hole."""
    if (facet.state & _IN_HOLE) != 0:
        return wp.float64(wp.nan)
    return lattice.z + facet.height * wp.float64(1.0e-5)


@wp.struct
class LevelLattice:
    """Placement of one level's posts, for :func:`sample_inside`."""

    x: wp.float64
    """World x of column 0 [m]."""
    y: wp.float64
    """World y of row 0 [m]."""
    z: wp.float64
    """World z of count 0 [m]."""
    spacing: wp.float64
    """Distance between the level's posts [m]."""
    west: wp.float64
    """The terrain's edges in columns and rows of the level."""
    east: wp.float64
    south: wp.float64
    north: wp.float64
    level: int
    """The level."""
    detail: int
    """Where the flags of blocks with detail begin in the table; -1 if none can have any."""


@wp.func
def is_plain(table: wp.array(dtype=int), lattice: LevelLattice, layer: int) -> bool:
    """Whether a block has no detail."""
    if lattice.detail >= 0:
        return table[lattice.detail + layer] != 1
    return True


# On the CPU a short kernel without rare cases runs at twice the speed of one that has them all.
@wp.kernel(enable_backward=False)
def sample_inside(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: LevelLattice,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    points: wp.array(dtype=wp.vec2d),
    # Out:
    height_out: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.uint8),
):
    """Heights of points whose cell lies inside one resident block without detail.

    The rest stay ``PENDING``.
    """
    i = wp.tid() & _NO_SIGN
    x = (points[i][0] - lattice.x) / lattice.spacing
    y = (points[i][1] - lattice.y) / lattice.spacing
    state = int(_PENDING)
    # Comparisons that NaN fails, too.
    if x >= lattice.west and x < lattice.east and y >= lattice.south and y < lattice.north:
        col = int(wp.floor(x))
        row = int(wp.floor(y))
        layer = layer_of(table, lattice.level, row >> _SHIFT, col >> _SHIFT)
        if layer >= 0 and (row & _LAST) != _LAST and (col & _LAST) != _LAST:
            u = x - wp.float64(col)
            v = y - wp.float64(row)
            near = offset_in_pool(layer, row, col)
            mid = (near + wp.where(u >= v, 1, _PITCH)) & _NO_SIGN
            far = (near + _PITCH + 1) & _NO_SIGN
            facet = facet_of(pool[near], pool[mid], pool[far], lattice.level, layer, u, v)
            if facet.state == 0 and is_plain(table, lattice, layer):
                height_out[i] = lattice.z + facet.height * wp.float64(1.0e-5)
                used_out[layer] = wp.uint8(1)
                state = 0
    state_out[i] = wp.uint8(state)


@wp.kernel(enable_backward=False)
def sample_height(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    points: wp.array(dtype=wp.vec2d),
    # Out:
    height_out: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.uint8),
):
    i = wp.tid()
    facet = facet_at(pool, table, lattice, level, points[i])
    used_out[facet.layer] = wp.uint8(1)
    height_out[i] = world_height(lattice, facet)
    state_out[i] = wp.uint8(facet.state)


@wp.kernel(enable_backward=False)
def sample_surface(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    points: wp.array(dtype=wp.vec2d),
    # Out:
    height_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    slope_out: wp.array(dtype=wp.float64),
    level_out: wp.array(dtype=wp.uint8),
    error_out: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.uint8),
):
    # Over the limit: six answers, each an array of its own so that a caller takes what it needs.
    i = wp.tid()
    facet = facet_at(pool, table, lattice, level, points[i])
    used_out[facet.layer] = wp.uint8(1)
    normal = normal_of(facet, lattice.spacing)
    height_out[i] = world_height(lattice, facet)
    normal_out[i] = normal
    slope_out[i] = wp.length(wp.vec2d(normal[0], normal[1])) / normal[2]
    level_out[i] = wp.uint8(facet.level)
    error_out[i] = wp.float64(error[facet.layer]) * wp.float64(1.0e-5)
    state_out[i] = wp.uint8(facet.state)
