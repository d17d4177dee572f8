"""Frames per second of dqn_atari.py beside Stable-Baselines3's DQN, and where a frame's time goes.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/dqn_throughput.py

The same game, minibatch of 32, replay ratio, learning rate and interval of target copies, ε at
0.01, timed once learning is under way, on an otherwise idle machine. The contenders run in
processes of their own that take turns, 100 frames each while the others wait: all see the same
machine, whose speed may drift. dqn_atari.py is run whole, as its users run it, in float32 and in
what its --precision auto chooses; Stable-Baselines3's DQN with its CnnPolicy and its own Atari
wrappers. All are on the CPU and warm up for 1,000 frames without learning and 1,000 with.

A run of hours slows down where a benchmark of seconds does not, so an optimizer is also timed
when it is old: moments of half of its units denormal, with and without the flag that flushes
them. Runs keep the frames per second of their first and last tenth in test.json.
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

import numpy as np
import torch
import tyro

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))
WARM_UP = 2_000  # frames: 1,000 without learning, 1,000 with
TURN = 100  # frames


@dataclasses.dataclass
class Args:
    frames: int = 2_000
    """frames of each contender that are timed, at one update a frame and at one in four"""
    env_id: str = "PongNoFrameskip-v4"
    """game"""


class Turns:
    """Lets a process run TURN frames at a time, in turns; keeps the seconds of the turns after
    warm-up."""

    def __init__(self, mine, following):
        self.mine, self.following = mine, following  # semaphores
        self.frames, self.seconds = 0, []
        mine.acquire()
        self.started = time.perf_counter()

    def frame(self) -> None:
        """To be called after every frame."""
        self.frames += 1
        if self.frames % TURN == 0:
            if self.frames > WARM_UP:
                self.seconds.append(time.perf_counter() - self.started)
            self.following.release()
            self.mine.acquire()
            self.started = time.perf_counter()


def ours(args: Args, update_frequency: int, turns: Turns, precision: str) -> None:
    """Run dqn_atari.py; a frame is an update of its progress bar."""
    import dqn_atari as dqn

    class Bar(dqn.tqdm):
        def update(self, n=1):
            super().update(n)
            turns.frame()

    dqn.tqdm = Bar
    with tempfile.TemporaryDirectory() as folder:
        dqn.main(dqn.Args(
            env_id=args.env_id, device="cpu", precision=precision, runs_dir=folder,
            environment_train_frames_max=WARM_UP + args.frames, agent_replay_buffer_initial=1000,
            agent_update_frequency=update_frequency, agent_epsilon_greedy_annealing=1000,
            environment_test_frames=1))


def stable_baselines3(args: Args, update_frequency: int, turns: Turns, _precision: str) -> None:
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
    env = make_atari_env(args.env_id, n_envs=1, seed=1, env_kwargs=same_game)
    frames = WARM_UP + args.frames
    model = DQN("CnnPolicy", VecFrameStack(env, n_stack=4), learning_rate=1e-4, buffer_size=frames,
                learning_starts=1000, batch_size=32, train_freq=update_frequency, gradient_steps=1,
                target_update_interval=1000, exploration_fraction=1000 / frames,
                exploration_final_eps=0.01, seed=1, device="cpu")
    model.learn(frames, callback=Clock())


CONTENDERS = {
    "Stable-Baselines3": (stable_baselines3, ""),
    "dqn_atari.py, float32": (ours, "float32"),
    "dqn_atari.py, auto": (ours, "auto"),
}


def run(name: str, args: Args, update_frequency: int, mine, following, results) -> None:
    """What the process of a contender does."""
    turns = Turns(mine, following)
    with open(os.devnull, "w") as nowhere:
        with contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
            who, precision = CONTENDERS[name]
            who(args, update_frequency, turns, precision)
    results.put((name, turns.seconds[: args.frames // TURN]))
    following.release()  # all turns are over: the next may end, too


def side_by_side(args: Args, update_frequency: int) -> dict[str, np.ndarray]:
    """Seconds of every turn of each contender."""
    spawn = multiprocessing.get_context("spawn")
    results = spawn.Queue()
    ring = [spawn.Semaphore(int(i == 0)) for i in range(len(CONTENDERS))]
    children = [
        spawn.Process(target=run, daemon=True, args=(
            name, args, update_frequency, ring[i], ring[(i + 1) % len(ring)], results))
        for i, name in enumerate(CONTENDERS)
    ]
    for child in children:
        child.start()
    found = {}
    while len(found) < len(children):
        with contextlib.suppress(queue.Empty):
            name, seconds = results.get(timeout=1)
            found[name] = np.array(seconds)
        if any(child.exitcode for child in children):  # the others would wait for it for ever
            raise SystemExit("error: a contender has failed")
    for child in children:
        child.join()
    return found


def milliseconds(call, repeats: int = 300, before=lambda: None) -> float:
    """Mean time of call(), after 20 calls of warm-up; before() each is not timed."""
    total = 0.0
    for i in range(repeats + 20):
        before()
        started = time.perf_counter()
        call()
        total += (time.perf_counter() - started) * (i >= 20)
    return total / repeats * 1e3


def parts(args: Args) -> dict[str, float]:
    """Milliseconds of each part of a frame in dqn_atari.py."""
    import ale_py
    import dqn_atari as dqn

    script_args = dqn.Args(env_id=args.env_id, device="cpu")
    rng = np.random.default_rng(0)
    env = dqn.FrameHistory(dqn.make_env(script_args, rng, training=True), 4)
    replay = dqn.ReplayMemory(2_000, (84, 84), "cpu")
    q_network = dqn.QNetwork(4, 84, 84, int(env.action_space.n))
    q_network.to(memory_format=torch.channels_last)
    target_network = copy.deepcopy(q_network).requires_grad_(False)
    optimizer = dqn.make_optimizer(script_args, q_network)
    s, _ = env.reset(seed=1)

    def step() -> None:
        nonlocal s
        a = int(rng.integers(env.action_space.n))
        s_next, r, terminated, truncated, _ = env.step(a)
        replay.add(s, a, r, s_next, terminated)
        s = env.reset()[0] if terminated or truncated else s_next

    def emulate() -> None:
        for _ in range(4):
            env.unwrapped.ale.act(ale_py.Action.NOOP)
        if env.unwrapped.ale.game_over():
            env.unwrapped.ale.reset_game()

    def update(precision: str) -> None:
        dqn.update(q_network, target_network, optimizer, minibatch, 0.99, precision)

    def grow_old() -> None:
        for θ in (q_network.layers[7].weight, q_network.head.weight):
            θ.grad[..., ::2] = 0
            optimizer.state[θ]["exp_avg"][..., ::2] = 1e-40
            optimizer.state[θ]["exp_avg_sq"][..., ::2] = 1e-40

    frame = milliseconds(step, 2_000)
    emulator = milliseconds(emulate, 2_000)
    minibatch = replay.gather(rng.integers(len(replay), size=32))
    times = {
        "emulate (the bare emulator)": emulator,
        "preprocess, compress, store": frame - emulator,
        "act": milliseconds(lambda: dqn.epsilon_greedy(q_network, replay.decode(s), 0.0, rng)),
        "sample": milliseconds(lambda: replay.gather(rng.integers(len(replay), size=32))),
        "update, float32": milliseconds(lambda: update("float32")),
        "update, bfloat16": milliseconds(lambda: update("bfloat16")),
        "of it Adam's step": milliseconds(optimizer.step),
        "Adam's step when old": milliseconds(optimizer.step, 100, grow_old),
    }
    return times


def cpu_name() -> str:
    """The CPU's model, as far as the operating system tells."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":")[1].strip()
    return platform.processor() or platform.machine()


