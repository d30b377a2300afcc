"""Evaluation of detections and of label weights against ground truth."""
