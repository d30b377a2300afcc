"""The science of curate: from a detector's guesses to weighted labels, without SQL or CLI."""
