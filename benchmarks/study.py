"""Run the experiments of the lecture's §7.5 and print its Tables 4, 5 and 6 beside ours.

    python benchmarks/study.py ablation --seeds 3        # Table 6: target network, replay buffer
    python benchmarks/study.py initialization            # Table 4: weights of the convolutions
    python benchmarks/study.py games                     # Table 5: five games
    python benchmarks/study.py tables runs               # the tables, from all runs below runs
    python benchmarks/study.py tables runs --markdown --figure curves.png

All other flags go to algorithms/dqn_atari_ablation.py, for example --environment-train-frames-max
500000. Seeds count from --seed up. Given again, a command skips the runs that have finished and
resumes those that were cut off. In --runs-dir each initialization and switch has a folder. The arm
that the three studies share, Table 3 on Breakout, runs once if they are run one after another. Each
run chooses its precision, and keeps it; --precision float32 makes it the same for all new ones.

On a cluster the runs go side by side. --list prints one command a run, safe to give again when the
runs have ended:
    python benchmarks/study.py ablation --seeds 3 --list > commands.txt
    parallel -j 4 < commands.txt
    sbatch --array=1-12 --wrap 'eval "$(sed -n ${SLURM_ARRAY_TASK_ID}p commands.txt)"'

A row of a table is the mean over seeds, the lecture's figure in brackets. Of two runs with the same
flags and seed the newer counts. Runs of dqn_atari.py count, too. From three seeds up a row has the
interquartile mean of the score with its 95 % bootstrap interval (Agarwal et al., NeurIPS 2021); of
three or four seeds such an interval is little more than their range. Runs with other
hyperparameters or frames stand apart, under the flags in which they differ from Table 3.
"""

import argparse
import dataclasses
import json
import re
import shlex
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from matplotlib.figure import Figure
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "algorithms"))
import dqn_atari_ablation
from dqn_atari_ablation import Args  # its defaults are Table 3

SCRIPT = Path(dqn_atari_ablation.__file__)


@dataclasses.dataclass(frozen=True, order=True)
class Arm:
    """What the rows of Tables 4, 5 and 6 vary."""

    game: str
    initialization: str = "orthogonal"
    target_network: bool = True
    replay_buffer: bool = True


# mean and variance of a game's score, mean and variance of its length in frames
LECTURE = {
    Arm("Breakout", "default"): (11.174, 696.84, 480.43, 22894),  # Table 4
    Arm("Breakout", "he"): (22.865, 749.63, 703.13, 87811),
    Arm("Breakout"): (32.154, 3695.1, 576.92, 29401),  # Tables 4, 5 and 6
    Arm("Enduro"): (258.63, 14905, 4500.0, 2782600),  # Table 5
    Arm("Pong"): (19.083, 5.4014, 1875.0, 56022),
    Arm("Riverraid"): (3459.4, 877420, 833.33, 37002),
    Arm("SpaceInvaders"): (748.14, 30417, 882.35, 41330),
    Arm("Breakout", target_network=False): (10.549, 1.4201, 639.81, 27774),  # Table 6
    Arm("Breakout", replay_buffer=False): (7.4837, 3.9444, 438.31, 35112),
    Arm("Breakout", target_network=False, replay_buffer=False): (10.701, 1.2104, 671.64, 38953),
}
TABLES = {  # which part of an arm its rows vary; the rest is the standard arm's
    "Table 4: initialization on Breakout": ["initialization"],
    "Table 5: games": ["game"],
    "Table 6: ablation on Breakout": ["target_network", "replay_buffer"],
}
STANDARD = Arm("Breakout")  # a row of all three
FIGURES = ["score_mean", "score_variance", "length_mean", "length_variance"]
NAMES = {
    True: "Yes", False: "No", "Riverraid": "River Raid", "SpaceInvaders": "Space Invaders",
    "default": "PyTorch Default", "he": "He", "orthogonal": "Orthogonal",
}  # fmt: skip
STUDIES = {  # each arm's flags
    "ablation": [
        ["--target-network", "--replay-buffer"],
        ["--no-target-network", "--replay-buffer"],
        ["--target-network", "--no-replay-buffer"],
        ["--no-target-network", "--no-replay-buffer"],
    ],
    "initialization": [["--initialization", name] for name in ("default", "he", "orthogonal")],
    "games": [
        ["--env-id", f"{game}NoFrameskip-v4"] for game in sorted({arm.game for arm in LECTURE})
    ],
}
TABLE_3 = "Table 3's hyperparameters"
# flags that tell arms and seeds apart, or say only how a run is carried out
NOT_COMPARED = {
    "env_id", "initialization", "target_network", "replay_buffer", "seed", "device", "precision",
    "threads", "runs_dir", "resume", "checkpoint_interval_minutes",
}  # fmt: skip


