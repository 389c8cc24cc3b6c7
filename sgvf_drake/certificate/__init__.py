"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.certificate import Certificate, Part, PieceResult
from sgvf_drake.certificate.certification import certify, check
from sgvf_drake.certificate.conditions import Conditions
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
