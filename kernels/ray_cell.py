"""One cell of the surface against a ray.

Along a ray the height above a triangle is linear in the distance, so a cell is two linear pieces
that meet where the ray crosses the diagonal. The ray hits where the sign changes. The sign at the
end of a piece is carried into the next one: rounding at a shared edge cannot let a ray slip
through, and where two levels meet with a gap, the gap's wall is hit.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool, post_or_absent
from terrasim.kernels.detail import NO_GROUND, total_of
from terrasim.kernels.facet import Facet, normal_of
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.ray import Ray

MISSED = 16
"""The ray meets no ground within its length."""
FROM_BELOW = 32
"""The ground was met from below."""
WAITING = 64
"""The ray has come to ground that is not resident."""

_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_PITCH = wp.constant(256)
_MISSED = wp.constant(MISSED)
_FROM_BELOW = wp.constant(FROM_BELOW)
_IN_HOLE = wp.constant(2)
_NO_GROUND = wp.constant(wp.int64(NO_GROUND))


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
    """The four posts of a cell, of a level or of the detail; ``NO_GROUND`` where one is a hole."""

    near: wp.int64
    right: wp.int64
    left: wp.int64
    far: wp.int64
    factor: wp.float64
    """What their heights are in a count: 1, or the detail's factor."""
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
    corners.factor = wp.float64(1.0)
    corners.layer = layer_of(table, level, row >> _SHIFT, col >> _SHIFT)
    if corners.layer >= 0 and (row & _LAST) != _LAST and (col & _LAST) != _LAST:
        place = offset_in_pool(corners.layer, row, col)
        corners.near = total_of(pool[place])
        corners.right = total_of(pool[place + 1])
        corners.left = total_of(pool[place + _PITCH])
        corners.far = total_of(pool[place + _PITCH + 1])
    elif corners.layer >= 0:
        right = post_or_absent(pool, table, level, row, col + 1)
        left = post_or_absent(pool, table, level, row + 1, col)
        far = post_or_absent(pool, table, level, row + 1, col + 1)
        corners.near = total_of(pool[offset_in_pool(corners.layer, row, col)])
        corners.right = total_of(right[0])
        corners.left = total_of(left[0])
        corners.far = total_of(far[0])
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
    facet = Facet()
    facet.level = corners.level
    facet.layer = corners.layer
    if corners.near == _NO_GROUND or mid == _NO_GROUND or corners.far == _NO_GROUND:
        facet.state = _IN_HOLE
        return facet
    first = wp.float64(mid - corners.near)
    second = wp.float64(corners.far - mid)
    facet.height = wp.float64(corners.near) + (first * larger + second * smaller)
    facet.du = wp.where(right == 1, first, second)
    facet.dv = wp.where(right == 1, second, first)
    return facet


@wp.func
def crossing(corners: Corners, ray: Ray, start: wp.float64, end: wp.float64) -> wp.vec4d:
    """Where one linear piece meets the ground, and what is carried on.

    Returns:
        The distance of the hit, -1 without one; a number below 0 if it is met from below; the
        height above the ground at ``end`` [counts]; and 1 if that is known, 0 over a hole.
    """
    middle = wp.float64(0.5) * (start + end)
    first = facet_along(corners, ray, start, middle)
    hit = wp.float64(-1.0)
    if first.state != 0:
        return wp.vec4d(hit, wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    last = facet_along(corners, ray, end, middle)
    above = ray.height + ray.dh * start - first.height
    below = ray.height + ray.dh * end - last.height
    came = wp.where(ray.known == 1, ray.above, above)
    if above == wp.float64(0.0) or above * came <= wp.float64(0.0):
        hit = start
    elif above * below <= wp.float64(0.0):
        hit = wp.min(start + (end - start) * (above / (above - below)), end)
    return wp.vec4d(hit, came, below, wp.float64(1.0))


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
        lattice.z + facet.height / corners.factor * wp.float64(1.0e-5),
    )
    return hit


@wp.func
def clears(corners: Corners, ray: Ray, end: wp.float64) -> bool:
    """Whether a ray stays above all four posts from where it is to ``end``, and was above."""
    highest = wp.max(wp.max(corners.near, corners.right), wp.max(corners.left, corners.far))
    lowest = ray.height + wp.min(ray.dh * ray.t, ray.dh * end)
    return lowest > wp.float64(highest) and (ray.known == 0 or ray.above > wp.float64(0.0))


@wp.func
def search_cell(lattice: Lattice, corners: Corners, ray: Ray, end: wp.float64) -> Hit:
    """The hit within a cell up to ``end``; without one, what is carried on stands in ``point``."""
    hit = Hit()
    hit.state = _MISSED
    if clears(corners, ray, end):
        # Only the sign is carried on, and it holds at every edge that has ground.
        hit.point = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(0.0))
        return hit
    split = diagonal(corners, ray)
    first = wp.where(split > ray.t and split < end, split, end)
    found = crossing(corners, ray, ray.t, first)
    start = ray.t
    stop = first
    if found[0] < wp.float64(0.0) and first < end:
        carried = ray
        carried.above = found[2]
        carried.known = int(found[3])
        start = first
        stop = end
        found = crossing(corners, carried, start, stop)
    if found[0] < wp.float64(0.0):
        hit.point = wp.vec3d(found[2], found[3], wp.float64(0.0))
        return hit
    hit = hit_at(lattice, corners, ray, found[0], wp.float64(0.5) * (start + stop))
    hit.state = wp.where(found[1] < wp.float64(0.0), _FROM_BELOW, 0)
    return hit
