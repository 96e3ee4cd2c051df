"""Commands of models: simulate, effects, schema."""

import json
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import AsJson, Hide, Model, Preset, app, progress_line, say


@app.command()
def simulate(
    out: Annotated[Path, typer.Option(help="The submission folder to write.")],
    preset: Preset = None,
    model: Model = None,
    hide: Hide = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed: same seed, same bytes.")] = 0,
    reported: Annotated[
        bool, typer.Option("--reported", help="Add the numbers an honest student would report.")
    ] = False,
) -> None:
    """Write a synthetic submission: decays, steps, sine dwells, a sweep, a closed-loop step."""
    from pipeline.output import new_folder
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.submission import write_submission

    new_folder(out)
    bench = prepare_bench(preset=preset, model=model, hide=hide or ())
    for sentence in bench.effect_sentences:
        say(f"hidden: {sentence}")
    with progress_line() as progress:
        progress("simulating the experiments")
        write_submission(out, bench, seed=seed, reported=reported)
    say(f"wrote {out}: try `cartlab report {out}`")


@app.command()
def effects(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One effect; default: all.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Write effects.html, with pictures, to this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the effects beyond the linear chain: law, fingerprint, deciding experiment."""
    from pipeline.plant.catalogue import CATALOGUE, find_effect
    from pipeline.report.effect_texts import catalogue_data, catalogue_text

    chosen = [find_effect(name)] if name else CATALOGUE
    if out:
        from pipeline.output import named_folder
        from pipeline.report.effects import render_effects

        with progress_line() as progress:
            render_effects(chosen, named_folder(out), progress=progress)
        say(f"wrote {out / 'effects.html'}")
    if as_json:
        typer.echo(json.dumps(catalogue_data(chosen), indent=1, ensure_ascii=False))
    elif not out:
        typer.echo(catalogue_text(chosen))


@app.command()
def schema(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="results, gap, solution, grade or check.")
    ] = "results",
) -> None:
    """Print the JSON Schema of results.json, gap.json, solution.json, grade.json or a check."""
    from pipeline.schemas import schema_text

    typer.echo(schema_text(name), nl=False)
