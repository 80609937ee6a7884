"""What is installed is what the checkout says; .ci/run tries the wheel itself."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib.metadata import PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]


def pins() -> dict[str, Requirement]:
    """The requirements of constraints.txt by normalised name."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(one.name): one for one in found}


def wanted() -> list[Requirement]:
    """Everything that pyproject.toml asks for, extras included."""
    groups = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    every = [Requirement(text) for group in groups for text in group]
    return [one for one in every if one.name != PROJECT["name"]]


def installed_below(requirements: list[Requirement]) -> Iterator[tuple[str, str]]:
    """Name and version of the installed distributions that requirements lead to."""
    todo, seen = list(requirements), set()
    while todo:
        one = todo.pop()
        name = canonicalize_name(one.name)
        if (name, *sorted(one.extras)) in seen:
            continue
        seen.add((name, *sorted(one.extras)))
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue  # an extra that this environment leaves out
        yield name, found.version
        for text in found.requires or []:
            below = Requirement(text)
            marker = below.marker
            if marker is None or any(marker.evaluate({"extra": e}) for e in one.extras | {""}):
                todo.append(below)


def test_the_version_stands_in_one_place() -> None:
    assert version("terrasim") == PROJECT["version"]
    code = [path for path in ROOT.glob("terrasim/*.py") if PROJECT["version"] in path.read_text()]
    assert code == []


@pytest.mark.parametrize("folder", ["kernels", "server"])
def test_a_relative_link_shows_the_folder_inside_the_package(folder: str) -> None:
    link = ROOT / "terrasim" / folder
    if not link.is_symlink():
        pytest.skip("this checkout was made without symbolic links")
    assert link.readlink() == Path("..") / folder
    assert PYPROJECT["tool"]["setuptools"]["package-dir"][f"terrasim.{folder}"] == folder


def test_every_folder_of_code_is_a_listed_package() -> None:
    """One that is missing from the list would work here and be absent from the wheel."""
    mapping = PYPROJECT["tool"]["setuptools"]["package-dir"]
    packages = PYPROJECT["tool"]["setuptools"]["packages"]
    listed = [mapping.get(name, name.replace(".", "/")) for name in packages]
    holding = {
        path.parent.relative_to(ROOT).as_posix()
        for top in ("terrasim", "kernels", "server")
        for path in (ROOT / top).rglob("*.py")
        if not {"kernels", "server"} & set(path.relative_to(ROOT).parts[1:])
    }
    assert holding == set(listed)
    assert all((ROOT / folder / "__init__.py").is_file() for folder in listed)


def test_every_data_file_is_packaged() -> None:
    patterns = PYPROJECT["tool"]["setuptools"]["package-data"]
    for package in ("terrasim", *(name for name in patterns if name != "terrasim")):
        assert package in PYPROJECT["tool"]["setuptools"]["packages"]
    missing = [
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "terrasim").rglob("*.*")
        if path.is_file()
        and path.suffix not in {".py", ".pyc"}
        and not any(
            fnmatch(path.name, one)
            for one in patterns.get(".".join(path.parent.relative_to(ROOT).parts), [])
        )
    ]
    assert missing == []
    assert (ROOT / "terrasim" / "py.typed").is_file()


def test_the_licence_is_apache() -> None:
    assert PROJECT["license"] == "Apache-2.0"
    assert "Version 2.0, January 2004" in (ROOT / "LICENSE").read_text()


def test_constraints_are_exact_and_name_no_place() -> None:
    for name, pin in pins().items():
        assert pin.url is None, name
        assert [one.operator for one in pin.specifier] == ["=="], name


def test_constraints_pin_what_the_project_asks_for_within_its_ranges() -> None:
    pinned = pins()
    for requirement in wanted():
        (exact,) = pinned[canonicalize_name(requirement.name)].specifier
        assert requirement.specifier.contains(exact.version), requirement


def test_constraints_pin_all_that_an_install_brings() -> None:
    pinned = pins()
    for name, found in installed_below(wanted()):
        assert name in pinned, f"{name} {found} is installed but not pinned"
        assert pinned[name].specifier.contains(found), f"{name} {found} is not the pinned one"
