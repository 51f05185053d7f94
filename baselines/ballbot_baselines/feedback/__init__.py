"""Model-based controllers, and the filters in front of them."""
