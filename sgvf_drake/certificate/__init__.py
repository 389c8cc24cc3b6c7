"""The certificate: a proof of path following, by bounds over squares."""

from sgvf_drake.certificate.arithmetic import ARITHMETICS, Arithmetic, ExportedField
from sgvf_drake.certificate.basin import Basin, ExcludedSet, find_basin, prove_basin
from sgvf_drake.certificate.cells import Cells
from sgvf_drake.certificate.certificate import Certificate, PieceResult
from sgvf_drake.certificate.certification import certify, check
from sgvf_drake.certificate.exported import ExportedCertificate, check_exported
from sgvf_drake.certificate.levels import Conditions, Levels
from sgvf_drake.certificate.network import NetworkCertificate
from sgvf_drake.certificate.network_certification import certify_network, check_network
from sgvf_drake.certificate.rest_ball import RestBall, RestProof, prove_rest
from sgvf_drake.certificate.tube import Tube, TubeProof, prove_tube
from sgvf_drake.certificate.tube_search import FoundTube, find_tube
from sgvf_drake.certificate.walls import Walls, WallsProof, prove_walls
from sgvf_drake.certificate.zeros import EnclosedZero, ZeroList, enclose_zeros

__all__ = [
    "ARITHMETICS",
    "Arithmetic",
    "Basin",
    "Cells",
    "Certificate",
    "Conditions",
    "EnclosedZero",
    "ExcludedSet",
    "ExportedCertificate",
    "ExportedField",
    "FoundTube",
    "Levels",
    "NetworkCertificate",
    "PieceResult",
    "RestBall",
    "RestProof",
    "Tube",
    "TubeProof",
    "Walls",
    "WallsProof",
    "ZeroList",
    "certify",
    "certify_network",
    "check",
    "check_exported",
    "check_network",
    "enclose_zeros",
    "find_basin",
    "find_tube",
    "prove_basin",
    "prove_rest",
    "prove_tube",
    "prove_walls",
]
