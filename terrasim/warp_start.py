"""Starting Warp without its remark that a machine has no GPU."""

from __future__ import annotations

import os
import sys
import tempfile

_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def start_warp() -> None:
    """Start Warp; what it prints meanwhile is passed on, but for the lack of a CUDA driver.

    The remark comes from native code, so the process's standard error is held back itself.
    """
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    with tempfile.TemporaryFile() as held:
        own = os.dup(2)
        try:
            os.dup2(held.fileno(), 2)
            wp.init()
        finally:
            os.dup2(own, 2)
            os.close(own)
        held.seek(0)
        said = held.read().decode(errors="replace")
    for line in said.splitlines():
        if line.strip() and _NO_DRIVER not in line:
            print(line, file=sys.stderr)
