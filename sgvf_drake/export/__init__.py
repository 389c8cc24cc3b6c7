"""Fields for other programs: what runs without Python."""

from sgvf_drake.export.c_code import C_FILES, export_c

__all__ = ["C_FILES", "export_c"]
