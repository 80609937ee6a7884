"""What the ground under balls did since their last step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass
class Moved:
    """How far the ground went up under balls since their last step."""

    rises: Any
    """``kernels.rise.Rise``, one a ball."""
    most: float = 0.0
    """No ball's ground went further up or down [m]."""
