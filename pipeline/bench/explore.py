"""Explore a bench over a serial line, while people watch and intervene."""

from collections.abc import Callable, Sequence
from pathlib import Path

from pipeline.bench.acquire import acquire, ensure_plan
from pipeline.bench.events import Buttons, Observer, Stopped
from pipeline.bench.raw import known_commands
from pipeline.bench.serial_line import Runaway
from pipeline.experiments.exploration import Exploration, Recorded, Turn
from pipeline.experiments.information import ErrorGoal
from pipeline.experiments.plan import Recording, session_time
from pipeline.submission.load import NAME
from pipeline.words.text import with_symbols


def explore_bench(
    folder: Path,
    *,
    port: str,
    observer: Observer,
    buttons: Buttons | None,
    goal: ErrorGoal,
    write_diary: Callable[..., object],
    seconds: float,
    vetoes: Callable[[Recording], bool] = lambda recording: False,
) -> tuple[Turn, ...]:
    """Explore the bench at a port; return the turns.

    Parameters
    ----------
    observer, buttons : see `acquire`. "skip" vetoes the chosen recording, before or during it;
        "stop" ends the exploration, even during a computation.
    goal, seconds, vetoes, write_diary : see `Exploration`.

    Raises
    ------
    Stopped : a signal or a button ended the exploration.
    HardwareError, ConfigError, DataError : see `acquire` and `Exploration`.
    """
    buttons = buttons or Buttons()

    def record(ids: Sequence[str]) -> Recorded:
        outcomes = acquire(folder, port=port, observer=observer, only=ids, buttons=buttons)
        if astray := [o.partial for o in outcomes if o.is_astray]:
            raise Runaway(f"{astray[-1]}; the exploration ends here")
        made = tuple(o.recording.id for o in outcomes if not o.partial)
        tried = [o.recording for o in outcomes if o.lines]
        skipped = any(o.wish == "skip" for o in outcomes)
        ends = dict.fromkeys(o.partial for o in outcomes if o.partial)
        return Recorded(
            ids=made,
            seconds=session_time(tried),
            vetoed=skipped and not made,
            why=". Then: ".join(ends),
        )

    def think(stage: str) -> None:
        if buttons.pressed == "stop":
            raise Stopped("by hand")
        observer.thinking(stage)

    if (folder / NAME).exists():
        ensure_plan(folder, port=port)
    exploration = Exploration(
        folder=folder,
        record=record,
        write_diary=write_diary,
        known_commands=known_commands,
        goal=goal,
        seconds=seconds,
        announce=lambda sentence: observer.thought(with_symbols(sentence)),
        progress=think,
        vetoes=vetoes,
    )
    return exploration.run()
