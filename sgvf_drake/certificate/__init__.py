"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.search import certify, check
from sgvf_drake.certificate.statement import Certificate, Conditions, Part, PieceResult
from sgvf_drake.certificate.zeros import EnclosedZero, ZeroList, enclose_zeros

__all__ = [
    "Certificate",
    "Conditions",
    "EnclosedZero",
    "Part",
    "PieceResult",
    "ZeroList",
    "certify",
    "check",
    "enclose_zeros",
]
