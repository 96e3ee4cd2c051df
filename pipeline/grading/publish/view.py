"""A grade as one audience may read it, and the pseudonyms under which names are hidden.

Every page, table and file for people uses this view. In a lab where students find the numbers
themselves (`see = "check"`), the team reads outcomes, points, the titles of flags, and what a
person wrote, but no computed number. Pseudonyms are made here; the key to them is a file, and
commands accept them.
"""

import hashlib
import re
from base64 import b32encode
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pipeline.grading.grade import Code, Criterion, Flag, Grade
from pipeline.grading.gradebook.entry import Entry
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import FAILED, Event
from pipeline.grading.rubric import Rubric, find_remarks
from pipeline.grading.similarity.shared_data import shared_message, student_message
from pipeline.grading.words import WORDS, person_lines, points_text
from pipeline.output import csv_text
from pipeline.words.text import with_symbols

Audience = Literal["team", "staff"]
See = Literal["report", "check"]
_WITHOUT_NUMBERS: tuple[Code, ...] = ("missing", "shared_data")  # flags whose text has no numbers


@dataclass(frozen=True, kw_only=True)
class GradeView:
    """A grade as one audience may read it.

    Attributes
    ----------
    grade : the grade, with the names that the audience may read.
    hides_numbers : whether to leave out all computed numbers.
    comments : what a person wrote about a criterion without giving points, by criterion.
    """

    grade: Grade
    rubric: Rubric
    hides_numbers: bool = False
    comments: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_by_hand(self) -> bool:
        """Whether a person gave points or changed the total."""
        return bool(self.grade.by_hand)

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of the grader."""
        return () if self.hides_numbers else self.grade.notes

    def flag_text(self, flag: Flag) -> str:
        """Return the text of a flag for students, without the name of another team; or ""."""
        hidden = self.hides_numbers and flag.code not in _WITHOUT_NUMBERS
        return "" if hidden else student_message(flag)

    def flag_lines(self) -> list[str]:
        """Return the texts of all flags."""
        return [with_symbols(text) for text in map(self.flag_text, self.grade.flags) if text]

    def reasons(self, judged: Criterion) -> list[str]:
        """Return why a criterion has its points.

        Without numbers, these are the titles of its flags, and what a person wrote.
        """
        if not self.hides_numbers:
            return [judged.message]
        asked = (one for one in self.rubric.criteria if one.id == judged.id)
        flags = [flag for one in asked for flag in find_remarks(self.grade, one, self.rubric)]
        titles = [WORDS.text(f"title_{flag.code}") for flag in flags]
        given = {one.criterion: one.why for one in self.grade.overrides}
        why = {**self.comments, **given}.get(judged.id, "")
        return [*dict.fromkeys(titles), *([why] if why else [])]

    def total_lines(self) -> list[str]:
        """Return the sentences about the total: lateness, adjustments, and what is not final."""
        off = self.grade.deducted
        late = [f"Late: {points_text(off)} points off."] if off else []
        return [*late, *person_lines(self.grade)]


def view(
    entry: Entry,
    audience: Audience,
    *,
    names: Mapping[str, str] | None = None,
    see: See | None = None,
) -> GradeView:
    """Return what an audience may read of a grade.

    Parameters
    ----------
    audience : a team reads its own grade; it never reads the name of another team in an anonymous
        class, and no computed number in a lab where students find them. The staff reads all.
    names : pseudonyms by submission, for a staff that may not read names; None to show names.
    see : what this reader may see; default: what the rubric lets students see.
    """
    rubric, grade = entry.rubric, entry.grade
    comments = {id_: own.text for id_, own in entry.comments.items()}
    if audience == "staff":
        grade = grade if names is None else anonymise(grade, names)
        return GradeView(grade=grade, rubric=rubric, comments=comments)
    if rubric.anonymous:
        grade = anonymise(grade, {entry.submission: entry.submission})
    return new_view(grade, rubric, comments=comments, see=see)


def new_view(
    grade: Grade, rubric: Rubric, *, comments: Mapping[str, str] = {}, see: See | None = None
) -> GradeView:
    """Return what a team may read of a grade that may be in no gradebook yet; see `view`."""
    hides_numbers = (see or rubric.students.see) == "check"
    return GradeView(grade=grade, rubric=rubric, hides_numbers=hides_numbers, comments=comments)


KEY_FILE = "anonymous-key.csv"
_PREFIX = "anon-"
_SHORTEST = 6  # characters: rarely too few, even for a thousand submissions
STRANGER = "another submission"
# The name of an archive at the beginning of a reason.
_ARCHIVE = re.compile(r"^.*?\.zip\W?: ", re.IGNORECASE)


def pseudonyms(first_keys: Mapping[str, str]) -> dict[str, str]:
    """Return a pseudonym for each submission.

    Parameters
    ----------
    first_keys : for each submission, the hash of its first version. So later versions keep the
        pseudonym, and nobody can compute it from the name.
    """
    hashes = {
        name: b32encode(hashlib.sha256(f"anonymous {key}".encode()).digest()).decode().lower()
        for name, key in first_keys.items()
    }
    length = _SHORTEST
    while max(Counter(code[:length] for code in hashes.values()).values(), default=1) > 1:
        length += 1
    return {name: f"{_PREFIX}{code[:length]}" for name, code in hashes.items()}


def pseudonyms_in(book: Gradebook) -> dict[str, str]:
    """Return the pseudonym of each submission of a class list."""
    return pseudonyms({entry.submission: entry.first_key for entry in book.entries()})


def is_pseudonym(name: str) -> bool:
    """Return whether a name looks like a pseudonym."""
    return name.startswith(_PREFIX)


def anonymise(grade: Grade, names: Mapping[str, str]) -> Grade:
    """Return the grade without the names of submissions and authors.

    These names also occur in two texts: in the flag for shared data, and in the reason why a
    submission could not be graded. In the reason they precede file names, because platforms put the
    student's name into the name of an archive. Names that students gave to runs and files stay.
    """
    own = names[grade.submission]
    hidden = {
        "submission": own,
        "authors": (),
        "reason": hidden_reason(grade.reason, grade.submission, own),
        "flags": tuple(
            _hidden(flag, names) if flag.code == "shared_data" else flag for flag in grade.flags
        ),
    }
    return grade.model_copy(update=hidden)


def hidden_reason(reason: str, submission: str, own: str) -> str:
    """Return the reason why a submission could not be graded, with `own` in place of its name."""
    if not reason:
        return ""
    name = re.escape(submission)
    path = re.compile(rf"^{name}(?=:)|(?<![^\s'\"(]){name}(?=[/\\])", re.MULTILINE)
    return path.sub(own, _ARCHIVE.sub("the archive: ", reason))


def _hidden(flag: Flag, names: Mapping[str, str]) -> Flag:
    """Return a flag for shared data with pseudonyms instead of names."""
    others = list(dict.fromkeys(names.get(o, STRANGER) for o in flag.evidence["submissions"]))
    evidence: dict[str, Any] = {"submissions": others}
    for kind in ("recordings", "tables"):
        evidence[kind] = [
            {**one, "submission": names.get(one["submission"], STRANGER)}
            for one in flag.evidence.get(kind, ())
        ]
    return Flag(
        code=flag.code,
        parameters=flag.parameters,
        message=shared_message(evidence),
        evidence=evidence,
    )


def key_text(names: Mapping[str, str], authors: Mapping[str, tuple[str, ...]]) -> str:
    """Return the key as CSV: submission and authors of each pseudonym."""
    rows = sorted((names[name], name, " ".join(authors[name])) for name in names)
    return csv_text(("anonymous", "submission", "authors"), rows)


def resolve_pseudonym(book: Gradebook, team: str) -> str:
    """Return the submission that a pseudonym stands for; any other name is returned unchanged."""
    if not is_pseudonym(team):
        return team
    return {shown: name for name, shown in pseudonyms_in(book).items()}.get(team, team)


def history_of(book: Gradebook, team: str) -> tuple[str, list[Event]]:
    """Return the history of a team, under the name that was asked for.

    If `team` is a pseudonym, the events contain no real names.

    Raises
    ------
    ConfigError : there is no such submission, or there are several.
    """
    name = resolve_pseudonym(book, team)
    submission, events = book.history(name, named=not is_pseudonym(team))
    return (submission, events) if name == team else (team, renamed_events(events, name, team))


def renamed_events(events: Sequence[Event], name: str, shown: str) -> list[Event]:
    """Return events in which the name of the submission is replaced by `shown`."""
    return [replace(event, text=_renamed(event.text, name, shown)) for event in events]


def _renamed(text: str, name: str, shown: str) -> str:
    if text.startswith(FAILED):
        text = FAILED + hidden_reason(text.removeprefix(FAILED), name, shown)
    return text.replace(name, shown)
