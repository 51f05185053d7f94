"""How good a controller is: results, leaderboards, robustness, basins, comparisons, statistics."""
