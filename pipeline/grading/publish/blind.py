"""Commands that name a team as the pages without names do, and answer in the same name."""

from collections.abc import Sequence
from dataclasses import replace

from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradebook.history import Event
from pipeline.grading.publish.anonymous import is_pseudonym, pseudonyms


def meant(book: Gradebook, team: str) -> str:
    """Return the submission that a name stands in for; any other name as it is."""
    if not is_pseudonym(team):
        return team
    names = pseudonyms({entry.submission: entry.first_key for entry in book.entries()})
    return {shown: name for name, shown in names.items()}.get(team, team)


def history_of(book: Gradebook, team: str) -> tuple[str, list[Event]]:
    """Return what to call a team, and its history without the name it was not asked by.

    Raises
    ------
    ConfigError : there is no such submission, or several.
    """
    name = meant(book, team)
    submission, events = book.history(name)
    return (submission, events) if name == team else (team, _hidden(events, name, team))


def _hidden(events: Sequence[Event], name: str, shown: str) -> list[Event]:
    return [replace(event, text=event.text.replace(name, shown)) for event in events]
