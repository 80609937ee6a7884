"""Use an installed wheel from outside the checkout: import, source, kernels, command, a run."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import warp as wp

import terrasim
import terrasim.kernels


def check_place() -> None:
    """The package in use is the installed one."""
    place = Path(inspect.getfile(terrasim))
    if "site-packages" not in place.parts:
        sys.exit(f"the checkout hides the wheel: terrasim is {place}")


def check_kernels() -> None:
    """Warp finds the source of every kernel, and a file of them compiles for a GPU."""
    names = [one.name for one in pkgutil.iter_modules(terrasim.kernels.__path__)]
    modules = [importlib.import_module(f"terrasim.kernels.{name}") for name in names]
    kernels = [
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, wp.Kernel)
    ]
    for kernel in kernels:
        inspect.getsource(kernel.func)
    with tempfile.TemporaryDirectory() as folder:
        wp.compile_aot_module(kernels[0].module, arch=80, module_dir=folder)
    print(f"{len(names)} kernel files, {len(kernels)} kernels, {kernels[0].module.name} compiles")


def command(*words: str) -> str:
    """Standard output of a terrasim command that has to succeed."""
    done = subprocess.run(["terrasim", *words], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"terrasim {' '.join(words)}: exit {done.returncode}\n{done.stderr}")
    return done.stdout


def check_run(folder: Path) -> None:
    """A run leaves its record and its report."""
    json.loads((folder / "run.json").read_text())
    report = (folder / "report.html").stat().st_size
    files = sorted(path.name for path in folder.iterdir())
    print(f"the run's folder holds {', '.join(files)}; the report has {report} bytes")


if __name__ == "__main__":
    check_place()
    check_kernels()
    command("--help")
    command("schema")
    scenario = sys.argv[1]
    json.loads(command("plan", scenario, "--json"))
    json.loads(command("run", scenario, "--out", "run", "--json"))
    check_run(Path("run"))
    print(f"terrasim {version('terrasim')} works as a wheel")
