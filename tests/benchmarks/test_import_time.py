"""How long a user waits for `hdmap --help`."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

MOST_S = 0.4
ROUNDS = 7


@pytest.mark.benchmark_suite
def test_help_is_quick(benchmark: Any) -> None:
    hdmap = Path(sys.executable).parent / "hdmap"

    def show_help() -> None:
        subprocess.run([hdmap, "--help"], check=True, capture_output=True)

    # The warm-up compiles the modules and brings them into the disk cache.
    benchmark.pedantic(show_help, rounds=ROUNDS, warmup_rounds=2)
    # The best round: what others do on the machine only ever adds to the time.
    assert benchmark.stats.stats.min <= MOST_S
