"""Does a learned fusion beat the paper's rule on scenes that it was not fitted to?

Generated scenes with exact truth, the model that comes with the package, five seeds: each splits the scenes anew into
those that are fitted to, those that tell when to stop, and those that the scores are of. Run it with

    python docs/research-notes/learned_fusion.py --out learned-fusion

and look at table.md and the pictures; docs/research-notes/learned-fusion.md says what came out here. The passes over
the scenes are kept: a second run has only the fits to do.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console
from rich.markdown import Markdown
from rich.progress import Progress

from vggtjax import load_model
from vggtjax.research.learning import FitConfig, ablate, generated_passes
from vggtjax.research.learning.ablation import gains, markdown, table
from vggtjax.research.learning.plots import draw_fits
from vggtjax.storage.writing import writing

FAMILIES = ("scale", "calibrated", "correlated", "features", "robust", "soft", "full", "gate")


def main() -> None:
    """Make the passes, fit every family with every seed, and write a table and pictures."""
    parser = argparse.ArgumentParser(description="Learned fusion against the paper's rule.")
    parser.add_argument("--out", type=Path, default=Path("learned-fusion"))
    parser.add_argument("--scenes", type=int, default=24)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--families", nargs="+", default=list(FAMILIES))
    options = parser.parse_args()

    console = Console()
    model = load_model("demo")
    with Progress(console=console) as progress:
        passes, fits = (progress.add_task(name, total=None) for name in ("passes over scenes", "fits"))
        made = generated_passes(
            model, options.scenes, progress=lambda done, total: progress.update(passes, completed=done, total=total)
        )
        clips = [clip for _, clip in made]
        outcomes = ablate(
            clips,
            options.families,
            FitConfig(steps=options.steps),
            seeds=range(options.seeds),
            progress=lambda done, total: progress.update(fits, completed=done, total=total),
        )
    rows = table(outcomes)
    with writing(options.out / "table.md") as path:
        path.write_text(markdown(rows), encoding="utf-8")
    shown = min((rule for rule in rows if rule in options.families), key=lambda rule: rows[rule]["nll"][0])
    draw_fits(options.out, outcomes, clips, shown)
    console.print(Markdown(markdown(rows)))
    console.print("Minus the paper's rule, on the same scenes: mean, standard deviation, seeds of which it is lower")
    for rule, row in gains(outcomes).items():
        parts = (f"{name} {row[name][0]:+.4f} ± {row[name][1]:.4f} ({row[name][2]})" for name in ("abs_rel", "nll"))
        console.print(f"{rule:18}", "   ".join(parts), highlight=False)


if __name__ == "__main__":
    main()
