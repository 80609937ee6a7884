"""Arrays in, arrays of the same kind out: NumPy, Warp or torch."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import warp as wp

from terrasim.errors import InputError

Kind = Literal["numpy", "warp", "torch"]


def kind_of(values: Any) -> Kind:
    """The kind of an array; lists and tuples count as NumPy."""
    if isinstance(values, wp.array):
        return "warp"
    # Asked by name, so that torch is not imported for those who do not use it.
    if type(values).__module__.partition(".")[0] == "torch":
        return "torch"
    return "numpy"


def vectors(values: Any, width: int, device: Any, name: str) -> Any:
    """An array of points as a Warp array of ``width`` float64 each on a device.

    Args:
        values: Shape ``(count, width)``, or a Warp array of vectors of that width; float32 is
            widened, float64 on the device is taken without a copy.
        width: 2 or 3.
        device: Warp device.
        name: What to call it in an error.

    Returns:
        Warp array of ``vec2d`` or ``vec3d``, shape ``(count,)``.

    Raises:
        InputError: If the shape or type does not fit.
    """
    vector = wp.types.vector(length=width, dtype=wp.float64)
    kind = kind_of(values)
    if kind == "warp":
        if _lies_ready(values, width, device):
            return wp.array(
                ptr=values.ptr,
                dtype=vector,
                shape=(values.shape[0],),
                device=device,
                deleter=None,
                copy=False,
            )
        values = values.numpy()
    elif kind == "torch":
        _check_shape(tuple(values.shape), width, name)
        if values.is_complex():
            raise InputError(f"{name} must be an array of numbers: got {values.dtype}")
        values = values.detach().double().contiguous()
        return wp.from_torch(values, dtype=vector).to(device)
    table = _as_float64(values, name)
    _check_shape(table.shape, width, name)
    return wp.array(np.ascontiguousarray(table), dtype=vector, device=device, copy=False)


def answer(array: Any, kind: Kind) -> Any:
    """A Warp array as the kind that was asked with."""
    if kind == "warp":
        return array
    if kind == "torch":
        return wp.to_torch(array)
    return array.numpy()


def _as_float64(values: Any, name: str) -> Any:
    got: object
    try:
        table = np.asarray(values)
        # NumPy would make numbers of texts, of dates and of one half of complex numbers.
        if table.dtype.kind in "biufO":
            return np.asarray(table, dtype=np.float64)
        got = f"got {table.dtype}"
    except (TypeError, ValueError) as error:
        got = error
    raise InputError(f"{name} must be an array of numbers: {got}")


def _lies_ready(values: Any, width: int, device: Any) -> bool:
    """Whether a Warp array is float64 on the device, point after point."""
    if values.device != device or not values.is_contiguous:
        return False
    if values.ndim == 2:
        return values.dtype is wp.float64 and values.shape[1] == width
    scalar = getattr(values.dtype, "_wp_scalar_type_", None)
    return values.ndim == 1 and scalar is wp.float64 and values.dtype._length_ == width


def _check_shape(shape: tuple[int, ...], width: int, name: str) -> None:
    if len(shape) != 2 or shape[1] != width:
        raise InputError(f"{name} must have shape (count, {width}), got {shape}")
