"""Device memory of a ball."""

from __future__ import annotations

import warp as wp

from terrasim.kernels.balls import Tally
from terrasim.kernels.body import Material

BALL_BYTES: int = sum(
    wp.types.type_size_in_bytes(dtype)
    for dtype in (wp.vec2i, wp.vec2d, wp.float64, wp.vec3d, Material, Tally)
)
"""Bytes of the arrays of :class:`terrasim.balls.balls.Balls`, a ball."""

SPIN_BYTES: int = sum(wp.types.type_size_in_bytes(dtype) for dtype in (wp.vec3d, wp.float64))
"""Bytes of spin and rolling friction, a ball that has them."""

MASS_BYTES: int = wp.types.type_size_in_bytes(wp.float64)
"""Bytes of the mass, a ball that has one."""

SPRING_BYTES: int = wp.types.type_size_in_bytes(wp.vec2d)
"""Bytes of stiffness and damping, a ball on springs."""

RISE_BYTES: int = 6 * 8 + 8
"""Bytes of ``kernels.rise.Rise`` and of the ground's rate, a ball, in steps whose ground moves."""
