"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.certificate import Certificate, Part, PieceResult
from sgvf_drake.certificate.certification import certify, check
from sgvf_drake.certificate.conditions import Conditions
from sgvf_drake.certificate.rest_ball import RestBall, RestProof, prove_rest
from sgvf_drake.certificate.tube import Tube, TubeProof, prove_tube
from sgvf_drake.certificate.tube_search import FoundTube, find_tube
from sgvf_drake.certificate.zeros import EnclosedZero, ZeroList, enclose_zeros

__all__ = [
    "Certificate",
    "Conditions",
    "EnclosedZero",
    "FoundTube",
    "Part",
    "PieceResult",
    "RestBall",
    "RestProof",
    "Tube",
    "TubeProof",
    "ZeroList",
    "certify",
    "check",
    "enclose_zeros",
    "find_tube",
    "prove_rest",
    "prove_tube",
]
