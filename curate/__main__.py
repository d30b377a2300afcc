"""`python -m curate` is the command `curate`, where that is installed."""

import runpy

if __name__ == "__main__":
    # As the main module, so that worker processes import it first.
    runpy.run_module("curate_command", run_name="__main__", alter_sys=True)
