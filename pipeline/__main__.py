"""Make `python -m pipeline` run the command `cartlab`."""

from pipeline.cli import main

main()
