"""Online and offline loops, checkpoints, metrics log."""
