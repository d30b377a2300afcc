"""Labels that people correct: what they are shown, in which editor, and what they decided."""
