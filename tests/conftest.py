"""What all tests share: one folder of compiled kernels a run, and the real terrain files."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

SHARED_TERRAIN = Path(__file__).resolve().parents[2] / "shared" / "terrain"

_kernels: tempfile.TemporaryDirectory[str] | None = None


def pytest_configure() -> None:
    """Give Warp one folder for its compiled kernels, before anything imports it.

    It is an environment variable, so that processes that tests start share the folder. Set
    WARP_CACHE_PATH yourself to keep what was compiled from one run to the next.
    """
    global _kernels  # noqa: PLW0603 the hooks of one run have nothing else in common
    if "WARP_CACHE_PATH" not in os.environ:
        _kernels = tempfile.TemporaryDirectory(prefix="terrasim-kernels-")
        os.environ["WARP_CACHE_PATH"] = _kernels.name


def pytest_unconfigure() -> None:
    """Remove the folder this run made."""
    if _kernels is not None:
        os.environ.pop("WARP_CACHE_PATH", None)
        _kernels.cleanup()


@pytest.fixture(scope="session", autouse=True)
def _quiet_warp() -> None:
    """Warp says nothing of modules it loads, so that a failure stands alone."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING


@pytest.fixture(scope="session")
def shared_terrain() -> Path:
    """Folder of real elevation files beside the checkout; they are not part of the project."""
    if not SHARED_TERRAIN.is_dir():
        pytest.skip("no folder shared/terrain beside the checkout: real elevation files are needed")
    return SHARED_TERRAIN
