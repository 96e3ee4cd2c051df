"""`python -m pipeline` is `cartlab`."""

from pipeline.cli import main

main()
