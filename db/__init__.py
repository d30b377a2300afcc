"""The database of curate: tables, views, sessions, bulk reading and writing, migrations."""
