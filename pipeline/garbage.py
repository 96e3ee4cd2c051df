"""When Python looks for garbage: seldom, as what libraries load stays for good."""

import atexit
import gc

# Containers made since the last look. By default it is 700: in a report 500 looks at a few hundred
# thousand objects, a tenth of its time, that free nothing; its memory is the same with either.
_MADE = 300_000
_OF_A_SERVER = 30_000  # in a process that runs for hours


def collect_seldom() -> None:
    """Look for cycles of dead objects less often, in a process that is ours alone.

    And not at its end, where Python would go through all of them before the system takes them:
    an eighth of a report's time.
    """
    gc.set_threshold(_MADE)
    atexit.register(gc.freeze)


def collect_for_hours() -> None:
    """Look for cycles more often again, in a process that runs for hours.

    Each saved row of a desk leaves some thousand dead objects: after 120 rows, before the first
    look, they were 30 MB.
    """
    gc.set_threshold(_OF_A_SERVER)
