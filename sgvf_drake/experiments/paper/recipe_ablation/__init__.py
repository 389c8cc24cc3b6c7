"""In the manner of Fig. 4: what each part of the robust recipe is for."""
