"""Training a detector from weighted labels."""
