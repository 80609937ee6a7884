"""The formula of each stamp, written down again in NumPy, and the kernel's own to compare."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.deform.stamps import (
    Berm,
    ConeStamp,
    Crater,
    Flatten,
    Gaussian,
    HalfCosine,
    HeightImage,
    Noise,
    Paraboloid,
    SphericalCap,
    Stamp,
    Texture,
    Trench,
)
from terrasim.kernels.shapes import shape_at

Floats = npt.NDArray[np.float64]
Formula = Callable[[Floats, Floats], tuple[Floats, Floats]]


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def evaluate(
    kind: int,
    shape: wp.array(dtype=wp.float64),  # type: ignore[valid-type]
    data: wp.array(dtype=wp.float64),  # type: ignore[valid-type]
    first: int,
    count: int,
    places: wp.array(dtype=wp.vec2d),  # type: ignore[valid-type]
    shape_out: wp.array(dtype=wp.vec2d),  # type: ignore[valid-type]
) -> None:
    i = wp.tid()
    at = places[i]
    shape_out[i] = shape_at(
        kind, shape[0], shape[1], shape[2], shape[3], data, first, count, at[0], at[1]
    )


def kernel_at(stamp: Stamp, dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
    """Heights [m] and weights from the kernel's own function; its data lie behind others'."""
    before = np.full(7, np.nan)
    places: Any = wp.array(np.stack((dx.ravel(), dy.ravel()), axis=1), dtype=wp.vec2d, device="cpu")
    out = wp.zeros(places.shape[0], dtype=wp.vec2d, device="cpu")
    data: Any = wp.array(np.concatenate((before, stamp.data)), dtype=wp.float64, device="cpu")
    shape: Any = wp.array(stamp.shape, dtype=wp.float64, device="cpu")
    wp.launch(
        evaluate,
        dim=places.shape[0],
        inputs=[
            stamp.kind,
            shape,
            data,
            7,
            len(stamp.data),
            places,
            out,
        ],
        device="cpu",
    )
    found = out.numpy()
    return found[:, 0].reshape(dx.shape), found[:, 1].reshape(dx.shape)


def lattice(stamp: Stamp, count: int = 61) -> tuple[Floats, Floats]:
    """Places over a stamp's extent and a tenth beyond."""
    west, south, east, north = stamp.extent
    more = 0.1 * max(east - west, north - south)
    x = np.linspace(west - more, east + more, count)
    y = np.linspace(south - more, north + more, count)
    dx, dy = np.meshgrid(x, y)
    return dx, dy


