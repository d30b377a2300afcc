"""The stages of a round, one file each with the name of its command."""
