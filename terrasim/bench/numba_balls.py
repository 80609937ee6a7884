"""The work of a step of balls as a serial numba loop: what a good CPU programmer would write.

It reads the same pool through the same tables and walks each ball from event to event by the same
rules, on ground without detail and all of it resident. Its balls end where ours do, to rounding.
"""

from __future__ import annotations

from typing import Any

EVENTS, PIT_EVENTS = 24, 6
TOUCH, STILL, NEVER = 1e-9, 1e-12, 1e300
BIT = 2.0**-52


def _ground() -> Any:
    """Compile the look-up of a triangle's plane."""
    from numba import njit

    from terrasim.bench.numba_loop import post_reader

    layer_of, post = post_reader()

    @njit
    def plane_of(pool, table, place, row, col, side):  # type: ignore[no-untyped-def]
        """Height at the cell's post and rises [counts], slopes, normal's length, layer, hole."""
        spacing, row0, col0, last_row, last_col = place
        r, c = min(max(row, row0), last_row), min(max(col, col0), last_col)
        right = 1 if side > 0 else 0
        layer = layer_of(table, r >> 8, c >> 8)
        if layer < 0 or (r & 255) == 255 or (c & 255) == 255:
            near, _ = post(pool, table, r, c)
            mid, _ = post(pool, table, r + 1 - right, c + right)
            far, _ = post(pool, table, r + 1, c + 1)
        else:
            at = (layer << 16) + ((r & 255) << 8) + (c & 255)
            near = pool[at]
            mid = pool[at + (1 if right else 256)]
            far = pool[at + 257]
        if near == -2147483648 or mid == -2147483648 or far == -2147483648:
            return 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, layer, True
        first, second = float(mid - near), float(far - mid)
        du = first if right else second
        dv = second if right else first
        height = float(near)
        if col != c:
            height += du if col > c else 0.0
            du = 0.0
        if row != r:
            height += dv if row > r else 0.0
            dv = 0.0
        rise = 1e-5 / spacing
        sx, sy = du * rise, dv * rise
        return height, du, dv, sx, sy, (1.0 + sx * sx + sy * sy) ** 0.5, layer, False

    return plane_of


def _response() -> tuple[Any, ...]:
    """Compile what happens on a plane and when the next event comes."""
    from numba import njit

    @njit
    def first_zero(q, rate, a):  # type: ignore[no-untyped-def]
        square = rate * rate - 2.0 * a * q
        if square < 0.0:
            return NEVER
        root = square**0.5
        if rate > 0.0:
            return (rate + root) / -a if a < 0.0 else NEVER
        if root - rate > 0.0:
            return 2.0 * q / (root - rate)
        return 0.0 if a < 0.0 else NEVER

    @njit
    def rest_of(plane, x, y, radius, spacing):  # type: ignore[no-untyped-def]
        counts = plane[0] + (plane[1] * (x / spacing) + plane[2] * (y / spacing))
        return counts * 1e-5 + radius * plane[5]

    @njit
    def strike(plane, vx, vy, vz, e, mu, half):  # type: ignore[no-untyped-def]
        length = plane[5]
        nx, ny, nz = -plane[3] / length, -plane[4] / length, 1.0 / length
        down = vx * nx + vy * ny + vz * nz
        up = -e * down
        if up < half / length:
            up = 0.0
        ax, ay, az = vx - nx * down, vy - ny * down, vz - nz * down
        speed = (ax * ax + ay * ay + az * az) ** 0.5
        keep = max(0.0, 1.0 - mu * (up - down) / speed) if speed > 0.0 else 1.0
        return ax * keep + nx * up, ay * keep + ny * up, az * keep + nz * up

    @njit
    def slide(px, py, pz, most, vx, vy, vz):  # type: ignore[no-untyped-def]
        strength = (px * px + py * py + pz * pz) ** 0.5
        sticks = strength <= most
        speed = (vx * vx + vy * vy + vz * vz) ** 0.5
        if speed > 0.0:
            drag = most / speed
            ax, ay, az = px - vx * drag, py - vy * drag, pz - vz * drag
            braking = -(ax * vx + ay * vy + az * vz)
            return ax, ay, az, speed * speed / braking if braking > 0.0 else NEVER, sticks
        if not sticks:
            part = 1.0 - most / strength
            return px * part, py * part, pz * part, NEVER, sticks
        return 0.0, 0.0, 0.0, NEVER, sticks

    @njit
    def leave(side, rail, x, y, vx, vy, ax, ay, spacing):  # type: ignore[no-untyped-def]
        time, edge = NEVER, -1
        if rail != 0:
            q = spacing - x if side > 0 else x
            time, edge = first_zero(q, -side * vx, -side * ax), 0
        if rail != 1:
            q = y if side > 0 else spacing - y
            other = first_zero(q, side * vy, side * ay)
            if other < time:
                time, edge = other, 1
        if rail != 2:
            other = first_zero(max(0.0, side * (x - y)), side * (vx - vy), side * (ax - ay))
            if other < time:
                time, edge = other, 2
        return time, edge

    return first_zero, rest_of, strike, slide, leave


