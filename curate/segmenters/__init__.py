"""Sources of semantic maps, one file each."""
