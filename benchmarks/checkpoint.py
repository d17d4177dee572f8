"""Bytes, seconds and memory of a checkpoint of a million transitions, and its share of training time.

    python benchmarks/checkpoint.py

The replay memory of dqn_atari.py is filled with frames of random play, copied as often as it takes, each copy an object
of its own; the checkpoint holds what a run's does. Written to the folder for temporary files, fsync included, and read
again while the system still holds it in memory.
"""

import dataclasses
import os
import tempfile
import threading
import time
from pathlib import Path

import psutil
import torch
import tyro
from replay_memory import dqn, play
from tqdm import tqdm


@dataclasses.dataclass
class Args:
    transitions: int = 1_000_000
    """Transitions in the replay memory."""
    games: tuple[str, ...] = ("Pong", "SpaceInvaders")
    """Games whose frames are used: the smallest and the largest of Table 5."""


class PeakMemory:
    """The highest resident memory of this process, in bytes, while the context lasts."""

    def __enter__(self):
        self.bytes, self.done, process = 0, threading.Event(), psutil.Process()

        def watch() -> None:
            while not self.done.wait(0.005):
                self.bytes = max(self.bytes, process.memory_info().rss)

        self.thread = threading.Thread(target=watch)
        self.thread.start()
        return self

    def __exit__(self, *_) -> None:
        self.done.set()
        self.thread.join()


def fill(game: str, transitions: int):
    """A replay memory with `transitions` transitions, each with a new frame object, and the last state."""
    env, memory, state = play(game, transitions, min(20_000, transitions))
    originals = memory.frames[: len(memory)]
    newest = [codes[-1] for codes in originals]
    history = state
    for i in tqdm(range(len(memory), transitions), desc=game, unit="frame", unit_scale=True):
        code = bytes(bytearray(newest[i % len(newest)]))  # an object of its own
        next_history = (*history[1:], code)
        memory.add(history, i % 4, 0.0, next_history, False)
        history = next_history
    return env, memory, history


def main(args: Args) -> None:
    """Print one row a game."""
    interval = 60 * dqn.Args().checkpoint_interval_minutes
    print(f"{args.transitions:,} transitions, {os.cpu_count()} cores\n")
    print(f"{'game':<16}{'GB':>7}{'write s':>9}{'share of time':>15}{'read s':>8}{'memory':>10}{'peak':>10}"
          f"{'ratio':>7}")
    for game in args.games:
        env, memory, history = fill(game, args.transitions)
        q_network = dqn.QNetwork(4, 84, 84, int(env.action_space.n))
        optimizer = dqn.make_optimizer(dqn.Args(), q_network)
        for parameter in q_network.parameters():
            parameter.grad = torch.zeros_like(parameter)
        optimizer.step()  # it has no state before its first step
        state = {"q_network": q_network.state_dict(), "target_network": q_network.state_dict(),
                 "optimizer": optimizer.state_dict(), "environment": dqn.environment_state(env)}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "checkpoint.pt"
            before = psutil.Process().memory_info().rss
            with PeakMemory() as peak:
                started = time.perf_counter()
                dqn.save_checkpoint(path, state, memory, history)
                write = time.perf_counter() - started
            size = path.stat().st_size
            del memory
            started = time.perf_counter()
            dqn.load_checkpoint(path)
            read = time.perf_counter() - started
        print(f"{game:<16}{size / 1e9:>7.2f}{write:>9.1f}{write / interval:>15.2%}{read:>8.1f}{before / 1e9:>7.2f} GB"
              f"{peak.bytes / 1e9:>7.2f} GB{peak.bytes / before:>7.2f}", flush=True)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main(tyro.cli(Args, description=__doc__))
