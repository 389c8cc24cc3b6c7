"""One page of what experiments found: verdicts, figures and tables, in a single HTML file."""

from sgvf_drake.paper.report.page import build_page

__all__ = ["build_page"]
