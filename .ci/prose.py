"""Find crooked English, and keep each folder within its budget.

`python .ci/prose.py` checks every text of the project that a person reads: Markdown, pages and
words of templates, docstrings, comments and messages. A folder with more odd sentences than
`.ci/prose.toml` allows fails. If no folder fails, `--lower` writes the present numbers as the new
budget, so it can only fall. `python .ci/prose.py PATH...` lists the odd sentences in these files.

Read a listed sentence aloud. Rewrite the whole thought, not only the word.

Well-kept linters look for other things. They were compared on this project's documentation before
it was edited, in which these rules find 144 phrases. There, proselint named 65 places: 63 of them
were quotation marks and signs of multiplication. The retext plugins for simplicity, passives and
readability named 633, mostly passives and terms of the field such as "effect".
"""

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BUDGET = ROOT / ".ci" / "prose.toml"
ROOTS = (
    "README.md AGENTS.md CONTRIBUTING.md CHANGELOG.md docs rubrics templates pipeline benchmarks "
    "tests"
)
KINDS = {".py", ".md", ".j2", ".html", ".toml"}
LONGEST = 38  # words in a sentence; above it a reader has to go back
MESSAGE = 5  # a string in a program counts as text from this number of words on

# Constructions that read like a translation, and what to write instead.
RULES = {
    r"\b(?:What|Who|Whoever) (?!is\b|are\b|do\b|does\b|did\b|was\b|were\b|can\b|to\b)[a-z][^?.!]*"
    r" (?:is|are|has|have|was|were|may|must|comes?)\b[^?]*[.!]": "name the thing: 'the runs that'",
    r"\b(?:is|are|was|were|has|have|of|where) none\b|\bnone is\b": "'there is no', 'is not a'",
    r"\b(?:no|nothing|nobody)(?: \w+){0,2} but (?!it|they|the|a|not|this|also)": "'only'",
    r"\bstands? (?:in|under|there|beside|below|above|at|once|twice)\b": "'is in', 'is below'",
    r"\b(?:is|are|was|were|be) (?:told|said)\b(?! (?:to|that))|\btells? (?:of|nothing)\b": "'says'",
    r"\b(?:brings?|leaves?) (?:most|more|nothing|little|less|noise)\b": "'improves', 'explains'",
    r"\b(?:mend(?:ed|s|ing)?|anew|alike|wherein|thereof|thrice|nought|lest)\b": "a common word",
    r"\b(?:one|those|any|all|nobody|everybody) who (?:is|are|has|does)\b": "'the run that'",
    r"\b(?:is|are|was|were) (?:not )?to be (?!able)\w+|\bthere to (?:see|read)\b": "'must be'",
}
FOUND = [(re.compile(pattern), advice) for pattern, advice in RULES.items()]
# Starts of a new paragraph, or of the next entry in a numpydoc section.
ENTRY = re.compile(r"\n\s*\n|\n\s*-{4,}\s*\n|\n(?=\s*[\w`][^:\n]{0,60} : |\s*- )")
INLINE = "a|abbr|b|code|em|i|kbd|label|mark|small|span|strong|sub|sup|time|var"


@dataclass(frozen=True, kw_only=True)
class Find:
    """An odd sentence, its place, and what to do about it."""

    file: Path
    line: int
    advice: str
    sentence: str


