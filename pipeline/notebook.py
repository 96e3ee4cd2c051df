"""Analyses for a notebook: one call each, with results as pandas and control objects."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from pipeline.errors import ConfigError, DataError
from pipeline.gap.types import Gap
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.self_check.answers import CheckAnswer, answer_lines
from pipeline.grading.self_check.check import check_numbers
from pipeline.plant.margins import closed_loop, stability_margins
from pipeline.plant.motion import EquationsOfMotion
from pipeline.report import gap_tables, tables
from pipeline.report.document import Block, Document, Heading
from pipeline.report.gap_files import with_gap
from pipeline.report.gap_verdict import terminal_verdict
from pipeline.report.html import render_fragment
from pipeline.report.lab_report import build_document
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis, ChainWithUnits, FeedbackDesign
from pipeline.submission import load_submission
from pipeline.submission.load import with_reported
from pipeline.words.progress import silent
from pipeline.words.text import spans, with_symbols
from pipeline.workflow import analyse as run

if TYPE_CHECKING:
    import control
    import pandas as pd

_AT_A_GLANCE = ("summary", "parameters")
T = TypeVar("T")


class Named(dict[str, T]):
    """A dictionary that answers a wrong name with all names."""

    def __missing__(self, name: object) -> T:
        """Refuse an unknown name."""
        raise KeyError(f"there is no {name!r}; there are {', '.join(self) or 'none'}")


class Records(Named["pd.DataFrame"]):
    """The measured data by experiment; a notebook cell displays the list of recordings."""

    @property
    def _shown(self) -> "pd.DataFrame":
        import pandas as pd

        rows = {
            name: {
                "kind": frame.attrs["kind"],
                "samples": len(frame),
                "duration [s]": round(float(np.ptp(frame.index)), 3),
                "columns": ", ".join(f"{c} [{frame.attrs['units'][c]}]" for c in frame.columns),
            }
            for name, frame in self.items()
        }
        return pd.DataFrame.from_dict(rows, orient="index")

    def __repr__(self) -> str:
        return self._shown.to_string()

    def _repr_html_(self) -> str:
        return self._shown.to_html()


@dataclass(frozen=True)
class Shown:
    """Parts of a report, displayed in a notebook as in the report."""

    title: str
    blocks: tuple[Block, ...]

    def _repr_html_(self) -> str:
        return render_fragment((Heading(spans(self.title)), *self.blocks))

    def __repr__(self) -> str:
        return f"Shown({self.title!r})"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Lab:
    """All results of one submission; a notebook cell displays its summary and table.

    Attributes
    ----------
    results : all results, in cartlab's own types (`pipeline.results`).
    """

    results: Analysis
    document: Document

    # ----------------------------------------------------------------- systems

    @cached_property
    def chain(self) -> ChainWithUnits:
        """The identified masses, dampings and springs.

        Raises
        ------
        DataError : the carts could not be identified; the message gives the reasons.
        """
        chain = self.results.chain_with_units
        if chain is None:
            raise DataError(f"the carts were not identified: {self._reasons}")
        return chain

    @cached_property
    def design(self) -> FeedbackDesign:
        """The designed state feedback: gains, prefilter, margins, …

        Raises
        ------
        DataError : no feedback was designed; the message gives the reasons.
        """
        if self.results.feedback is None:
            raise DataError(f"no feedback was designed: {self._reasons}")
        return replace(self.results.feedback, units=self.results.bench.units)

    @property
    def _reasons(self) -> str:
        return "; ".join(f"{skip.name}: {skip.reason}" for skip in self.results.skipped)

    @cached_property
    def system(self) -> "control.StateSpace":
        """The carts as a continuous system: states `x1, v1, …`, input `u`, outputs `x1, …`."""
        return self.chain.to_control()

    @cached_property
    def transfer_functions(self) -> "dict[str, control.TransferFunction]":
        """The transfer function from `u` to each output, by the output's name."""
        import control

        return Named(
            (
                name,
                control.TransferFunction(
                    *self.chain.transfer_function(cart), inputs=["u"], outputs=[name], name=name
                ),
            )
            for cart, name in enumerate(self.system.output_labels, start=1)
        )

    @cached_property
    def frd(self) -> "dict[str, control.FrequencyResponseData]":
        """The measured frequency response from `u` to each output, by the output's name.

        A table of amplitude ratios has no phases, so it is only in `frequency_response`.
        """
        import control

        return Named(
            (
                f"x{measured.cart}",
                control.FrequencyResponseData(
                    measured.magnitude * np.exp(1j * measured.phase),
                    measured.omega,
                    inputs=["u"],
                    outputs=[f"x{measured.cart}"],
                    name=f"x{measured.cart}",
                ),
            )
            for measured in self.results.frequency_responses
            if measured.phase is not None
        )

    @cached_property
    def closed_loop(self) -> "control.StateSpace":
        """The designed loop from set point `r` to the positions, a discrete system with `dt` in s.

        Its states are `x1, v1, …` and `u`, the input computed one sample earlier.
        """
        controller = self.design.controller(self.chain)
        return closed_loop(self.chain, controller, sample_time=self.design.sample_time)

    def stability_margins(self) -> tuple[float, float, float, float, float, float]:
        """Return gm, pm, sm, wpc, wgc, wms of the designed loop, cut at the motor.

        They mean the same as those of `control.stability_margins`.
        """
        controller = self.design.controller(self.chain)
        return stability_margins(self.chain, controller, sample_time=self.design.sample_time)

    # ------------------------------------------------------------------ tables

    @cached_property
    def parameters(self) -> "pd.DataFrame":
        """Initial and final estimates, one row per parameter."""
        return tables.parameters(self.results)

    @cached_property
    def checks(self) -> "pd.DataFrame":
        """The consistency checks, one row per check."""
        return tables.checks(self.results)

    @cached_property
    def decays(self) -> "pd.DataFrame":
        """Natural frequency and damping of each free decay, with its friction test."""
        return tables.decays(self.results)

    @cached_property
    def steps(self) -> "pd.DataFrame":
        """The static gain of each step and cart."""
        return tables.steps(self.results)

    @cached_property
    def dwells(self) -> "pd.DataFrame":
        """Amplitudes, ratio and phase of each sine dwell and cart."""
        return tables.dwells(self.results)

    @cached_property
    def frequency_response(self) -> "pd.DataFrame":
        """The measured points of the Bode plots, by cart and frequency."""
        return tables.frequency_response(self.results)

    @cached_property
    def records(self) -> "dict[str, pd.DataFrame]":
        """The measured data by experiment, as tables with index `time` and columns `u`, `x1`, …"""
        records = self.results.records
        return Records((r.id, tables.record_frame(r, analysis=self.results)) for r in records)

    # ------------------------------------------------------------------ report

    @property
    def questions(self) -> dict[str, str]:
        """The questions that the data raise, by the id that `notes.md` uses for the answer."""
        return Named((one.id, with_symbols(one.text)) for one in ask(self.results))

    @property
    def sections(self) -> tuple[str, ...]:
        """The names of the sections that `show` accepts."""
        return tuple(section.id for section in self.document.sections)

    def show(self, section: str) -> Shown:
        """Return one section of the report ("frequency-response", "feedback", …).

        Raises
        ------
        ConfigError : this report has no such section.
        """
        for found in self.document.sections:
            if found.id == section:
                return Shown(found.title, found.blocks)
        raise ConfigError(f"no section {section!r}; there are {', '.join(self.sections)}")

    def _repr_html_(self) -> str:
        shown = (section for section in self.document.sections if section.id in _AT_A_GLANCE)
        return render_fragment(
            [block for s in shown for block in (Heading(spans(s.title)), *s.blocks)]
        )

    def __repr__(self) -> str:
        return terminal_summary(self.results)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ExplainedGap:
    """The gap analysis; a notebook cell displays its verdict.

    Attributes
    ----------
    results : the results of the gap analysis, in cartlab's own types (`pipeline.gap.types`).
    analysis : the analysis of the submission, which gives the tables their units.
    """

    results: Gap
    analysis: Analysis

    @property
    def verdict(self) -> str:
        """The verdict: `named`, `partial`, `none`, `ambiguous` or `unexplained`."""
        return self.results.verdict

    @cached_property
    def effects(self) -> "pd.DataFrame":
        """The effects in the order found, one row each; the columns are the keys of `gap.json`."""
        return gap_tables.effects(self.results)

    @cached_property
    def parameters(self) -> "pd.DataFrame":
        """The parameters of the effects, one row each, with standard errors and units."""
        return gap_tables.parameters(self.results)

    @cached_property
    def linear(self) -> "control.StateSpace":
        """The best linear model of the carts: states `x1, v1, …`, input `u`, outputs `x1, …`."""
        return self.results.linear.chain.to_control()

    @cached_property
    def system(self) -> "control.NonlinearIOSystem":
        """The carts with their effects: states `x1, v1, …` and the effects' own states.

        Raises
        ------
        DataError : the motor acts before its logged input; no state model can do that.
        """
        return EquationsOfMotion(self.results.model).to_control()

    @property
    def records(self) -> tuple[str, ...]:
        """The recordings that the gap analysis used; `simulate` accepts them."""
        return tuple(sorted({trace.experiment for trace in self.results.traces}))

    def simulate(self, record: str) -> "pd.DataFrame":
        """Return a table by `time` with `measured`, `linear` and `with_effects` for each cart.

        Raises
        ------
        ConfigError : the gap analysis did not use this recording.
        """
        if record not in self.records:
            known = ", ".join(self.records)
            raise ConfigError(f"no recording {record!r} was used; there are {known}")
        return gap_tables.simulated(self.results, record)

    @cached_property
    def residual(self) -> "pd.DataFrame":
        """The force that the model does not explain, one row per cart and short window."""
        return gap_tables.residual(self.results, analysis=self.analysis)

    def __repr__(self) -> str:
        return terminal_verdict(self.results)


