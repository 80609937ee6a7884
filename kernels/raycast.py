"""Rays against the triangulated posts, cell by cell.

Along a ray the height above a triangle is linear in the distance, so a cell is two linear pieces
that meet where the ray crosses the diagonal. The ray hits where the sign changes. The sign at the
end of a piece is carried into the next one: rounding at a shared edge cannot let a ray slip
through, and where two levels meet with a gap, the gap's wall is hit.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool
from terrasim.kernels.ray import Ray, cell_exit, cell_index, inside, moved_on, within
from terrasim.kernels.surface import Facet, Lattice, normal_of, plane_of, post_or_absent

MISSED = 16
"""The ray meets no ground within its length."""
FROM_BELOW = 32
"""The ground was met from below."""
WAITING = 64
"""The ray has come to ground that is not resident."""

_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_PITCH = wp.constant(256)
_IN_HOLE = wp.constant(2)
_COARSER = wp.constant(4)
_MISSED = wp.constant(MISSED)
_FROM_BELOW = wp.constant(FROM_BELOW)
_WAITING = wp.constant(WAITING)


@wp.struct
class Hit:
    """Where a ray meets the ground."""

    distance: wp.float64
    """Metres along the ray."""
    point: wp.vec3d
    """World place on the surface."""
    normal: wp.vec3d
    """Upward unit normal of the triangle."""
    error: wp.float64
    """Error bound of the block that was hit [m]."""
    level: int
    """Level that was hit."""
    state: int
    """Sum of ``COARSER``, ``MISSED``, ``FROM_BELOW``; ``WAITING`` while it cannot go on."""


@wp.struct
class Corners:
    """The four posts of a cell."""

    near: int
    right: int
    left: int
    far: int
    level: int
    layer: int
    """Layer of the near one; -1 where one of them is not resident."""


@wp.func
def corners_of(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), level: int, row: int, col: int
) -> Corners:
    """Posts (x-, y-), (x+, y-), (x-, y+), (x+, y+) of a level's cell."""
    corners = Corners()
    corners.level = level
    corners.layer = layer_of(table, level, row >> _SHIFT, col >> _SHIFT)
    if corners.layer >= 0 and (row & _LAST) != _LAST and (col & _LAST) != _LAST:
        place = offset_in_pool(corners.layer, row, col)
        corners.near = pool[place]
        corners.right = pool[place + 1]
        corners.left = pool[place + _PITCH]
        corners.far = pool[place + _PITCH + 1]
    elif corners.layer >= 0:
        right = post_or_absent(pool, table, level, row, col + 1)
        left = post_or_absent(pool, table, level, row + 1, col)
        far = post_or_absent(pool, table, level, row + 1, col + 1)
        corners.near = pool[offset_in_pool(corners.layer, row, col)]
        corners.right = right[0]
        corners.left = left[0]
        corners.far = far[0]
        corners.layer = wp.where(wp.min(right[1], wp.min(left[1], far[1])) < 0, -1, corners.layer)
    return corners


@wp.func
def facet_along(corners: Corners, ray: Ray, t: wp.float64, middle: wp.float64) -> Facet:
    """The plane of the triangle that the ray is over at ``middle``, evaluated at ``t``."""
    scale = wp.float64(1 << corners.level)
    col = (ray.at_col >> corners.level) << corners.level
    row = (ray.at_row >> corners.level) << corners.level
    u0 = wp.float64(ray.col - col) + ray.u
    v0 = wp.float64(ray.row - row) + ray.v
    u = (u0 + ray.du * t) / scale
    v = (v0 + ray.dv * t) / scale
    right = wp.where(u0 + ray.du * middle >= v0 + ray.dv * middle, 1, 0)
    mid = wp.where(right == 1, corners.right, corners.left)
    larger = wp.where(right == 1, u, v)
    smaller = wp.where(right == 1, v, u)
    facet = plane_of(corners.near, mid, corners.far, right, larger, smaller)
    facet.level = corners.level
    facet.layer = corners.layer
    return facet


