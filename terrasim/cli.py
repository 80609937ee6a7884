"""The command line: parse, call what works, print. Everything heavy is imported by its command."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from terrasim.cli_print import show_result
from terrasim.cli_store import commands
from terrasim.errors import InputError, RunError

app = typer.Typer(
    name="terrasim",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="The ground under robots and vehicles: one surface from disk to GPU.",
)
_USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
"""The base of what typer raises for a wrong command line; it has moved between versions."""

_SQLITE = b"SQLite format 3\0"
"""What a store begins with."""

File = Annotated[Path, typer.Argument(help="Scenario file (TOML).", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]


@app.command()
def run(
    file: File,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the run; by default out/NAME.")
    ] = None,
    device: Annotated[str | None, typer.Option(help="cpu, or a CUDA device: cuda:0.")] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads of a launch.")] = None,
    as_json: Json = False,
) -> None:
    """Run a scenario and write its record, report and outputs into a folder."""
    from terrasim.cli_print import print_run
    from terrasim.progress import progress_bar
    from terrasim.scenario.run import run_file
    from terrasim.warp_start import start_warp

    start_warp()
    with progress_bar() as progress:
        record = run_file(file, out=out, device=device, threads=threads, progress=progress)
    show_result(record, as_json, print_run)


@app.command()
def plan(file: File, device: str | None = None, as_json: Json = False) -> None:
    """Show what a scenario needs: parts, imports, kernels and bytes; nothing is run."""
    from terrasim.cli_print import print_plan
    from terrasim.scenario.run import plan_file

    show_result(plan_file(file, device=device).as_json(), as_json, print_plan)


@app.command()
def study(
    file: Annotated[
        Path, typer.Argument(help="Scenario file, or a folder of them.", show_default=False)
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the study; by default out/NAME-study.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Vary a scenario as its [study] says: errors against run time.

    Of a folder: run every scenario in it, and tell whether what its [expect] says held. What is
    finished is kept: a study that was ended goes on where it was.
    """
    from terrasim.progress import progress_bar
    from terrasim.study.print_study import print_expectations, print_study

    with progress_bar() as progress:
        if file.is_dir():
            from terrasim.study.expectations import study_folder

            record, show = study_folder(file, out=out, progress=progress), print_expectations
        else:
            from terrasim.study.study import study_file

            record, show = study_file(file, out=out, progress=progress), print_study
    show_result(record, as_json, show)
    return 0 if record["held"] else 1


@app.command()
def schema() -> None:
    """Print the JSON Schema of scenario files."""
    from terrasim.scenario.scenario import scenario_schema

    show_result(scenario_schema(), True, None)


@app.command()
def info(
    files: Annotated[
        list[Path], typer.Argument(help="A store, or files of heights.", show_default=False)
    ],
    as_json: Json = False,
    **options: Any,
) -> None:
    """Tell what a store or files of heights hold."""
    from terrasim.cli_print import print_tree
    from terrasim.dem.imports import ImportOptions, describe_input
    from terrasim.dem.input_file import begins_with

    if len(files) == 1 and files[0].is_file() and begins_with(files[0], _SQLITE):
        from terrasim.store.info import info as store_info

        show_result(store_info(files[0]), as_json, print_tree)
        return
    show_result(describe_input(files, ImportOptions(**options)), as_json, print_tree)


@app.command(name="import")
def import_(
    files: Annotated[list[Path], typer.Argument(help="Files of heights.", show_default=False)],
    store: Annotated[Path, typer.Argument(help="The store to make.", show_default=False)],
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a store that is there.")
    ] = False,
    as_json: Json = False,
    **options: Any,
) -> None:
    """Read files of heights into a new store."""
    from terrasim.cli_print import print_tree
    from terrasim.dem.imports import ImportOptions, import_terrain
    from terrasim.progress import progress_bar

    with progress_bar() as progress:
        made = import_terrain(
            files,
            store,
            ImportOptions(**options),
            replace_store=replace,
            progress=progress,
        )
    show_result(made, as_json, print_tree)


