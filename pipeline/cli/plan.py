"""The command `plan`: propose what to record."""

import json
from typing import Annotated

import typer

from pipeline.cli.common import AsJson, Folder, app, progress_line, say
from pipeline.errors import ConfigError


@app.command()
def plan(
    folder: Folder,
    stock: Annotated[
        bool, typer.Option("--stock", help="The bench has only the stock commands (no chirp).")
    ] = False,
    number: Annotated[
        int | None,
        typer.Option("--next", min=1, max=20, help="Choose this many new experiments, best first."),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            "--for",
            help="With --next: what to improve: a parameter (zeta_2), `design` (the "
            "predicted overshoot), `worst`, `mean`, `volume`, or `gap` (the right explanation).",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Propose the experiments to record: write plan.toml, or add to it."""
    from pipeline.bench.raw import known_commands
    from pipeline.experiments.information import WORST
    from pipeline.experiments.next_recordings import plan_next
    from pipeline.experiments.plan import plan_data, plan_table
    from pipeline.experiments.propose import current_plan, make_plan
    from pipeline.submission import load_submission
    from pipeline.words.text import with_symbols

    if goal and number is None:
        raise ConfigError("--for states the goal of the next experiments, so it needs --next N")
    submission = load_submission(folder)
    before = {recording.id for recording in current_plan(submission).recordings}
    with progress_line() as progress:
        if number is None:
            made = make_plan(submission, stock=stock, progress=progress)
            words, further = [made.trouble, made.message], {}
        else:
            commands = frozenset[str]() if stock else known_commands(folder)
            made = plan_next(
                submission, n=number, goal=goal or WORST, commands=commands, progress=progress
            )
            words = [made.wrote, *map(with_symbols, made.sentences)]
            further = {
                "next": {"for": made.words, "separation": made.separation}
                if made.separation is not None
                else {
                    "for": made.words,
                    "now": made.now,
                    "errors": made.errors,
                    "planned": made.planned,
                }
            }
    new = {recording.id for recording in made.plan.recordings} - before
    if as_json:
        data = plan_data(made.plan, submission, new=new) | further
        typer.echo(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        typer.echo(plan_table(made.plan, submission, new=new))
    for sentence in filter(None, words):
        say(sentence)
