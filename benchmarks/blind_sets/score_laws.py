"""Score the diagnoses of laws outside the library: verdicts, drawn curves, levels left out.

Run: python benchmarks/blind_sets/score_laws.py --sets DIR/sets --keys DIR/keys --diagnoses OUT

Sets are those of `generate.py --laws`. How a drawn law is counted:
- right: it is a function of what the true law is a function of, and the true force is inside the
  95 % band over at least 90 % of the measured range; without harmonics the odd part of a force is
  compared, which is all that such data show;
- class open: it is not, but the answer names the true class as one that would do as well;
- wrong: neither of these.
`named` and `ambiguous` answers by effects of the library are imitations: honest where `ambiguous`
and the level left out is predicted to 1.3 times the noise. Confidently wrong are wrong drawings
and every `named`. One JSON line at the end.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import laws
import numpy as np

BAND = 1.96
INSIDE = 0.9
WITHIN_NOISE = 1.3


def class_of(kind: str) -> str:
    """What an effect of a drawn model is a function of."""
    if kind == "displacement_damping_law":
        return "damping by displacement"
    if kind == "slip_law":
        return "slip"
    return "displacement" if kind.endswith("stiffness_law") else "velocity"


def true_force(key: dict, at: np.ndarray, law: dict) -> np.ndarray:
    """The true force at the sensor, N, where a drawn law has its table."""
    base, kind = key["baseline"], key["outside"]
    omega, size = 2 * np.pi * base["frequency_hz"], base["displacement_scale"]
    of = laws.OF[kind]
    unit = omega * size if of == "velocity" else size  # kg^1/2 m or kg^1/2 m/s

    def curve(x: np.ndarray) -> np.ndarray:
        return laws.true_curve(kind, key["parameters"], x / base["shape"] / unit)

    if of == "damping by displacement":
        speed = law["at_velocity_m_s"] / base["shape"]
        return curve(at) * omega * speed / base["shape"]
    force = curve(np.abs(at)) * np.sign(at) if of == "slip" else curve(at)
    if of != "slip" and not key["harmonics"]:
        force = 0.5 * (force - curve(-at))
    return force * omega**2 * size / base["shape"]


def share_inside(key: dict, law: dict) -> float:
    """Share of the measured range over which the true force is inside the 95 % band."""
    at = np.array(law.get("velocity_m_s", law.get("displacement_m")))
    force, std = np.array(law["force_n"]), np.array(law["force_std_n"])
    true = true_force(key, at, law)
    inside = np.abs(true - force) <= BAND * std + 1e-9 * np.abs(true).max()
    length = np.gradient(at) * (np.abs(at) <= 1.03 * law["measured_up_to"])
    return float(np.sum(length * inside) / np.sum(length))


def judged(key: dict, answer: dict) -> tuple[str, float | None]:
    """How an answer counts, and the share of the range inside the band where one is drawn."""
    verdict, gap = answer["verdict"], answer["gap"]
    if key["outside"] is None:
        return ("none" if verdict == "none" else "false alarm"), None
    if verdict == "drawn":
        classes = [class_of(kind) for kind in answer["candidates"][0]]
        of = laws.OF[key["outside"]]
        if classes[0] != of:
            return ("class open" if of in classes else "drawn wrong"), None
        share = share_inside(key, answer["law"])
        alone = "further" not in answer["law"]
        return ("drawn right" if share >= INSIDE and alone else "drawn wrong"), share
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
