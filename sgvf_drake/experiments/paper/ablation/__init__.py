"""What both ablations share."""
