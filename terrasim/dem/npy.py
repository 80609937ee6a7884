"""NumPy arrays on disk as heights, mapped and never loaded; row 0 is the northern edge."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counts import Metres
from terrasim.dem.image import scale_samples
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import check_claim, check_file
from terrasim.errors import InputError

NPY_MAGIC = b"\x93NUMPY"
_LONGEST_HEADER = 4096


@dataclass(frozen=True)
class ArrayHeights:
    """A mapped array as a raster of metres."""

    name: str
    """What to call it in an error."""
    array: npt.NDArray[Any]
    """Samples, shape ``(rows, cols)``, in the file."""
    options: ImportOptions
    """Scale, offset and nodata value."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.array.shape[0])

    @property
    def cols(self) -> int:
        """Number of columns."""
        return int(self.array.shape[1])

    @property
    def driver(self) -> str:
        """Format and sample type."""
        return f"npy {self.array.dtype}"

    def read(self, row: int, count: int) -> Metres:
        """Heights [m] of whole rows, shape ``(count, cols)``, float64; NaN: no height."""
        return scale_samples(self.array[row : row + count], self.options)


def read_npy(path: str | Path, options: ImportOptions) -> ArrayHeights:
    """Map an array file of integers or floats, C or Fortran order.

    Raises:
        InputError: If it cannot be read, is not 2-D and numeric, or is shorter than its header
            says.
    """
    file = check_file(path)
    if options.encoding != "plain" or options.band is not None:
        raise InputError(f"{path}: an array has neither bands nor an encoding; leave both out")
    try:
        array = np.load(file, mmap_mode="r", allow_pickle=False, max_header_size=_LONGEST_HEADER)
    except Exception as error:  # noqa: BLE001 a header is parsed as Python, which fails in any way
        reason = " ".join(str(error).split())[:120]
        raise InputError(
            f"{path}: header and file do not make an array of numbers ({reason}); save it again "
            "with numpy.save"
        ) from None
    if array.ndim != 2 or array.dtype.kind not in "iuf":
        raise InputError(
            f"{path}: holds {array.dtype} of shape {array.shape}: heights are 2-D numbers"
        )
    rows, cols = array.shape
    check_claim(file, rows, cols, array.itemsize)
    return ArrayHeights(str(path), array, options)
