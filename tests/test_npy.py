"""Array files as heights: mapped, held against their header, never unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE
from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import open_input
from terrasim.errors import InputError


def read(path: Path, **options: Any) -> SouthUpRows:
    """Rows of one file."""
    return open_input([path], ImportOptions(**{"spacing": 10.0, **options}))


def save(path: Path, array: npt.ArrayLike) -> Path:
    """An array file."""
    np.save(path, array, allow_pickle=True)
    return path


@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<f2", ">i2", "<u4", "|i1"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_row_zero_is_the_northern_edge(tmp_path: Path, dtype: str, order: Any) -> None:
    """In any numeric type and either order."""
    samples = np.asarray(np.arange(12).reshape(3, 4), dtype=dtype, order=order)
    rows = read(save(tmp_path / "a.npy", samples), z_scale=0.5, z_offset=1.0)
    expected = (np.arange(12).reshape(3, 4)[::-1] * 50_000 + 100_000).astype(np.int32)
    np.testing.assert_array_equal(rows.read_rows(0, 3), expected)
    assert rows.provenance["range_m"] == [1.0, 6.5]


def test_nan_is_a_hole(tmp_path: Path) -> None:
    rows = read(save(tmp_path / "a.npy", np.array([[np.nan, 1.0], [2.0, 3.0]])))
    assert rows.read_rows(0, 2).tolist() == [[200_000, 300_000], [HOLE, 100_000]]


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.zeros(5), r"holds float64 of shape \(5,\)"),
        (np.zeros((2, 2, 2)), r"shape \(2, 2, 2\)"),
        (np.zeros((2, 2), complex), "holds complex128"),
        (np.zeros((2, 2), bool), "holds bool"),
        (np.array([["a", "b"], ["c", "d"]]), "holds <U1"),
        (np.array([[1, None], [2, 3]], object), "header and file do not make an array"),
        (np.zeros((0, 5)), "a.npy: "),
        (np.zeros((1, 5)), "at least 2 x 2"),
        (np.array([[np.inf, 0.0], [0.0, 0.0]]), "height inf m at row 0, column 0"),
    ],
)
def test_arrays_that_hold_no_heights_are_refused(
    tmp_path: Path, array: npt.NDArray[Any], said: str
) -> None:
    with pytest.raises(InputError, match=said) as error:
        read(save(tmp_path / "a.npy", array))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 100000), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9999999999), }",
        b"{'descr': '<f8', 'fortran_order': False}",
        b"{'descr': 'nonsense', 'fortran_order': False, 'shape': (2, 2), }",
        b"(" * 1000,
        b"__import__('os').abort()",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (2, 2), }" + b" " * 60_000,
    ],
)
def test_a_header_that_lies_is_refused_before_anything_is_allocated(
    tmp_path: Path, header: bytes
) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\0" * 24)
    with pytest.raises(InputError, match=r"a\.npy: header and file") as error:
        read(path)
    assert "\n" not in str(error.value)


def test_a_truncated_array_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.npy", np.zeros((50, 50)))
    whole = path.read_bytes()
    for size in (7, 60, 1000):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"a\.npy: "):
            read(path)


@pytest.mark.parametrize("options", [{"band": 1}, {"encoding": "terrarium"}])
def test_an_array_has_no_bands(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="neither bands nor an encoding"):
        read(save(tmp_path / "a.npy", np.zeros((3, 3))), **options)