@wp.func
def crossing(corners: Corners, ray: Ray, start: wp.float64, end: wp.float64) -> wp.vec3d:
    """Where one linear piece meets the ground, and what is carried on.

    Returns:
        The distance of the hit, -1 without one; the height above the ground at ``end`` [counts];
        and 1 if that is known, 0 over a hole.
    """
    middle = wp.float64(0.5) * (start + end)
    first = facet_along(corners, ray, start, middle)
    if first.state != 0:
        return wp.vec3d(wp.float64(-1.0), wp.float64(0.0), wp.float64(0.0))
    last = facet_along(corners, ray, end, middle)
    above = ray.height + ray.dh * start - first.height
    below = ray.height + ray.dh * end - last.height
    hit = wp.float64(-1.0)
    if above == wp.float64(0.0) or (ray.known == 1 and above * ray.above <= wp.float64(0.0)):
        hit = start
    elif above * below <= wp.float64(0.0):
        hit = wp.min(start + (end - start) * (above / (above - below)), end)
    return wp.vec3d(hit, below, wp.float64(1.0))


@wp.func
def diagonal(corners: Corners, ray: Ray) -> wp.float64:
    """Distance at which a ray crosses its cell's diagonal [m]; -1 if it runs along it."""
    if ray.du == ray.dv:
        return wp.float64(-1.0)
    col = (ray.at_col >> corners.level) << corners.level
    row = (ray.at_row >> corners.level) << corners.level
    u0 = wp.float64(ray.col - col) + ray.u
    v0 = wp.float64(ray.row - row) + ray.v
    return (v0 - u0) / (ray.du - ray.dv)


@wp.func
def hit_at(lattice: Lattice, corners: Corners, ray: Ray, t: wp.float64, middle: wp.float64) -> Hit:
    """The hit at a distance; its place lies on the surface, whatever the ray's rounding."""
    facet = facet_along(corners, ray, t, middle)
    hit = Hit()
    hit.distance = t
    hit.level = facet.level
    hit.normal = normal_of(facet, lattice.spacing)
    hit.point = wp.vec3d(
        lattice.x + (wp.float64(ray.col) + (ray.u + ray.du * t)) * lattice.spacing,
        lattice.y + (wp.float64(ray.row) + (ray.v + ray.dv * t)) * lattice.spacing,
        lattice.z + facet.height * wp.float64(1.0e-5),
    )
    return hit


@wp.struct
class Walk:
    """How rays walk."""

    level: int
    """Level they are to meet."""
    wait: int
    """1: stop at ground that is not resident. 0: take the finest resident level there."""


@wp.func
def cell_under(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), levels: int, walk: Walk, ray: Ray
) -> Corners:
    """The cell that a ray has come to, at the level it is to meet or the finest resident above."""
    level = walk.level
    corners = corners_of(pool, table, level, ray.at_row >> level, ray.at_col >> level)
    while corners.layer < 0 and walk.wait == 0 and level < levels - 1:
        level += 1
        corners = corners_of(pool, table, level, ray.at_row >> level, ray.at_col >> level)
    return corners


@wp.func
def search_cell(lattice: Lattice, corners: Corners, ray: Ray, end: wp.float64) -> Hit:
    """The hit within a cell up to ``end``; without one, what is carried on stands in ``point``."""
    split = diagonal(corners, ray)
    start = ray.t
    hit = Hit()
    hit.state = _MISSED
    known = ray.known
    above = ray.above
    for piece in range(2):
        stop = end
        if piece == 0 and split > start and split < end:
            stop = split
        if piece == 0 or (split > ray.t and split < end):
            carried = ray
            carried.known = known
            carried.above = above
            found = crossing(corners, carried, start, stop)
            if found[0] >= wp.float64(0.0) and hit.state == _MISSED:
                middle = wp.float64(0.5) * (start + stop)
                hit = hit_at(lattice, corners, ray, found[0], middle)
                upward = found[1] > wp.float64(0.0)
                if known == 1 and above != wp.float64(0.0):
                    upward = above < wp.float64(0.0)
                hit.state = wp.where(upward, _FROM_BELOW, 0)
            above = found[1]
            known = int(found[2])
        start = stop
    if hit.state == _MISSED:
        hit.point = wp.vec3d(above, wp.float64(known), wp.float64(0.0))
    return hit


