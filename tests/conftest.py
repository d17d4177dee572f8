"""What every test needs: the scripts on the import path, one thread, and the command line."""

import os
import subprocess
import sys
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # small problems: threads cost more than they bring
os.environ["CUDA_VISIBLE_DEVICES"] = ""  # the same device on every machine

import pytest

ROOT = Path(__file__).parent.parent
ALGORITHMS = ROOT / "algorithms"
sys.path.insert(0, str(ALGORITHMS))


@pytest.fixture
def command_line(tmp_path):
    """Run a script as its users do, in an empty folder; returns the finished process."""

    def run(script: str, *flags: str, timeout: float = 180) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, str(ALGORITHMS / script), *map(str, flags)], cwd=tmp_path,
            capture_output=True, text=True, encoding="utf-8", timeout=timeout)
    return run
