"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.search import certify, check
from sgvf_drake.certificate.statement import Certificate, Conditions, PieceResult
from sgvf_drake.certificate.zeros import EnclosedZero, ZeroList, enclose_zeros

__all__ = [
    "Certificate",
    "Conditions",
    "EnclosedZero",
    "PieceResult",
    "ZeroList",
    "certify",
    "check",
    "enclose_zeros",
]
