"""Images as the heights of a stamp, and their files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from terrasim.dem.image import channel_rows, open_image
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import begins_with, check_file
from terrasim.dem.npy import NPY_MAGIC, read_npy
from terrasim.errors import InputError

MAX_SAMPLES = 1 << 24
"""Most samples of an image that is a stamp: 128 MiB as it is held."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class HeightImage:
    """Samples of an image, row 0 in the north. Two of the same samples are equal."""

    samples: Floats
    """Samples, float64, shape ``(rows, cols)``, at least 2 x 2."""
    weights: Floats | None = None
    """Weight of each from 0 to 1, same shape; None is 1 everywhere."""

    def __post_init__(self) -> None:
        """Refuse what is no image, and keep a copy that nobody changes."""
        object.__setattr__(self, "samples", _plane(self.samples, "samples"))
        if self.weights is None:
            return
        weights = _plane(self.weights, "weights")
        if weights.shape != self.samples.shape:
            raise InputError(
                f"image: weights must have the shape of the samples {self.samples.shape}, got "
                f"{weights.shape}"
            )
        wrong = weights[(weights < 0.0) | (weights > 1.0)]
        if wrong.size:
            raise InputError(f"image: weights must lie between 0 and 1, got {wrong[0]:g}")
        object.__setattr__(self, "weights", weights)

    def __repr__(self) -> str:
        """Its size, not its samples."""
        rows, cols = self.samples.shape
        return f"HeightImage({rows} x {cols}{' with weights' if self.weights is not None else ''})"

    def __eq__(self, other: object) -> bool:
        """Whether the samples and weights are the same."""
        if not isinstance(other, HeightImage):
            return NotImplemented
        if (self.weights is None) != (other.weights is None):
            return False
        return all(np.array_equal(a, b) for a, b in zip(self.arrays, other.arrays, strict=True))

    def __hash__(self) -> int:
        """The same for equal images."""
        return hash((self.samples.shape, self.samples[0].tobytes(), self.weights is None))

    @property
    def arrays(self) -> list[Floats]:
        """Samples, and weights where it has them."""
        return [self.samples] if self.weights is None else [self.samples, self.weights]

    @classmethod
    def load(cls, path: str | Path, *, channel: int | None = None, alpha: bool = True) -> Self:
        """Read an image file: PNG, TIFF, OpenEXR, or an array in NumPy's format.

        Unsigned samples of 8 and 16 bits run from 0 to 1; all others are taken as they are.

        Args:
            path: The file. Its header is held against the file and the limit before anything is
                read.
            channel: Channel that holds the heights, from 1. Images with several beside alpha need
                it.
            alpha: Whether the image's alpha channel, if it has one, is the samples' weight.

        Raises:
            InputError: If it cannot be read, is too large, leaves open which channel holds the
                heights, or holds what is no number.
        """
        file = check_file(path)
        try:
            if begins_with(file, NPY_MAGIC):
                return cls(_read_array(path, channel))
            return cls(*_read_image(path, channel, alpha))
        except InputError as error:
            if str(error).startswith(f"{path}: "):
                raise
            raise InputError(f"{path}: {error}") from None


def _plane(samples: Any, what: str) -> Floats:
    """A copy of samples that cannot be written to."""
    array = np.asarray(samples)
    if array.ndim != 2 or array.dtype.kind not in "iuf" or min(array.shape) < 2:
        raise InputError(
            f"image: {what} must be numbers of 2 x 2 or more, got {array.dtype} of {array.shape}"
        )
    _check_size("image", *array.shape)
    plane = np.array(array, dtype=np.float64, order="C")
    wrong = ~np.isfinite(plane)
    if wrong.any():
        row, col = np.argwhere(wrong)[0].tolist()
        raise InputError(
            f"image: {what} must be finite, got {plane[row, col]} in row {row}, column {col}; "
            "leave places out by alpha 0"
        )
    plane.flags.writeable = False
    return plane


def _check_size(name: str | Path, rows: int, cols: int) -> None:
    if rows * cols > MAX_SAMPLES:
        raise InputError(
            f"{name}: has {rows} x {cols} samples, a stamp at most {MAX_SAMPLES}; make it smaller "
            "or import it as terrain"
        )


def _read_array(path: str | Path, channel: int | None) -> npt.NDArray[Any]:
    if channel is not None:
        raise InputError(f"{path}: an array has no channels; leave channel out")
    array = read_npy(path, ImportOptions()).array
    _check_size(path, *array.shape)
    return _unit(np.asarray(array))


def _read_image(
    path: str | Path, channel: int | None, alpha: bool
) -> tuple[npt.NDArray[Any], npt.NDArray[Any] | None]:
    image = open_image(path)
    spec = image.spec()
    _check_size(path, spec.height, spec.width)
    wanted = _channel(path, spec, channel)
    planes = []
    for one in (wanted, spec.alpha_channel if alpha else -1):
        if one >= 0:
            samples = channel_rows(str(path), image, one, one + 1)(0, spec.height)
            planes.append(_unit(samples[..., 0]))
    return planes[0], planes[1] if len(planes) > 1 else None


def _channel(path: str | Path, spec: Any, channel: Any) -> int:
    """Which channel holds the heights, from 0."""
    beside = [i for i in range(spec.nchannels) if i != spec.alpha_channel]
    if channel is None:
        if len(beside) != 1:
            raise InputError(
                f"{path}: has {len(beside)} channels beside alpha and heights are one: choose it "
                "with channel"
            )
        return beside[0]
    if not isinstance(channel, int) or isinstance(channel, bool):
        raise InputError(f"{path}: channel must be a whole number, got {channel!r}")
    if not 1 <= channel <= spec.nchannels or channel - 1 == spec.alpha_channel:
        allowed = ", ".join(str(i + 1) for i in beside)
        raise InputError(f"{path}: channel must be one of {allowed}, got {channel}")
    return channel - 1


def _unit(samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Samples with those of 8 and 16 bits without a sign from 0 to 1."""
    if samples.dtype in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        return samples / float(np.iinfo(samples.dtype).max)
    return samples
