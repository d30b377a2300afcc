"""Read-only SQL: named queries that ship with curate, and how any query is run."""
