"""The optimum of any episode of any task: its search, certified episodes, and what is measured against it."""
