"""Import files that other programs record, as they appear in a folder."""

import filecmp
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.bench.events import Observer
from pipeline.bench.experiments import add_experiment
from pipeline.errors import ConfigError, SubmissionError
from pipeline.experiments.plan import Plan, Recording, hold_words, load_plan, plan_path
from pipeline.ingest.files import ENDINGS, OF_STRANGERS
from pipeline.ingest.fill import experiment_entry, free_id
from pipeline.ingest.inspect import Inspection, inspect_file
from pipeline.output import own_folder
from pipeline.results import ExperimentKind
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import MAX_DATA_BYTES
from pipeline.submission.toml import Value

LOOK_EVERY = 0.5  # s between two scans of the folder


@dataclass(frozen=True, kw_only=True)
class Imported:
    """An imported file.

    Attributes
    ----------
    file : original name of the file.
    experiment : id of the file's experiment in the submission.
    planned : whether the file is the next recording of the plan.
    remarks : what to check before a report is made.
    """

    file: str
    experiment: str
    kind: ExperimentKind
    planned: bool
    remarks: tuple[str, ...] = ()


class Importer:
    """Watch a folder and import its files into a submission.

    Files that exist at the start are imported too, the oldest first. Each file is imported only
    once, even over several sessions, because the submission has a copy of it.
    """

    def __init__(self, folder: Path, source: Path, *, observer: Observer) -> None:
        if not source.is_dir():
            raise ConfigError(f"{source}: not a folder")
        OF_STRANGERS.set(True)
        self._folder = folder
        self._source = source
        self._observer = observer
        self._submission = load_submission(folder)
        self._plan: Plan | None = (
            load_plan(self._submission) if plan_path(self._submission).exists() else None
        )
        self._last_state: dict[Path, tuple[int, int]] = {}  # size and time at the last scan
        self._unchanged: dict[Path, int] = {}
        self._over: set[Path] = set()  # imported, refused, or already in the submission
        self._locked: set[Path] = set()  # locked files that were reported
        if self._plan:
            self._observer.planned(self._plan, self._done)

    def watch(
        self, *, once: bool, wait: Callable[[float], None] = time.sleep
    ) -> Iterator[Imported]:
        """Yield each imported file; end when the plan is done.

        Parameters
        ----------
        once : import only the files that exist now.
        """
        self._ask()
        while True:
            for path in self._complete(at_once=once):
                if (imported := self._try(path, final=once)) is not None:
                    yield imported
                    self._ask()
            if once or (self._plan is not None and self._next is None):
                return
            wait(LOOK_EVERY)

    @property
    def _done(self) -> frozenset[str]:
        return frozenset(experiment.id for experiment in self._submission.experiments)

    @property
    def _next(self) -> Recording | None:
        recordings = self._plan.recordings if self._plan else ()
        return next((r for r in recordings if r.id not in self._done), None)

    def _ask(self) -> None:
        if (recording := self._next) is not None:
            held = hold_words(recording.carts, n=self._submission.system.carts)
            hertz = f" at {recording.frequency:g} Hz" if recording.kind == "sine" else ""
            self._observer.remark(f"next: {recording.id}, a {recording.kind}{hertz}; {held}")

    def _complete(self, *, at_once: bool) -> list[Path]:
        """Return the files that no longer change and so are complete, oldest first."""
        ready = []
        for path in self._source.iterdir():
            # Hidden files, or temporary files of a running program.
            hidden = path.name.startswith((".", "~"))
            if path in self._over or hidden or self._is_other(path) or not self._opens(path):
                continue
            try:
                info = path.stat()
            except OSError:  # removed in the meantime
                continue
            state = info.st_size, info.st_mtime_ns
            self._unchanged[path] = (
                self._unchanged.get(path, 0) + 1 if self._last_state.get(path) == state else 0
            )
            self._last_state[path] = state
            if info.st_size and (at_once or self._unchanged[path] >= 2):  # it no longer changes
                ready.append(path)
        return sorted(ready, key=lambda path: (self._last_state[path][1], path.name))

    def _is_other(self, path: Path) -> bool:
        """Return True, and report it, if a path cannot be a data file."""
        if path.is_dir():
            why = "it is a folder"
        elif path.suffix.casefold() not in ENDINGS:
            why = f"the name of a data file ends in {', '.join(ENDINGS)}"
        else:
            return not path.is_file()
        self._over.add(path)
        self._observer.remark(f"{path.name}: not imported: {why}")
        return True

    def _opens(self, path: Path) -> bool:
        """Return whether a file can be read; a file that its program locks is tried again later."""
        try:
            path.open("rb").close()
        except OSError as error:
            if path not in self._locked:
                self._locked.add(path)
                self._observer.remark(f"{path.name}: cannot be read yet ({error.strerror})")
            return False
        return True

    def _try(self, path: Path, *, final: bool) -> Imported | None:
        """Import a file; if it is locked or vanishes, it is tried again later."""
        try:
            return self._take(path, final=final)
        except OSError:
            if path.exists() and self._opens(path):
                raise  # the file can be read, so writing to the submission failed
            self._over.discard(path)
            self._unchanged[path] = 0
            return None

    def _take(self, path: Path, *, final: bool) -> Imported | None:
        """Copy a file into the submission as an experiment.

        Return None if the file is refused, tried again later, or already in the submission.

        A file with an incomplete last line may still grow, so it is tried again later.

        Parameters
        ----------
        final : whether this is the last scan, so that a file cannot be tried again.
        """
        self._over.add(path)
        if path.stat().st_size > MAX_DATA_BYTES:
            self._observer.remark(
                f"{path.name}: not imported: larger than {MAX_DATA_BYTES:,} bytes"
            )
            return None
        if self._is_known(path):
            return None
        try:
            inspection = inspect_file(path)
        except SubmissionError as error:
            self._observer.remark(f"not imported: {error}")
            return None
        if inspection.cut_short:
            if not final and self._unchanged[path] < 20:  # its last line may still be written
                self._over.discard(path)
                return None
            if inspection.unusable:
                self._observer.remark(f"{path.name}: not imported: {inspection.problems[0]}")
                return None
        planned = self._match(inspection)
        kind = planned.kind if planned else inspection.kind
        if kind is None:
            why = "; ".join(inspection.problems)
            self._observer.remark(f"{path.name}: not imported: its content is unclear ({why})")
            return None
        name = planned.id if planned else free_id(path.stem, self._done)
        data = own_folder(self._folder, "data")
        data.mkdir(exist_ok=True)
        target = data / f"{name}{path.suffix.casefold()}"
        if target.exists() or target.is_symlink():
            self._observer.remark(f"{path.name}: not imported: {target} exists already")
            return None
        try:
            shutil.copyfile(path, target)
            entry = _entry(name, kind, target, inspection, planned, self._submission)
            self._submission = add_experiment(load_submission(self._folder), entry)
        except BaseException:
            target.unlink(missing_ok=True)
            raise
        if self._plan:
            self._observer.planned(self._plan, self._done)
        return Imported(
            file=path.name,
            experiment=name,
            kind=kind,
            planned=planned is not None,
            remarks=inspection.problems,
        )

    def _is_known(self, path: Path) -> bool:
        """Return whether the submission has a copy of the file."""
        copies = [self._folder / experiment.file for experiment in self._submission.experiments]
        return any(copy.is_file() and filecmp.cmp(copy, path, shallow=False) for copy in copies)

    def _match(self, inspection: Inspection) -> Recording | None:
        """Return the next recording of the plan if the file fits it."""
        recording = self._next
        if recording is None:
            return None
        if recording.kind == "sine":
            found = inspection.frequency
            near = found and abs(found / recording.frequency - 1) < 0.05
            return recording if inspection.kind == "sine" and near else None
        # Steps and sweeps can look the same, for example if a sweep switches its input.
        alike = {"sweep": ("sweep", "step"), "step": ("step", "sweep")}
        return (
            recording if inspection.kind in alike.get(recording.kind, (recording.kind,)) else None
        )


def _entry(
    name: str,
    kind: ExperimentKind,
    target: Path,
    inspection: Inspection,
    planned: Recording | None,
    submission: Submission,
) -> dict[str, Value]:
    """Return the keys of the `[[experiments]]` table of an imported file."""
    n = submission.system.carts
    carts = planned.carts if planned else inspection.moving
    file = f"data/{target.name}"
    entry = experiment_entry(inspection, name=name, kind=kind, file=file, carts=carts, n=n)
    if kind == "sine" and (hertz := planned.frequency if planned else inspection.frequency):
        entry["frequency"] = hertz if planned else float(f"{hertz:.4g}")
    return entry
