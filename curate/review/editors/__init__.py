"""File formats of annotation tools: boxes are written for them and edited boxes read back."""
