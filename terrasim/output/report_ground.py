"""The report's part on the ground: what it lost and gained, what moved it, what keeps it."""

from __future__ import annotations

from html import escape
from typing import Any

from terrasim.deform.ledger import Ledger
from terrasim.output.report_table import explained, number_text, table

Record = dict[str, Any]


def ledger_html(record: Record) -> str:
    """What the ground lost and gained; empty if nothing changed it."""
    ledger = record["ledger"]
    if not ledger["posts"]:
        return ""
    lead = (
        f"<p>{ledger['removed_m3']:,.1f} m<sup>3</sup> of ground went and "
        f"{ledger['added_m3']:,.1f} m<sup>3</sup> came: {ledger['net_m3']:+,.1f} m<sup>3</sup> in "
        f"all. The counts below are whole numbers and exact. {_balance(ledger)}</p>"
    )
    return lead + explained(ledger, Ledger)


def relaxation_html(record: Record) -> str:
    """How the ground slumped; empty if it was not to."""
    said = record.get("relaxation")
    if not said:
        return ""
    rest = (
        "Everything came to rest."
        if not said["still_slumping"]
        else f"{said['still_slumping']:,} places had not come to rest at the end."
    )
    return (
        f"<p>Slumping took {said['removed_counts']:,} counts of ground down and put "
        f"{said['moved_counts']:,} elsewhere, step by step: {said['net_counts']:,} in all. "
        f"{rest}</p>"
    )


def dynamics_html(record: Record) -> str:
    """What became of deformations that change over time; empty without any."""
    rows = [
        (
            f"{index}, {escape(one['kind'])}",
            f"{one['time_s']:g} s in {one['steps']:,} steps",
            number_text(one["courant"]) if "courant" in one else "",
            _energy(one),
            escape(one["end"] or "still going on"),
            f"{one['ledger']['net']:+,}",
            f"{one['net_m3']:+,.1f}",
        )
        for index, one in enumerate(record["dynamics"], 1)
    ]
    heads = (
        *("dynamic", "lasted", "Courant number", "energy [m<sup>4</sup>/s<sup>2</sup>]", "end"),
        *("net [counts]", "net [m<sup>3</sup>]"),
    )
    return table(heads, rows, numbers=(2, 5, 6)) if rows else ""


def _energy(one: dict[str, Any]) -> str:
    if "energy_start_m4_s2" not in one:
        return ""
    return f"{one['energy_start_m4_s2']:,.4g} to {one['energy_end_m4_s2']:,.4g}"


def store_html(record: Record) -> str:
    """What keeps the ground; empty without a store."""
    said = record.get("store")
    if not said:
        return ""
    lead = (
        f"<p>{said['operations']:,} operations stand in the journal of "
        f"<code>{escape(said['file'])}</code>, with {said['snapshots']:,} snapshots. "
        "<code>terrasim history</code> lists them.</p>"
    )
    rows = [
        (
            number_text(one["time_s"]),
            f"{one['replayed']:,}",
            "the same to the bit" if one["same_heights"] else "NOT the same",
        )
        for one in said["reopened"]
    ]
    heads = ("closed and opened again at [s]", "operations done again", "heights")
    return lead + (table(heads, rows, numbers=(0, 1)) if rows else "")


def _balance(ledger: dict[str, Any]) -> str:
    """Whether the ledger and the heights say the same."""
    if ledger["heights"] == ledger["net"]:
        return f"The sum of all heights changed by the ledger's net, {ledger['net']:+,}, exactly."
    return (
        f"<strong>The sum of all heights changed by {ledger['heights']:+,}, not by the ledger's "
        f"net of {ledger['net']:+,}.</strong>"
    )
