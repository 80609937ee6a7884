"""Rays against the triangulated posts, cell by cell."""

import warp as wp

from terrasim.kernels.detail import fine_at
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.ray import (
    Ray,
    cell_area,
    cell_index,
    exits,
    going_on,
    leap,
    moved_on,
    within,
)
from terrasim.kernels.ray_cell import MISSED, WAITING, Corners, Hit, corners_of, search_cell
from terrasim.kernels.ray_detail import through_detail

_COARSER = wp.constant(4)
_MISSED = wp.constant(MISSED)
_WAITING = wp.constant(WAITING)
# Beyond what an int32 holds, with as much again for detail: no ground is outside.
_MOST = wp.constant(wp.float64(4294967298.0))


@wp.struct
class Walk:
    """How rays walk."""

    level: int
    """Level they are to meet."""
    wait: int
    """1: stop at ground that is not resident. 0: take the finest resident level there."""


@wp.func
def direction_of(way: wp.vec3d) -> wp.vec3d:
    """A direction of unit length; its parts may be too large or too small to be squared."""
    largest = wp.max(wp.abs(way[0]), wp.max(wp.abs(way[1]), wp.abs(way[2])))
    return wp.normalize(wp.vec3d(way[0] / largest, way[1] / largest, way[2] / largest))


@wp.func
def ray_of(lattice: Lattice, origin: wp.vec3d, way: wp.vec3d) -> Ray:
    """A ray at its start, of any length."""
    ray = Ray()
    x = (origin[0] - lattice.x) / lattice.spacing
    y = (origin[1] - lattice.y) / lattice.spacing
    ray.col = cell_index(x)
    ray.row = cell_index(y)
    ray.u = x - wp.float64(ray.col)
    ray.v = y - wp.float64(ray.row)
    ray.height = (origin[2] - lattice.z) * wp.float64(1.0e5)
    ray.du = way[0] / lattice.spacing
    ray.dv = way[1] / lattice.spacing
    ray.dh = way[2] * wp.float64(1.0e5)
    return ray


@wp.func
def entered(lattice: Lattice, ray: Ray, max_distance: wp.float64) -> Ray:
    """The ray where it comes over the terrain, at a height that ground can have."""
    col = wp.float64(ray.col)
    row = wp.float64(ray.row)
    west = wp.float64(lattice.col) - col - ray.u
    east = wp.float64(lattice.last_col + 1) - col - ray.u
    south = wp.float64(lattice.row) - row - ray.v
    north = wp.float64(lattice.last_row + 1) - row - ray.v
    across = within(west, east, ray.du)
    along = within(south, north, ray.dv)
    upward = within(-_MOST - ray.height, _MOST - ray.height, ray.dh)
    over = ray
    over.t = wp.max(wp.max(wp.float64(0.0), upward[0]), wp.max(across[0], along[0]))
    over.end = wp.min(wp.min(max_distance, upward[1]), wp.min(across[1], along[1]))
    at_col = ray.col + int(wp.floor(ray.u + ray.du * over.t))
    at_row = ray.row + int(wp.floor(ray.v + ray.dv * over.t))
    over.at_col = wp.clamp(at_col, lattice.col, lattice.last_col)
    over.at_row = wp.clamp(at_row, lattice.row, lattice.last_row)
    return over


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
def stepped(lattice: Lattice, corners: Corners, ray: Ray) -> tuple[Ray, Hit]:
    """The ray in its next cell, or the hit in this one."""
    area = cell_area(ray, corners.level)
    leaves = exits(ray, area)
    end = wp.max(ray.t, wp.min(ray.end, wp.min(leaves[0], leaves[1])))
    hit = search_cell(lattice, corners, ray, end)
    moved = moved_on(ray, area, end, leaves)
    moved.above = hit.point[0]
    moved.known = int(hit.point[1])
    return moved, hit


@wp.func
def without_ground(state: int) -> Hit:
    """The answer of a ray that has met no ground."""
    hit = Hit()
    hit.distance = wp.float64(wp.inf)
    hit.point = wp.vec3d(wp.float64(wp.nan), wp.float64(wp.nan), wp.float64(wp.nan))
    hit.state = state
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
    ray = entered(lattice, ray_of(lattice, origins[i], direction_of(directions[i])), max_distance)
    rays_out[i] = ray
    hits_out[i] = without_ground(wp.where(ray.t <= ray.end, _WAITING, _MISSED))


@wp.kernel(enable_backward=False)
def cast(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    highest: wp.array(dtype=int),
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
    hit = without_ground(_MISSED)
    coarser = int(0)
    going = int(1)
    while going == 1:
        corners = cell_under(pool, table, lattice.levels, walk, ray)
        if corners.layer < 0:
            hit = without_ground(_WAITING)
            break
        used_out[corners.layer] = wp.uint8(1)
        coarser = wp.where(corners.level > walk.level, _COARSER, coarser)
        ahead = leap(ray, corners.level, highest[corners.layer])
        if ahead.t == ray.t:
            if corners.level == 0 and fine_at(table, lattice, ray.at_row, ray.at_col) == 1:
                ahead, hit = through_detail(pool, table, highest, lattice, corners, ray)
            else:
                ahead, hit = stepped(lattice, corners, ray)
            hit.error = wp.float64(error[corners.layer]) * wp.float64(1.0e-5)
        ray = ahead
        going = wp.where(hit.state == _MISSED and going_on(lattice, ray), 1, 0)
    rays[i] = ray
    if hit.state == _MISSED:
        hit = without_ground(_MISSED)
    if hit.state != _WAITING:
        hit.state += coarser
    hits[i] = hit
