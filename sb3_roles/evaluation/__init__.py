"""Evaluation: play episodes into records, and turn records into metrics."""
