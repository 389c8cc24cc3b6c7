"""Fig. 1: what the order of waypoints decides."""
