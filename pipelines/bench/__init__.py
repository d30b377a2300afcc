"""The bench: methods x labeled ratios x seeds as a resumable grid, and the tables of it."""
