"""Erase submissions for good: all their rows, and their names in the flags of other submissions."""

import json
import re
from collections.abc import Mapping

from sqlalchemy import Connection, delete, select, update

from pipeline.grading.gradebook.schema import (
    drop_copied,
    entries,
    events,
    figures,
    findings,
    gradings,
    submissions,
)

NOBODY = "an erased submission"


def erase_rows(connection: Connection, gone: Mapping[int, str]) -> None:
    """Delete all rows about the submissions in `gone`, which maps their numbers to their names.

    Teams that shared recordings with an erased submission keep the flag, without the erased name.
    """
    numbers = list(gone)
    graded = select(gradings.c.id).where(gradings.c.submission_id.in_(numbers))
    drop_copied(connection)
    for table in (figures, findings):
        connection.execute(delete(table).where(table.c.grading_id.in_(graded)))
    for table in (entries, events, gradings):
        connection.execute(delete(table).where(table.c.submission_id.in_(numbers)))
    connection.execute(delete(submissions).where(submissions.c.id.in_(numbers)))
    flagged = select(entries.c.batch_id, entries.c.position, entries.c.shared)
    names = "|".join(re.escape(json.dumps(name)[1:-1]) for name in gone.values())
    any_name = re.compile(rf"(?<![\w-])(?:{names})(?![\w-])")
    for row in connection.execute(flagged.where(entries.c.shared != "")).all():
        where = (entries.c.batch_id == row.batch_id) & (entries.c.position == row.position)
        erased = any_name.sub(NOBODY, row.shared)
        if erased != row.shared:
            connection.execute(update(entries).where(where).values(shared=erased))
