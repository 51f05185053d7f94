"""Experts that know the model: linear control, trajectory optimization, and the optima that everything is measured by."""
