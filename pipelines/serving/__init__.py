"""The pages of `curate serve`: Datasette over the databases, and a page per frame."""
