"""The filter and the order of the teams on a page; the page's address contains both."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from urllib.parse import urlencode

from pipeline.desk.gradebooks import ClassView
from pipeline.grading.grade import CODES
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.words import WORDS, slip_of

_STATES: Mapping[str, tuple[str, Callable[[Entry], bool]]] = {
    "failed": ("could not be graded", lambda team: team.grade.status == "failed"),
    "late": ("late", lambda team: team.grade.days_late > 0),
    "hand": ("changed by hand", lambda team: bool(team.grade.by_hand)),
    "open": ("not final", lambda team: bool(team.grade.open)),
    "held": ("held back", lambda team: bool(team.hold)),
    "remark": ("with a flag", lambda team: bool(team.grade.codes)),
}
_SEEN = {"no": "not yet reviewed", "yes": "reviewed"}
_ORDERS = {
    "": "to review first",
    "name": "name",
    "points": "points, lowest first",
    "late": "days late, latest first",
}


@dataclass(frozen=True, kw_only=True)
class Filter:
    """The filter and order of a page; an empty field has no effect.

    Attributes
    ----------
    flag : only teams with this flag.
    slip : only teams whose flag is of this kind of mistake, as `slip_of` names it.
    lost : only teams that lost points in this criterion.
    state : only teams in one of the `_STATES`.
    seen : only reviewed teams ("yes"), or only teams not yet reviewed ("no").
    q : only teams with this text in their name or authors.
    by : criterion that the pages of all teams show first, to grade it for one team after another.
    order : one of the `_ORDERS`; "" shows what is still to review first, doubts before the rest,
        and there those with the fewest points.
    """

    flag: str = ""
    slip: str = ""
    lost: str = ""
    state: str = ""
    seen: str = ""
    q: str = ""
    by: str = ""
    order: str = ""

    @classmethod
    def read(cls, asked: Mapping[str, str]) -> "Filter":
        """Return the filter that the query of an address contains."""
        return cls(**{name: asked.get(name, "").strip() for name in cls.__dataclass_fields__})

    @property
    def query(self) -> str:
        """The query of an address that contains this filter."""
        return urlencode({name: value for name, value in asdict(self).items() if value})

    def chosen(self, shown: ClassView) -> list[Entry]:
        """Return the teams that pass the filter, in its order."""
        return [team for team in self.ordered(shown) if self._takes(team, shown)]

    def beside(self, shown: ClassView, name: str) -> tuple[str, str]:
        """Return the names of the teams before and after a team, among those that pass the filter.

        The team itself need not pass. A name is "" if there is no team.
        """
        before, after, passed = "", "", False
        for team in self.ordered(shown):
            if team.grade.submission == name:
                passed = True
            elif self._takes(team, shown):
                if passed:
                    after = team.grade.submission
                    break
                before = team.grade.submission
        return before, after

    def ordered(self, shown: ClassView) -> Sequence[Entry]:
        """Return the whole class in the order of the filter."""
        teams = list(shown.teams.values())
        if self.order not in _ORDERS or not self.order:
            teams.sort(key=lambda t: (bool(t.reviewed_by), not t.grade.in_doubt, t.grade.points))
        elif self.order == "points":
            teams.sort(key=lambda team: team.grade.points)
        elif self.order == "late":
            teams.sort(key=lambda team: -team.grade.days_late)
        return teams

    def _takes(self, team: Entry, shown: ClassView) -> bool:
        grade = team.grade
        if self.flag and self.flag not in grade.codes:
            return False
        kinds = (slip_of(flag.evidence) for flag in grade.flags if flag.code == self.flag)
        if self.slip and self.slip not in kinds:
            return False
        if self.seen in _SEEN and bool(team.reviewed_by) != (self.seen == "yes"):
            return False
        if self.state in _STATES and not _STATES[self.state][1](team):
            return False
        if self.lost and grade.submission not in shown.lost.get(self.lost, ()):
            return False
        wanted = self.q.casefold()
        return not wanted or any(
            wanted in text.casefold() for text in (grade.submission, *grade.authors)
        )

    def fields(self, shown: ClassView) -> list[dict]:
        """Return the fields of the form, with their choices and the number of teams for each."""
        teams = list(shown.teams.values())
        flags = Counter(code for team in teams for code in team.grade.codes)
        common = sorted(flags, key=lambda code: (-flags[code], CODES.index(code)))
        seen = sum(bool(team.reviewed_by) for team in teams)
        numbers = {"no": len(teams) - seen, "yes": seen}
        lost = {key: len(names) for key, names in shown.lost.items()}
        titles = shown.rubric.titles
        by_state = {key: sum(map(test, teams)) for key, (_, test) in _STATES.items()}
        remarks = {c: f"{WORDS.text(f'title_{c}')} ({flags[c]})" for c in common}
        return [
            _choice("flag", "Flag", remarks, self.flag),
            _choice("lost", "Points lost in", {c: f"{titles[c]} ({n})" for c, n in lost.items()},
                    self.lost),
            _choice("state", "State", {k: f"{_STATES[k][0]} ({n})" for k, n in by_state.items()},
                    self.state),
            _choice("seen", "Looked at", {k: f"{_SEEN[k]} ({n})" for k, n in numbers.items()},
                    self.seen),
            _choice("order", "Order", _ORDERS, self.order, whole=False),
            _choice("by", "Grade", {"": "whole teams", **titles}, self.by, whole=False),
        ]  # fmt: skip


def _choice(name: str, label: str, choices: Mapping, chosen: str, *, whole: bool = True) -> dict:
    every = {"": "all"} if whole else {}
    return {"name": name, "label": label, "choices": {**every, **choices}, "chosen": chosen}
