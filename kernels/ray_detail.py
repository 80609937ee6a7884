"""A ray through the detail of one level-0 cell.

Within the cell the ray is told in detail cells from the cell's (x-, y-) post and in counts divided
by the factor, and walks as over cells of any level. It comes in and goes out with the same distance
and the same sign of its height above the ground as between any two cells, so a seam between ground
with detail and without lets nothing through. Where a whole detail block is zero, or the ray passes
above all of it, it is crossed at once.
"""

import warp as wp

from terrasim.kernels.detail import NO_GROUND, detail_at, detail_layer, weighed
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.ray import Area, Ray, cell_area, exits, moved_on
from terrasim.kernels.ray_cell import MISSED, Corners, Hit, search_cell

_BLOCK_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_MISSED = wp.constant(MISSED)
_NO_GROUND = wp.constant(wp.int64(NO_GROUND))


@wp.func
def fine_ray(lattice: Lattice, ray: Ray) -> Ray:
    """A ray in the detail cells of the level-0 cell it has come to."""
    scale = wp.float64(lattice.factor)
    fine = ray
    fine.row = 0
    fine.col = 0
    fine.u = (wp.float64(ray.col - ray.at_col) + ray.u) * scale
    fine.v = (wp.float64(ray.row - ray.at_row) + ray.v) * scale
    fine.height = ray.height * scale
    fine.du = ray.du * scale
    fine.dv = ray.dv * scale
    fine.dh = ray.dh * scale
    col = wp.clamp(wp.floor(fine.u + fine.du * ray.t), wp.float64(0.0), scale - wp.float64(1.0))
    row = wp.clamp(wp.floor(fine.v + fine.dv * ray.t), wp.float64(0.0), scale - wp.float64(1.0))
    fine.at_col = int(col)
    fine.at_row = int(row)
    return fine


@wp.func
def total(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    cell: Corners,
    row: int,
    col: int,
    i: int,
    j: int,
) -> wp.int64:
    """Base and detail at a detail post of a cell [counts / factor]; ``NO_GROUND`` in a hole.

    ``row`` and ``col`` are those of the detail post that the cell's (x-, y-) post is.
    """
    mid = wp.where(j >= i, cell.right, cell.left)
    base = weighed(lattice.factor, cell.near, mid, cell.far, wp.max(i, j), wp.min(i, j))
    if base == _NO_GROUND:
        return base
    return base + wp.int64(detail_at(pool, table, lattice, row + i, col + j))


@wp.func
def fine_corners(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    cell: Corners,
    row: int,
    col: int,
    fine: Ray,
) -> Corners:
    """The posts of the detail cell that a ray has come to."""
    i = fine.at_row
    j = fine.at_col
    corners = cell
    corners.factor = wp.float64(lattice.factor)
    corners.near = total(pool, table, lattice, cell, row, col, i, j)
    corners.right = total(pool, table, lattice, cell, row, col, i, j + 1)
    corners.left = total(pool, table, lattice, cell, row, col, i + 1, j)
    corners.far = total(pool, table, lattice, cell, row, col, i + 1, j + 1)
    return corners


@wp.func
def within_block(lattice: Lattice, row: int, col: int, fine: Ray) -> Area:
    """The detail cells of the level-0 cell with all posts in the detail block that a ray is over.

    Empty if the ray's own detail cell has posts in others.
    """
    area = Area()
    first_row = (((row + fine.at_row) >> _BLOCK_SHIFT) << _BLOCK_SHIFT) - row
    first_col = (((col + fine.at_col) >> _BLOCK_SHIFT) << _BLOCK_SHIFT) - col
    area.row0 = wp.max(0, first_row)
    area.col0 = wp.max(0, first_col)
    area.row1 = wp.min(lattice.factor, first_row + _LAST)
    area.col1 = wp.min(lattice.factor, first_col + _LAST)
    return area


@wp.func
def above_all(lattice: Lattice, cell: Corners, highest: int, fine: Ray, end: wp.float64) -> bool:
    """Whether a ray was and stays above all that a cell's posts and a detail block can reach."""
    post = wp.max(wp.max(cell.near, cell.right), wp.max(cell.left, cell.far))
    if post == _NO_GROUND:
        return False
    top = wp.float64(post) * wp.float64(lattice.factor) + wp.float64(wp.max(0, highest))
    lowest = fine.height + wp.min(fine.dh * fine.t, fine.dh * end)
    return lowest > top and (fine.known == 0 or fine.above > wp.float64(0.0))


