"""Proofs in interval arithmetic that optima are strict local minima, and enclosures of their costs: `ballbot prove`."""
