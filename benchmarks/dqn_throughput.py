"""Frames per second of dqn_atari.py beside Stable-Baselines3's DQN, and where a frame's time goes.

    pip install -r requirements.txt -r benchmarks/requirements.txt
    python benchmarks/dqn_throughput.py

One process after another on an otherwise idle machine: the same game, minibatch of 32, replay ratio, learning rate and
interval of target copies, ε at 0.01, timed once learning is under way. dqn_atari.py is run as its users run it, timed
by the frames per second that it logs; Stable-Baselines3's DQN (CnnPolicy, its own Atari wrappers) by a callback. Both
warm up for 1,000 frames of learning and are then timed for `frames`. They take turns for `rounds` rounds, since a
shared machine's speed drifts; a speed is the median of its rounds and a ratio the median of the rounds' ratios. The
floors are the bare emulator, four frames of it, and the update alone on a minibatch that is never changed.
"""

import copy
import dataclasses
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import tyro

ALGORITHMS = Path(__file__).parent.parent / "algorithms"
sys.path.insert(0, str(ALGORITHMS))
WARM_UP = 2_000  # frames: 1,000 without learning, 1,000 with


@dataclasses.dataclass
class Args:
    frames: int = 3_000
    """Frames that are timed, at one update per frame and at one in four."""
    rounds: int = 3
    """Times that each of the two is run, in turns."""
    env_id: str = "PongNoFrameskip-v4"
    """The game."""
    worker: str = ""
    """Used by the benchmark itself: what this process measures."""
    update_frequency: int = 1
    """Used by the benchmark itself: frames per update."""


def ours(args: Args) -> float:
    """Frames per second that dqn_atari.py logs after the warm-up."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, ALGORITHMS / "dqn_atari.py", "--env-id", args.env_id, "--runs-dir", folder,
             "--environment-train-frames-max", str(WARM_UP + args.frames), "--agent-replay-buffer-initial", "1000",
             "--agent-update-frequency", str(args.update_frequency), "--agent-epsilon-greedy-annealing", "1000",
             "--environment-test-frames", "1"], check=True, capture_output=True)
        (run_dir,) = Path(folder).iterdir()
        points = EventAccumulator(str(run_dir)).Reload().Scalars("charts/frames_per_second")
        windows = [point.value for point in points if point.step > WARM_UP]
    return len(windows) / sum(1 / rate for rate in windows)  # all windows have the same number of frames


def stable_baselines3(args: Args) -> float:
    """Frames per second of its DQN after the warm-up."""
    import ale_py
    import gymnasium as gym
    from stable_baselines3 import DQN
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_atari_env
    from stable_baselines3.common.vec_env import VecFrameStack

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == WARM_UP:
                self.started = time.perf_counter()
            return True

    gym.register_envs(ale_py)
    env = VecFrameStack(make_atari_env(args.env_id, n_envs=1, seed=1), n_stack=4)
    model = DQN("CnnPolicy", env, learning_rate=1e-4, buffer_size=WARM_UP + args.frames, learning_starts=1000,
                batch_size=32, train_freq=args.update_frequency, gradient_steps=1, target_update_interval=1000,
                exploration_fraction=1000 / (WARM_UP + args.frames), exploration_final_eps=0.01, seed=1)
    clock = Clock()
    model.learn(WARM_UP + args.frames, callback=clock)
    return args.frames / (time.perf_counter() - clock.started)


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

    script_args = dqn.Args(env_id=args.env_id)
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


def measure(worker: str, update_frequency: int, args: Args):
    """What one fresh process measures."""
    done = subprocess.run([sys.executable, __file__, "--worker", worker, "--update-frequency", str(update_frequency),
                           "--frames", str(args.frames), "--env-id", args.env_id], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{worker} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def main(args: Args) -> None:
    """Measure in processes of their own, one after another, and print the two tables."""
    workers = {"dqn_atari.py": ours, "Stable-Baselines3": stable_baselines3, "parts": parts}
    if args.worker:
        print(json.dumps(workers[args.worker](args)))
        return
    print(f"{args.env_id}, {os.cpu_count()} cores, {platform.machine()}, PyTorch {torch.__version__}, "
          f"{torch.get_num_threads()} threads")
    times = measure("parts", 1, args)
    print(f"\n{'milliseconds a frame':<38}{'update every frame':>20}{'update every 4th':>20}")
    for name, value in times.items():
        rare = value / 4 if name.startswith(("sample", "update")) else value
        print(f"{name:<38}{value:>20.2f}{rare:>20.2f}")
    peers = ("dqn_atari.py", "Stable-Baselines3")
    speeds = {(name, frequency): [] for name in peers for frequency in (1, 4)}
    for _ in range(args.rounds):
        for name, frequency in sorted(speeds, key=lambda key: key[1]):
            speeds[name, frequency].append(measure(name, frequency, args))
    ratios = {("ratio", frequency): np.divide(*(speeds[name, frequency] for name in peers)) for frequency in (1, 4)}
    print(f"\n{f'frames a second, {args.rounds} rounds':<38}{'update every frame':>26}{'update every 4th':>26}")
    for name, digits in ((peers[0], 1), (peers[1], 1), ("ratio", 2)):
        columns = [(speeds | ratios)[name, frequency] for frequency in (1, 4)]
        print(f"{name:<38}" + "".join(
            f"{f'{np.median(x):.{digits}f} ({min(x):.{digits}f} to {max(x):.{digits}f})':>26}" for x in columns))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
