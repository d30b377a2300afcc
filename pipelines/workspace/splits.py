"""The splits of a workspace's frames."""

SPLITS = ("labeled", "unlabeled", "val")
