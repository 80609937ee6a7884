"""Height, normal, level and error bound at world points."""

import warp as wp

from terrasim.kernels.surface import Facet, Lattice, normal_of, surface_at

_OFF = wp.constant(1)


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
    return facet


@wp.kernel(enable_backward=False)
def sample_height(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    # In:
    points: wp.array(dtype=wp.vec2d),
    # Out:
    used_out: wp.array(dtype=wp.uint8),
    height_out: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.uint8),
):
    i = wp.tid()
    facet = facet_at(pool, table, lattice, level, points[i])
    used_out[facet.layer] = wp.uint8(1)
    height_out[i] = lattice.z + facet.height * wp.float64(1.0e-5)
    state_out[i] = wp.uint8(facet.state)


@wp.kernel(enable_backward=False)
def sample_surface(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    # In:
    points: wp.array(dtype=wp.vec2d),
    # Out:
    used_out: wp.array(dtype=wp.uint8),
    height_out: wp.array(dtype=wp.float64),
    normal_out: wp.array(dtype=wp.vec3d),
    level_out: wp.array(dtype=wp.uint8),
    error_out: wp.array(dtype=wp.float64),
    state_out: wp.array(dtype=wp.uint8),
):
    i = wp.tid()
    facet = facet_at(pool, table, lattice, level, points[i])
    used_out[facet.layer] = wp.uint8(1)
    height_out[i] = lattice.z + facet.height * wp.float64(1.0e-5)
    normal_out[i] = normal_of(facet, lattice.spacing)
    level_out[i] = wp.uint8(facet.level)
    error_out[i] = wp.float64(error[facet.layer]) * wp.float64(1.0e-5)
    state_out[i] = wp.uint8(facet.state)
