"""The leakage firewall: what may be on both sides of a split, and what may not."""
