"""A command rarely collects garbage while it runs, and never when it ends."""

import subprocess
import sys

SERVES = """
from pipeline.startup import collect_for_hours, collect_seldom
class Cycle:
    def __init__(self):
        self.own = self
collect_seldom()
collect_for_hours()
import gc
looks = []
gc.callbacks.append(lambda phase, info: looks.append(info["collected"]))
for _ in range(100_000):
    Cycle()
print(sum(looks))
"""


def test_a_long_process_collects_garbage_while_it_runs():
    """A process that runs for hours frees most of 100,000 unused objects while it creates more."""
    command = [sys.executable, "-c", SERVES]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) > 50_000
