"""What the paper says of the classical methods and of its own, against what was measured.

A method handles a case if 95 % of the starts succeed and 95 % of the waypoints are passed,
on average over the seeds; in part, if half of both; it is broken if 5 % of the starts succeed,
or fewer.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.baselines.methods import CASES, LEARNED, METHODS

HANDLED = 0.95
HALF = 0.5
BROKEN = 0.05
INTERPOLATIONS = ("fourier", "lagrange", "parametric")
CLASSICAL = tuple(name for name in METHODS if name not in LEARNED)

Means = Mapping[tuple[str, str], tuple[float, float]]


def baseline_claims(means: Means) -> list[Claim]:
    """Returns the verdicts on what was run.

    Args:
        means: Success and coverage by case and method, means over the seeds.  A claim whose
            cases or methods are not there is not judged.
    """
    shares = _Shares(means)
    claims = [
        _interpolation(shares),
        _shuffled(shares),
        *(_classical(shares, *about) for about in _FAILURES),
        _own(shares),
        _where_others_fail(shares),
    ]
    return [claim for claim in claims if claim is not None]


@dataclass(frozen=True)
class _Shares:
    """The means by case and method, and words for them."""

    means: Means

    def cases(self, methods: Iterable[str]) -> list[str]:
        """The cases on which one of these methods was run."""
        return [case for case in CASES if self.methods(case, methods)]

    def methods(self, case: str, methods: Iterable[str]) -> list[str]:
        """Which of these methods were run on a case."""
        return [method for method in methods if (case, method) in self.means]

    def handles(self, method: str, case: str) -> bool:
        return min(self.means[case, method]) >= HANDLED

    def handles_in_part(self, method: str, case: str) -> bool:
        return min(self.means[case, method]) >= HALF

    def is_broken(self, method: str, case: str) -> bool:
        return self.means[case, method][0] <= BROKEN

    def words(self, case: str, methods: Iterable[str]) -> str:
        """Success, and coverage where that is what is missing, of methods on a case."""
        parts = []
        for method in self.methods(case, methods):
            success, coverage = self.means[case, method]
            part = f"{METHODS[method].label} {100 * success:.0f} %"
            if coverage < HANDLED <= success:
                part += f" on {100 * coverage:.0f} % of the waypoints"
            parts.append(part)
        return f"{CASES[case].label}: {', '.join(parts)}"


def _interpolation(shares: _Shares) -> Claim | None:
    methods = shares.methods("ordered", INTERPOLATIONS)
    if not methods:
        return None
    return Claim(
        "baselines-ordered",
        "Section I, Fig. 1 (left)",
        "Ordered waypoints are interpolated, by Lagrange's or Fourier's method, to a curve "
        "that a classical guiding vector field follows.",
        Verdict.of([shares.handles(method, "ordered") for method in methods]),
        f"Starts that lap the path: {shares.words('ordered', methods)}.",
    )


def _shuffled(shares: _Shares) -> Claim | None:
    methods = shares.methods(
        "shuffled", (name for name in METHODS if METHODS[name].takes_order)
    )
    if not methods:
        return None
    return Claim(
        "baselines-shuffled",
        "Section I, Fig. 1 (middle)",
        "Shuffled waypoints break what takes their order for that of the path.",
        Verdict.of([shares.is_broken(method, "shuffled") for method in methods]),
        f"Starts that lap the path: {shares.words('shuffled', methods)}.",
    )


_FAILURES = (
    (
        "baselines-unordered",
        "Abstract, Section I",
        "Classical methods fail when the waypoints are unordered.",
        ("shuffled", "noisy"),
    ),
    (
        "baselines-branching",
        "Abstract, Section I, Fig. 1 (right)",
        "Classical methods fail when the path branches.",
        ("branching",),
    ),
    (
        "baselines-pieces",
        "Abstract, Section V-A",
        "Classical methods fail when the path is several curves.",
        ("pieces",),
    ),
    (
        "baselines-corners",
        "Section I",
        "A path with corners, as a square, cannot have a classical guiding vector field.",
        ("corners",),
    ),
)


def _classical(
    shares: _Shares, key: str, source: str, statement: str, cases: Sequence[str]
) -> Claim | None:
    """Holds if no classical method handles any of the cases; not if one handles all."""
    run = [case for case in cases if shares.methods(case, CLASSICAL)]
    if not run:
        return None
    handled = [
        [shares.handles(method, case) for case in run]
        for method in shares.methods(run[0], CLASSICAL)
    ]
    if not any(map(any, handled)):
        verdict = Verdict.HOLDS
    else:
        verdict = Verdict.FAILS if any(map(all, handled)) else Verdict.PARTLY
    evidence = "; ".join(shares.words(case, CLASSICAL) for case in run)
    return Claim(key, source, statement, verdict, f"Starts that succeed on {evidence}.")


def _own(shares: _Shares) -> Claim | None:
    cases = shares.cases(["paper"])
    if not cases:
        return None
    evidence = "; ".join(shares.words(case, LEARNED) for case in cases)
    return Claim(
        "baselines-sgvf",
        "Abstract, Section I (contribution 1)",
        "SGVF follows unordered, noisy and branching waypoints in one framework.",
        Verdict.of([shares.handles("paper", case) for case in cases]),
        f"Judged by the paper's own recipe; starts that succeed on {evidence}.",
    )


def _where_others_fail(shares: _Shares) -> Claim | None:
    cases = [case for case in shares.cases(LEARNED) if shares.methods(case, CLASSICAL)]
    if not cases:
        return None
    left = [
        case
        for case in cases
        if not any(shares.handles(method, case) for method in shares.methods(case, CLASSICAL))
    ]
    if left:
        own = [(case, shares.methods(case, LEARNED)) for case in left]
        if all(any(shares.handles(one, case) for one in found) for case, found in own):
            verdict = Verdict.HOLDS
        elif any(shares.handles_in_part(one, case) for case, found in own for one in found):
            verdict = Verdict.PARTLY
        else:
            verdict = Verdict.FAILS
        evidence = "No classical method, sorting first included, handles " + "; ".join(
            shares.words(case, LEARNED) for case in left
        )
    else:
        verdict = Verdict.FAILS
        labels = ", ".join(CASES[case].label for case in cases)
        evidence = f"Some classical method handles each of the cases ({labels})"
    return Claim(
        "baselines-advantage",
        "Abstract, Section VII",
        "SGVF follows paths reliably on which classical guiding vector fields fail.",
        verdict,
        f"{evidence}.",
    )
