"""The paper's own problems, by direct collocation."""
