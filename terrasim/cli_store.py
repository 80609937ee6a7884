"""Commands on stores: their history, their names, and looking after them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from terrasim.cli_print import print_rows, print_tree, show_result
from terrasim.errors import InputError

Store = Annotated[Path, typer.Argument(help="The store.", show_default=False)]
Name = Annotated[str | None, typer.Argument(help="Its name; without one, all are listed.")]
Branch = Annotated[str, typer.Option(help="The branch.")]
Drop = Annotated[bool, typer.Option("--drop", help="Forget the one of that name.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]

commands = typer.Typer()
"""The commands; ``terrasim.cli`` takes them in."""


@commands.command()
def history(
    store: Store,
    branch: Branch = "main",
    limit: Annotated[int, typer.Option(help="Most operations to list.")] = 20,
    as_json: Json = False,
) -> None:
    """List what was done to a terrain, newest first."""
    from terrasim.store.history import history as read_history

    rows = [
        {
            "seq": row.seq,
            "time": _when(row.time),
            "summary": row.summary,
            "idempotency_key": row.idem,
            "engine": row.engine,
            "bytes": len(row.op),
        }
        for row in read_history(store, branch, limit)
    ]
    show_result({"store": str(store), "branch": branch, "operations": rows}, as_json, _list)


@commands.command()
def snapshot(
    store: Store,
    name: Name = None,
    branch: Branch = "main",
    drop: Drop = False,
    as_json: Json = False,
) -> None:
    """Name the state of a branch to come back to, or list the snapshots."""
    from terrasim.store.names import snapshots

    _require_name(name, drop=drop)
    if name is not None and drop:
        _with_branch(store, branch, lambda one: one.drop_snapshot(name))
    elif name is not None:
        _with_terrain(store, branch, lambda terrain: terrain.edits.snapshot(name))
    rows = [_shown(one) for one in snapshots(store).values()]
    show_result({"store": str(store), "snapshots": rows}, as_json, _list)


@commands.command()
def branch(
    store: Store,
    name: Name = None,
    at: Annotated[
        str | None, typer.Option(help="Snapshot to begin from; by default the state of main.")
    ] = None,
    drop: Drop = False,
    as_json: Json = False,
) -> None:
    """Begin a branch, or list the branches."""
    from terrasim.store.names import branches

    _require_name(name, drop=drop, at=at is not None)
    if drop and at is not None:
        raise InputError("a branch is begun --at a snapshot or dropped: give one, got both")
    if name is not None and drop:
        _with_branch(store, "main", lambda one: one.drop_branch(name))
    elif name is not None and at is not None:
        _with_branch(store, "main", lambda one: one.fork(name, at))
    elif name is not None:
        # Opened as a terrain, so that rows that wait for a checkpoint come along.
        _with_terrain(store, "main", lambda terrain: terrain.edits.fork(name))
    rows = [_shown(one) for one in branches(store).values()]
    show_result({"store": str(store), "branches": rows}, as_json, _list)


@commands.command()
def reset(
    store: Store,
    to: Annotated[str, typer.Argument(help="The snapshot to go back to.")],
    branch: Branch = "main",
    as_json: Json = False,
) -> None:
    """Make a branch what it was at a snapshot; what was done since is dropped."""
    _with_branch(store, branch, lambda one: one.reset(to))
    show_result({"store": str(store), "branch": branch, "reset_to": to}, as_json, print_tree)


@commands.command()
def undo(
    store: Store,
    seq: Annotated[int, typer.Argument(help="Number of the operation; see history.")],
    branch: Branch = "main",
    as_json: Json = False,
) -> None:
    """Take back an operation that only added, exactly."""
    from terrasim.deform.commit import undo as take_back

    receipt = _with_terrain(store, branch, lambda terrain: take_back(terrain, seq))
    said = {"store": str(store), "undone": seq, "seq": receipt.seq}
    show_result(said | {"ledger": asdict(receipt.ledger)}, as_json, print_tree)


@commands.command()
def verify(store: Store, as_json: Json = False) -> None:
    """Check every hash, seal and reference of a store; exit status 1 if one is wrong."""
    from terrasim.store.verify import verify as check

    found = check(store)
    show_result(found, as_json, print_tree)
    if not found["sound"]:
        raise typer.Exit(1)


@commands.command()
def collect(
    store: Store,
    keep: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Journal rows to keep, counted back from every branch and snapshot; all by "
            "default. What is older cannot be undone any more.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Delete what no branch and no snapshot needs, and make the file smaller."""
    from terrasim.store.collect import collect as let_go

    def work(one: Any) -> dict[str, Any]:
        trimmed = 0 if keep is None else one.trim(keep)
        return {"store": str(store), "trimmed_rows": trimmed, **let_go(one)}

    show_result(_with_branch(store, "main", work), as_json, print_tree)


@commands.command()
def backup(
    store: Store,
    target: Annotated[Path, typer.Argument(help="The copy to make.", show_default=False)],
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a store that is there.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Copy a store, whoever writes to it meanwhile; the copy is checked."""
    from terrasim.progress import progress_bar
    from terrasim.store.backup import backup as copy

    with progress_bar() as progress:
        made = copy(store, target, replace=replace, progress=progress)
    show_result(made, as_json, print_tree)


@commands.command()
def export(
    store: Store,
    file: Annotated[Path, typer.Argument(help="The file to make: .tif or .exr.")],
    branch: Annotated[str | None, typer.Option(help="The branch; main by default.")] = None,
    snapshot: Annotated[str | None, typer.Option(help="A snapshot instead.")] = None,
    as_json: Json = False,
) -> None:
    """Write the heights of a branch or a snapshot as GeoTIFF, with its CRS, or as EXR."""
    from terrasim.dem.export import export as write
    from terrasim.progress import progress_bar
    from terrasim.store.store import open_store

    heights = open_store(store, branch=branch, snapshot=snapshot)
    with heights, progress_bar() as progress:
        made = write(heights, file, progress=progress)
    show_result(made, as_json, print_tree)


def _require_name(name: str | None, **options: bool) -> None:
    """Refuse options that need a name and would do nothing without one."""
    for option, given in options.items():
        if given and name is None:
            raise InputError(f"--{option} needs a name, got none: give it after the store")


def _with_branch(store: Path, name: str, work: Callable[[Any], Any]) -> Any:
    from terrasim.store.branch import open_branch

    with open_branch(store, name) as one:
        return work(one)


def _with_terrain(store: Path, name: str, work: Callable[[Any], Any]) -> Any:
    from terrasim.open_terrain import open_terrain
    from terrasim.warp_start import start_warp

    start_warp()
    with open_terrain(store, name) as terrain:
        return work(terrain)


def _shown(state: Any) -> dict[str, Any]:
    return asdict(state) | {"time": _when(state.time)}


def _when(time: float) -> str:
    """A time in UTC."""
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S")


def _list(result: dict[str, Any]) -> None:
    [(name, rows)] = [(key, value) for key, value in result.items() if isinstance(value, list)]
    print_rows(name, rows)