def explain(folder: Path | str, *, budget: float | None = None) -> ExplainedGap:
    """Find what the linear model of a submission leaves out, as `cartlab gap` does.

    `budget` is a time limit in s; if the search reaches it, the result is the best answer so far.

    Raises
    ------
    SubmissionError : `submission.toml` is wrong or missing, or no data can be read.
    DataError : no recording can be compared with a model.
    """
    from pipeline.gap.explain import investigate  # imported here because it compiles, which is slow

    analysis = run(load_submission(Path(folder)), design=False)
    found = investigate(analysis, budget=budget, progress=silent)
    return ExplainedGap(results=found, analysis=analysis)


def analyse(folder: Path | str) -> Lab:
    """Run the whole pipeline on a submission folder.

    Raises
    ------
    SubmissionError : `submission.toml` is wrong or missing, or no data can be read.
    """
    submission = load_submission(Path(folder))
    results, gap = with_gap(run(submission), submission.folder)
    return Lab(results=results, document=build_document(results, gap=gap))


@dataclass(frozen=True, kw_only=True, repr=False)
class CheckedNumbers:
    """Which reported numbers disagree with the recordings, displayed as by `cartlab check`.

    Attributes
    ----------
    answer : the line of `checks.jsonl`, which contains no estimated value.
    """

    answer: CheckAnswer

    @property
    def disagree(self) -> tuple[str, ...]:
        """The keys of the numbers that disagree with the recordings, such as "final.K"."""
        return self.answer.disagree

    @property
    def agree(self) -> tuple[str, ...]:
        """The keys of the numbers that agree with the recordings."""
        return self.answer.agree

    def share(self, *numbers: str) -> float:
        """Return the share of these numbers that agree; a missing number counts as wrong."""
        if not numbers:
            raise TypeError('name the numbers that count: share("final.K", "final.zeta")')
        return sum(number in self.agree for number in numbers) / len(numbers)

    def __repr__(self) -> str:
        return "\n".join(answer_lines(self.answer))


def check(
    folder: Path | str,
    *,
    reported: Mapping[str, Any] | None = None,
    rubric: Path | str | None = None,
) -> CheckedNumbers:
    """Find which reported numbers disagree with the recordings, as `cartlab check` does.

    A second call without changes says where to look. The answer never contains the right value.
    Each answer is appended to the submission's `checks.jsonl`.

    Parameters
    ----------
    reported : numbers by table, as in `{"final": {"K": 24.3}}`. A string such as "0.10" keeps its
        trailing zeros. By default the numbers in `submission.toml`.
    rubric : file, or name of a shipped rubric, that sets the tolerances. By default the shipped
        rubric for this number of carts.

    Raises
    ------
    SubmissionError : nothing is reported, a name is unknown, or no recording can be read.
    """
    submission = load_submission(Path(folder))
    if reported is not None:
        submission = with_reported(submission, reported)
    asked = load_rubric(Path(rubric)) if rubric else None
    return CheckedNumbers(answer=check_numbers(submission, rubric=asked))
