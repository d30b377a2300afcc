"""`python -m pipelines` is the command `curate`."""

import runpy

# As the main module, so that worker processes import it first.
runpy.run_module("curate_command", run_name="__main__", alter_sys=True)
