"""Reviews of labels by people: the boxes shown, the editors' files, and the decisions."""
