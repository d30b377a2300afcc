"""The engine: it finds stale work, runs it in an executor, and writes the results.

It receives the graph of stages as a value, and imports no stage.
"""
