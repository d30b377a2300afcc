"""Reports, explanations, status tables, images and recordings of a workspace."""