@app.command()
def bench(
    names: Annotated[
        list[str] | None, typer.Argument(help="Benchmarks to run; all by default.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, or a CUDA device: cuda:0.")] = "cpu",
    save: Annotated[
        Path | None, typer.Option(help="Folder in which <device>.json is written or brought up.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure against the limits of this machine: a memory copy, and NumPy doing the same."""
    from terrasim.bench.bench import bench as run_bench
    from terrasim.bench.bench import save as save_bench
    from terrasim.bench.bench import table
    from terrasim.progress import progress_bar
    from terrasim.warp_start import start_warp

    if save is not None and save.name.startswith("-"):
        raise InputError(f"--save takes a folder, got {str(save)!r}: name one after it")
    start_warp()
    with progress_bar() as progress:
        result = run_bench(names or (), device=device, tell=lambda name: progress(0.0, name))
    if save is not None:
        save_bench(result, save)
    show_result(result, as_json, lambda found: print(table(found)))


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command and end the process with its exit status.

    0: done. 1: the run failed. 2: bad input. 130: interrupted. What went wrong is one line on
    standard error.
    """
    sys.exit(command(sys.argv[1:] if argv is None else argv))


def command(argv: Sequence[str]) -> int:
    """Run a command; returns its exit status."""
    try:
        _require_text(argv)
        status = app(args=list(argv), prog_name="terrasim", standalone_mode=False)
    except BrokenPipeError:
        # Nobody reads on: say nothing, and let the interpreter not flush into it again.
        sys.stdout = None
        return 1
    except _EXPECTED as error:
        return _failed(error)
    return status if isinstance(status, int) else 0


def _require_text(argv: Sequence[str]) -> None:
    """Refuse what is no text before anything is done: SQLite and GDAL take no other names."""
    for one in argv:
        try:
            one.encode()
        except UnicodeEncodeError:
            raise InputError(f"names must be UTF-8, got {one!r}: choose another") from None


def _failed(error: BaseException) -> int:
    """Say what went wrong in one line; returns the exit status."""
    status, message = 1, str(error)
    if isinstance(error, _USAGE_ERROR):
        status, message = 2, _usage(error)
    elif isinstance(error, InputError):
        status = 2
    elif isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        message = f"{where}{error.strerror or error}"
    elif isinstance(error, MemoryError):
        message = f"not enough memory ({error}); make the scenario or its pool smaller"
    elif isinstance(error, KeyboardInterrupt | typer.Abort):
        status, message = 130, "interrupted"
    if message:
        print(f"terrasim: error: {' '.join(message.split())}", file=sys.stderr)
    return status


def _usage(error: Any) -> str:
    """What is wrong with the command line; nothing where typer has shown its help."""
    text = str(error.format_message())
    shown = type(error).__name__ == "NoArgsIsHelpError"
    return "" if shown else f"{text.rstrip('.')}; see terrasim --help"


_EXPECTED = (
    _USAGE_ERROR,
    InputError,
    RunError,
    OSError,
    MemoryError,
    KeyboardInterrupt,
    typer.Abort,
)


def _take_options(function: Any) -> None:
    """Give a command an option for each field of ``ImportOptions``, described as it is there."""
    from terrasim.dem.import_options import ImportOptions
    from terrasim.scenario.descriptions import descriptions

    own = Signature.from_callable(function, eval_str=True)
    types, lines = get_type_hints(ImportOptions), descriptions(ImportOptions)
    options = []
    for one in fields(ImportOptions):
        taken = types[one.name]
        # Which words are allowed the options know best.
        taken = str if isinstance(one.default, str) else taken
        help_ = typer.Option(help=" ".join(lines[one.name].split()).replace("[", "\\["))
        options.append(
            Parameter(
                one.name,
                Parameter.KEYWORD_ONLY,
                default=one.default,
                annotation=Annotated[taken, help_],
            )
        )
    kept = [one for one in own.parameters.values() if one.kind != Parameter.VAR_KEYWORD]
    function.__signature__ = own.replace(parameters=[*kept, *options])


_take_options(info)
_take_options(import_)
app.add_typer(commands)
