"""A plant as a whole submission: `submission.toml` and the data a class would have recorded."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.errors import ConfigError
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.loop.sampled_loop import StateFeedback
from pipeline.plant.nonlinear.effects import Term
from pipeline.results import FeedbackDesign
from pipeline.stages.state_feedback import design_feedback
from pipeline.submission import Design
from pipeline.synthesis import claims, runs
from pipeline.synthesis.files import Value, csv_text, toml_section
from pipeline.synthesis.rig import Rig, Run

# The ECP 210: its servo loop and its encoder.
SAMPLE_TIME = 0.00884  # s
COUNT = 0.00227  # cm

_NOISE_COUNTS = 0.2  # enough to make a free cart's reading flicker between two counts
_ZERO_ERROR_COUNTS = 2.0  # encoders are zeroed by hand


def write_submission(
    folder: Path,
    *,
    chain: Chain | str,
    seed: int,
    effects: Sequence[Term] = (),
    title: str | None = None,
    section: str = "01",
    authors: Sequence[str] | None = None,
    springs: Sequence[bool] | None = None,
    position_unit: str = "cm",
    input_unit: str = "V",
    sample_time: float = SAMPLE_TIME,
    time_decimals: int = 5,
    count: float = COUNT,
    travel: float = 1.0,
    input_limit: float = 5.0,
    compact: bool = False,
    reported: bool = False,
    notes: str | None = None,
) -> None:
    """Write the submission of students who measured `chain`; same arguments, same bytes.

    Parameters
    ----------
    folder : made if need be; files of the same names are replaced.
    chain : the true plant, or a preset's name.
    authors : ids; default: two that go with the seed, so that a class has no one twice.
    effects : what the bench does beyond the linear chain. Nothing written tells of it, and the
        students believe in a linear chain.
    springs : which springs the students say there are; default: those of the chain.
    sample_time : s, of the controller and the log; `time_decimals` of its stamps (3 gives the
        rounded ones of an ECP export).
    count : the encoder step, position units.
    travel : how far the carts are meant to move, and the size of the controlled step.
    compact : fewer repeats and dwells, most dwells without their transient: half the size.
    reported : add what honest students claim, `[reported]`.
    notes : text of `notes.md`.

    Raises
    ------
    ConfigError : there is no such preset.
    DataError : the chain never settles, has no static gain, or runs away with its effects.
    """
    if isinstance(chain, str):
        title = title or f"Simulated bench, {chain}, seed {seed}"
        chain = preset_chain(chain)
    authors = authors or (f"s{1001 + 2 * seed}", f"s{1002 + 2 * seed}")
    rng = np.random.default_rng(seed)
    session = runs.Session(
        sample_time=sample_time,
        travel=travel,
        input_limit=input_limit,
        repeats=2 if compact else 3,
        n_dwells=22 if compact else 28,
        transients=not compact,
        sweep_time=12.0 if compact else 20.0,
    )
    bench = Rig(
        chain=chain,
        sample_time=sample_time,
        count=count,
        noise=_NOISE_COUNTS * count,
        zero_error=_ZERO_ERROR_COUNTS * count,
        effects=tuple(effects),
    )
    believed = claims.believed_chain(chain, rng)
    task = Design(
        cart=min(2, chain.n),  # the far one of two carts; the paper's choice of three
        reference=travel,
        overshoot_percent=10.0,
        settling_time=1.0,
        input_limit=input_limit,
        sample_time=sample_time,
        method="lqr",
    )
    design = _design(believed, task)
    dwells = runs.dwells(chain, session)
    programme = [
        *runs.decays(chain, session, rng),
        *runs.steps(chain, session),
        *dwells,
        runs.sweep(chain, session),
        runs.closed_loop(
            chain,
            session,
            cart=task.cart,
            reference=task.reference,
            controller=StateFeedback(
                gains=design.gains, prefilter=design.prefilter, model=believed
            ),
        ),
    ]

    logs = {}
    for run in programme:
        motion = bench.move(run)
        y = bench.read(motion, run=run, rng=rng)
        logs[_data_file(run)] = csv_text(
            run, u=motion.u, y=y, time_decimals=time_decimals, count=count
        )
    sections = [
        toml_section("", {"version": 1, "title": title or "Simulated bench", "section": section}),
        *(toml_section("[[authors]]", {"id": author}) for author in authors),
        toml_section(
            "[system]",
            {
                "carts": chain.n,
                "springs": [bool(k > 0) for k in chain.k] if springs is None else list(springs),
                "input": {"unit": input_unit, "sign": 1},
                "position": {"unit": position_unit},
            },
        ),
        toml_section("[design]", task.model_dump()),
        *(toml_section("[[experiments]]", _experiment(run)) for run in programme),
    ]
    if reported:
        initial = claims.initial_estimates(
            chain, dwells_hz=[run.frequency for run in dwells if run.frequency], rng=rng
        )
        sections += [
            toml_section("[reported.initial]", initial),
            toml_section("[reported.final]", claims.final_estimates(believed)),
            toml_section("[reported.state_space]", claims.state_space(believed)),
            toml_section("[reported.feedback]", claims.feedback(design)),
        ]
    (folder / "data").mkdir(parents=True, exist_ok=True)
    for file, text in logs.items():
        _write(folder / file, text)
    _write(folder / "submission.toml", "\n".join(sections))
    if notes is not None:
        _write(folder / "notes.md", notes)


def preset_chain(name: str) -> Chain:
    """Return a preset by its name.

    Raises
    ------
    ConfigError : there is no such preset.
    """
    if name not in PRESETS:
        raise ConfigError(f"no preset {name!r}: there are {', '.join(PRESETS)}")
    return PRESETS[name]


def _design(believed: Chain, task: Design) -> FeedbackDesign:
    """Return the controller as it is typed into the bench: gains to four digits."""
    design = design_feedback(believed, **dict(task))
    return replace(
        design,
        gains=np.array([float(f"{gain:.4g}") for gain in design.gains]),
        prefilter=float(f"{design.prefilter:.4g}"),
    )


def _data_file(run: Run) -> str:
    return f"data/{run.id}.csv"


def _experiment(run: Run) -> dict[str, Value]:
    """Return the keys of one `[[experiments]]`."""
    entry: dict[str, Value] = {"id": run.id, "kind": run.kind}
    if run.kind == "decay":
        entry["carts"] = list(run.free)
    if run.frequency is not None:
        entry["frequency"] = run.frequency
    if run.controller is not None and run.cart is not None:
        entry["controlled_cart"] = run.cart
        entry["controller"] = {
            "type": "state_feedback",
            "gains": run.controller.gains.tolist(),
            "prefilter": run.controller.prefilter,
        }
    entry["file"] = _data_file(run)
    if run.note:
        entry["note"] = run.note
    return entry


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")
