"""Classical fields beside SGVF, on the same waypoints."""
