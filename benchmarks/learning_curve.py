"""A run's learning curve as a picture: every training game, the mean of the last 20, the evaluations, the final test.

    python benchmarks/learning_curve.py runs/published/pong        # writes learning_curve.png into it
"""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


@dataclasses.dataclass
class Args:
    run_dir: Annotated[Path, tyro.conf.Positional]
    """A run directory of dqn_atari.py."""


def main(args: Args) -> None:
    """Read TensorBoard's events, evaluations.csv and test.json; draw learning_curve.png."""
    events = EventAccumulator(str(args.run_dir), size_guidance={"scalars": 0}).Reload()
    points = events.Scalars("charts/episodic_return")
    frames, scores = np.array([p.step for p in points]), np.array([p.value for p in points])  # (games,) each
    means = [scores[max(i - 19, 0) : i + 1].mean() for i in range(len(scores))]
    evaluations = args.run_dir / "evaluations.csv"
    rows = list(csv.DictReader(evaluations.read_text().splitlines())) if evaluations.exists() else []
    run = json.loads((args.run_dir / "args.json").read_text())

    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(frames, scores, ".", color="0.75", label="training game")
    axes.plot(frames, means, color="tab:blue", label="mean of the last 20 training games")
    axes.errorbar([int(row["frames"]) for row in rows], [float(row["score_mean"]) for row in rows],
                  [float(row["score_variance"]) ** 0.5 for row in rows], fmt="o", color="tab:orange", capsize=3,
                  label=f"evaluation, {run['environment_evaluation_episodes']} games: mean, standard deviation")
    path = args.run_dir / "test.json"
    test = json.loads(path.read_text()) if path.exists() else {"scores": []}
    if test["scores"]:
        axes.axhline(test["score_mean"], color="tab:green", linestyle="--",
                     label=f"final test, {len(test['scores'])} games: {test['score_mean']:.2f}")
    axes.set(xlabel="frames (each four of the emulator's)", ylabel="score of a game",
             title=f"{run['env_id']}, seed {run['seed']}")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(args.run_dir / "learning_curve.png", dpi=100)
    print(f"wrote {args.run_dir / 'learning_curve.png'}: {len(scores)} training games, {len(rows)} evaluations")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
