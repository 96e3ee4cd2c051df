"""The tables of learning platforms: their columns and the values written into them.

A column's text names values of a student in braces, see `export.values_of`; `{title}` is the
assignment's.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipeline.grading.intake.lms_names import Platform


@dataclass(frozen=True, kw_only=True)
class Form:
    """The columns of a platform.

    Attributes
    ----------
    own : columns of which its own table always has one, and other platforms' never.
    filled : columns of its own table that receive grades; `if_there` : optional ones.
    kept : other columns to keep; empty: all.
    new : the columns of a new table.
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
        # All that is about the student: the importer wants "Section" to be the last of them.
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
# Of Moodle, where participants have numbers: the offline grading worksheet of one assignment.
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
