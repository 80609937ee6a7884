"""Ledgers: whole numbers that add up, of level 0 and of the detail grid."""

from __future__ import annotations

import pytest

from terrasim.counts import COUNT_M
from terrasim.deform.ledger import Ledger


def test_ledgers_add_up() -> None:
    one = Ledger(1, 2, 3, 4, 5, 6, 7)
    assert one + Ledger(10, 20, 30, 40, 50, 60, 70) == Ledger(11, 22, 33, 44, 55, 66, 77)
    assert one + Ledger() == one
    assert one.net == 1


def test_ledgers_of_level_0_and_of_detail_add_up_exactly() -> None:
    """A detail count of factor 4 is a 64th of a count at a post of level 0."""
    base, detail = Ledger(removed=10, added=3), Ledger(removed=1, added=130, unit=64)
    both = base + detail
    assert (both.removed, both.added, both.unit) == (641, 322, 64)
    assert detail + base == both
    assert both.volume(2.0) == pytest.approx(base.volume(2.0) + detail.volume(2.0), rel=1e-14)


def test_a_detail_count_stands_for_its_own_post_s_ground() -> None:
    """Posts half as far apart, counts half as high: an eighth of the volume."""
    assert Ledger(added=8, unit=8).volume(3.0) == Ledger(added=1).volume(3.0)
    assert Ledger(added=1).volume(3.0) == pytest.approx(9.0 * COUNT_M, rel=1e-15)
