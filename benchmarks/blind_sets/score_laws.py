"""Score the diagnoses of laws outside the library: verdicts, drawn curves, levels left out.

Run: python benchmarks/blind_sets/score_laws.py --sets DIR/sets --keys DIR/keys --diagnoses OUT

Sets are those of `generate.py --laws`. A drawn law is right, open in its class or wrong by
`drawn`.
`named` and `ambiguous` answers by effects of the library are imitations: honest where `ambiguous`
and the level left out is predicted to 1.3 times the noise. Confidently wrong are wrong drawings
and every `named`. One JSON line at the end.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np
from drawn import judged_drawing

WITHIN_NOISE = 1.3


def judged(key: dict, answer: dict) -> tuple[str, float | None]:
    """How an answer counts, and the share of the range inside the band where one is drawn."""
    verdict, gap = answer["verdict"], answer["gap"]
    if key["outside"] is None:
        return ("none" if verdict == "none" else "false alarm"), None
    if verdict == "drawn":
        return judged_drawing(key, answer)
    if verdict == "ambiguous":
        after = gap["held_out_after"]
        honest = after is not None and after <= WITHIN_NOISE
        return ("imitated" if honest else "ambiguous, level missed"), None
    return verdict, None


def closed(answer: dict) -> float | None:
    """Share of the excess gap closed on the level left out; None where there was none."""
    gap = answer["gap"]
    before, after = gap["held_out_before"], gap["held_out_after"]
    if before is None or before <= 1.5:
        return None
    return 1 - max(after - 1, 0.0) / (before - 1)


def main() -> None:
    """Print one line a set that is not as it should be, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sets", type=Path, required=True)
    parser.add_argument("--keys", type=Path, required=True)
    parser.add_argument("--diagnoses", type=Path, required=True)
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    gaps: list[float] = []
    shares: list[float] = []
    for path in sorted(options.keys.glob("*.json")):
        file = options.diagnoses / path.stem / "diagnosis.json"
        if not file.exists():
            continue
        key = json.loads(path.read_text(encoding="utf-8"))
        answer = json.loads(file.read_text(encoding="utf-8"))
        word, share = judged(key, answer)
        counts[word] += 1
        if share is not None:
            shares.append(share)
        gap = closed(answer) if answer["verdict"] == "drawn" else None
        if gap is not None:
            gaps.append(gap)
        if word not in ("none", "drawn right", "imitated"):
            text = answer.get("law", {}).get("class") or "+".join(answer["effects"])
            kind, seen = key["outside"], "harmonics" if key["harmonics"] else "fundamental"
            inside = "" if share is None else f" inside {share:.2f}"
            print(f"{path.stem} {kind} ({seen}): {word}{inside}: {text}")
    n = sum(counts.values()) - counts["none"] - counts["false alarm"]
    line = {
        "laws": n,
        **counts,
        "unknown_share": round(counts["unknown"] / max(n, 1), 3),
        "confidently_wrong": counts["drawn wrong"] + counts["named"],
        "median_share_inside": round(float(np.median(shares)), 3) if shares else None,
        "median_gap_closed": round(float(np.median(gaps)), 3) if gaps else None,
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
