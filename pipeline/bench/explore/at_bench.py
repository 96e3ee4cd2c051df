"""An exploration of a bench on a line, which people watch and steer."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.bench.explore.explore import Recorded, explore
from pipeline.bench.explore.wish import Wish
from pipeline.bench.host.acquire import acquire, ensure_plan
from pipeline.bench.host.serial_line import Runaway
from pipeline.bench.host.session import BY_HAND
from pipeline.bench.host.signals import Stopped
from pipeline.bench.live.observer import Buttons, Observer, Observers
from pipeline.bench.planning.plan import Recording
from pipeline.bench.planning.plan_words import session_time
from pipeline.report.exploration.turn import Turn
from pipeline.report.words import with_symbols
from pipeline.submission.load import NAME


def explore_bench(
    folder: Path,
    *,
    port: str,
    observers: Sequence[Observer],
    buttons: Buttons | None,
    wish: Wish,
    seconds: float,
    vetoes: Callable[[Recording], bool] = lambda recording: False,
) -> tuple[Turn, ...]:
    """Explore the bench at a port; return what was known turn by turn.

    Parameters
    ----------
    observers, buttons : see `acquire`; "skip" vetoes a recording that was chosen, before it begins
        or while it goes on, and "stop" ends the exploration, also while it thinks.
    wish, seconds, vetoes : see `explore`.

    Raises
    ------
    Stopped : a signal or a button ended it.
    HardwareError, ConfigError, DataError : see `acquire` and `explore`.
    """
    everyone, buttons = Observers(observers), buttons or Buttons()

    def record(ids: Sequence[str]) -> Recorded:
        outcomes = acquire(folder, port=port, observers=observers, only=ids, buttons=buttons)
        if astray := [o.partial for o in outcomes if o.is_astray]:
            raise Runaway(f"{astray[-1]}; the exploration ends here")
        made = tuple(o.recording.id for o in outcomes if not o.partial)
        tried = [o.recording for o in outcomes if o.lines]
        skipped = any(o.partial.endswith(BY_HAND["skip"]) for o in outcomes)
        ends = dict.fromkeys(o.partial for o in outcomes if o.partial)
        return Recorded(
            ids=made,
            seconds=session_time(tried),
            vetoed=skipped and not made,
            why="; then ".join(ends),
        )

    def think(stage: str) -> None:
        if buttons.pressed == "stop":
            raise Stopped("by hand")
        everyone.thinking(stage)

    if (folder / NAME).exists():
        ensure_plan(folder, port=port)
    return explore(
        folder,
        record=record,
        wish=wish,
        seconds=seconds,
        tell=lambda sentence: everyone.thought(with_symbols(sentence)),
        progress=think,
        vetoes=vetoes,
    )
