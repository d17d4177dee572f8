"""Resident memory of dqn_atari.py's replay memory, filled by random play of the five games of Table
5.

    python benchmarks/replay_memory.py        # 100,000 transitions a game, scaled to a million
    python benchmarks/replay_memory.py --transitions 1000000 --games SpaceInvaders
    python benchmarks/replay_memory.py --games --checkpoints runs/RUN/checkpoint.pt    # of a run

One process a game or checkpoint. Resident memory is what the operating system counts (RSS),
after less before: frames, references, actions, rewards and whatever Python and the allocator add.
Beside it stand the lecture's figure (§7.3.2), one raw 84×84 frame a transition, and what CleanRL
(one stack of four frames) and Stable-Baselines3 (two stacks) allocate.
"""

import dataclasses
import gc
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import torch
import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))
import dqn_atari as dqn


@dataclasses.dataclass
class Args:
    transitions: int = 100_000
    """Transitions to store."""
    games: tuple[str, ...] = ("Breakout", "Enduro", "Pong", "Riverraid", "SpaceInvaders")
    """Games to play."""
    checkpoints: tuple[Path, ...] = ()
    """Checkpoints of dqn_atari.py, whose replay memories are measured, too."""
    worker: bool = False
    """Used by the benchmark itself: measure one game in this process."""


def play(game: str, capacity: int, transitions: int) -> dqn.ReplayMemory:
    """`transitions` of random play in a replay memory of `capacity`."""
    args = dqn.Args(env_id=f"{game}NoFrameskip-v4")
    rng = np.random.default_rng(0)
    env = dqn.FrameHistory(dqn.make_env(args, rng, training=True), args.agent_history_length)
    replay = dqn.ReplayMemory(capacity, (4, 84, 84), "cpu")
    s, _ = env.reset(seed=1)
    for _ in tqdm(range(transitions), desc=game, unit="frame", unit_scale=True):
        a = int(rng.integers(env.action_space.n))
        s_next, r, terminated, truncated, _ = env.step(a)
        replay.add(s, a, r, s_next, terminated)
        s = env.reset()[0] if terminated or truncated else s_next
    return replay


def read(checkpoint: Path) -> dqn.ReplayMemory:
    """The replay memory of a run."""
    saved = torch.load(checkpoint, map_location="cpu", weights_only=True)["replay"]
    replay = dqn.ReplayMemory(len(saved["places"]), (4, 84, 84), "cpu")
    replay.load_state_dict(saved)
    return replay


def resident(args: Args) -> float:
    """Bytes of resident memory that a transition takes."""
    play("Pong", 100, 100)  # the emulator's and the libraries' own memory is not the replay's
    gc.collect()
    before = psutil.Process().memory_info().rss
    if args.checkpoints:
        kept = read(args.checkpoints[0])
    else:
        kept = play(args.games[0], args.transitions, args.transitions)
    gc.collect()
    return (psutil.Process().memory_info().rss - before) / len(kept)


def main(args: Args) -> None:
    """Measure each game or checkpoint in a process of its own and print the table."""
    if args.worker:
        print(json.dumps(resident(args)))
        return
    print(f"{args.transitions:,} transitions a game, or those of a checkpoint\n")
    print(f"{'GB for a million transitions':<44}{'resident':>10}{'bytes each':>12}")
    jobs = [(game, ["--games", game]) for game in args.games]
    jobs += [(path.parent.name.split("NoFrameskip")[0] + ", trained", ["--checkpoints", str(path)])
             for path in args.checkpoints]
    for name, flags in jobs:
        command = [sys.executable, __file__, "--worker", "--transitions", str(args.transitions)]
        done = subprocess.run([*command, *flags], stdout=subprocess.PIPE, check=True, text=True)
        each = json.loads(done.stdout.splitlines()[-1])
        print(f"{'dqn_atari.py, ' + name:<44}{each / 1e3:>10.2f}{each:>12.0f}", flush=True)
    others = {
        "one raw frame (Nature, Dopamine)": 84 * 84,
        "the lecture (§7.3.2)": 11_000,
        "CleanRL: a stack of 4": 4 * 84 * 84,
        "Stable-Baselines3: two stacks of 4": 8 * 84 * 84,
    }
    for name, each in others.items():
        print(f"{name:<44}{each / 1e3:>10.2f}{each:>12,}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
