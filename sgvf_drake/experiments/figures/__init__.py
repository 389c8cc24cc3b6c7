"""The figures that the commands leave behind, each from one result."""
