"""A short table of quantities with units, as plain text and as HTML."""

from collections.abc import Sequence

from markupsafe import Markup, escape

from pipeline.words.numbers import unit_text

Quantity = tuple[str, str, str]  # name, value, unit


def quantity_lines(title: str, rows: Sequence[Quantity]) -> str:
    """Return the title and one line per quantity, in aligned columns."""
    width, size = (max((len(row[i]) for row in rows), default=0) for i in (0, 1))
    lines = (f"{name:<{width}}  {value:>{size}}  {unit_text(unit)}" for name, value, unit in rows)
    return "\n".join([title, *(line.rstrip() for line in lines)])


def quantity_html(title: str, rows: Sequence[Quantity]) -> str:
    """Return a table as HTML; every text is escaped."""
    body = Markup("").join(
        Markup("<tr><th>{}</th><td>{}</td><td>{}</td></tr>").format(name, value, unit_text(unit))
        for name, value, unit in rows
    )
    return Markup("<table><caption>{}</caption><tbody>{}</tbody></table>").format(
        escape(title), body
    )
