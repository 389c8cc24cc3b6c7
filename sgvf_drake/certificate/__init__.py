"""The certificate: a proof of path following, by bounds over squares."""
