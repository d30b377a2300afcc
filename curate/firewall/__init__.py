"""The leakage firewall: finds data that two splits must not share."""
