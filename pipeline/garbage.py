"""Make Python's garbage collection run seldom, because most objects live until the end."""

import atexit
import gc

# Number of new containers that triggers a search for garbage. With Python's default of 700, a
# report searches a few hundred thousand objects 500 times. This takes a tenth of the report's time
# and frees nothing.
_NEW_OBJECTS = 300_000
_NEW_OBJECTS_SERVER = 30_000  # the same for a process that runs for hours


def collect_seldom() -> None:
    """Search for cycles of dead objects less often, in a process that only cartlab uses.

    Skip the search at exit as well: the system frees the memory anyway, and the search takes an
    eighth of a report's time.
    """
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)


def collect_for_hours() -> None:
    """Search for dead objects more often than `collect_seldom`, in a process that runs for hours.

    Saving rows in a desk leaves many dead objects. With `collect_seldom` alone, 120 rows filled 30
    MB before the first search.
    """
    gc.set_threshold(_NEW_OBJECTS_SERVER)
