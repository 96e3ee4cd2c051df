"""The command that proposes what to record."""

import json
from typing import Annotated

import typer

from pipeline.cli.common import AsJson, Folder, app, progress_line, say
from pipeline.errors import DataError


@app.command()
def plan(
    folder: Folder,
    stock: Annotated[
        bool, typer.Option("--stock", help="The bench knows the stock commands only: no chirp.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Propose the experiments to record: write plan.toml, or add to it what the data allow."""
    from pipeline.bench.planning.plan_file import load_plan, plan_path, save_plan
    from pipeline.bench.planning.plan_words import plan_data, plan_table
    from pipeline.bench.planning.propose import extend_plan, propose_plan
    from pipeline.bench.protocol.messages import Description
    from pipeline.submission import load_submission

    submission = load_submission(folder)
    bench = Description(name="stock", encoders=2, carts=submission.system.carts) if stock else None
    there = plan_path(submission).exists()
    old = load_plan(submission) if there else propose_plan(submission, bench=bench)
    with progress_line() as progress:
        progress("asking the data what else to record")
        try:
            new, trouble = extend_plan(old, submission, bench=bench), None
        except DataError as error:  # a plan that data cannot help stands as it is
            new, trouble = old, str(error)
    path = save_plan(new, submission)
    if as_json:
        typer.echo(json.dumps(plan_data(new, submission), indent=1, ensure_ascii=False))
    else:
        typer.echo(plan_table(new, submission))
    if trouble:
        say(trouble)
    added = len(new.recordings) - (len(old.recordings) if there else 0)
    say(f"{path}: {added} recordings added" if there else f"wrote {path}: check its [limits]")