@wp.func
def came_to(fine: Ray, area: Area, end: wp.float64, leaves: wp.vec2d, hit: Hit) -> Ray:
    """A ray after it searched an area to ``end``; what it carries on stands in ``hit``."""
    moved = moved_on(fine, area, end, leaves)
    moved.above = hit.point[0]
    moved.known = int(hit.point[1])
    return moved


@wp.func
def over_block(
    table: wp.array(dtype=int),
    highest: wp.array(dtype=int),
    lattice: Lattice,
    cell: Corners,
    row: int,
    col: int,
    ray: Ray,
    fine: Ray,
) -> tuple[Ray, Hit]:
    """The ray beyond its detail block if that is zero or far below, as it is if it is not.

    Over a block of zeros the surface is the level-0 cell's own.
    """
    area = within_block(lattice, row, col, fine)
    hit = Hit()
    hit.state = _MISSED
    moved = fine
    if fine.at_row >= area.row1 or fine.at_col >= area.col1:
        return moved, hit
    leaves = exits(fine, area)
    end = wp.max(fine.t, wp.min(fine.end, wp.min(leaves[0], leaves[1])))
    block_row = (row + fine.at_row) >> _BLOCK_SHIFT
    layer = detail_layer(table, lattice, block_row, (col + fine.at_col) >> _BLOCK_SHIFT)
    if layer < 0:
        along = ray
        along.t = fine.t
        along.above = fine.above
        along.known = fine.known
        hit = search_cell(lattice, cell, along, end)
        moved = came_to(fine, area, end, leaves, hit)
    elif above_all(lattice, cell, highest[layer], fine, end):
        hit.point = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(0.0))
        moved = came_to(fine, area, end, leaves, hit)
    return moved, hit


@wp.func
def over_cell(lattice: Lattice, corners: Corners, ray: Ray, fine: Ray) -> tuple[Ray, Hit]:
    """The ray in its next detail cell, or the hit in this one."""
    area = cell_area(fine, 0)
    leaves = exits(fine, area)
    end = wp.max(fine.t, wp.min(fine.end, wp.min(leaves[0], leaves[1])))
    hit = search_cell(lattice, corners, fine, end)
    moved = came_to(fine, area, end, leaves, hit)
    if hit.state != _MISSED:
        # Its height is the detail cell's; its place is told from where the ray started.
        hit.point[0] = lattice.x + place_of(ray.col, ray.u, ray.du, hit.distance) * lattice.spacing
        hit.point[1] = lattice.y + place_of(ray.row, ray.v, ray.dv, hit.distance) * lattice.spacing
    return moved, hit


@wp.func
def place_of(start: int, offset: wp.float64, speed: wp.float64, t: wp.float64) -> wp.float64:
    """Place of a ray along an axis [level-0 posts]."""
    return wp.float64(start) + (offset + speed * t)


@wp.func
def beyond_cell(index: int, factor: int) -> int:
    """To which neighbour of a level-0 cell a detail index within it leads: -1, 0 or 1."""
    return wp.where(index < 0, -1, wp.where(index >= factor, 1, 0))


@wp.func
def through_detail(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    highest: wp.array(dtype=int),
    lattice: Lattice,
    cell: Corners,
    ray: Ray,
) -> tuple[Ray, Hit]:
    """The ray in the level-0 cell after this one, or the hit in this one."""
    row = (ray.at_row - lattice.row0) * lattice.factor
    col = (ray.at_col - lattice.col0) * lattice.factor
    fine = fine_ray(lattice, ray)
    hit = Hit()
    going = int(1)
    while going == 1:
        ahead, hit = over_block(table, highest, lattice, cell, row, col, ray, fine)
        stays = ahead.at_row == fine.at_row and ahead.at_col == fine.at_col and ahead.t == fine.t
        if hit.state == _MISSED and stays:
            corners = fine_corners(pool, table, lattice, cell, row, col, fine)
            ahead, hit = over_cell(lattice, corners, ray, fine)
        fine = ahead
        inside = beyond_cell(fine.at_row, lattice.factor) == 0
        if beyond_cell(fine.at_col, lattice.factor) != 0:
            inside = False
        going = wp.where(hit.state == _MISSED and inside and fine.t < fine.end, 1, 0)
    moved = ray
    moved.t = fine.t
    moved.above = fine.above
    moved.known = fine.known
    moved.at_row = ray.at_row + beyond_cell(fine.at_row, lattice.factor)
    moved.at_col = ray.at_col + beyond_cell(fine.at_col, lattice.factor)
    return moved, hit
