"""A command collects garbage rarely, and not when it ends."""

import subprocess
import sys

LOOKS = """
import gc, sys
looks = []
gc.callbacks.append(lambda phase, info: looks.append(phase) if phase == "start" else None)
sys.argv = ["cartlab", "effects", "--json"]
from pipeline.cli import main
try:
    main()
except SystemExit:
    sys.stderr.write(f"{len(looks)}\\n")
"""


def test_a_command_looks_for_garbage_a_few_times_only():
    """By default the imports of this command alone would start a hundred collections."""
    command = [sys.executable, "-c", LOOKS]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stderr.split()[-1]) < 40


ENDS = """
from pipeline.garbage import collect_seldom
class Cycle:
    def __init__(self):
        self.own = self
    def __del__(self):
        print("found")
collect_seldom()
Cycle()
"""


def test_what_is_left_at_the_end_is_the_systems():
    """At exit Python would search everything that was loaded, twice.

    The system frees it instead.
    """
    done = subprocess.run([sys.executable, "-c", ENDS], capture_output=True, text=True, check=True)
    assert done.stdout == ""


SERVES = """
from pipeline.garbage import collect_for_hours, collect_seldom
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


def test_a_process_for_hours_does_not_wait_for_300_000_dead_objects():
    """Of 100,000 cycles most are found while they are made."""
    command = [sys.executable, "-c", SERVES]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) > 50_000
