"""The desk for JupyterLab: an entry of its launcher, and the process that the entry starts.

Jupyter passes on what the person who is logged in asks, and a secret that only it and the process
know. Other people on the same computer can reach the port, but not the desk.
"""

import os
import secrets
import sys
from typing import Any

SECRET = "CARTLAB_JUPYTER_SECRET"  # a variable of the process, which only its owner can read
_START_LIMIT = 60.0  # s


def launcher() -> dict[str, Any]:
    """Return how jupyter-server-proxy starts the desk; its entry point."""
    from pipeline.desk.doors import JUPYTER_SECRET
    from pipeline.resources import TEMPLATES

    secret = secrets.token_urlsafe(24)
    return {
        "command": [sys.executable, "-m", "pipeline.cli.jupyter", "{port}"],
        "environment": {SECRET: secret},
        "request_headers_override": {JUPYTER_SECRET: secret},
        "timeout": _START_LIMIT,
        "launcher_entry": {"title": "cartlab", "icon_path": str(TEMPLATES / "desk" / "icon.svg")},
    }


def main() -> None:
    """Serve the desk at a port until Jupyter ends it."""
    from pipeline.cli.common import say
    from pipeline.desk.app import DeskServer
    from pipeline.desk.ending import Ending

    server = DeskServer(port=int(sys.argv[1]), jupyter=os.environ.pop(SECRET))
    with Ending(say=say) as ending, server:
        while server.runs and not ending.asked.wait(0.5):  # s
            pass


if __name__ == "__main__":
    main()
