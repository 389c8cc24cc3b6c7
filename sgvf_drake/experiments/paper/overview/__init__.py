"""Fig. 2: two loops in one learned field, and agents that follow it."""
