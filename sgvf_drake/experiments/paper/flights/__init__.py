"""Fig. 3: flights from branch to branch."""
