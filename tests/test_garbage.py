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
