"""benchmarks/study.py: what it runs, skips and resumes, and the numbers in its tables."""

import itertools
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import ROOT

FAKE_SCRIPT = '''
import dataclasses, json, signal, time
from pathlib import Path
import tyro
@dataclasses.dataclass
class Args:
    env_id: str = "BreakoutNoFrameskip-v4"
    environment_train_frames_max: int = 100
    initialization: str = "orthogonal"
    target_network: bool = True
    replay_buffer: bool = True
    seed: int = 1
    precision: str = "auto"
    runs_dir: str = "runs"
    resume: str = ""
if __name__ == "__main__":
    args = tyro.cli(Args)
    call = vars(args) | {"arm": [args.target_network, args.replay_buffer]}
    open("calls", "a").write(json.dumps(call) + "\\n")
    name = f"{args.runs_dir}/{args.env_id}__dqn_atari_ablation__{args.seed}__2026"
    run_dir = Path(args.resume or name)
    if not args.resume:
        run_dir.mkdir(parents=True)
        args.precision, args.threads = "float32", 2  # as chosen
        (run_dir / "args.json").write_text(json.dumps(vars(args)))
        (run_dir / "checkpoint.pt").touch()
    assert args.replay_buffer or not Path("fail").exists()
    if Path("wait").exists():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: open("signals", "a").write("x"))
        Path("waiting").touch()
        time.sleep(2)
        raise SystemExit(1)
    (run_dir / "test.json").touch()
'''
STUDY = [sys.executable, "benchmarks/study.py"]
ARMS = [[True, True], [False, True], [True, False], [False, False]]


@pytest.fixture
def study(tmp_path):
    """Run the benchmark beside a fake script; returns (exit code, output, flags of its runs)."""
    shutil.copytree(ROOT / "benchmarks", tmp_path / "benchmarks")
    (tmp_path / "algorithms").mkdir()
    (tmp_path / "algorithms" / "dqn_atari_ablation.py").write_text(FAKE_SCRIPT)

    def call(*flags: str, command=STUDY):
        (tmp_path / "calls").write_text("")
        done = subprocess.run([*command, *flags], cwd=tmp_path, capture_output=True, text=True)
        runs = [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]
        return done.returncode, done.stdout, runs
    return call


def test_each_arm_runs_once_and_what_is_finished_or_shared_is_skipped(study):
    code, _, runs = study("ablation", "--seeds", "2", "--seed", "5", "--precision", "bfloat16")
    assert code == 0 and [(r["seed"], r["arm"]) for r in runs] == [*itertools.product((5, 6), ARMS)]
    assert study("ablation", "--seeds", "2", "--seed", "5")[::2] == (0, [])
    assert len(study("initialization", "--seed", "5")[2]) == 2
    assert len({run["env_id"] for run in study("games", "--seed", "5")[2]}) == 4
    assert len(study("ablation", "--seed", "5", "--environment-train-frames-max", "9")[2]) == 4


def test_a_failed_arm_stops_no_other_and_is_resumed_by_the_next_call(study, tmp_path):
    (tmp_path / "fail").touch()
    code, _, runs = study("ablation")
    assert code != 0 and [run["arm"] for run in runs] == ARMS
    (tmp_path / "fail").unlink()
    code, _, runs = study("ablation")
    assert code == 0 and ["no-replay-buffer" in run["resume"] for run in runs] == [True, True]


def test_each_listed_line_runs_its_own_arm_once(study):
    short = ["ablation", "--environment-train-frames-max", "9"]
    lines = [shlex.split(line) for line in study(*short, "--list")[1].splitlines()]
    assert [study(command=line)[2][0]["arm"] for line in lines] == ARMS
    assert study(command=lines[2])[::2] == study(*short)[::2] == (0, [])


@pytest.mark.skipif(os.name != "posix", reason="process groups")
def test_ctrl_c_reaches_the_run_and_ends_the_study(study, tmp_path):
    (tmp_path / "wait").touch()
    process = subprocess.Popen([*STUDY, "ablation"], cwd=tmp_path, start_new_session=True)
    while not (tmp_path / "waiting").exists() and process.poll() is None:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to all in the foreground
    assert process.wait(30) == 130 and (tmp_path / "signals").exists()
    (tmp_path / "wait").unlink()
    assert [bool(run["resume"]) for run in study("ablation")[2]] == [True, False, False, False]


def test_tables_hold_means_over_seeds_and_the_iqm_and_mix_nothing_unlike(study, tmp_path):
    scores = [1.0, 12.0, 4.0, 2.0, 6.0]
    runs = [(500.0, {"seed": 1}), (500.0, {"seed": 6})]  # older than seed 1's below; published
    runs += [(score, {"seed": seed, "threads": seed}) for seed, score in enumerate(scores, 1)]
    runs += [(3.5, {"replay_buffer": False}), (7.0, {"environment_train_frames_max": 9})]
    names = [*enumerate(("score_mean", "score_variance", "length_mean", "length_variance"))]
    for number, (score, args) in enumerate(runs):  # dqn_atari.py writes no fields of an arm
        run_dir = tmp_path / "runs" / ("published" if number == 1 else f"run__{number}")
        run_dir.mkdir(parents=True)
        (run_dir / "args.json").write_text(json.dumps(args))
        (run_dir / "test.json").write_text(json.dumps({n: score * 10**i for i, n in names}))
        (run_dir / "evaluations.csv").write_text(f"frames,score_mean\n5,{score}\n")
    code, text, _ = study("tables", "--markdown", "--figure", "curves.png")
    assert code == 0 and (tmp_path / "curves.png").exists()
    row = "| 5 | 5 (32.154) | 50 (3,695.1) | 500 (576.92) | 5,000 (29,401) | "
    iqm = text.partition(row)[2].partition(" |")[0].split()
    draws = [sorted(drawn)[1:-1] for drawn in itertools.product(scores, repeat=5)]
    expected = [4, *np.percentile(np.mean(draws, axis=1), [2.5, 97.5])]  # 2, 4, 6: the middle
    assert [float(part.strip("[],")) for part in iqm] == pytest.approx(expected, abs=0.5)
    assert "| Yes | No | 1 | 3.5 (7.4837) | 35 (3.9444) | 350 (438.31) |" in text
    assert "| Breakout | 1 | 7 (32.154) |" in text.partition("--environment-train-frames-max 9")[2]
