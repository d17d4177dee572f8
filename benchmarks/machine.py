"""What the benchmarks say of the machine that they ran on."""

import contextlib
import platform
from pathlib import Path


def cpu_name() -> str:
    """The CPU's model, as far as the operating system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":")[1].strip()
    return platform.processor() or platform.machine()
