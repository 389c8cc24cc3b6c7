"""The command that finds the zeros of a field: singularities."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer

from sgvf_drake.cli.application import app
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import print_folder, print_table


@app.command()
def singularities(
    field: FieldPath,
    out: Out,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    prove: Annotated[
        bool, typer.Option("--prove", help="Prove that there are no other zeros.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Find all zeros of a planar field, its score and its tangent, and where they lie."""
    from sgvf_drake.experiments import choose_reference, open_field, run_singularities

    loaded = open_field(field)
    chosen = choose_reference(loaded, reference, columns_of(columns, reference, "--reference"))
    summary = run_singularities(loaded, chosen, out, prove=prove, overwrite=overwrite)
    _print_singularities(summary)
    print_folder(out)


def _print_singularities(summary: Mapping[str, Any]) -> None:
    """Prints the summary of the singularities."""
    prefixes = {"guiding": "", "score": "score_", "tangent": "tangent_"}
    rows = {
        f"zeros of the {name}{'' if name == 'score' else ' field'}": (
            f"{_kinds(summary['zeros'], name)}; indices sum up to "
            f"{summary[f'{prefix}index_sum']}, winding number "
            f"{summary[f'{prefix}winding_number']}"
        )
        for name, prefix in prefixes.items()
    }
    for name, proof in summary.get("proved", {}).items():
        rows[f"proved of the {name}"] = _proved(proof)
    rows["undecided places"] = str(summary["undecided"])
    claims = {
        "low_density": "score vanishes at low density",
        "low_density_off_path": "the same off the path",
        "high_curvature": "score vanishes at high curvature",
        "branches": "score vanishes near branches",
    }
    for claim, name in claims.items():
        rows[name] = _concentration(summary["vanishing"][claim])
    print_table("Singularities", rows)


def _proved(proof: Mapping[str, Any]) -> str:
    """Returns what is proved of the zeros of a field."""
    count, undecided = len(proof["zeros"]), proof["undecided"]
    others = "no others" if proof["complete"] else f"{undecided} squares undecided"
    winding = proof["winding_number"]
    turns = "winding number not proved" if winding is None else f"winding number {winding}"
    return f"{count} enclosed, {others}; {turns}"


def _kinds(zeros: Sequence[Mapping[str, Any]], field: str) -> str:
    """Returns how many zeros of each kind a field has: "1 focus, 2 saddle"."""
    counts = Counter(zero["kind"] for zero in zeros if zero["field"] == field)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "none"


def _concentration(claim: Mapping[str, Any] | None) -> str:
    if claim is None:
        return "nothing to tell by"
    verdict = "yes" if claim["holds"] else "no"
    return f"{verdict} (probability {claim['probability']:.2f}; by chance 0.5)"