# ---- run directories ---------------------------------------------------------------------------


def read_args(run_dir: Path) -> dict:
    """A run's flags; dqn_atari.py has none for an arm, its runs are the standard arm."""
    return vars(Args()) | json.loads((run_dir / "args.json").read_text(encoding="utf-8"))


def arm_of(args: dict) -> Arm:
    """The arm, with ALE's name of the game: Breakout for BreakoutNoFrameskip-v4."""
    game = re.sub(r"^ALE/|(NoFrameskip)?-v\d+$", "", args["env_id"])
    return Arm(game, args["initialization"], args["target_network"], args["replay_buffer"])


def short_name(arm: Arm) -> str:
    """An arm's name in file names and legends, without the game: orthogonal-no-replay-buffer."""
    name = arm.initialization
    name += "" if arm.target_network else "-no-target-network"
    return name + ("" if arm.replay_buffer else "-no-replay-buffer")


def differences(args: dict) -> str:
    """The flags in which a run differs from Table 3, other than its arm's; "" if there are none."""
    table_3 = vars(Args())
    names = [name for name in sorted(args) if args[name] != table_3.get(name)]
    names = [name for name in names if name not in NOT_COMPARED]
    return " ".join(f"--{name.replace('_', '-')} {args[name]}" for name in names)


def identity(args: dict) -> tuple:
    """Two runs with the same identity are the same experiment."""
    return differences(args), arm_of(args), args["seed"]


def run_directories(folder: Path, pattern: str = "*") -> list[Path]:
    """The run directories below a folder but for `published` ones, oldest first: their names end in
    the time."""
    found = [path.parent for path in folder.rglob(f"{pattern}/args.json")]
    found = [path for path in found if "published" not in path.relative_to(folder).parts]
    return sorted(found, key=lambda run_dir: (run_dir.name.rpartition("__")[1:], run_dir))


# ---- study -------------------------------------------------------------------------------------


def next_step(flags: list[str]) -> tuple[str, list[str]]:
    """What is to be done for the run with these flags: a word about it, and the command if any."""
    args = tyro.cli(Args, args=flags)
    command = [sys.executable, str(SCRIPT)]
    for run_dir in reversed(run_directories(Path(args.runs_dir), f"*__{SCRIPT.stem}__*")):
        if identity(read_args(run_dir)) == identity(vars(args)):
            if (run_dir / "test.json").exists():
                return f"has finished, {run_dir}", []
            if (run_dir / "checkpoint.pt").exists():
                return f"goes on, {run_dir}", [*command, "--resume", str(run_dir)]
    # A folder for each arm: runs that start in the same second must not meet in one directory.
    folder = Path(args.runs_dir) / short_name(arm_of(vars(args)))
    return "starts", [*command, *flags, "--runs-dir", str(folder)]


def run(command: list[str]) -> int:
    """Run to the end and return the exit code. A Ctrl-C stops the run with a checkpoint."""
    process = subprocess.Popen(command)
    try:
        return process.wait()
    except KeyboardInterrupt:
        if sys.platform != "win32":  # where the Ctrl-C has reached it, and this would kill it
            process.terminate()
        process.wait()
        raise


