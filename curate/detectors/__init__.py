"""3D detectors, one file or folder each."""
