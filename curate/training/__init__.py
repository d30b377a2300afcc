"""Training of a detector from weighted labels."""
