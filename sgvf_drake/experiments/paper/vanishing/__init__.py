"""Fig. 5: where a learned score vanishes, and a field that vanishes nowhere."""
