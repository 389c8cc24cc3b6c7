"""Fig. 4: what each loss of the tangent is for."""
