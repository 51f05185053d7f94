"""Controllers that know the model, and the filters in front of them."""
