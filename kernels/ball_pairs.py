"""Impacts between balls: every ball sums what its neighbours do to it, all from the state before.

A ball that meets several at once is treated as if it were as many equal pieces, one for each, that
are joined again afterwards. Each piece loses energy or keeps it, and so does joining them: so the
energy never grows, however many meet. A pair is computed alike for both of its balls, so the
momentum stays. This is repeated: an impact runs through a row of balls that touch, one ball further
each time.
"""

import warp as wp

from terrasim.kernels.ball_grid import Sphere, between

# Else a sum of products could depend on which of two balls it is computed for.
wp.set_module_options({"fuse_fp": False})

TOUCH = 1e-9
"""Balls touch if they are apart by at most this part of the sum of their radii."""
ROUNDING = 1e-12
"""Balls overlap if they do by more than this part of it."""

_TOUCH = wp.constant(wp.float64(TOUCH))
_ROUNDING = wp.constant(wp.float64(ROUNDING))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_BIT = wp.constant(wp.float64(2.0**-52))


@wp.struct
class PairRule:
    """What happens when balls meet."""

    spacing: wp.float64
    """Width of a cell [m]."""
    restitution: wp.float64
    """Speed along the line of centres after an impact over that before."""
    friction: wp.float64
    """Coulomb's coefficient."""
    still: wp.float64
    """Balls that approach each other at most as fast do not bounce [m/s]."""


@wp.struct
class Contact:
    """Two balls, seen from one of them."""

    n: wp.vec3d
    """Unit vector from the ball to the other."""
    gap: wp.float64
    """Distance between their surfaces [m]."""
    sum: wp.float64
    """Sum of their radii [m]."""


@wp.func
def contact_of(
    me: Sphere, it: Sphere, shift: wp.vec3d, its_shift: wp.vec3d, spacing: wp.float64
) -> Contact:
    """Two balls that were shifted since; on one spot the lower number counts as the lower ball."""
    way = between(me, it, spacing) + (its_shift - shift)
    far = wp.length(way)
    out = Contact()
    out.sum = me.radius + it.radius
    out.gap = far - out.sum
    if far > _ZERO:
        out.n = way / far
    else:
        out.n = wp.vec3d(_ZERO, _ZERO, wp.where(me.number < it.number, _ONE, -_ONE))
    return out


@wp.func
def yields(me: Sphere, it: Sphere, mine: int, its: int) -> wp.float64:
    """How much of what two balls change falls to the first, which has that many pieces.

    A half for two equal balls that meet nothing else.
    """
    return it.mass / (wp.float64(mine) * it.mass + wp.float64(its) * me.mass)


@wp.func
def impact(closing: wp.vec3d, n: wp.vec3d, rule: PairRule) -> wp.vec3d:
    """Change of the velocity at which two balls close in, if nothing else holds them."""
    speed = wp.dot(closing, n)
    bounce = wp.where(speed > rule.still, rule.restitution, _ZERO)
    push = (_ONE + bounce) * speed
    across = closing - n * speed
    slip = wp.length(across)
    out = n * -push
    if slip > _ZERO:
        out = out - across * wp.min(_ONE, rule.friction * push / slip)
    return out


@wp.kernel(enable_backward=False)
def count_impacts(
    # In, of all, in order:
    rule: PairRule,
    sphere: wp.array(dtype=Sphere),
    near: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    velocity: wp.array(dtype=wp.vec3d),
    # Out, of all, in order:
    touching_out: wp.array(dtype=int),
    closing_out: wp.array(dtype=int),
    # In:
    at: wp.array(dtype=int),
):
    """How many balls a ball touches, and how many of them it approaches."""
    self = at[wp.tid()]
    me = sphere[self]
    touching = int(0)
    closing = int(0)
    for k in range(listed[self]):
        other = near[self, k]
        contact = contact_of(me, sphere[other], wp.vec3d(), wp.vec3d(), rule.spacing)
        if contact.gap <= _TOUCH * contact.sum:
            touching += 1
            if wp.dot(velocity[self] - velocity[other], contact.n) > _ZERO:
                closing += 1
    touching_out[self] = touching
    closing_out[self] = closing


