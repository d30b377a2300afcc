"""The engine: what is stale, who works on it, and who writes; it knows no stage."""
