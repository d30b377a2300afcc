"""The memory of curate: tables, sessions, bulk reading and writing, migrations."""
