"""Are diagnoses right as often as they say? The reliability diagram of stated probabilities.

Run, with keys and diagnoses of sets (`generate.py`, `snrmjax diagnose`; several of both):
    python benchmarks/blind_sets/reliability.py --keys DIR/keys --diagnoses OUT
        (or --keys DIR/keys DIR2/keys --diagnoses OUT OUT2)

Every diagnosis states a `probability` of the answer that it gives. An answer is right where it has
as many classes as there are true effects and each of these stands in a class of its own; `none`
where nothing is missing, or nothing that the columns show; `unknown` where the law is outside the
library; a drawn law where it is that of the generator (`drawn`); `noise_rejected` where the noise
is stated wrong. In five bins of the stated probability the number of right answers is compared with
what the stated probabilities themselves allow by chance (95 %). Prints one JSON line, and the sets
of a bin outside its limits to the standard error.
"""

import json
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from drawn import RIGHT
from score import Result, options, tell

EDGES = (0.0, 0.4, 0.6, 0.8, 0.95, 1.0)
CHANCE = 0.95


class Stated(NamedTuple):
    """A diagnosis: what it said, how probable it said that is, and whether it is right."""

    name: str
    probability: float
    right: bool


class Bin(NamedTuple):
    """Diagnoses of similar stated probability."""

    members: tuple[Stated, ...]
    fewest: int  # right answers that chance allows
    most: int

    @property
    def right(self) -> int:
        """How many are right."""
        return sum(one.right for one in self.members)

    @property
    def holds(self) -> bool:
        """Whether chance allows so many right answers."""
        return self.fewest <= self.right <= self.most


def is_right(result: Result) -> bool:
    """Whether the answer given is the truth."""
    key, verdict = result.key, result.verdict
    if key["group"] == "noise_wrong":
        return verdict == "noise_rejected"
    if verdict == "drawn":
        return result.drawing == RIGHT
    if key["outside"]:
        named = key["outside"] in {kind for group in result.classes for kind in group}
        return verdict == "unknown" or (named and len(result.classes) == 1)
    if not key["effects"] or verdict == "none":
        return verdict == "none" and not (key["effects"] and result.seen)
    return result.in_class and len(result.classes) == len(key["effects"])


def read_stated(keys: Path, diagnoses: Path) -> list[Stated]:
    """All sets with a key and a diagnosis."""
    found = []
    for path in sorted(keys.glob("*.json")):
        file = diagnoses / path.stem / "diagnosis.json"
        if not file.exists():
            continue
        result = Result(
            json.loads(path.read_text(encoding="utf-8")),
            json.loads(file.read_text(encoding="utf-8")),
        )
        said = result.diagnosis["probability"] if result.diagnosis else 0.0
        found.append(Stated(f"{keys.parent.name}/{path.stem}", said, is_right(result)))
    return found


def limits(probabilities: Sequence[float]) -> tuple[int, int]:
    """Numbers of right answers between which chance leaves 95 %, if the probabilities hold.

    Of independent events with these probabilities (Poisson's binomial distribution).
    """
    distribution = np.ones(1)
    for p in probabilities:
        distribution = np.convolve(distribution, [1 - p, p])
    below, tail = np.cumsum(distribution), 0.5 * (1 - CHANCE)
    fewest, most = np.searchsorted(below, [tail, 1 - tail]).tolist()
    return fewest, min(most, len(probabilities))


def binned(stated: Sequence[Stated]) -> list[Bin]:
    """The diagnoses in five bins of their stated probability."""
    found = []
    for low, high in pairwise(EDGES):
        last = high == EDGES[-1]
        mine = tuple(one for one in stated if low <= one.probability and (last or one[1] < high))
        found.append(Bin(mine, *limits([one.probability for one in mine])))
    return found


def main() -> None:
    """Print the line, and draw the figure."""
    chosen = options(__doc__, keys=[Path()], diagnoses=[Path()])
    stated = []
    for keys, diagnoses in zip(map(Path, chosen.keys), map(Path, chosen.diagnoses), strict=True):
        stated += read_stated(keys, diagnoses)
    if not stated:
        sys.exit("no set has both a key and a diagnosis.")
    bins = binned(stated)
    said, right = (np.array([one[k] for one in stated], dtype=float) for k in (1, 2))
    tell(
        record="reliability",
        sets=len(stated),
        right=int(right.sum()),
        mean_stated=said.mean(),
        brier=np.mean((said - right) ** 2),
        brier_of_one_number=right.mean() * (1 - right.mean()),
        bins=[
            {
                "from": low,
                "sets": len(one.members),
                "right": one.right,
                "by_chance": [one.fewest, one.most],
            }
            for low, one in zip(EDGES[:-1], bins, strict=True)
        ],
        bins_within_chance=sum(one.holds for one in bins),
    )
    for one in bins:
        for each in one.members if not one.holds else ():
            print(f"{each.name} {each.probability:.3f} {each.right}", file=sys.stderr)


if __name__ == "__main__":
    main()