def study(options: argparse.Namespace, flags: list[str]) -> None:
    """Run the arms of a study for each seed, one after another, or list their commands."""
    first = tyro.cli(Args, args=flags).seed
    runs = [
        [*flags, *arm, "--seed", str(seed)]
        for seed in range(first, first + options.seeds)
        for arm in STUDIES[options.command]
    ]
    if options.only not in (None, *range(1, len(runs) + 1)):
        raise SystemExit(f"error: --only is from 1 to {len(runs)}")
    failed = False
    for number, run_flags in enumerate(runs, 1):
        if options.list:
            again = [sys.executable, str(Path(__file__).resolve()), options.command]
            again += ["--seeds", str(options.seeds), "--only", str(number), *flags]
            print(shlex.join(again))
        elif options.only in (None, number):
            state, command = next_step(run_flags)
            name = " ".join(run_flags[len(flags) :])
            print(f"run {number} of {len(runs)}, {name}: {state}", flush=True)
            if command and run(command) != 0:
                failed = True
                print(f"error: run {number} of {len(runs)} failed", file=sys.stderr, flush=True)
    if failed:
        raise SystemExit(1)


# ---- tables ------------------------------------------------------------------------------------


def read_tests(run_dirs: list[Path]) -> pd.DataFrame:
    """One row a finished run: label, arm, seed and the four figures of its test."""
    rows = []
    for run_dir in run_dirs:
        if (run_dir / "test.json").exists():
            test = json.loads((run_dir / "test.json").read_text(encoding="utf-8"))
            rows.append([*identity(read_args(run_dir)), *(test[name] for name in FIGURES)])
    tests = pd.DataFrame(rows, columns=["label", "arm", "seed", *FIGURES])
    tests = tests.dropna(subset="score_mean")  # no game of the test ended
    return tests.drop_duplicates(["label", "arm", "seed"], keep="last")


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of all scores; a quarter, rounded down, is cut off at each end."""
    return stats.trim_mean(scores, 0.25, axis=axis)


def iqm_with_interval(scores: np.ndarray) -> str:
    """The interquartile mean over seeds and its 95 % interval, from seeds drawn anew."""
    if len(scores) < 3:
        return "-"
    drawn = stats.bootstrap([scores], interquartile_mean, method="percentile", rng=0)
    low, high = drawn.confidence_interval
    return f"{digits(interquartile_mean(scores))} [{digits(low)}, {digits(high)}]"


def digits(value: float) -> str:
    """Five digits, as in the lecture, and no power of ten."""
    return f"{float(f'{value:.5g}'):,.15g}"


def make_table(tests: pd.DataFrame, arms: list[Arm], parts: list[str]) -> pd.DataFrame:
    """A row an arm: what names it, seeds, our mean over seeds (the lecture's figure), the IQM."""
    rows = []
    for arm in arms:
        measured = tests[tests["arm"] == arm]
        row = {part: NAMES.get(getattr(arm, part), getattr(arm, part)) for part in parts}
        row["seeds"] = len(measured)
        for i, name in enumerate(FIGURES):
            row[name] = digits(measured[name].mean()) if len(measured) else "-"
            row[name] += f" ({digits(LECTURE[arm][i])})" if arm in LECTURE else ""
        row["score_iqm [95 %]"] = iqm_with_interval(measured["score_mean"].to_numpy())
        rows.append(row)
    return pd.DataFrame(rows).rename(columns=lambda name: name.replace("_", " "))


def print_table(title: str, table: pd.DataFrame, markdown: bool) -> None:
    """A table as text or as Markdown."""
    if markdown:
        rows = [table.columns, ["---"] * len(table.columns), *table.to_numpy()]
        lines = [f"| {' | '.join(map(str, row))} |" for row in rows]
        print(f"### {title}", "", *lines, "", sep="\n")
    else:
        print(title, table.to_string(index=False), "", sep="\n")


def print_tables(tests: pd.DataFrame, markdown: bool) -> None:
    """The tables that have a measured row; Table 3's hyperparameters before other settings."""
    if tests.empty:
        raise SystemExit("error: no finished test")
    for label, alike in tests.groupby("label"):
        heading = f"Other than Table 3: {label}" if label else TABLE_3
        print(f"{'## ' if markdown else ''}{heading}; in brackets the lecture's figures\n")
        for title, parts in TABLES.items():
            same = {part: getattr(STANDARD, part) for part in parts}
            arms = [arm for arm in LECTURE if dataclasses.replace(arm, **same) == STANDARD]
            if alike["arm"].isin(arms).any():
                print_table(title, make_table(alike, arms, parts), markdown)
        others = sorted(set(alike["arm"]) - LECTURE.keys())
        if others:
            print_table("Other arms", make_table(alike, others, list(vars(STANDARD))), markdown)


def draw_curves(run_dirs: list[Path], file: str) -> None:
    """A row of panels a setting and game; a colour an arm, a line a run."""
    runs = {}  # of two with the same flags and seed the newer
    for run_dir in run_dirs:
        if (run_dir / "evaluations.csv").exists():
            label, arm, _ = same = identity(read_args(run_dir))
            names = {"label": label or TABLE_3, "game": arm.game, "arm": short_name(arm)}
            runs[same] = pd.read_csv(run_dir / "evaluations.csv").assign(**names, run=str(run_dir))
    panels = {"score_mean": "score, evaluation", "held_out_max_q_mean": "max Q, held-out states"}
    if not runs:
        raise SystemExit("error: no evaluations.csv to draw")
    settings = pd.concat(runs.values()).groupby(["label", "game"])
    figure = Figure(figsize=(12, 4 * settings.ngroups), layout="constrained")
    grid = figure.subplots(settings.ngroups, 2, squeeze=False)
    for ((label, game), alike), axes in zip(settings, grid, strict=True):
        colours = {arm: f"C{i}" for i, arm in enumerate(sorted(set(alike["arm"])))}
        for axis, (column, title) in zip(axes, panels.items(), strict=True):
            axis.set(xlabel="frames", ylabel=title)
            for (arm, _), curve in alike.groupby(["arm", "run"]):
                if column in curve:  # dqn_atari.py has no held-out states
                    axis.plot(curve["frames"], curve[column], ".-", c=colours[arm], label=arm)
        lines = {line.get_label(): line for line in axes[0].lines}  # one of each arm's seeds
        axes[0].legend(lines.values(), lines.keys(), fontsize="small")
        axes[0].set_title(textwrap.fill(f"{game}: {label}", 75), fontsize="small")
        axes[1].set_yscale("symlog")  # what diverges goes through decades
    try:
        figure.savefig(file, dpi=120)
    except (OSError, ValueError) as error:  # a ValueError: a format that matplotlib does not know
        raise SystemExit(f"error: {file} could not be drawn: {error}") from None


# ---- main --------------------------------------------------------------------------------------


def main() -> None:
    """Read the command line; what it does not know is for the script."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name in STUDIES:  # no abbreviations: --seed is the script's, --seeds is ours
        command = commands.add_parser(name, allow_abbrev=False, epilog="other flags: the script's")
        command.add_argument("--seeds", type=int, default=1, help="runs of each arm")
        command.add_argument("--list", action="store_true", help="print the commands, run nothing")
        command.add_argument("--only", type=int, help="the one run with this number")
    command = commands.add_parser("tables", allow_abbrev=False)
    command.add_argument("dir", nargs="?", default="runs", help="folder of run directories")
    command.add_argument("--markdown", action="store_true", help="print Markdown")
    command.add_argument("--figure", help="file to draw the learning curves in")
    options, flags = parser.parse_known_args()
    if options.command == "tables":
        if flags:
            parser.error(f"unrecognized arguments: {' '.join(flags)}")
        run_dirs = run_directories(Path(options.dir))
        print_tables(read_tests(run_dirs), options.markdown)
        if options.figure:
            draw_curves(run_dirs, options.figure)
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    try:
        study(options, flags)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
