"""Whether tests run at their full size (`make soak`) or in small (`make test`)."""

from __future__ import annotations

import os

SOAKING = os.environ.get("TERRASIM_SOAK") == "1"
"""Set by `make soak`."""
