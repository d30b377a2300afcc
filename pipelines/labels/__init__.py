"""Reading stored labels and their evidence from the database."""