def old_without_flushing() -> float:
    """Milliseconds of an old Adam's step where denormal numbers are not flushed."""
    torch.set_flush_denormal(False)
    θ = torch.zeros(512, 3136, requires_grad=True)
    θ.grad = torch.ones_like(θ)
    adam = torch.optim.Adam([θ], lr=1e-4, fused=True)
    adam.step()

    def grow_old() -> None:
        θ.grad[:, ::2] = 0
        adam.state[θ]["exp_avg"][:, ::2] = 1e-40
        adam.state[θ]["exp_avg_sq"][:, ::2] = 1e-40

    return milliseconds(adam.step, 100, grow_old)


def in_a_process(call, *args):
    """call(*args) in a process of its own: flags and threads of another do not reach it."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(call, args)


def flushed_parts(args: Args) -> dict[str, float]:
    """`parts` as in a run: denormal numbers flushed before the first parallel work."""
    torch.set_flush_denormal(True)
    return parts(args)


def main(args: Args) -> None:
    """Print where a frame's time goes, then the contenders side by side."""
    import stable_baselines3  # noqa: F401  it is wanted later: its absence is to be known now

    print(f"{args.env_id}; {cpu_name()}, {os.cpu_count()} cores; PyTorch {torch.__version__}\n")
    print(f"{'milliseconds':<38}")
    for name, value in in_a_process(flushed_parts, args).items():
        print(f"{name:<38}{value:>10.2f}", flush=True)
    print(f"{'  the same, denormals not flushed':<38}{in_a_process(old_without_flushing):>10.2f}")
    columns = [side_by_side(args, frequency) for frequency in (1, 4)]
    title = ("update every frame", "update every 4th")
    print(f"\n{'frames a second':<38}{title[0]:>22}{title[1]:>22}")
    for name in CONTENDERS:
        print(f"{name:<38}" + "".join(f"{TURN / c[name].mean():>22.1f}" for c in columns))
    for name in list(CONTENDERS)[1:]:
        ratios = [c["Stable-Baselines3"].sum() / c[name].sum() for c in columns]
        print(f"{'ratio, ' + name:<38}" + "".join(f"{ratio:>22.2f}" for ratio in ratios))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