@wp.kernel(enable_backward=False)
def bounce_balls(
    # In, of all, in order:
    rule: PairRule,
    sphere: wp.array(dtype=Sphere),
    near: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    closing: wp.array(dtype=int),
    velocity: wp.array(dtype=wp.vec3d),
    # Out, of all, in order:
    velocity_out: wp.array(dtype=wp.vec3d),
    # In:
    at: wp.array(dtype=int),
):
    """A ball's velocity after its impacts."""
    self = at[wp.tid()]
    me = sphere[self]
    v = velocity[self]
    change = wp.vec3d()
    if closing[self] > 0:
        for k in range(listed[self]):
            other = near[self, k]
            it = sphere[other]
            contact = contact_of(me, it, wp.vec3d(), wp.vec3d(), rule.spacing)
            relative = v - velocity[other]
            if contact.gap <= _TOUCH * contact.sum and wp.dot(relative, contact.n) > _ZERO:
                part = yields(me, it, closing[self], closing[other])
                change = change + impact(relative, contact.n, rule) * part
    velocity_out[self] = v + change


@wp.kernel(enable_backward=False)
def count_overlaps(
    # In, of all, in order:
    rule: PairRule,
    sphere: wp.array(dtype=Sphere),
    near: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3d),
    # Out, of all, in order:
    overlaps_out: wp.array(dtype=int),
    deepest_out: wp.array(dtype=wp.float64),
    # In:
    at: wp.array(dtype=int),
):
    """How many balls a ball overlaps, and how far at most."""
    self = at[wp.tid()]
    me = sphere[self]
    overlaps = int(0)
    deepest = wp.float64(0.0)
    for k in range(listed[self]):
        other = near[self, k]
        contact = contact_of(me, sphere[other], shift[self], shift[other], rule.spacing)
        if contact.gap < -_ROUNDING * contact.sum:
            overlaps += 1
            deepest = wp.max(deepest, -contact.gap)
    overlaps_out[self] = overlaps
    deepest_out[self] = deepest


@wp.kernel(enable_backward=False)
def push_balls(
    # In, of all, in order:
    rule: PairRule,
    sphere: wp.array(dtype=Sphere),
    near: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    overlaps: wp.array(dtype=int),
    shift: wp.array(dtype=wp.vec3d),
    # Out, of all, in order:
    shift_out: wp.array(dtype=wp.vec3d),
    # In:
    at: wp.array(dtype=int),
):
    """How far a ball has been pushed out of those it overlaps."""
    self = at[wp.tid()]
    me = sphere[self]
    change = wp.vec3d()
    if overlaps[self] > 0:
        for k in range(listed[self]):
            other = near[self, k]
            it = sphere[other]
            contact = contact_of(me, it, shift[self], shift[other], rule.spacing)
            if contact.gap < -_ROUNDING * contact.sum:
                part = yields(me, it, overlaps[self], overlaps[other])
                change = change + contact.n * (contact.gap * part)
    shift_out[self] = shift[self] + change


@wp.kernel(enable_backward=False)
def store_balls(
    # In, of all, in order:
    spacing: wp.float64,
    sphere: wp.array(dtype=Sphere),
    velocity: wp.array(dtype=wp.vec3d),
    shift: wp.array(dtype=wp.vec3d),
    # Out, by number:
    cell_out: wp.array(dtype=wp.vec2i),
    offset_out: wp.array(dtype=wp.vec2d),
    z_out: wp.array(dtype=wp.float64),
    velocity_out: wp.array(dtype=wp.vec3d),
    # In:
    at: wp.array(dtype=int),
):
    """Put a ball back; one that was not pushed keeps its place to the bit."""
    self = at[wp.tid()]
    me = sphere[self]
    velocity_out[me.number] = velocity[self]
    moved = shift[self]
    if wp.dot(moved, moved) > _ZERO:
        x = me.x + moved[0]
        y = me.y + moved[1]
        cols = wp.floor(x / spacing)
        rows = wp.floor(y / spacing)
        cell_out[me.number] = wp.vec2i(me.row + int(rows), me.col + int(cols))
        # Rounding may put a place just below a post onto the cell's far edge.
        most = spacing - spacing * _BIT
        x = wp.clamp(x - cols * spacing, _ZERO, most)
        y = wp.clamp(y - rows * spacing, _ZERO, most)
        offset_out[me.number] = wp.vec2d(x, y)
        z_out[me.number] = me.z + moved[2]
