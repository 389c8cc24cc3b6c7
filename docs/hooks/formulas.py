"""Formulas of the pages, from LaTeX to MathML, which browsers draw without a library.

In the sources a formula stands in dollars, as GitHub renders it too: `$x$` in a line, and
`$$x$$` as a paragraph.  The Markdown extension arithmatex marks them, and this turns them into
MathML when the site is built, so that its pages need no network.
"""

import html
import re

from latex2mathml.converter import convert

FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', flags=re.DOTALL
)
# What latex2mathml leaves out: bars that belong to what they enclose, and the space between
# the name of a function and its argument.
BARS = {r"\lvert": r"\left|", r"\rvert": r"\right|"}
NAMED_FUNCTION = re.compile(r"<m[io]>[a-z]{2,}</m[io]>(?=<mi>)")


def on_page_content(content: str, **_: object) -> str:
    """Replaces the formulas of a page."""
    return FORMULA.sub(_in_mathml, content)


def _in_mathml(formula: re.Match[str]) -> str:
    latex = html.unescape(formula[2]).strip()
    for sign, paired in BARS.items():
        latex = latex.replace(sign, paired)
    mathml = convert(latex, display="block" if formula[1] == "div" else "inline")
    return NAMED_FUNCTION.sub(r'\g<0><mspace width="0.17em"/>', mathml)
