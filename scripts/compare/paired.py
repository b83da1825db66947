"""Compare evaluations of the same clips, with 95 % confidence intervals of the paired differences.

    python scripts/compare/paired.py whole.json physics.json flow.json

Every file is the output of `qudi eval --json`. Rows of the other files are compared with the rows of the first file
that have the same method, steps and light level. Prints one line for every row of every other file.
"""

import json
import statistics
import sys

MEASURES = ["psnr_a", "lpips_alex", "lpips_vgg", "gmsd", "flicker"]

# Quantiles of Student's t for two-sided confidence of 95 %, by degrees of freedom.
QUANTILES = [12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23]


def rows(path):
    """Return the rows of a file by method, steps and light level."""
    with open(path, encoding="utf-8") as file:
        listed = json.load(file)["rows"]
    return {(row["method"], row.get("steps", ""), row["ppp"]): row for row in listed}


def by_clip(row, measure):
    """Return the mean of a measure for every clip, or None if the evaluation lacks it."""

    def value(clip):
        if measure in clip:
            return clip[measure]
        values = [frame.get(measure) for frame in clip["frames"]]
        return None if None in values else statistics.mean(values)

    return {clip["clip"]: value(clip) for clip in row["clips"]}


def paired(first, other):
    """Return the mean difference over clips, and half the width of its confidence interval."""
    apart = [other[clip] - first[clip] for clip in first]
    if len(apart) < 2:
        return apart[0], float("inf")
    quantile = QUANTILES[min(len(apart) - 2, len(QUANTILES) - 1)]
    return statistics.mean(apart), quantile * statistics.stdev(apart) / len(apart) ** 0.5


def main(paths):
    if len(paths) < 2:
        sys.exit(__doc__)
    first = rows(paths[0])
    print("file", "method", "steps", "PPP", *MEASURES, sep=" | ")
    for path in paths[1:]:
        for key, row in rows(path).items():
            if key not in first:
                sys.exit(f"{path}: {paths[0]} has no row of {key}; evaluate both with the same options")
            cells = []
            for measure in MEASURES:
                ours, theirs = by_clip(first[key], measure), by_clip(row, measure)
                if None in (*ours.values(), *theirs.values()):
                    cells.append("")
                    continue
                mean, half = paired(ours, theirs)
                cells.append(f"{mean:+.4f} ± {half:.4f}")
            print(path, *map(str, key), *cells, sep=" | ")


if __name__ == "__main__":
    main(sys.argv[1:])
