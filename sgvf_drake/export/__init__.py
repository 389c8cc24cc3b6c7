"""Guiding fields for other machines, as files that need nothing of this package."""
