"""A run's learning curve as a picture: every training game, the mean of the last 20, the
evaluations, the final test.

    python benchmarks/learning_curve.py runs/published/breakout  # writes learning_curve.png into it
"""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


@dataclasses.dataclass
class Args:
    run_dir: Annotated[Path, tyro.conf.Positional]
    """run directory of dqn_atari.py"""


def main(args: Args) -> None:
    """Read TensorBoard's events, evaluations.csv and test.json; draw learning_curve.png."""
    if not (args.run_dir / "args.json").exists():
        sys.exit(f"error: {args.run_dir} is no run directory: args.json is missing")
    events = EventAccumulator(str(args.run_dir), size_guidance={"scalars": 0}).Reload()
    if "charts/episodic_return" not in events.Tags()["scalars"]:
        sys.exit(f"error: {args.run_dir} has no TensorBoard events of a finished game")
    points = events.Scalars("charts/episodic_return")
    games = pd.Series([p.value for p in points], index=[p.step for p in points])
    run = json.loads((args.run_dir / "args.json").read_text())

    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(games.index, games, ".", color="0.8", label="training game")
    means = games.rolling(20, min_periods=1).mean()
    axes.plot(games.index, means, color="tab:blue", label="mean of the last 20 training games")
    if (args.run_dir / "evaluations.csv").exists():  # games of Enduro are long: none in time
        evaluations = pd.read_csv(args.run_dir / "evaluations.csv")
        axes.errorbar(evaluations.frames, evaluations.score_mean,
                      np.sqrt(evaluations.score_variance),
                      fmt="o", markersize=4, color="tab:orange", capsize=3,
                      label=f"evaluation, up to {run['environment_evaluation_episodes']} games: "
                            "mean, standard deviation")
    if (args.run_dir / "test.json").exists():
        test = json.loads((args.run_dir / "test.json").read_text())
        if test["scores"]:  # else no game of the test ended
            axes.axhline(test["score_mean"], color="tab:green", linestyle="--",
                         label=f"final test, {len(test['scores'])} games: {test['score_mean']:.2f}")
    axes.set(xlabel="frames (each four of the emulator's)", ylabel="score of a game",
             title=f"{run['env_id']}, seed {run['seed']}")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(args.run_dir / "learning_curve.png", dpi=100)
    print(f"wrote {args.run_dir / 'learning_curve.png'}: {len(games)} training games, the last 20 "
          f"with a mean of {means.iloc[-1]:.4g}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
