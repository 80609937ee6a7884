"""Kernels that the tests of spin launch: its functions, each alone."""

# mypy: ignore-errors
import warp as wp

from terrasim.kernels.spin import after, course_of, in_groove, on_plane, slip_of, struck


@wp.kernel(enable_backward=False)
def lie(
    down: wp.vec3d,
    n: wp.vec3d,
    friction: wp.float64,
    rolling: wp.float64,
    dt: wp.float64,
    steps: int,
    place: wp.array(dtype=wp.vec3d),
    velocity: wp.array(dtype=wp.vec3d),
    spin: wp.array(dtype=wp.vec3d),
    met: wp.array(dtype=int),
):
    """Balls that lie on a plane, from one kind of motion to the next."""
    i = wp.tid()
    wheel = on_plane(n, wp.float64(0.1), friction, rolling)
    pull = down - n * wp.dot(down, n)
    load = -wp.dot(down, n)
    for _ in range(steps):
        left = wp.float64(dt)
        for event in range(50):
            if left > wp.float64(0.0):
                course = course_of(velocity[i], spin[i], wheel, pull, load, left)
                t = wp.min(left, course.time)
                place[i] = place[i] + velocity[i] * t + course.a * (wp.float64(0.5) * t * t)
                out = after(velocity[i], spin[i], wheel, course, t)
                velocity[i] = out.v
                spin[i] = out.w
                left -= t
                met[i] = wp.max(met[i], event + 1)


@wp.kernel(enable_backward=False)
def strike(
    n: wp.vec3d,
    restitution: wp.float64,
    friction: wp.float64,
    rolling: wp.float64,
    velocity: wp.array(dtype=wp.vec3d),
    spin: wp.array(dtype=wp.vec3d),
    slip_out: wp.array(dtype=wp.vec3d),
):
    """An impact of balls on a plane."""
    i = wp.tid()
    wheel = on_plane(n, wp.float64(0.1), friction, rolling)
    up = -restitution * wp.dot(velocity[i], n)
    out = struck(velocity[i], spin[i], wheel, up)
    velocity[i] = out.v
    spin[i] = out.w
    slip_out[i] = slip_of(out.v, out.w, wheel)


@wp.kernel(enable_backward=False)
def groove(
    way: wp.vec3d,
    up: wp.vec3d,
    rise: wp.float64,
    pull: wp.float64,
    load: wp.float64,
    friction: wp.float64,
    rolling: wp.float64,
    acceleration_out: wp.array(dtype=wp.vec3d),
):
    """The acceleration of a ball at rest in a groove."""
    wheel = in_groove(up, rise, wp.float64(0.1), friction, rolling)
    zero = wp.vec3d()
    acceleration_out[0] = course_of(zero, zero, wheel, way * pull, load, wp.float64(1.0)).a
