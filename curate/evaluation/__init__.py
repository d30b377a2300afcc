"""How good detections and weights are."""
