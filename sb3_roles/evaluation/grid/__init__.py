"""Play the cells of a plan, and keep what was played."""
