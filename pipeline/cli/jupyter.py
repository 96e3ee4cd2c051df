"""The desk in JupyterLab: an entry in its launcher, and the process that the entry starts.

Jupyter forwards the requests of the person who is logged in, and adds a secret. Other people on the
same computer can reach the port, but they do not know the secret.
"""

import os
import secrets
import sys
from typing import Any

# Environment variable, which only the owner of the process can read.
SECRET = "CARTLAB_JUPYTER_SECRET"
_START_LIMIT = 60.0  # s


def launcher() -> dict[str, Any]:
    """Return how jupyter-server-proxy starts the desk; this function is its entry point."""
    from pipeline.desk.login import JUPYTER_SECRET
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
    """Serve the desk until Jupyter ends the process."""
    from pipeline.cli.common import say
    from pipeline.desk.app import DeskServer
    from pipeline.desk.crash_log import CrashLog

    server = DeskServer(port=int(sys.argv[1]), jupyter=os.environ.pop(SECRET))
    with CrashLog(say=say) as ending, server:
        while server.runs and not ending.asked.wait(0.5):  # s
            pass


if __name__ == "__main__":
    main()
