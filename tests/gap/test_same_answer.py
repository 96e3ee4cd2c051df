"""No clock decides: the same records give the same file, however busy the machine."""

import json
import subprocess
import sys

from pipeline.gap.explain import explain_gap
from pipeline.json_files import plain
from pipeline.set_up import Bench
from tests.truth.cases import make_case


def test_two_busy_processes_change_no_byte():
    """Friction on two carts, first alone, then beside two programs that never rest."""
    case = make_case(seed=61, n=2, effects=("coulomb_friction",), rate=113.1)

    def answer() -> str:
        gap = explain_gap(case.records, Bench(springs=case.springs))
        return json.dumps(plain(gap))

    alone = answer()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        assert answer() == alone
    finally:
        for process in busy:
            process.kill()
            process.wait()
