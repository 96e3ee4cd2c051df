"""The tables of learning platforms: their columns and the values written into them.

The text for a column contains placeholders in braces, which are replaced by the student's values;
see `export.values_of`. In column names, `{title}` is replaced by the title of the assignment.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.grading.intake.lms_names import Platform


@dataclass(frozen=True, kw_only=True)
class Form:
    """The columns of a platform's tables.

    Attributes
    ----------
    own : sets of columns; a table is the platform's own if it has all columns of one set.
    filled : columns of the platform's own table that receive grades.
    if_there : columns that receive values only if the table has them.
    kept : other columns to keep; empty: all.
    new : the columns of a table that cartlab makes.
    """

    own: tuple[frozenset[str], ...] = ()
    filled: Mapping[str, str]
    if_there: Mapping[str, str] = field(default_factory=dict)
    kept: tuple[str, ...] = ()
    new: Mapping[str, str]


FORMS: Mapping[Platform, Form] = {
    "canvas": Form(
        own=(frozenset({"Student", "ID"}),),
        filled={"{title}": "{points}"},
        # All columns about the student. The importer wants "Section" to be the last of these.
        kept=(
            "Student", "ID", "SIS User ID", "SIS Login ID", "Integration ID", "Root Account",
            "Section",
        ),
        new={
            "Student": "{name_or_id}", "ID": "{number}", "SIS User ID": "{id}",
            "SIS Login ID": "{id}", "Section": "", "{title}": "{points}",
        },
    ),
    "moodle": Form(
        own=tuple(
            frozenset({name}) for name in ("Identifier", "ID number", "Username", "Email address")
        ),
        filled={"{title} (Real)": "{points}"},
        if_there={"Feedback comments": "{comment}"},
        new={
            "ID number": "{id_or_name}", "{title} (Real)": "{points}",
            "{title} (Feedback)": "{comment}",
        },
    ),
    "gradescope": Form(
        own=(frozenset({"SID"}), frozenset({"Email"}), frozenset({"Submission ID"})),
        filled={"Total Score": "{points}", "Max Points": "{most}"},
        new={
            "First Name": "{first_name}", "Last Name": "{last_name}", "SID": "{sid}",
            "Email": "{email}", "Sections": "", "Total Score": "{points}", "Max Points": "{most}",
            "Status": "{status}", "Submission ID": "{number}", "Submission Time": "",
            "Lateness (H:M:S)": "{late}", "View Count": "", "Submission Count": "",
        },
    ),
}  # fmt: skip
# Moodle's offline grading worksheet of one assignment, used if the participant numbers are known.
WORKSHEET = Form(
    filled={"Grade": "{points}"},
    if_there={"Feedback comments": "{comment}"},
    new={
        "Identifier": "Participant {number}", "Full name": "{name}", "ID number": "{id}",
        "Status": "", "Grade": "{points}", "Maximum Grade": "{most}",
        "Grade can be changed": "Yes", "Last modified (submission)": "-",
        "Last modified (grade)": "-", "Feedback comments": "{comment}",
    },
)  # fmt: skip
