"""How it stands with a reproduction: which scenarios have results, and which are its own."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
import hashlib
import json
from pathlib import Path
from typing import Any

from sgvf_drake.exceptions import OutputExistsError
from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.provenance import provenance
from sgvf_drake.experiments.results import SUMMARY, check_results
from sgvf_drake.experiments.running import SCENARIO_FILE, TRIALS, is_result_of, stored_summary
from sgvf_drake.experiments.scenario import Scenario

REPORT = "report.html"
MARKER = {"made_by": "sgvf reproduce"}
"""What tells the summary of a reproduction from those of other commands."""


class Status(StrEnum):
    """How it stands with a scenario."""

    DONE = "done"
    OUTDATED = "outdated"
    """It has a result, of other code or of other options than now."""
    FAILED = "failed"
    MISSING = "missing"

    @property
    def has_result(self) -> bool:
        """Whether there is something to show."""
        return self in (Status.DONE, Status.OUTDATED)


@dataclass(frozen=True)
class Entry:
    """A scenario in a reproduction.

    Attributes:
        title: What it shows.
        source: Where the paper has it.
        status: How it stands with it.
        error: Why it failed, in one line.
        traceback: The same at length.
        digest: Of the summary in its folder, by which that is known as its own; None if
            there is none, or one that came otherwise.
    """

    title: str
    source: str
    status: Status = Status.MISSING
    error: str | None = None
    traceback: str | None = None
    digest: str | None = None


class Reproduction:
    """A folder with a result for each scenario, the trials that they share, and the report.

    Args:
        folder: The folder, which need not be there.
        scenarios: All of them by name, as they are resolved.
        quick: Whether they are the small ones.
        overwrite: Whether files may be replaced that are no part of this reproduction.

    Raises:
        OutputExistsError: The folder holds files in the way that are not of a reproduction,
            or one of the other kind, quick or full.
        ConfigurationError: The folder cannot be one.
    """

    def __init__(
        self, folder: Path, scenarios: Mapping[str, Scenario], *, quick: bool, overwrite: bool
    ) -> None:
        self.folder = folder
        self.scenarios = scenarios
        self.quick = quick
        self.overwrite = overwrite
        earlier = self._earlier()
        self.entries = {name: self._found(name, earlier.get(name, {})) for name in scenarios}

    def check_own(self, name: str) -> None:
        """Raises OutputExistsError if a scenario's folder has a result that came otherwise."""
        if self.entries[name].digest is None:
            names = (SUMMARY, SCENARIO_FILE)
            check_results(self.folder / name, names, overwrite=self.overwrite)

    def is_done(self, name: str) -> bool:
        """Whether the result of a scenario is what running it again would give."""
        return self.entries[name].status is Status.DONE

    def set_done(self, name: str) -> None:
        """Takes up the result that a scenario has left in its folder."""
        fresh, digest = self._fresh(name), _digest(self.folder / name)
        self.entries[name] = replace(fresh, status=Status.DONE, digest=digest)

    def set_failed(self, name: str, error: str, traceback: str) -> None:
        """Notes why a scenario has failed; an earlier result stays its own."""
        self.entries[name] = replace(
            self.entries[name], status=Status.FAILED, error=error, traceback=traceback
        )

    def summary(self, wall_s: float) -> dict[str, Any]:
        """Returns what its `summary.json` says, by what is in the folders.

        Args:
            wall_s: How long the run has taken so far.
        """
        results = {
            name: result
            for name, entry in self.entries.items()
            if entry.status.has_result
            and (result := stored_summary(self.folder / name)) is not None
        }
        claims = [
            {"scenario": name, **claim}
            for name, result in results.items()
            for claim in result["claims"]
        ]
        counts = Counter(claim["verdict"] for claim in claims if claim["of_paper"])
        return {
            **MARKER,
            "quick": self.quick,
            "complete": all(map(self.is_done, self.entries)),
            "counts": {verdict.value: counts[verdict.value] for verdict in Verdict},
            "claims": claims,
            "scenarios": {
                name: {
                    **asdict(entry),
                    **{key: results.get(name, {}).get(key) for key in ("seeds", "trial_s")},
                }
                for name, entry in self.entries.items()
            },
            "trial_s": sum(result["trial_s"] for result in results.values()),
            "wall_s": wall_s,
            **provenance(),
        }

    def _earlier(self) -> Mapping[str, Any]:
        """The entries of an earlier run in this folder, if it may be gone on with."""
        try:
            summary = json.loads((self.folder / SUMMARY).read_text(encoding="utf-8"))
            own = all(summary[key] == value for key, value in MARKER.items())
            entries, quick = summary["scenarios"], summary["quick"]
        except (OSError, ValueError, KeyError, TypeError):
            own, entries, quick = False, {}, self.quick
        if not own:
            names = (SUMMARY, REPORT, TRIALS, *self.scenarios)
            check_results(self.folder, names, overwrite=self.overwrite)
            return {}
        if quick != self.quick and not self.overwrite:
            kind, option = ("a quick", "with") if quick else ("a full", "without")
            raise OutputExistsError(
                f"{self.folder} holds {kind} reproduction; go on with it {option} --quick, "
                "choose another --out, or pass --overwrite to replace it"
            )
        return entries

    def _found(self, name: str, earlier: Mapping[str, Any]) -> Entry:
        """How it stands with a scenario, by its folder and what was noted before."""
        fresh, folder = self._fresh(name), self.folder / name
        result, digest = stored_summary(folder), _digest(folder)
        if result is not None and is_result_of(result, self.scenarios[name]):
            return replace(fresh, status=Status.DONE, digest=digest)
        if digest != earlier.get("digest"):
            digest = None
        if earlier.get("status") == Status.FAILED:
            told = {key: earlier[key] for key in ("error", "traceback")}
            return replace(fresh, status=Status.FAILED, digest=digest, **told)
        if result is not None and digest is not None:
            return replace(fresh, status=Status.OUTDATED, digest=digest)
        return replace(fresh, digest=digest)

    def _fresh(self, name: str) -> Entry:
        scenario = self.scenarios[name]
        return Entry(scenario.title, scenario.source)


def _digest(folder: Path) -> str | None:
    try:
        return hashlib.sha256((folder / SUMMARY).read_bytes()).hexdigest()
    except OSError:
        return None
