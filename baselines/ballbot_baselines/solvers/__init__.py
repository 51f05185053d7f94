"""Optimal-control problems in stages, and what solves them: fatrop, ipopt, and iLQR in SIMD lanes."""
