"""Every kernel compiles for CUDA, which needs no GPU: the compiler comes with Warp."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Any

import pytest
import warp as wp

import terrasim.kernels

ARCHITECTURES = (80, 90)
"""Ampere and Hopper."""

FILES = [module.name for module in pkgutil.iter_modules(terrasim.kernels.__path__)]


def kernels_of(name: str) -> list[Any]:
    """The kernels of a file of ``terrasim.kernels``, variants kept in a container included."""
    found = []
    for value in vars(importlib.import_module(f"terrasim.kernels.{name}")).values():
        members = value.values() if isinstance(value, dict) else value
        candidates = members if isinstance(value, dict | list | tuple) else [value]
        found += [one for one in candidates if isinstance(one, wp.Kernel)]
    return found


def test_there_are_kernels_to_compile() -> None:
    assert any(kernels_of(name) for name in FILES)


@pytest.mark.parametrize("name", [name for name in FILES if kernels_of(name)])
def test_every_kernel_compiles_for_cuda(name: str, tmp_path: Path) -> None:
    """A kernel of its own Warp module counts with the file that makes it."""
    for module in {kernel.module for kernel in kernels_of(name)}:
        made = wp.compile_aot_module(module, arch=ARCHITECTURES, module_dir=tmp_path, use_ptx=False)
        assert len(made) == len(ARCHITECTURES)
        assert all(path.stat().st_size > 0 for path in made)
