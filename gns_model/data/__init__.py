"""Data: random scenes, their generation in parallel, and windows for training."""
