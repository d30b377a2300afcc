"""The stages of a round: one module per stage, with the name of its command."""
