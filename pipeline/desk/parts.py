"""Send only those parts of a page that the browser does not have yet.

A template encloses each part, an element with an id, in `<!--part-->` and `<!--/part-->`; parts may
contain parts. Every part gets a digest of its content as `data-part`. A request by htmx lists the
parts of its page in the header `X-Parts`. In the answer, an empty element stands for each part with
the same digest, and htmx keeps the old element (`hx-preserve`) with all that was typed into it.
"""

import re
from hashlib import blake2b

_MARK = re.compile(r"<!--(/?)part-->")
_ELEMENT = re.compile(r'\s*<(\w+)(?=[^>]*? id="([\w-]+)")')
# The version of the file from which a form was filled in. It changes with every change of the file;
# `desk.js` sends the version of the whole page.
_SEEN = re.compile(r'name="seen" value="\w*"')


def leave_out_parts(page: str, known: str) -> str:
    """Return a page in which each known part is replaced by an empty element.

    Parameters
    ----------
    page : the page, with the marks of its parts.
    known : the parts that the browser has, as "id=digest", with spaces between them.
    """
    there = frozenset(known.split())
    # For every open part: its text as it is sent, and its text with the digests of its inner parts,
    # from which its own digest is made.
    sent, content = [""], [""]
    pieces = _MARK.split(page)
    for text, mark in zip(pieces[::2], [None, *pieces[1::2]], strict=True):
        if mark == "":
            sent.append("")
            content.append("")
        elif mark == "/":
            part, digest = _finish(sent.pop(), content.pop(), there)
            sent[-1] += part
            content[-1] += digest
        sent[-1] += text
        content[-1] += text
    return sent[0]


def _finish(sent: str, content: str, there: frozenset[str]) -> tuple[str, str]:
    """Return a part as it is sent, and its digest."""
    element = _ELEMENT.match(sent)
    if element is None:
        raise ValueError(f"a part of a page is an element with an id; found {sent[:60]!r}")
    digest = blake2b(_SEEN.sub("", content).encode(), digest_size=5).hexdigest()
    tag, id_ = element.groups()
    if f"{id_}={digest}" in there:
        return f'<{tag} id="{id_}" data-part="{digest}" hx-preserve></{tag}>', digest
    start = element.end(1)
    return f'{sent[:start]} data-part="{digest}"{sent[start:]}', digest
