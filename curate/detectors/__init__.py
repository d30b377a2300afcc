"""3D detectors, one file each."""
