"""Files and pages that the desk serves, each under the strictest security policy that works.

Uploads, and files to download, pass through scratch folders.
"""

import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import psutil
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse, Response

from pipeline.bench.live_page import LIVE_FILES
from pipeline.desk.page_request import PageRequest
from pipeline.report.html import every_hash
from pipeline.resources import TEMPLATES
from pipeline.submission.load import file_problem

# The policy for a page from a submission's folder, which may come from a stranger. The page gets an
# origin of its own, so that it sees no cookie and sends nothing to the desk. It may run only the
# scripts of reports.
_STRANGE_PAGE = (
    "sandbox allow-scripts; default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; "
    "img-src data:; font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
# The policy for complete pages that cartlab made. It allows their one script by its hash.
_OWN_PAGE = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:; "
    "font-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_INERT = "sandbox; default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"
_KINDS = {
    ".html": "text/html",
    ".pdf": "application/pdf",
    ".svg": "image/svg+xml",
    ".json": "application/json",
}
_OWN_KINDS = {".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
_STATIC = {
    "desk.css": "desk/desk.css",
    "desk.js": "desk/desk.js",
    **{name: name for name in LIVE_FILES},
    "grades.js": "desk/grades.js",
    "htmx.js": "desk/htmx.min.js",
    "icon.svg": "desk/icon.svg",
}


def serve_file(folder: Path, name: str) -> Response:
    """Return a file in a folder; a link in the folder that leads out of it is refused."""
    kind = _KINDS.get(PurePosixPath(name).suffix)
    if kind is None or file_problem(folder, name) is not None:
        raise HTTPException(404, "there is no such file")
    policy = _allow_own_scripts(_STRANGE_PAGE) if kind == "text/html" else _INERT
    headers = {} if kind == "application/pdf" else {"Content-Security-Policy": policy}
    return FileResponse(folder / name, media_type=kind, headers=headers)


def send_paper(folder: Path, name: str) -> Response:
    """Send a PDF from a submission's folder; the browser stores it, and runs nothing in it."""
    headers = {"Content-Security-Policy": _INERT}
    return FileResponse(
        folder / name, media_type="application/pdf", headers=headers, filename=Path(name).name
    )


def show_own_page(text: str) -> Response:
    """Return a page that cartlab made."""
    headers = {"Content-Security-Policy": _allow_own_scripts(_OWN_PAGE)}
    return Response(text, media_type="text/html", headers=headers)


def show_drawing(svg: str) -> Response:
    """Return a drawing; it cannot run scripts, wherever it is opened."""
    return Response(svg, media_type="image/svg+xml", headers={"Content-Security-Policy": _INERT})


def _allow_own_scripts(policy: str) -> str:
    return policy.format(hashes=" ".join(f"'{one}'" for one in every_hash()))


def serve_static(ask: PageRequest) -> Response:
    """Return a style sheet or script of the desk."""
    name = ask.request.path_params["name"]
    if name not in _STATIC:
        raise HTTPException(404, "there is no such file")
    kind = _OWN_KINDS[PurePosixPath(name).suffix]
    return Response((TEMPLATES / _STATIC[name]).read_bytes(), media_type=kind)


# ---------------------------------------------------------------------------------- scratch folders

# The name contains the computer's name, because a process number of another container has no
# meaning here.
_OWN = f"cartlab-{re.sub('[^A-Za-z0-9]+', '', platform.node())}"


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Make a folder for uploads and for files to download; remove it at the end."""
    with tempfile.TemporaryDirectory(prefix=f"{_OWN}-{os.getpid()}-") as folder:
        yield Path(folder)


def clear_scratch() -> None:
    """Remove the scratch folders of processes that have ended."""
    for left in Path(tempfile.gettempdir()).glob(f"{_OWN}-*"):
        found = re.fullmatch(_OWN + r"-(\d{1,9})-\w+", left.name)
        if found and not psutil.pid_exists(int(found[1])) and not left.is_symlink():
            # Folders of another user cannot be removed; they stay.
            shutil.rmtree(left, ignore_errors=True)