def texts(file: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and text of everything in a file that a person reads."""
    raw = file.read_text(encoding="utf-8")
    if file.suffix == ".py":
        yield from _strings(raw)
        yield from _comments(raw)
    elif file.suffix == ".toml":
        for number, line in enumerate(raw.splitlines(), 1):
            quoted = re.findall(r'"((?:[^"\\]|\\.)*)"', line)
            yield from ((number, text) for text in quoted)
            if line.lstrip().startswith("#"):
                yield number, line.lstrip("# ")
    elif file.name.endswith((".c.j2", ".h.j2", ".m.j2")):
        for found in re.finditer(r"(?ms)/\*.*?\*/|^% .*?$", raw):
            plain = re.sub(r"(?m)^ \* ?|\{[%#{].*?[%#}]\}|^/\*|^% ?", " ", found[0])
            yield raw[: found.start()].count("\n") + 1, plain
    else:
        yield from _paragraphs(raw, marked_up=file.suffix != ".md")


def _strings(source: str) -> Iterator[tuple[int, str]]:
    nodes = list(ast.walk(ast.parse(source)))
    formatted = [node for node in nodes if isinstance(node, ast.JoinedStr)]
    pieces = {id(part) for node in formatted for part in node.values}
    for node in nodes:
        text = ""
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value if id(node) not in pieces else ""
        elif isinstance(node, ast.JoinedStr):
            text = "".join(p.value if isinstance(p, ast.Constant) else "X" for p in node.values)
        for part in ENTRY.split(text):
            if len(part.split()) >= MESSAGE:
                yield node.lineno, part


def _comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield line number and text of each comment; successive comment lines are one text."""
    first, last, block = 0, -1, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        line, text = token.start[0], token.string.lstrip("# ")
        alone = not token.line[: token.start[1]].strip()
        if alone and line == last + 1:
            block += " " + text
        else:
            yield first, block
            first, block = line, text
        last = line if alone else -1
    yield first, block


def _paragraphs(raw: str, *, marked_up: bool) -> Iterator[tuple[int, str]]:
    """Yield the paragraphs of Markdown or of a page.

    In a page, every tag that is not in INLINE ends a paragraph.
    """

    def by(word: str) -> Callable[[re.Match[str]], str]:
        return lambda found: word + "\n" * found[0].count("\n")

    raw = re.sub(r"(?s)```.*?```", by(" X "), raw)
    if marked_up:
        raw = re.sub(r"(?s)\{\{.*?\}\}", by("X"), raw)
        raw = re.sub(rf"(?s)</?(?:{INLINE})\b[^>]*>", by(""), raw)
        raw = re.sub(r"(?s)<(style|script)\b.*?</\1>|\{%.*?%\}|\{#.*?#\}|<[^>]+>", by("\n\n"), raw)
    line = 1
    for part in re.split(r"(\n\s*\n|\n(?=\s*(?:[-*|#]|\d+\.)))", raw):
        yield line, part
        line += part.count("\n")


def sentences(text: str) -> list[str]:
    """Return the sentences of a text; code in it counts as one word."""
    plain = re.sub(r"\s+", " ", re.sub(r"`[^`]*`", "X", text)).strip()
    return [part for part in re.split(r"(?<=[.!?]) (?=[A-Z“\"(])", plain) if part]


def finds(file: Path) -> Iterator[Find]:
    """Yield each sentence of a file that has an odd construction, or too many words."""
    for line, text in texts(file):
        for sentence in sentences(text):
            odd = [advice for pattern, advice in FOUND if pattern.search(sentence)]
            if len(sentence.split()) > LONGEST and sentence.count("|") < 3:
                odd.append("two sentences")
            for advice in odd:
                yield Find(file=file, line=line, advice=advice, sentence=sentence)


def files_of(paths: list[Path]) -> list[Path]:
    """Return the files with texts below some paths, in order."""
    every = [f for path in paths for f in ([path] if path.is_file() else sorted(path.rglob("*")))]
    return [f for f in every if f.suffix in KINDS and "__pycache__" not in f.parts]


def folder_of(file: Path) -> str:
    """Return the name under which the budget counts a file: its folder, at most two levels."""
    return "/".join(file.relative_to(ROOT).parts[:-1][:2]) or file.name


def counts() -> dict[str, int]:
    """Return the number of odd sentences in each folder that has any."""
    every: dict[str, int] = {}
    for file in files_of([ROOT / name for name in ROOTS.split()]):
        n = len(list(finds(file)))
        if n:
            every[folder_of(file)] = every.get(folder_of(file), 0) + n
    return dict(sorted(every.items()))


def check(*, lower: bool) -> int:
    """Compare the counts with the budget; return the exit code."""
    now = counts()
    budget = tomllib.loads(BUDGET.read_text(encoding="utf-8")) if BUDGET.exists() else now
    over = {name: n for name, n in now.items() if n > budget.get(name, 0)}
    for name, n in over.items():
        print(f"{name}: {n} odd sentences, {budget.get(name, 0)} allowed.", file=sys.stderr)
        print(f"  To see them: python .ci/prose.py {name}", file=sys.stderr)
    if over:
        return 1
    if not lower:
        if now != budget:
            print(
                "Fewer odd sentences than allowed. To lower the limits: python .ci/prose.py --lower"
            )
        return 0
    lines = [f'"{name}" = {n}' for name, n in now.items()]
    head = "# Odd sentences that each folder may have, counted by prose.py. A number may only fall."
    BUDGET.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")
    return 0


def main(arguments: list[str]) -> int:
    """List the odd sentences of some paths, or check the project."""
    paths = [Path(name).resolve() for name in arguments if name != "--lower"]
    for find in (f for file in files_of(paths) for f in finds(file)):
        where = find.file.relative_to(ROOT)
        print(f"{where}:{find.line}: {find.advice}\n    {find.sentence[:220]}")
    return 0 if paths else check(lower="--lower" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
