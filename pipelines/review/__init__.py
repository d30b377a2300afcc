"""Reviews: labels are selected and exported for an editor, and decisions imported from it."""
