"""The order of work: stages, the runner, configuration and the command line."""
