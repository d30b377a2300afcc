"""The leakage firewall: rules that are checked before every export and training."""