@wp.kernel(enable_backward=False)
def aim(
    # Terrain:
    lattice: Lattice,
    max_distance: wp.float64,
    # In:
    origins: wp.array(dtype=wp.vec3d),
    directions: wp.array(dtype=wp.vec3d),
    # Out:
    rays_out: wp.array(dtype=Ray),
    hits_out: wp.array(dtype=Hit),
):
    i = wp.tid()
    way = wp.normalize(directions[i])
    ray = Ray()
    x = (origins[i][0] - lattice.x) / lattice.spacing
    y = (origins[i][1] - lattice.y) / lattice.spacing
    ray.col = cell_index(x)
    ray.row = cell_index(y)
    ray.u = x - wp.float64(ray.col)
    ray.v = y - wp.float64(ray.row)
    ray.height = (origins[i][2] - lattice.z) * wp.float64(1.0e5)
    ray.du = way[0] / lattice.spacing
    ray.dv = way[1] / lattice.spacing
    ray.dh = way[2] * wp.float64(1.0e5)
    across = within(ray.col, ray.u, ray.du, lattice.col, lattice.last_col + 1)
    along = within(ray.row, ray.v, ray.dv, lattice.row, lattice.last_row + 1)
    ray.t = wp.max(wp.float64(0.0), wp.max(across[0], along[0]))
    ray.end = wp.min(max_distance, wp.min(across[1], along[1]))
    col = cell_index(x + ray.du * ray.t)
    row = cell_index(y + ray.dv * ray.t)
    ray.at_col = wp.clamp(col, lattice.col, lattice.last_col)
    ray.at_row = wp.clamp(row, lattice.row, lattice.last_row)
    rays_out[i] = ray
    hit = Hit()
    hit.state = wp.where(ray.t <= ray.end, _WAITING, _MISSED)
    hit.distance = wp.float64(wp.inf)
    hits_out[i] = hit


@wp.kernel(enable_backward=False)
def cast(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    walk: Walk,
    used_out: wp.array(dtype=wp.uint8),
    # In and out:
    rays: wp.array(dtype=Ray),
    hits: wp.array(dtype=Hit),
):
    i = wp.tid()
    if hits[i].state != _WAITING:
        return
    ray = rays[i]
    hit = Hit()
    hit.state = _MISSED
    coarser = int(0)
    going = int(1)
    while going == 1:
        corners = cell_under(pool, table, lattice.levels, walk, ray)
        if corners.layer < 0:
            hit.state = _WAITING
            break
        used_out[corners.layer] = wp.uint8(1)
        coarser = wp.where(corners.level > walk.level, _COARSER, coarser)
        x = cell_exit(ray, corners.level, 0)
        y = cell_exit(ray, corners.level, 1)
        end = wp.max(ray.t, wp.min(ray.end, wp.min(x, y)))
        hit = search_cell(lattice, corners, ray, end)
        if hit.state != _MISSED:
            hit.error = wp.float64(error[corners.layer]) * wp.float64(1.0e-5)
            break
        ray.above = hit.point[0]
        ray.known = int(hit.point[1])
        ray = moved_on(ray, corners.level, end, x, y)
        going = wp.where(end < ray.end and inside(lattice, ray), 1, 0)
    rays[i] = ray
    if hit.state != _WAITING:
        hit.state += coarser
    if (hit.state & (_MISSED | _WAITING)) != 0:
        hit.distance = wp.float64(wp.inf)
        hit.point = wp.vec3d(wp.float64(wp.nan), wp.float64(wp.nan), wp.float64(wp.nan))
    hits[i] = hit
