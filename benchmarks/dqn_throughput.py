"""Frames per second of dqn_atari.py beside Stable-Baselines3's DQN, and where a frame's time goes.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/dqn_throughput.py

The same game, minibatch of 32, replay ratio, learning rate and interval of target copies, ε at 0.01, timed once
learning is under way, on an otherwise idle machine. The two run in processes of their own that take turns, 100 frames
each while the other waits: both see the same machine, whose speed may drift. dqn_atari.py is run whole, as its users
run it, in bfloat16 where its --precision auto takes that; Stable-Baselines3's DQN, which has float32 only, with its
CnnPolicy and its own Atari wrappers. Both run on the CPU and warm up for 1,000 frames without and 1,000 with learning.
The floors are the bare emulator, four frames of it, and the update alone on a minibatch that is never changed.
"""

import contextlib
import copy
import dataclasses
import multiprocessing
import os
import platform
import queue
import sys
import tempfile
import time
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import tyro

ALGORITHMS = Path(__file__).parent.parent / "algorithms"
sys.path.insert(0, str(ALGORITHMS))
WARM_UP = 2_000  # frames: 1,000 without learning, 1,000 with
TURN = 100  # frames


@dataclasses.dataclass
class Args:
    frames: int = 3_000
    """Frames of each that are timed, at one update per frame and at one in four."""
    env_id: str = "PongNoFrameskip-v4"
    """The game."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """That of dqn_atari.py's training."""


class Turns:
    """Lets a process run TURN frames at a time, in turns with another; keeps the seconds of the turns after warm-up."""

    def __init__(self, mine, theirs):
        self.mine, self.theirs = mine, theirs  # semaphores
        self.frames, self.seconds = 0, []
        mine.acquire()
        self.started = time.perf_counter()

    def frame(self) -> None:
        """To be called after every frame."""
        self.frames += 1
        if self.frames % TURN == 0:
            if self.frames > WARM_UP:
                self.seconds.append(time.perf_counter() - self.started)
            self.theirs.release()
            self.mine.acquire()
            self.started = time.perf_counter()


def ours(args: Args, update_frequency: int, turns: Turns) -> None:
    """Run dqn_atari.py; a frame is an update of its progress bar."""
    import dqn_atari as dqn

    class Bar(dqn.tqdm):
        def update(self, n=1):
            super().update(n)
            turns.frame()

    dqn.tqdm = Bar
    with tempfile.TemporaryDirectory() as folder:
        dqn.main(dqn.Args(
            env_id=args.env_id, device="cpu", precision=args.precision, runs_dir=folder,
            environment_train_frames_max=WARM_UP + args.frames,
            agent_replay_buffer_initial=1000, agent_update_frequency=update_frequency,
            agent_epsilon_greedy_annealing=1000, environment_test_frames=1))


def stable_baselines3(args: Args, update_frequency: int, turns: Turns) -> None:
    """Run its DQN; a frame is a call of its callback."""
    import ale_py
    import gymnasium as gym
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_atari_env
    from stable_baselines3.common.vec_env import VecFrameStack

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            turns.frame()
            return True

    gym.register_envs(ale_py)
    same_game = {"frameskip": 1, "repeat_action_probability": 0.0}
    env = VecFrameStack(make_atari_env(args.env_id, n_envs=1, seed=1, env_kwargs=same_game), n_stack=4)
    model = DQN("CnnPolicy", env, learning_rate=1e-4, buffer_size=WARM_UP + args.frames, learning_starts=1000,
                batch_size=32, train_freq=update_frequency, gradient_steps=1, target_update_interval=1000,
                exploration_fraction=1000 / (WARM_UP + args.frames), exploration_final_eps=0.01, seed=1,
                device="cpu")
    model.learn(WARM_UP + args.frames, callback=Clock())


