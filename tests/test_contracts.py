"""Rules of the code that a machine can check; import-linter checks those between packages."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
KERNEL_FILES = sorted((ROOT / "kernels").glob("*.py"))
FILES = sorted(
    path
    for folder in ("kernels", "server", "terrasim", "tests")
    for path in ROOT.glob(f"{folder}/*.py")
)
TEST_FILES = [path for path in FILES if path.name.startswith("test_")]
LONGEST_FILE = 400
LONGEST_BODY = 40
MOST_PARAMETERS = 12
REASON = "# Over the limit:"
"""A comment that begins so lets a kernel be longer or wider, and says why."""

kernel_file = pytest.mark.parametrize("path", KERNEL_FILES, ids=lambda path: path.name)


def warp_functions(source: str) -> Iterator[ast.FunctionDef]:
    """Functions that Warp compiles: a decorator says ``wp.func`` or ``wp.kernel``."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and any(
            ast.unparse(mark).startswith(("wp.func", "wp.kernel")) for mark in node.decorator_list
        ):
            yield node


def body_lines(node: ast.FunctionDef) -> int:
    """Lines from a function's first statement to its last, the docstring left out."""
    first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
    return (node.end_lineno or first.lineno) - first.lineno + 1


def oversized(source: str) -> list[str]:
    """Names of Warp functions over the limits whose code gives no reason."""
    lines = source.splitlines()
    return [
        f"{node.name}: {body_lines(node)} lines, {len(node.args.args)} parameters"
        for node in warp_functions(source)
        if (body_lines(node) > LONGEST_BODY or len(node.args.args) > MOST_PARAMETERS)
        and not any(REASON in line for line in lines[node.lineno - 1 : node.end_lineno])
    ]


def forbidden_calls(source: str) -> list[str]:
    """Atomics and tiles that Warp functions use: neither repeats to the bit on every launch."""
    return [
        f"line {node.lineno}: {ast.unparse(node)}"
        for function in warp_functions(source)
        for node in ast.walk(function)
        if isinstance(node, ast.Attribute) and node.attr.startswith(("tile_", "atomic_"))
    ]


def divided_addresses(source: str) -> list[str]:
    """Uses of ``%`` and ``//`` in Warp functions.

    Warp takes ``-1 % 1024`` for -1, as C does, so an index west of the origin would leave its
    block: ``&`` and ``>>`` alone.
    """
    return [
        f"line {node.lineno}: {ast.unparse(node)}"
        for function in warp_functions(source)
        for node in ast.walk(function)
        if isinstance(node, ast.BinOp | ast.AugAssign)
        and isinstance(node.op, ast.Mod | ast.FloorDiv)
    ]


def foreign_imports(source: str) -> list[str]:
    """Imports of a kernel file beyond the standard library, Warp and other kernel files."""
    found = []
    for node in ast.walk(ast.parse(source)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom):
            names = [node.module or "."]
        found += [
            name
            for name in names
            if name.split(".")[0] not in {*sys.stdlib_module_names, "warp"}
            and not f"{name}.".startswith("terrasim.kernels.")
        ]
    return found


def differentiated(source: str) -> list[str]:
    """Kernels that do not say ``enable_backward=False``: each would compile twice over."""
    return [
        node.name
        for node in warp_functions(source)
        if any(
            ast.unparse(mark).startswith("wp.kernel")
            and "enable_backward=False" not in ast.unparse(mark)
            for mark in node.decorator_list
        )
    ]


def unmarked_torch(source: str) -> list[str]:
    """Tests that need torch without the mark by which .ci/run chooses them."""
    return [
        node.name
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef)
        and any(
            isinstance(call, ast.Call)
            and ast.unparse(call).startswith("pytest.importorskip('torch'")
            for call in ast.walk(node)
        )
        and not any("mark.torch" in ast.unparse(mark) for mark in node.decorator_list)
    ]


@kernel_file
def test_a_kernel_fits_on_a_screen(path: Path) -> None:
    assert oversized(path.read_text()) == []


@kernel_file
def test_kernels_gather_without_atomics_or_tiles(path: Path) -> None:
    assert forbidden_calls(path.read_text()) == []


@kernel_file
def test_kernels_find_addresses_by_shift_and_mask(path: Path) -> None:
    assert divided_addresses(path.read_text()) == []


@kernel_file
def test_kernel_files_import_warp_and_each_other_alone(path: Path) -> None:
    assert foreign_imports(path.read_text()) == []


@kernel_file
def test_kernels_are_not_compiled_for_gradients(path: Path) -> None:
    assert differentiated(path.read_text()) == []


@kernel_file
def test_kernel_annotations_are_objects(path: Path) -> None:
    """Warp reads a parameter's type from the annotation: it must not be a string."""
    assert "from __future__ import annotations" not in path.read_text()


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_file_holds_one_idea(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST_FILE


@pytest.mark.parametrize("path", TEST_FILES, ids=lambda path: path.name)
def test_what_needs_torch_is_marked(path: Path) -> None:
    """Unmarked, it would be skipped in every run."""
    assert unmarked_torch(path.read_text()) == []


BAD_KERNEL = """
import numpy
import terrasim.grid

@wp.kernel
def spread({parameters}):
    i = wp.tid()
    wp.atomic_add(out, a % 256, wp.tile_sum(b // 2))
{filling}
"""


def test_the_checks_see_what_they_forbid() -> None:
    source = BAD_KERNEL.format(
        parameters=", ".join(f"p{i}: int" for i in range(13)), filling="    i += 1\n" * 40
    )
    assert oversized(source) == ["spread: 42 lines, 13 parameters"]
    assert oversized(source.replace("wp.tid()", f"wp.tid()  {REASON} a test")) == []
    assert len(forbidden_calls(source)) == 2
    assert len(divided_addresses(source)) == 2
    assert foreign_imports(source) == ["numpy", "terrasim.grid"]
    assert differentiated(source) == ["spread"]
    needs = 'def test_it():\n    pytest.importorskip("torch", reason="no torch")\n'
    assert unmarked_torch(needs) == ["test_it"]
    assert unmarked_torch(f"@pytest.mark.torch\n{needs}") == []
