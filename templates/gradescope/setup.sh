#!/usr/bin/env bash
# Gradescope runs this once, as root, when it builds the autograder.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

version=$(cat python-version)
python=python$version
if ! "$python" -c "import ensurepip" 2> /dev/null; then  # Ubuntu may have another Python
  export PIP_BREAK_SYSTEM_PACKAGES=1
  python3 -m pip --version > /dev/null 2>&1 || { apt-get update -qq && apt-get install -y -qq python3-pip; }
  python3 -m pip install --quiet uv
  python3 -m uv python install "$version"
  python=$(python3 -m uv python find --managed-python "$version")
fi
[ -d venv ] || "$python" -m venv venv
venv/bin/python -m pip install --quiet --requirement requirements.txt
venv/bin/python -m compileall -q cartlab