def run(who, args: Args, update_frequency: int, mine, theirs, results) -> None:
    """What each of the two processes does."""
    turns = Turns(mine, theirs)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        who(args, update_frequency, turns)
    results.put((who.__name__, turns.seconds[: args.frames // TURN]))
    for _ in range(100_000):
        theirs.release()  # the other may finish without us


def side_by_side(args: Args, update_frequency: int) -> dict[str, np.ndarray]:
    """Seconds of every turn of each."""
    processes = multiprocessing.get_context("spawn")
    first, second, results = processes.Semaphore(1), processes.Semaphore(0), processes.Queue()
    children = [processes.Process(name=who.__name__, daemon=True, target=run,
                                  args=(who, args, update_frequency, mine, theirs, results))
                for who, mine, theirs in ((ours, first, second), (stable_baselines3, second, first))]
    for child in children:
        child.start()
    found = {}
    while len(found) < len(children):
        try:
            name, seconds = results.get(timeout=1)
            found[name] = np.array(seconds)
        except queue.Empty:
            if failed := [child for child in children if child.exitcode]:  # the other would wait for it for ever
                for child in children:
                    child.kill()
                raise SystemExit(f"error: {failed[0].name} ended with code {failed[0].exitcode}") from None
    return found


def milliseconds(call, repeats: int = 300) -> float:
    """Mean time of call(), after 20 calls of warm-up."""
    for _ in range(20):
        call()
    started = time.perf_counter()
    for _ in range(repeats):
        call()
    return (time.perf_counter() - started) / repeats * 1e3


def parts(args: Args) -> dict[str, float]:
    """Milliseconds of each part of a frame in dqn_atari.py, and of the floors."""
    import ale_py
    import dqn_atari as dqn

    script_args = dqn.Args(env_id=args.env_id, device="cpu", precision=args.precision)
    device, precision = dqn.choose_device(script_args)
    rng = np.random.default_rng(0)
    encode, decode = dqn.frame_encoding("lz4", 84, 84, device)
    env = dqn.preprocess(dqn.make_emulator(args.env_id), script_args, encode, rng, training=True)
    memory = dqn.ReplayMemory(2_000, decode)
    torch.manual_seed(0)
    q_network = dqn.QNetwork(4, 84, 84, int(env.action_space.n)).to(device)
    working_network = dqn.working_copy(q_network, precision)
    target_network = copy.deepcopy(working_network).requires_grad_(False)
    optimizer = dqn.make_optimizer(script_args, q_network)
    state, _ = env.reset(seed=1)

    def step() -> None:
        nonlocal state
        action = int(rng.integers(env.action_space.n))
        next_state, reward, terminated, truncated, _ = env.step(action)
        memory.add(state, action, reward, next_state, terminated)
        state = env.reset()[0] if terminated or truncated else next_state

    ale = env.unwrapped.ale

    def emulate() -> None:
        for _ in range(4):
            ale.act(ale_py.Action.NOOP)
        if ale.game_over():
            ale.reset_game()

    frame = milliseconds(step, 2_000)
    minibatch = memory.sample(32, rng)
    emulator = milliseconds(emulate, 2_000)
    return {
        "emulate (floor: the bare emulator)": emulator,
        "preprocess, encode, store": frame - emulator,
        "act": milliseconds(lambda: dqn.greedy_action(working_network, decode(state))),
        "sample": milliseconds(lambda: memory.sample(32, rng)),
        "update (floor: the update alone)": milliseconds(
            lambda: dqn.update(q_network, working_network, target_network, optimizer, minibatch, 0.99)),
    }


def main(args: Args) -> None:
    """Print where a frame's time goes, then the two side by side."""
    import dqn_atari as dqn
    import stable_baselines3  # noqa: F401  it is wanted later: its absence is to be known now

    if args.frames < TURN:
        raise SystemExit(f"error: --frames must be at least {TURN}, one turn")
    _, precision = dqn.choose_device(dqn.Args(device="cpu", precision=args.precision))
    print(f"{args.env_id}, {os.cpu_count()} cores, {platform.machine()}, PyTorch {torch.__version__}, "
          f"{torch.get_num_threads()} threads; dqn_atari.py in {str(precision).removeprefix('torch.')}")
    print(f"\n{'milliseconds a frame':<38}{'update every frame':>22}{'update every 4th':>22}")
    for name, value in parts(args).items():
        rare = value / 4 if name.startswith(("sample", "update")) else value
        print(f"{name:<38}{value:>22.2f}{rare:>22.2f}", flush=True)
    columns = [side_by_side(args, frequency) for frequency in (1, 4)]
    print(f"\n{'frames a second':<38}{'update every frame':>22}{'update every 4th':>22}")
    for name, title in (("ours", "dqn_atari.py"), ("stable_baselines3", "Stable-Baselines3")):
        print(f"{title:<38}" + "".join(f"{TURN / column[name].mean():>22.1f}" for column in columns))
    print(f"{'ratio':<38}" + "".join(f"{c['stable_baselines3'].sum() / c['ours'].sum():>22.2f}" for c in columns))
    quarters = [np.quantile(column["stable_baselines3"] / column["ours"], (0.25, 0.75)) for column in columns]
    print(f"{'  of turn and turn, middle half':<38}" + "".join(f"{f'{q[0]:.2f} to {q[1]:.2f}':>22}" for q in quarters))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
