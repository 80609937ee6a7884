"""Height, normal, level and error bound at world points."""

import warp as wp

from terrasim.kernels.surface import Facet, Lattice, normal_of, surface_at

NOT_A_NUMBER = 8
"""A coordinate is NaN or infinite."""

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
        lattice.levels,
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


# Thirteen parameters: six answers, each an array of its own so that a caller takes what it needs.
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
