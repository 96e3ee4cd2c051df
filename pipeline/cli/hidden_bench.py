"""The bench of `demo`, run with `python -m` in a second process: hide friction, then find it."""

import json
import os
import sys
import threading
from pathlib import Path

from pipeline.cli.reports import explain
from pipeline.startup import collect_seldom
from pipeline.words.progress import Progress, silent


def find_hidden(out: Path, *, progress: Progress) -> list[str]:
    """Write a bench with hidden friction and its gap analysis; return the messages to print."""
    from pipeline.gap.explain import predictor_compiled
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.submission import write_submission

    hidden, folder = prepare_bench(preset="throne-2dof", hide=["coulomb_friction"]), out / "bench"
    if not (folder / "submission.toml").exists():
        with predictor_compiled():
            write_submission(folder, hidden, seed=0)
    _, told = explain(folder, out=out / "gap", progress=progress)
    return [*(f"hidden: {sentence}" for sentence in hidden.effect_sentences), *told]


def _end_with_parent() -> None:
    os.read(0, 1)  # returns when the process that started this one has ended
    os._exit(1)  # safe at any time, because files are written whole or not at all


if __name__ == "__main__":
    collect_seldom()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    json.dump(find_hidden(Path(sys.argv[1]), progress=silent), sys.stdout)
