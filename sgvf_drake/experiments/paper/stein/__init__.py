"""Section II: Stein's identity of exact, learned and normalised scores."""