def balls_loop() -> Any:
    """Compile the loop.

    Returns:
        ``loop(pool, table, place, dt, gravity, material, cell, offset, z, velocity, tally)`` with
        ``place`` as (spacing, row, col, last row, last col) of the cells, ``material`` as (radius,
        restitution, friction) a ball and ``tally`` as (impacts, lifts, held) a ball.
    """
    from numba import njit

    plane_of = _ground()
    first_zero, rest_of, strike, slide, leave = _response()

    @njit
    def rail_way(plane, edge):  # type: ignore[no-untyped-def]
        x, y = 0.0 if edge == 0 else 1.0, 0.0 if edge == 1 else 1.0
        z = x * plane[3] + y * plane[4]
        length = (x * x + y * y + z * z) ** 0.5
        return x / length, y / length, z / length

    # One loop, as one would write it: over the usual length for that.
    @njit
    def loop(  # type: ignore[no-untyped-def]
        pool, table, place, dt, gravity, material, cell, offset, z, velocity, tally
    ):
        spacing = place[0]
        half = 0.5 * gravity * dt
        for i in range(len(z)):
            radius, e, mu = material[i, 0], material[i, 1], material[i, 2]
            row, col = cell[i, 0], cell[i, 1]
            x, y, h = offset[i, 0], offset[i, 1], z[i]
            vx, vy, vz = velocity[i, 0], velocity[i, 1], velocity[i, 2]
            side = 1 if x >= y else -1
            left, rail, press = dt, -1, 0.0
            impacts, lifts = 0, 0
            plane = plane_of(pool, table, place, row, col, side)
            rest = rest_of(plane, x, y, radius, spacing)
            if not plane[7] and h < rest:
                lifts += 1 if rest - h > TOUCH else 0
                h = rest
            speed = (vx * vx + vy * vy + vz * vz) ** 0.5
            most = EVENTS + int(min(6.0 * (speed + gravity * dt) * dt / spacing, 1e6))
            events = 0
            while left > 0.0 and events < most:
                events += 1
                lies = False
                rest = rest_of(plane, x, y, radius, spacing)
                if not plane[7] and h - rest <= TOUCH:
                    rate = vz - (plane[3] * vx + plane[4] * vy)
                    if rate < -TOUCH:
                        impacts += 1 if -rate > half * plane[5] else 0
                        vx, vy, vz = strike(plane, vx, vy, vz, e, mu, half)
                        rate = vz - (plane[3] * vx + plane[4] * vy)
                    if rate <= TOUCH:
                        lies, h = True, rest
                        part = rate / (plane[5] * plane[5])
                        vx, vy, vz = vx + plane[3] * part, vy + plane[4] * part, vz - part
                sticks, until = False, NEVER
                ax, ay, az = 0.0, 0.0, -gravity
                if rail >= 0:
                    wx, wy, wz = rail_way(plane, rail)
                    pull = -gravity * wz
                    ax, ay, az, until, sticks = slide(
                        wx * pull, wy * pull, wz * pull, mu * press, vx, vy, vz
                    )
                elif lies:
                    n = 1.0 / plane[5]
                    ax, ay, az, until, sticks = slide(
                        -plane[3] * n * n * gravity,
                        -plane[4] * n * n * gravity,
                        (n * n - 1.0) * gravity,
                        mu * gravity * n,
                        vx, vy, vz,
                    )  # fmt: skip
                elif not plane[7]:
                    rate = vz - (plane[3] * vx + plane[4] * vy)
                    until = first_zero(max(0.0, h - rest), rate, -gravity)
                time, edge = leave(side, rail, x, y, vx, vy, ax, ay, spacing)
                t = min(left, until, time)
                x = min(max(x + (vx * t + 0.5 * ax * t * t), 0.0), spacing)
                y = min(max(y + (vy * t + 0.5 * ay * t * t), 0.0), spacing)
                h += vz * t + 0.5 * az * t * t
                vx, vy, vz = vx + ax * t, vy + ay * t, vz + az * t
                left -= t
                slow = vx * vx + vy * vy + vz * vz
                if lies and until <= t and (sticks or slow < STILL * STILL):
                    vx = vy = vz = 0.0
                if time <= t:
                    # The triangle beyond the edge.
                    row2, col2, x2, y2 = row, col, x, y
                    if edge == 0:
                        col2 = col + side
                        x2 = 0.0 if side > 0 else spacing
                    elif edge == 1:
                        row2 = row - side
                        y2 = spacing if side > 0 else 0.0
                    there = plane_of(pool, table, place, row2, col2, -side)
                    lift = rest_of(there, x2, y2, radius, spacing) - h
                    across = vx if edge == 0 else (-vy if edge == 1 else vy - vx)
                    out = side * across
                    goes = there[7] or lift <= TOUCH
                    a, b = plane[5], there[5]
                    both = (1.0 + plane[3] * there[3] + plane[4] * there[4]) / (a * b)
                    if (
                        not there[7] and lift >= -TOUCH and lies and out <= half
                        and 1.0 / b - both / a > STILL and 1.0 / a - both / b > STILL
                    ):  # fmt: skip
                        wx, wy, wz = rail_way(plane, edge)
                        pace = wx * vx + wy * vy + wz * vz
                        vx, vy, vz = wx * pace, wy * pace, wz * pace
                        rail = edge
                        press = gravity * (1.0 / a + 1.0 / b) / (1.0 + both)
                        goes = False
                    elif not goes:
                        rail = -1
                        rate = vz - (there[3] * vx + there[4] * vy)
                        if plane[7] and lift > radius * there[5]:
                            vx, vy = -e * vx, -e * vy
                            impacts += 1
                        else:
                            if rate < 0.0:
                                impacts += 1 if -rate > half * there[5] else 0
                                vx, vy, vz = strike(there, vx, vy, vz, e, mu, half)
                            across = vx if edge == 0 else (-vy if edge == 1 else vy - vx)
                            if side * across > 0.0:
                                square = vx * vx + vy * vy + vz * vz
                                spare = square - 2.0 * gravity * lift
                                if spare < 0.0:
                                    vx, vy, vz = -e * vx, -e * vy, -e * vz
                                else:
                                    part = (spare / square) ** 0.5
                                    vx, vy, vz = vx * part, vy * part, vz * part
                                    h += lift
                                    lifts += 1
                                    goes = True
                    if goes:
                        row, col, x, y, side, rail = row2, col2, x2, y2, -side, -1
                        plane = there
                slow = vx * vx + vy * vy + vz * vz <= half * half
                if left > 0.0 and most - events <= EVENTS - PIT_EVENTS and slow:
                    vx = vy = vz = 0.0
                    left = 0.0
            rest = rest_of(plane, x, y, radius, spacing)
            if not plane[7] and h < rest:
                lifts += 1 if rest - h > TOUCH else 0
                h = rest
            if left > 0.0:
                vx = vy = vz = 0.0
                tally[i, 2] += 1
            bit = spacing * BIT
            x, y = min(x, spacing - bit), min(y, spacing - bit)
            if side > 0 and x < y:
                y = x
            if side < 0 and x >= y:
                if y > bit:
                    x = y - bit
                else:
                    y = x + bit
            tally[i, 0] += impacts
            tally[i, 1] += lifts
            cell[i, 0], cell[i, 1] = row, col
            offset[i, 0], offset[i, 1], z[i] = x, y, h
            velocity[i, 0], velocity[i, 1], velocity[i, 2] = vx, vy, vz

    return loop
