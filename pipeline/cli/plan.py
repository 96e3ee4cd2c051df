"""The command that proposes what to record."""

import json
from typing import Annotated

import typer

from pipeline.cli.common import AsJson, Folder, app, progress_line, say


@app.command()
def plan(
    folder: Folder,
    stock: Annotated[
        bool, typer.Option("--stock", help="The bench knows the stock commands only: no chirp.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Propose the experiments to record: write plan.toml, or add to it what the data allow."""
    from pipeline.bench.planning.make import make_plan
    from pipeline.bench.planning.plan_words import plan_data, plan_table
    from pipeline.submission import load_submission

    submission = load_submission(folder)
    with progress_line() as progress:
        made = make_plan(submission, stock=stock, progress=progress)
    if as_json:
        typer.echo(json.dumps(plan_data(made.plan, submission), indent=1, ensure_ascii=False))
    else:
        typer.echo(plan_table(made.plan, submission))
    if made.trouble:
        say(made.trouble)
    say(made.said)