def mound(height: float, profile: Callable[[Floats], Floats], end: float) -> Formula:
    """A round stamp from its profile, 1 in the middle."""

    def formula(dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        r = np.hypot(dx, dy)
        weight = np.where(r < end, profile(np.minimum(r, end)), 0.0)
        return height * weight, weight

    return formula


def crater(radius: float, depth: float, rim: float) -> Formula:
    def formula(dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        s = np.hypot(dx, dy) / radius
        t = (np.maximum(s, 1.0) ** -3.0 - 1 / 27) / (26 / 27)
        out = (s >= 3.0) | ((s > 1.0) & (rim == 0.0))
        height = np.where(s <= 1.0, (depth + rim) * s**2 - depth, rim * t)
        return np.where(out, 0.0, height), np.where(out, 0.0, np.where(s <= 1.0, 1.0, t))

    return formula


def distance(points: Sequence[tuple[float, float]], z: Any, *, flat: bool = False) -> Floats:
    """From places, as complex numbers, to a polyline: each piece turned onto the real axis."""
    found = np.full(z.shape, np.inf)
    line = [complex(*point) for point in points]
    for i, (a, b) in enumerate(pairwise(line)):
        w = (z - a) / (b - a)
        one = np.where(w.real < 0.0, np.abs(z - a), np.abs(z - b))
        one = np.where((w.real >= 0.0) & (w.real <= 1.0), np.abs(w.imag) * abs(b - a), one)
        before = flat and i == 0
        after = flat and i == len(line) - 2
        one[(before & (w.real < 0.0)) | (after & (w.real > 1.0))] = np.inf
        found = np.minimum(found, one)
    return found


def swept(
    points: Sequence[tuple[float, float]],
    profile: Callable[[Floats], Floats],
    height: float,
    half: float,
    *,
    flat: bool = False,
) -> Formula:
    """A profile, 1 in the middle, along a polyline."""

    def formula(dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        s = distance(points, dx + 1j * dy, flat=flat)
        weight = np.where(s < half, profile(np.minimum(s, half)), 0.0)
        return height * weight, weight

    return formula


def window(half_x: float, half_y: float, degrees: float, fade: float) -> Callable[..., Floats]:
    """Weight of a turned rectangle that fades: the distance to it, by cases."""

    def weight(dx: Floats, dy: Floats) -> Floats:
        place = (dx + 1j * dy) * np.exp(-1j * np.radians(degrees))
        u, v = np.abs(place.real) - half_x, np.abs(place.imag) - half_y
        beyond = np.where(u <= 0.0, v, np.where(v <= 0.0, u, np.abs(u + 1j * v)))
        t = np.clip(1.0 - beyond / fade, 0.0, 1.0)
        smooth: Floats = 3.0 * t**2 - 2.0 * t**3
        return smooth

    return weight


def plane(slope_x: float, slope_y: float, weight: Callable[..., Floats]) -> Formula:
    return lambda dx, dy: (slope_x * dx + slope_y * dy, weight(dx, dy))


def mixed(bits: int) -> int:
    """SplitMix64's finisher in whole numbers of any size."""
    bits = (bits ^ (bits >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    bits = (bits ^ (bits >> 27)) * 0x94D049BB133111EB % 2**64
    return bits ^ (bits >> 31)


def perlin(seed: int, octaves: int, gain: float, u: float, v: float) -> float:
    """Gradient noise of one place, as Perlin (2002) has it, the gradients hashed."""
    golden, total = 0x9E3779B97F4A7C15, 0.0
    for k in range(octaves):
        key = mixed((seed + (k + 1) * golden) % 2**64)
        x, y = u * 2.0**k, v * 2.0**k
        for i in (math.floor(x), math.floor(x) + 1):
            for j in (math.floor(y), math.floor(y) + 1):
                node = mixed((mixed((key + i * golden) % 2**64) + j * golden) % 2**64)
                slopes = [(half / 2**31) - 1.0 for half in (node >> 32, node % 2**32)]
                near = [1.0 - abs(x - i), 1.0 - abs(y - j)]
                blend = math.prod(6 * t**5 - 15 * t**4 + 10 * t**3 for t in near)
                total += gain**k * blend * (slopes[0] * (x - i) + slopes[1] * (y - j))
    return total / sum(gain**k for k in range(octaves))


def noise(stamp: Noise, weight: Callable[..., Floats]) -> Formula:
    def formula(dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        places = zip(dx.ravel().tolist(), dy.ravel().tolist(), strict=True)
        length, of = stamp.wavelength, (stamp.seed, stamp.octaves, stamp.gain)
        raw = [perlin(*of, (stamp.x + x) / length, (stamp.y + y) / length) for x, y in places]
        height = stamp.amplitude * np.array(raw).reshape(dx.shape)
        w = weight(dx, dy)
        return np.where(w > 0.0, height * (w if stamp.mode == "add" else 1.0), 0.0), w

    return formula


def picture(stamp: Texture) -> Formula:
    """Bilinear by two passes of linear interpolation, rows from the north."""

    def bilinear(samples: Floats, u: Floats, v: Floats) -> Floats:
        rows, cols = samples.shape
        found = []
        for x, y in zip(u.ravel(), v.ravel(), strict=True):
            column = [float(np.interp(x, np.linspace(0, 1, cols), row)) for row in samples]
            found.append(float(np.interp(1.0 - y, np.linspace(0, 1, rows), column)))
        return np.array(found).reshape(u.shape)

    def formula(dx: Floats, dy: Floats) -> tuple[Floats, Floats]:
        place = (dx + 1j * dy) * np.exp(-1j * np.radians(stamp.turn_deg))
        u, v = place.real / stamp.size_x + 0.5, place.imag / stamp.size_y + 0.5
        inside = (np.abs(u - 0.5) <= 0.5) & (np.abs(v - 0.5) <= 0.5)
        metres = stamp.intensity * (stamp.offset + stamp.scale * stamp.image.samples)
        weight = np.ones_like(u)
        if stamp.image.weights is not None:
            weight = bilinear(stamp.image.weights, u, v)
        height = bilinear(metres, u, v) * (weight if stamp.mode == "add" else 1.0)
        return np.where(inside, height, 0.0), np.where(inside, weight, 0.0)

    return formula


BEND = [(-3.0, -2.0), (2.0, -1.0), (1.0, 3.0)]
SPHERE = (3.0**2 + 1.5**2) / (2 * 1.5)
ARC = (2.0**2 + 0.5**2) / (2 * 0.5)

WANDERING = [
    (float(x), float(y))
    for x, y in np.random.default_rng(0).normal(0.0, 2.0, (300, 2)).cumsum(axis=0)
]
ROUGH = Noise(
    71.3,
    -40.1,
    2.0,
    1.7,
    seed=2**63 - 5,
    octaves=3,
    gain=0.6,
    size_x=6.0,
    size_y=4.0,
    turn_deg=90.0,
    fade=1.0,
)
ROUGH_AT_Z = replace(ROUGH, mode="blend", z=5.0)
_random = np.random.default_rng(8)
SAMPLES = _random.uniform(-1.0, 1.0, (5, 4))
PICTURE = Texture(
    0.0,
    0.0,
    HeightImage(SAMPLES),
    6.0,
    4.0,
    turn_deg=20.0,
    scale=2.0,
    offset=0.5,
    intensity=-0.7,
)
MASKED = replace(PICTURE, image=HeightImage(SAMPLES, _random.uniform(0.0, 1.0, (5, 4))))
MASKED_AT_Z = replace(MASKED, mode="fill", z=5.0)


def shrunk(dx: Floats, dy: Floats, by: float) -> tuple[Floats, Floats]:
    """Places moved towards the middle."""
    r = np.hypot(dx, dy)
    part = np.maximum(0.0, r - by) / np.maximum(r, 1e-300)
    return dx * part, dy * part


FORMULAS: list[tuple[Stamp, Formula, float]] = [
    (
        Gaussian(0.0, 0.0, 2.0, 1.5),
        mound(2.0, lambda r: np.exp(-(r**2) / 4.5), 1.5 * math.sqrt(2 * math.log(4e5))),
        1e-15,
    ),
    (
        Gaussian(0.0, 0.0, -2.0, 1.5, mode="blend", z=3.0),
        mound(-2.0, lambda r: np.exp(-(r**2) / 4.5), 1.5 * math.sqrt(2 * math.log(1e9))),
        1e-15,
    ),
    (ConeStamp(0.0, 0.0, 3.0, 1.5), mound(1.5, lambda r: 1 - r / 3, 3.0), 1e-15),
    (Paraboloid(0.0, 0.0, 3.0, -1.5), mound(-1.5, lambda r: 1 - (r / 3) ** 2, 3.0), 1e-15),
    (
        SphericalCap(0.0, 0.0, 3.0, 1.5),
        mound(1.5, lambda r: (np.sqrt(SPHERE**2 - r**2) - SPHERE + 1.5) / 1.5, 3.0),
        1e-14,
    ),
    (
        HalfCosine(0.0, 0.0, 3.0, 1.5),
        mound(1.5, lambda r: 0.5 * (1 + np.cos(np.pi * r / 3)), 3.0),
        1e-15,
    ),
    (Crater(0.0, 0.0, 2.0, 1.0, 0.4), crater(2.0, 1.0, 0.4), 1e-15),
    (Crater(0.0, 0.0, 2.0, 1.0), crater(2.0, 1.0, 0.0), 1e-15),
    (Crater(0.0, 0.0, 2.0, 1.0, balanced=True), crater(2.0, 1.0, 13 / 41), 1e-15),
    (Trench(0.0, 0.0, BEND, 4.0, 0.5), swept(BEND, lambda s: 1 - s / 2, -0.5, 2.0), 1e-15),
    (
        Trench(0.0, 0.0, BEND, 4.0, 0.5, section="round", ends="flat"),
        swept(BEND, lambda s: (np.sqrt(ARC**2 - s**2) - ARC + 0.5) / 0.5, -0.5, 2.0, flat=True),
        1e-14,
    ),
    (
        Berm(0.0, 0.0, BEND, 4.0, 0.5, section="box", side=0.75),
        swept(BEND, lambda s: np.minimum(1.0, (2.0 - s) / 0.75), 0.5, 2.0),
        1e-15,
    ),
    # Where it ends it began: nothing is cut off there.
    (
        Berm(0.0, 0.0, [*BEND, BEND[0]], 1.0, 0.5, section="box", side=0.2, ends="flat"),
        swept([*BEND, BEND[0]], lambda s: np.minimum(1.0, (0.5 - s) / 0.2), 0.5, 0.5),
        1e-14,
    ),
    (
        Berm(0.0, 0.0, WANDERING, 6.0, 2.0),
        swept(WANDERING, lambda s: 1 - s / 3, 2.0, 3.0),
        1e-14,
    ),
    (
        Flatten(0.0, 0.0, size_x=4.0, size_y=2.0, turn_deg=30.0, fade=1.5, z=7.0, slope_x=0.1),
        plane(0.1, 0.0, window(2.0, 1.0, 30.0, 1.5)),
        1e-14,
    ),
    (
        Flatten(0.0, 0.0, radius=3.0, fade=1.5, z=7.0, slope_y=-0.3, mode="dig"),
        plane(0.0, -0.3, lambda dx, dy: window(0.0, 0.0, 0.0, 1.5)(*shrunk(dx, dy, 3.0))),
        1e-14,
    ),
    (ROUGH, noise(ROUGH, window(3.0, 2.0, 90.0, 1.0)), 1e-12),
    (ROUGH_AT_Z, noise(ROUGH_AT_Z, window(3.0, 2.0, 90.0, 1.0)), 1e-12),
    (PICTURE, picture(PICTURE), 1e-13),
    (MASKED, picture(MASKED), 1e-13),
    (MASKED_AT_Z, picture(MASKED_AT_Z), 1e-13),
]
