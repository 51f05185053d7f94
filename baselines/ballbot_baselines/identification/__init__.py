"""From a log of a robot to its numbers."""
