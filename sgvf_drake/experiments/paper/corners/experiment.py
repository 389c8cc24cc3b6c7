"""Fig. 6: what shallow and deep tangent networks do at the corners of polygons."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.corners import (
    CornerView,
    angles_figure,
    corners_figure,
    near_figure,
)
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.corners.claims import HEXAGON, SQUARE, corner_claims
from sgvf_drake.experiments.paper.corners.tables import (
    NETWORKS,
    CornerField,
    CornerFields,
    fields_table,
    stalls_table,
    traps_table,
)
from sgvf_drake.experiments.paper.corners.traps import slowest_corner
from sgvf_drake.experiments.paper.corners.trials import CornerTrial, measure_corners
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import load_field

NAMES = {4: "square", 6: "hexagon"}
# The panels of the paper's Fig. 6, and the robust recipe on the sharper of the two.
PANELS = ((SQUARE, "shallow"), (HEXAGON, "shallow"), (HEXAGON, "deep"), (SQUARE, "robust"))

FIGURE_CAPTION = (
    "Agents from a grid of starts on the square and the hexagon, seed {seed}: the paper's "
    "shallow and deeper tangent, and the robust recipe. Red agents do not complete a lap, and "
    "crosses mark where agents stall."
)
NEAR_CAPTION = (
    "The same fields at the corner where |m| is least: |m| in colour, stream lines of m, the "
    "waypoints and the zeros of m."
)
ANGLES_CAPTION = (
    "Top: agents that stall, and corners with a trap nearby, over the angle of the corners; "
    "means over the seeds with 95 % intervals. Bottom left: |m| along the square past a "
    "corner, median over seeds and corners, and from 10 % to 90 % of them. Bottom right: where "
    "the traps near corners sit, all polygons."
)
STALLS_CAPTION = (
    "Where agents stall: shares of the starts in per cent, and of those that stall the share "
    "within 0.5 U of a corner, beside the share of the path that is. Paused: those that stand "
    "still for a while and go on."
)
TRAPS_CAPTION = (
    "Traps, stable zeros of m on the path within 0.5 U of a corner: the share of corners that "
    "have one, how many sit before and after it in the direction of travel (or where the sides "
    "run against each other) and how many outside of the polygon; and the least |m| near "
    "corners and about the middle of sides, means over them."
)


@dataclass
class Corners:
    """Follows fields of shallow, deep and robust networks around the corners of polygons.

    Attributes:
        angle_polygons: Numbers of corners of further polygons, besides square and hexagon.
        angle_seeds: Their seeds.
        num_points: Waypoints on each.
        starts: Agents that follow each field.
        patience: How many times as long as usual they have.
        effort: Part of the recipes' iterations.
        seeds: Of square and hexagon.
    """

    angle_polygons: list[int] = field(default_factory=lambda: [3, 5, 8, 12])
    angle_seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    num_points: int = 240
    starts: int = 100
    patience: float = 4.0
    effort: float = 1.0
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show."""
        if {SQUARE, HEXAGON} & set(self.angle_polygons):
            raise ConfigurationError(
                "angle_polygons are those besides the square (4) and the hexagon (6), "
                f"not {self.angle_polygons}"
            )
        pairs = [(corners, seed) for corners in (SQUARE, HEXAGON) for seed in self.seeds]
        pairs += [
            (corners, seed) for corners in self.angle_polygons for seed in self.angle_seeds
        ]
        trials = [
            CornerTrial(*pair, self.num_points, self.starts, self.patience, self.effort)
            for pair in pairs
        ]
        records = dict(zip(pairs, bench.run(measure_corners, trials, "corners"), strict=True))
        found = {
            (*pair, name): CornerField.load(record.folder, name, record.row)
            for pair, record in records.items()
            for name in NETWORKS
        }
        table = fields_table(found)
        first = self.seeds[0]
        views = [_view(found[corners, first, name], corners, name) for corners, name in PANELS]
        return Outcome(
            exhibits=[
                Exhibit("corners", FIGURE_CAPTION.format(seed=first), corners_figure(views)),
                Exhibit("corners_near", NEAR_CAPTION, near_figure(views)),
                Exhibit(
                    "corner_angles",
                    ANGLES_CAPTION,
                    angles_figure(table, _profiles(found, SQUARE), _trap_places(found)),
                ),
                Exhibit("corner_stalls", STALLS_CAPTION, stalls_table(table)),
                Exhibit("corner_traps", TRAPS_CAPTION, traps_table(table, found)),
            ],
            claims=corner_claims(table, _tangent_at_traps(found)),
            logs={"corner_fields": table},
        )


def _view(item: CornerField, corners: int, name: str) -> CornerView:
    """Returns what the figures show of a field."""
    with np.load(item.folder / f"{name}.npz") as stored:
        positions = stored["positions"]
    return CornerView(
        title=f"{NAMES[corners]}, {name}",
        field=load_field(item.folder / f"{name}.safetensors"),
        positions=positions.astype(np.float64),
        lapped=np.array(item.row["lapped"], bool),
        stalled=np.array(item.row["stalled"], bool),
        zeros=np.array(item.row["zeros"]).reshape(-1, 2),
        stable=np.array(item.row["zeros_stable"], bool),
        corner=slowest_corner(item.along["speed"]),
    )


def _profiles(found: CornerFields, corners: int) -> dict[str, list[FloatArray]]:
    """Returns |m| along the sides of a polygon in the direction of travel, by network.

    Fields that run clockwise for the most part are turned around.
    """
    profiles: dict[str, list[FloatArray]] = {name: [] for name in NETWORKS}
    for (number, _, name), item in found.items():
        if number == corners:
            mirrored = item.along["progress"].mean() < 0
            speed = item.along["speed"]
            profiles[name].append(speed[::-1, ::-1] if mirrored else speed)
    return profiles


def _trap_places(found: CornerFields) -> dict[str, FloatArray]:
    """Returns how far past its corner and how far outside each trap near one sits, (k, 2).

    By network; without those at which the sides run against each other, which are past none.
    """
    places = {
        network: np.concatenate(
            [item.traps.at_corners for (*_, name), item in found.items() if name == network]
        )
        for network in NETWORKS
    }
    return {name: own[~np.isnan(own[:, 0]), :2] for name, own in places.items()}


def _tangent_at_traps(found: CornerFields) -> Sequence[float]:
    """|v| at the traps of shallow networks near corners; where m is zero, it is |s|."""
    return [
        float(score)
        for (*_, name), item in found.items()
        if name == "shallow"
        for score in item.traps.score[item.traps.places.near]
    ]
