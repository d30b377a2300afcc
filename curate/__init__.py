"""The science of curate: from a detector's guesses to weighted labels, without SQL or CLI."""

__version__ = "0.2.0"
