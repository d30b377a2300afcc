"""`python -m pipelines` is the command `curate`."""

from pipelines.cli import main

main()
