"""One project on disk: its folder, its configuration, and its first setup."""
