"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.search import certify, check
from sgvf_drake.certificate.statement import Certificate, Conditions, PieceResult

__all__ = ["Certificate", "Conditions", "PieceResult", "certify", "check"]
