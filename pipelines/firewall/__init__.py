"""The leakage firewall: rules that hold before anything is exported or trained on."""
