# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "filelock", "gymnasium>=1.1", "lz4", "numpy>=1.26", "opencv-python-headless", "psutil",
#     "tensorboard", "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
r"""Deep Q-Learning on Atari games: Algorithm 6 of the lecture (ECE 544NA, Lecture 27, §5.3 and §7), the method of
Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015), [8] below.

Run it
    python algorithms/dqn_atari.py --env-id PongNoFrameskip-v4          # Table 3's hyperparameters, 10 million frames
    python algorithms/dqn_atari.py --env-id ALE/Breakout-v5 --seed 2    # any Atari game, by either of its names
    python algorithms/dqn_atari.py --resume runs/RUN                    # go on with an interrupted run
    tensorboard --logdir runs                                           # watch it learn

The column of the Nature paper (Figure 18; 50 million frames):
    python algorithms/dqn_atari.py --env-id PongNoFrameskip-v4 --environment-train-frames-max 50000000 \
        --optimizer-name RMSprop --optimizer-learning-rate 0.00025 --agent-update-frequency 4 \
        --agent-epsilon-greedy-epsilon-final 0.1 --agent-replay-buffer-initial 50000 \
        --optimizer-q-network-parameter-update-interval-frames 40000

How to read it
    The loop in `main` is Algorithm 6, line by line, and `update` its lines 20 to 22; then `ReplayMemory`, `QNetwork`
    and the wrappers. "report and checkpoint" is what keeps hours of work safe: it can wait.

Measured
    Pong, seed 1, two CPU cores, PyTorch 2.13: 3,000,000 frames and 1,495,001 updates in 3 hours and 20 minutes,
    resumed twice; screens of 60×60, not Table 3's 84×84 (with those, 17.47 after 1,980,000 frames in 3 hours and 49
    minutes):
        python algorithms/dqn_atari.py --env-id PongNoFrameskip-v4 --environment-train-frames-max 3000000 \
            --environment-state-height 60 --environment-state-width 60 --agent-update-frequency 2 \
            --agent-discount-factor 0.98 --agent-epsilon-greedy-epsilon-final 0.05 \
            --agent-epsilon-greedy-annealing 50000 --agent-replay-buffer-initial 10000 \
            --agent-replay-buffer-maximum-length 400000 \
            --environment-evaluation-interval-episodes 200 --environment-checkpoint-interval-episodes 200
    The final test, 73 games in 135,000 frames: mean score 19.92, variance 1.86. Evaluations on the way, mean score at
    frame: -7.6 at 427,887, -2.0 at 1,570,766, 19.4 at 2,037,596, 19.7 at 2,483,746, 18.5 at 2,888,068. Table 5's 19.1
    after ten million frames of Table 3 has not been tried.

Deviations
    lecture or paper                        this file                              why
    --------------------------------------  -------------------------------------  ------------------------------------
    Algorithm 6 copies θ to θ⁻ by episodes  every 1,000 frames, every 500          Table 3 says so; the two disagree
    and evaluates by frames                 episodes
    squared error (Algorithm 6, line 22)    Huber loss                             §5.3: [8] clips the error's gradient;
                                                                                   so does this file
    [8] acts at random until learning       ε is annealed from the first frame     Algorithm 6, lines 10-13
    starts
    [8]: biases and weights uniform         orthogonal convolution filters,        §7.5.1: the best of Table 4
                                            PyTorch's default elsewhere
    [8]: a state begins with empty frames   a state begins with copies of the      one rule for acting and replay; no
                                            episode's first frame                  frame that was never on the screen
    [8]: 1 to 30 no-ops                     0 to 30 no-ops, in emulator frames     §7.2.1: "maximum number"
    32-bit arithmetic                       bfloat16 while training, on x86 CPUs   speed; the weights θ, the head, Adam
                                            that have it (--precision)             and evaluation stay 32-bit
    raw frames, shared by reference         LZ4-compressed frames, by reference    0.4 to 1.4 GB instead of 11 GB
    [8]: FIRE may be part of any action     four directions, FIRE when centred     §7.3.3
    [8] released: θ⁻ copied every 10,000    Figure 18's 10,000 updates, 40,000     the lecture's table counts updates
    frames, area-averaged screens, ties     frames; bilinear screens; the first    §7.2.1 says bilinear; float ties
    broken at random, lives looked at       of tied actions; lives looked at       are rare; one transformation, one
    every emulator frame                    every frame                            wrapper
"""

from __future__ import annotations

import contextlib
import copy
import csv
import dataclasses
import difflib
import functools
import inspect
import io
import itertools
import json
import math
import operator
import os
import platform
import shlex
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections import OrderedDict, deque
from pathlib import Path
from typing import Literal, NoReturn, TypeVar

import ale_py
import cv2
import filelock
import gymnasium as gym
import lz4.block
import numpy as np
import psutil
import torch
import torch.nn.functional as F
import tyro
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

Flags = TypeVar("Flags")

LOG_INTERVAL = 500  # frames between two points of a curve, rounded up to a frame that has an update
CHECKPOINT_FORMAT = "dqn_atari checkpoint 1"
Q_NETWORK_FORMAT = "dqn_atari q_network 1"


# ---- Args ------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Args:
    """One unit of time: a FRAME is a frame that the agent observes = one action of the agent = `agent_action_repeat`
    (4) emulator frames. An EPISODE is one life while training; a GAME ends with the last life. The flags down to
    `optimizer_learning_rate` are Table 3, in its order and with its values."""

    environment_train_frames_max: int = 10_000_000
    """Frames to train for [Table 3; 50,000,000 in the paper]."""
    environment_evaluation_episodes: int = 10
    """Games that one evaluation plays [Table 3]."""
    environment_evaluation_interval_episodes: int = 500
    """Episodes between evaluations [Table 3]."""
    environment_checkpoint_interval_episodes: int = 500
    """Episodes between checkpoints [Table 3]."""
    environment_no_op_max: int = 30
    """At most this many no-operations, in emulator frames, before the agent may act in a new game [Table 3]."""
    environment_reward_clip_limit: float = 1.0
    """While training, the reward of a frame is clipped to [-limit, limit] [Table 3]."""
    environment_frames_to_maxpool: int = 2
    """Most recent emulator frames whose pixelwise maximum is the screen [Table 3]."""
    environment_state_height: int = 84
    """Height of a frame given to the network, pixels [Table 3]."""
    environment_state_width: int = 84
    """Width of a frame given to the network, pixels [Table 3]."""
    agent_history_length: int = 4
    """Most recent frames in a state [Table 3]."""
    agent_action_repeat: int = 4
    """Emulator frames for which an action is repeated [Table 3]."""
    agent_update_frequency: int = 1
    """Actions (frames) from one optimization iteration to the next [Table 3; 4 in the paper]."""
    agent_discount_factor: float = 0.99
    """γ, discount factor of a frame [Table 3, Equation 37]."""
    agent_epsilon_greedy_epsilon_initial: float = 1.0
    """ε_initial, probability of a random action at frame 0 [Table 3]."""
    agent_epsilon_greedy_epsilon_final: float = 0.01
    """ε_final, the same once annealed [Table 3; 0.1 in the paper]."""
    agent_epsilon_greedy_annealing: int = 1_000_000
    """Frames over which ε goes linearly from ε_initial to ε_final [Table 3]."""
    agent_epsilon_greedy_epsilon_evaluation: float = 0.05
    """ε while evaluating [Table 3]."""
    agent_replay_buffer_initial: int = 100_000
    """Transitions in the replay memory before learning starts [Table 3; 50,000 in the paper]."""
    agent_replay_buffer_maximum_length: int = 1_000_000
    """N, transitions that the replay memory 𝒟 holds; the oldest give way [Table 3]."""
    optimizer_name: Literal["Adam", "RMSprop"] = "Adam"
    """Adam [Table 3], or the released RMSProp of the paper: centred, its constant inside the root, no momentum."""
    optimizer_minibatch_size: int = 32
    """Transitions in a minibatch ℬ [Table 3]."""
    optimizer_q_network_parameter_update_interval_frames: int = 1_000
    """C, frames between copies of θ to the target network θ⁻ [Table 3; 10,000 updates = 40,000 frames in the paper]."""
    optimizer_learning_rate: float = 0.0001
    """Learning rate [Table 3; 0.00025 in the paper]."""

    env_id: str = "PongNoFrameskip-v4"
    """The game: any of Gymnasium's Atari names, PongNoFrameskip-v4 or ALE/Pong-v5; both mean the same here."""
    seed: int = 1
    """Seed of the weights, the exploration, the minibatches, the no-operations and the evaluations."""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Where the network lives; auto takes an accelerator if PyTorch sees one."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Arithmetic while training; auto takes bfloat16 on an x86 CPU that multiplies it, float32 elsewhere."""
    environment_test_frames: int = 135_000
    """Frames of the final test, in which only finished games count [§7.3.3]."""
    optimizer_gradient_momentum: float = 0.95
    """RMSprop only: decay of the mean gradient that centres it [Figure 18]."""
    optimizer_squared_gradient_momentum: float = 0.95
    """RMSprop only: decay of the mean squared gradient [Figure 18]."""
    optimizer_min_squared_gradient: float = 0.01
    """RMSprop only: constant added inside the root [Figure 18]."""
    replay_encoding: Literal["auto", "lz4", "raw", "tensor"] = "auto"
    """How a frame is kept: LZ4 bytes, a raw array, or a tensor on the device; auto takes tensor where an accelerator
    has room for it, else lz4."""
    checkpoint_interval_minutes: float = 10.0
    """Minutes after which a checkpoint is written even if no interval of episodes has passed."""
    resume: str = ""
    """A run directory to go on with; its own flags hold, only --environment-train-frames-max may be raised."""
    runs_dir: str = "runs"
    """Folder that the run directory is made in."""


def fail(message: str) -> NoReturn:
    """Bad input: one line on standard error, exit code 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


def parse_args(args_class: type[Flags]) -> Flags:
    """Read the command line; a flag that cannot be read ends in one line and exit code 2, not in tyro's box."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a Windows console or pipe may not know π
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            return tyro.cli(args_class, description=f"{__doc__}\n{inspect.getdoc(args_class)}")
    except SystemExit as stop:
        if stop.code != 2:
            raise
        lines = [line.strip("│ ") for line in box.getvalue().splitlines()[1:]]
        fail(" ".join(itertools.takewhile(lambda line: not line.startswith(("─", "╰")), lines)) + " (see --help)")


def flag(name: str) -> str:
    """The command-line spelling of a field of Args."""
    return "--" + name.replace("_", "-")


def check_args(args: Args) -> None:
    """Raise ValueError, with the flag's name, for a value that no run can use."""
    numbers = {name: value for name, value in vars(args).items() if type(value) in (int, float)}
    for name, value in numbers.items():
        if "epsilon_greedy_epsilon" in name or "momentum" in name or name == "agent_discount_factor":
            good, demand = 0 <= value <= 1, "lie between 0 and 1"
        elif name in ("environment_state_height", "environment_state_width"):
            good, demand = value >= 36, "be at least 36, which three strided convolutions need"
        elif name in ("seed", "environment_no_op_max"):
            good, demand = 0 <= value < 2**63, "be at least 0 and below 2^63"
        else:
            good, demand = 0 < value < math.inf, "be above 0 and finite"
        if not good:
            raise ValueError(f"{flag(name)} must {demand}, not {value}")
    for small, large in (("optimizer_minibatch_size", "agent_replay_buffer_initial"),
                         ("agent_replay_buffer_initial", "agent_replay_buffer_maximum_length")):
        if numbers[small] > numbers[large]:
            raise ValueError(f"{flag(small)} {numbers[small]} must not be above {flag(large)} {numbers[large]}")
    for name, available in (("cuda", torch.cuda.is_available()), ("mps", torch.backends.mps.is_available())):
        if args.device == name and not available:
            raise ValueError(f"--device {name}: this PyTorch sees no such device; use --device auto or --device cpu")


# ---- problem: the Atari environment and its wrappers -----------------------------------------------
#
#   emulator frame   1  2  3  4  5  6  7  8  9 10 11 12      60 a second
#   action           a₁ ────────  a₂ ────────  a₃ ───────    repeated 4 times, rewards summed
#   max-pool               3∨4         7∨8       11∨12       of the last two: some sprites are drawn every other frame
#   frame          x₀       x₁          x₂          x₃       grey, 84×84: what the agent observes, its unit of time
#   state           (x₀,x₀,x₀,x₁) (x₀,x₀,x₁,x₂) (x₀,x₁,x₂,x₃)


class JoystickActions(gym.ActionWrapper):
    """The game's minimal actions without diagonals and without FIRE off centre (§7.3.3): a subset of NOOP, FIRE, UP,
    RIGHT, LEFT, DOWN. `meanings` names them."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        minimal = env.unwrapped.get_action_meanings()
        self.meanings = [name for name in minimal if name in ("NOOP", "FIRE", "UP", "RIGHT", "LEFT", "DOWN")]
        self.indices = [minimal.index(name) for name in self.meanings]
        if len(self.meanings) < 2:
            raise ValueError(f"{env.unwrapped.spec.id} cannot be played with four directions and FIRE when centred")
        self.action_space = gym.spaces.Discrete(len(self.meanings))

    def action(self, action: int) -> int:
        return self.indices[action]


class NoOpReset(gym.Wrapper):
    """A new game starts with 0 to `no_op_max` no-operations, emulator frames, drawn from `rng` (§7.2.1); with none in
    the few games that have no NOOP."""

    def __init__(self, env: JoystickActions, no_op_max: int, rng: np.random.Generator):
        super().__init__(env)
        self.no_op = env.meanings.index("NOOP") if "NOOP" in env.meanings else None
        self.no_op_max, self.rng = no_op_max if self.no_op is not None else 0, rng

    def reset(self, **kwargs):
        screen, info = self.env.reset(**kwargs)
        for _ in range(self.rng.integers(self.no_op_max + 1)):
            screen, _, terminated, truncated, info = self.env.step(self.no_op)
            if terminated or truncated:
                screen, info = self.env.reset()
        return screen, info


class MaxPool(gym.Wrapper):
    """The screen is the pixelwise maximum, per colour, of the last `length` emulator frames (§7.2.1)."""

    def __init__(self, env: gym.Env, length: int):
        super().__init__(env)
        self.screens = deque(maxlen=length)  # each (210, 160, 3) uint8

    def reset(self, **kwargs):
        screen, info = self.env.reset(**kwargs)
        self.screens.clear()
        self.screens.append(screen)
        return screen, info

    def step(self, action: int):
        screen, reward, terminated, truncated, info = self.env.step(action)
        self.screens.append(screen)
        return functools.reduce(np.maximum, self.screens), reward, terminated, truncated, info  # (210, 160, 3) uint8


class ActionRepeat(gym.Wrapper):
    """An action lasts `repeat` emulator frames, or until the game ends; its rewards are summed (§7.2.1)."""

    def __init__(self, env: gym.Env, repeat: int):
        super().__init__(env)
        self.repeat = repeat

    def step(self, action: int):
        total_reward = 0.0
        for _ in range(self.repeat):
            screen, reward, terminated, truncated, info = self.env.step(action)
            total_reward += reward
            if terminated or truncated:
                break
        return screen, total_reward, terminated, truncated, info


class Greyscale(gym.ObservationWrapper):
    """Colour to luminance, 0.299 R + 0.587 G + 0.114 B (§7.2.1)."""

    def observation(self, screen: np.ndarray) -> np.ndarray:
        return cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY)  # (210, 160) uint8


class Downsample(gym.ObservationWrapper):
    """Bilinear downsampling to `height` × `width` (§7.2.1)."""

    def __init__(self, env: gym.Env, height: int, width: int):
        super().__init__(env)
        self.height, self.width = height, width

    def observation(self, screen: np.ndarray) -> np.ndarray:
        return cv2.resize(screen, (self.width, self.height), interpolation=cv2.INTER_LINEAR)  # (84, 84) uint8


class RewardClip(gym.Wrapper):
    """The reward is clipped to [-limit, limit]; the game's own stays in info["raw_reward"] (§7.2.1, training only)."""

    def __init__(self, env: gym.Env, limit: float):
        super().__init__(env)
        self.limit = limit

    def step(self, action: int):
        frame, reward, terminated, truncated, info = self.env.step(action)
        return frame, min(max(reward, -self.limit), self.limit), terminated, truncated, info | {"raw_reward": reward}


class LifeLoss(gym.Wrapper):
    """A lost life terminates the episode, and the game goes on (§7.2.1, training only). info["game_over"] tells a
    game's end from a life's. Easy to get wrong: after a lost life reset() returns the very frame that the episode ended
    with. If it reset the emulator, the later lives would never be seen; if it stepped, a frame would be missed."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.lives, self.game_over = 0, True

    def reset(self, **kwargs):
        if self.game_over:
            self.frame, self.info = self.env.reset(**kwargs)
            self.lives, self.game_over = self.info["lives"], False
        return self.frame, self.info

    def step(self, action: int):
        self.frame, reward, terminated, truncated, self.info = self.env.step(action)
        life_lost = self.info["lives"] < self.lives
        self.lives, self.game_over = self.info["lives"], terminated or truncated
        self.info["game_over"] = self.game_over
        return self.frame, reward, terminated or life_lost, truncated, self.info


class FrameHistory(gym.Wrapper):
    """The state: references to the last `length` encoded frames, oldest first (§7.3.2). A frame is encoded once, when
    it arrives, and never changed; acting and replay decode the same objects. An episode starts with `length` references
    to its first frame."""

    def __init__(self, env: gym.Env, length: int, encode):
        super().__init__(env)
        self.length, self.encode = length, encode

    def reset(self, **kwargs):
        frame, info = self.env.reset(**kwargs)
        self.history = (self.encode(frame),) * self.length
        return self.history, info

    def step(self, action: int):
        frame, reward, terminated, truncated, info = self.env.step(action)
        self.history = (*self.history[1:], self.encode(frame))
        return self.history, reward, terminated, truncated, info


def make_emulator(env_id: str) -> gym.Env:
    """The bare game at 60 frames a second: nothing skipped, no action repeated at random, truncated after 108,000
    emulator frames. Raises ValueError for a name that is no Atari game."""
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    gym.register_envs(ale_py)  # gives Gymnasium the names; the ROMs are in ale-py's wheel
    games = [name for name, spec in gym.registry.items() if spec.entry_point == "ale_py.env:AtariEnv"]
    if env_id not in games:
        if env_id in gym.registry:
            raise ValueError(f"{env_id} is no Atari game")
        near = difflib.get_close_matches(env_id, games, n=3, cutoff=0.5)
        raise ValueError(f"unknown game {env_id!r}" + (f"; near names: {', '.join(near)}" if near else ""))
    return gym.make(env_id, frameskip=1, repeat_action_probability=0.0, full_action_space=False,
                    max_num_frames_per_episode=108_000, disable_env_checker=True)


def preprocess(env: gym.Env, args: Args, encode, rng: np.random.Generator, training: bool) -> gym.Env:
    """Stack the transformations in the order of Figure 16 (training) or Figure 17 (evaluation: without the `if`)."""
    env = JoystickActions(env)
    env = NoOpReset(env, args.environment_no_op_max, rng)
    env = MaxPool(env, args.environment_frames_to_maxpool)
    env = ActionRepeat(env, args.agent_action_repeat)
    env = Greyscale(env)
    env = Downsample(env, args.environment_state_height, args.environment_state_width)
    if training:
        env = RewardClip(env, args.environment_reward_clip_limit)
        env = LifeLoss(env)
    return FrameHistory(env, args.agent_history_length, encode)


def wrapper(env: gym.Env, kind: type[gym.Wrapper]) -> gym.Wrapper:
    """The wrapper of class `kind` in a stack."""
    while not isinstance(env, kind):
        env = env.env
    return env


# ---- memory: lazy replay ---------------------------------------------------------------------------


def frame_encoding(name: str, height: int, width: int, device: torch.device):
    """Return (encode, decode). encode: (height, width) uint8 array -> an immutable object; decode: n such objects ->
    (n, height, width) uint8 tensor on `device`."""
    size = height * width
    encode, decode = {
        "lz4": (lambda frame: lz4.block.compress(frame, store_size=False),
                lambda codes: torch.frombuffer(bytearray().join(
                    [lz4.block.decompress(code, uncompressed_size=size) for code in codes]), dtype=torch.uint8)),
        "raw": (lambda frame: frame, lambda codes: torch.from_numpy(np.stack(codes))),
        "tensor": (lambda frame: torch.from_numpy(frame).to(device), torch.stack),
    }[name]
    return encode, lambda codes: decode(codes).view(-1, height, width).to(device)


def to_bytes(code) -> bytes:
    """An encoded frame as LZ4 bytes, for a checkpoint."""
    if isinstance(code, bytes):
        return code
    frame = code.cpu().numpy() if torch.is_tensor(code) else code
    return lz4.block.compress(frame, store_size=False)


def from_bytes(blob: bytes, encoding_name: str, shape: tuple[int, int], encode) -> object:
    """The encoded frame that `to_bytes` was given."""
    if encoding_name == "lz4":
        return blob
    frame = bytearray(lz4.block.decompress(blob, uncompressed_size=shape[0] * shape[1]))
    return encode(np.frombuffer(frame, np.uint8).reshape(shape))


class ReplayMemory:
    """𝒟: the last `capacity` transitions (§5.3). A transition is references to its `agent_history_length + 1` encoded
    frames, an action, a clipped reward and whether s' is terminal; arrays are made when a minibatch is drawn (§7.3.2).
    Every transition is whole in itself: none can mix two episodes or span the place where the oldest is overwritten."""

    def __init__(self, capacity: int, decode):
        self.capacity, self.decode, self.added = capacity, decode, 0
        self.frames = [()] * capacity  # per transition: x_{t-3}, x_{t-2}, x_{t-1}, x_t, x_{t+1}
        self.actions = np.zeros(capacity, np.int64)
        self.rewards = np.zeros(capacity, np.float32)
        self.terminals = np.zeros(capacity, np.bool_)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, state: tuple, action: int, reward: float, next_state: tuple, terminal: bool) -> None:
        """Store (s, a, r, s'). Easy to get wrong: `terminal` must not be set by truncation, or a game that was cut off
        teaches that its last state is worth nothing."""
        i = self.added % self.capacity
        self.frames[i] = (*state, next_state[-1])
        self.actions[i], self.rewards[i], self.terminals[i] = action, reward, terminal
        self.added += 1

    def sample(self, size: int, rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
        """Draw ℬ uniformly with replacement: s (B, 4, 84, 84) uint8, a (B,) int64, r (B,) float32, s' like s, terminal
        (B,) bool, on the device."""
        return self.gather(rng.integers(len(self), size=size))

    def gather(self, indices: np.ndarray) -> tuple[torch.Tensor, ...]:
        """The transitions at `indices` (B,), as `sample` returns them."""
        codes = [code for i in indices for code in self.frames[i]]
        frames = self.decode(codes).unflatten(0, (len(indices), -1))  # (B, 5, 84, 84) uint8: s the first 4, s' the last
        columns = [torch.from_numpy(column[indices]).to(frames.device)  # (B,) each
                   for column in (self.actions, self.rewards, self.terminals)]
        return frames[:, :-1], columns[0], columns[1], frames[:, 1:], columns[2]


# ---- network ---------------------------------------------------------------------------------------


class PixelConv2d(nn.Conv2d):
    """A first layer for pixels from 0 to 255: it divides its filters by 255 instead of every pixel, which is the same
    up to rounding, and less work."""

    def filters(self) -> torch.Tensor:
        return self.weight / 255

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        return self._conv_forward(pixels, self.filters(), self.bias)


class QNetwork(nn.Module):
    """Table 2: (B, 4, 84, 84) uint8 states to (B, num_actions) float32 values Q(s, ·; θ)."""

    def __init__(self, history_length: int, height: int, width: int, num_actions: int):
        super().__init__()
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):  # 84 -> 20 -> 9 -> 7
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        self.layers = nn.Sequential(OrderedDict(
            conv1=PixelConv2d(history_length, 32, kernel_size=8, stride=4), conv1_relu=nn.ReLU(),  # (B, 32, 20, 20)
            conv2=nn.Conv2d(32, 64, kernel_size=4, stride=2), conv2_relu=nn.ReLU(),                # (B, 64, 9, 9)
            conv3=nn.Conv2d(64, 64, kernel_size=3, stride=1), conv3_relu=nn.ReLU(),                # (B, 64, 7, 7)
            flatten=nn.Flatten(),                                                                  # (B, 3136)
            linear=nn.Linear(64 * height * width, 512), linear_relu=nn.ReLU(),                     # (B, 512)
        ))
        self.head = nn.Linear(512, num_actions)                                                    # (B, num_actions)

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        x = self.layers(states.to(self.layers.conv1.weight.dtype))    # (B, 512)
        return self.head(x.to(self.head.weight.dtype))                # (B, num_actions) float32


def initialize_orthogonal(q_network: QNetwork) -> None:
    """Orthogonal convolution filters, the best of Table 4 (§7.5.1); everything else stays PyTorch's default."""
    for layer in q_network.layers:
        if isinstance(layer, nn.Conv2d):
            nn.init.orthogonal_(layer.weight)


class LayersInOneDNN(nn.Sequential):
    """The layers of a QNetwork, computed in the memory layout of oneDNN, PyTorch's library on CPUs. Layer by layer, it
    would be converted to and from at every convolution. (A layer that does not know this layout needs `to_dense`.)"""

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        x = pixels.to_mkldnn()                                                        # (B, 4, 84, 84)
        for layer in self:
            if isinstance(layer, nn.Conv2d):
                weight = layer.filters() if isinstance(layer, PixelConv2d) else layer.weight
                x = torch.mkldnn_convolution(x, weight, layer.bias, layer.padding, layer.stride, layer.dilation,
                                             layer.groups)                            # (B, filters, height, width)
            else:
                x = layer(x.to_dense() if isinstance(layer, nn.Flatten) else x)
        return x                                                                      # (B, 512)


def multiplies_bfloat16() -> bool:
    """Whether the CPU has instructions for it."""
    return any(torch.cpu.get_capabilities().get(unit) for unit in ("avx512_bf16", "amx_bf16"))


def working_copy(q_network: QNetwork, precision: torch.dtype) -> QNetwork:
    """The network that acts and learns while training: `q_network` itself, or its copy with layers of lower precision.
    The head stays float32: Q keeps more than bfloat16's three digits."""
    if precision == torch.float32:
        return q_network
    working_network = copy.deepcopy(q_network)
    working_network.layers.to(precision)
    if working_network.head.weight.is_cpu and multiplies_bfloat16():
        working_network.layers = LayersInOneDNN(OrderedDict(working_network.layers.named_children()))
    for θ in q_network.parameters():
        θ.grad = torch.zeros_like(θ)  # `update` copies into it: allocated anew, its pages would cost time
    return working_network


# ---- algorithm: deep Q-learning --------------------------------------------------------------------


class NatureRMSprop(torch.optim.Optimizer):
    """The RMSProp that [8] released (Figure 18): centred, no momentum, its constant inside the root. (PyTorch's own
    adds it outside, and "gradient momentum 0.95" is the decay of the mean gradient, no momentum of the step.)"""

    def __init__(self, parameters, lr: float, mean_decay: float, square_decay: float, constant: float):
        super().__init__(parameters, dict(lr=lr, mean_decay=mean_decay, square_decay=square_decay, constant=constant))

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            for θ in group["params"]:
                state = self.state[θ]
                if not state:
                    state["g"], state["n"] = torch.zeros_like(θ), torch.zeros_like(θ)
                # g ← 0.95 g + 0.05 ∇        n ← 0.95 n + 0.05 ∇²        θ ← θ - lr ∇ / √(n - g² + 0.01)
                state["g"].lerp_(θ.grad, 1 - group["mean_decay"])
                state["n"].lerp_(θ.grad.square(), 1 - group["square_decay"])
                variance = (state["n"] - state["g"].square()).clamp_min(0)  # below 0 only if the two decays differ
                root = (variance + group["constant"]).sqrt()
                θ.addcdiv_(θ.grad, root, value=-group["lr"])


def make_optimizer(args: Args, q_network: QNetwork) -> torch.optim.Optimizer:
    """Table 3's Adam, or Figure 18's RMSProp."""
    if args.optimizer_name == "Adam":
        return torch.optim.Adam(q_network.parameters(), lr=args.optimizer_learning_rate, fused=True)
    return NatureRMSprop(q_network.parameters(), args.optimizer_learning_rate, args.optimizer_gradient_momentum,
                         args.optimizer_squared_gradient_momentum, args.optimizer_min_squared_gradient)


def epsilon_at(frame: int, args: Args) -> float:
    """ε at a frame: linear from ε_initial at frame 0 to ε_final at frame `agent_epsilon_greedy_annealing`, then
    constant (Algorithm 6, lines 11-13)."""
    annealed = min(frame / args.agent_epsilon_greedy_annealing, 1.0)
    initial, final = args.agent_epsilon_greedy_epsilon_initial, args.agent_epsilon_greedy_epsilon_final
    return initial + annealed * (final - initial)


@torch.inference_mode()
def greedy_action(q_network: QNetwork, state: torch.Tensor) -> int:
    """π(s) = argmax_a Q(s, a; θ) (Equation 35) of one state (4, 84, 84) uint8."""
    # waits for an accelerator; so do the points of the curves, and a frame or minibatch that is copied to it
    return q_network(state.unsqueeze(0)).argmax(dim=1).item()


def update(q_network: QNetwork, working_network: QNetwork, target_network: QNetwork, optimizer: torch.optim.Optimizer,
           minibatch: tuple, discount: float) -> tuple[torch.Tensor, torch.Tensor]:
    """One optimization iteration (Algorithm 6, lines 20-22). The optimizer moves θ, the float32 weights of `q_network`;
    the arithmetic is done by its `working_copy`, in lower precision or the same network. Returns the minibatch's mean
    Huber loss, () float32, and Q(s_j, a_j; θ), (B,) float32."""
    s, a, r, s_next, terminal = minibatch

    # y_j = r_j                                      if s_{j+1} is terminal
    #       r_j + γ max_a' Q(s_{j+1}, a'; θ⁻)        else                                   (Equation 37)
    with torch.no_grad():
        y = r + discount * ~terminal * target_network(s_next).amax(dim=1)  # (B,)

    # Q(s_j, a_j; θ)
    q = working_network(s).gather(1, a.unsqueeze(1)).squeeze(1)  # (B,)

    # Σ_j huber(Q(s_j, a_j; θ) - y_j): its gradient in Q is the error clipped to [-1, 1]. The sum, as in line 22; Adam's
    # steps do not depend on the loss's scale, RMSProp's learning rate is meant for the sum.
    # Easy to get wrong: a (B,) minus a (B, 1) is a (B, B), and learns the mean of the minibatch.
    assert q.shape == y.shape == r.shape
    loss = F.huber_loss(q, y, reduction="sum")  # ()
    working_network.zero_grad()
    loss.backward()

    # The gradient moves θ in float32, where a small step is not rounded away; then θ is cast anew. (Where the two are
    # one network, both loops change nothing.)
    pairs = list(zip(q_network.parameters(), working_network.parameters(), strict=True))
    for θ, working in pairs:
        θ.grad.copy_(working.grad)
    optimizer.step()
    with torch.no_grad():
        for θ, working in pairs:
            working.copy_(θ)
    return loss.detach() / len(r), q.detach()


@torch.no_grad()
def diagnose(q_network: QNetwork, states: torch.Tensor) -> dict[str, float]:
    """How alive the network is on a minibatch of states (B, 4, 84, 84): of every layer the share of its units (filters)
    that are 0 in every state, and the standard deviation of Q over the states, mean over actions. If a whole layer is
    dead, Q is the same in all of them and no gradient passes to the layers below."""
    scalars = {}
    x = states.float()  # (B, 4, 84, 84)
    for name, layer in q_network.layers.named_children():
        x = layer(x)  # (B, units, …)
        if isinstance(layer, nn.ReLU):
            alive = (x > 0).transpose(0, 1).flatten(1).any(dim=1)  # (units,)
            scalars[f"diagnostics/dead_units_{name.removesuffix('_relu')}"] = 1 - alive.float().mean().item()
    scalars["diagnostics/q_spread"] = q_network.head(x).std(dim=0, correction=0).mean().item()
    return scalars


# ---- evaluation ------------------------------------------------------------------------------------


def evaluate(args: Args, q_network: QNetwork, encoding: tuple, number: int, stop: Stop, games: int | None = None,
             frames: int | None = None) -> list[tuple[float, int]] | None:
    """Play whole games at ε_evaluation for raw reward until `games` are finished or `frames` have passed; an unfinished
    game does not count. It depends on the network, the seed and its own `number` alone. Returns (score, length in
    frames) per game, or None if it was stopped. Number 0 is the final test."""
    encode, decode = encoding
    # + 1, for SeedSequence([seed, 0]) is SeedSequence(seed): the final test would draw what training drew
    exploration, no_ops = (np.random.default_rng(s) for s in np.random.SeedSequence([args.seed, number + 1]).spawn(2))
    env = preprocess(make_emulator(args.env_id), args, encode, no_ops, training=False)
    finished, score, length = [], 0.0, 0
    state, _ = env.reset(seed=args.seed + number)
    with tqdm(itertools.count() if frames is None else range(frames), desc="evaluation" if number else "final test",
              unit="frame", leave=False, **bar_style()) as bar:
        for _ in bar:
            if exploration.random() < args.agent_epsilon_greedy_epsilon_evaluation:
                action = int(exploration.integers(env.action_space.n))
            else:
                action = greedy_action(q_network, decode(state))
            state, reward, terminated, truncated, _ = env.step(action)
            score, length = score + reward, length + 1
            if terminated or truncated:
                finished.append((score, length))
                bar.set_postfix_str(f"{len(finished)} games, last score {score:g}", refresh=False)
                score, length = 0.0, 0
                state, _ = env.reset()
            if len(finished) == games or stop.signum:
                break
    env.close()
    return None if stop.signum else finished


# ---- report and checkpoint -------------------------------------------------------------------------


@dataclasses.dataclass
class Counters:
    """Everything that the loop counts; saved whole in a checkpoint."""

    frames: int = 0
    updates: int = 0
    episodes: int = 0
    evaluations: int = 0
    evaluation_episodes: int = 0  # `episodes` at the last evaluation
    checkpoint_episodes: int = 0  # `episodes` at the last checkpoint
    game_score: float = 0.0  # raw, of the game now being played
    game_length: int = 0  # frames
    recent_scores: list[float] = dataclasses.field(default_factory=list)  # of the last 20 games
    evaluation_rows: list[dict] = dataclasses.field(default_factory=list)  # of evaluations.csv
    seconds: float = 0.0  # of wall-clock, evaluations included, pauses between resumes not
    peak_memory: int = 0  # bytes resident, the most seen at a point of the curves or before a checkpoint


def evaluation_row(counters: Counters, finished: list[tuple[float, int]]) -> dict:
    """A row of evaluations.csv; the mean and (population) variance of score and of length in frames are the columns of
    Tables 4-6, None without a finished game."""
    row = {"frames": counters.frames, "updates": counters.updates, "episodes": counters.episodes}
    for i, name in enumerate(("score", "length")):
        values = [game[i] for game in finished]
        row[f"{name}_mean"] = float(np.mean(values)) if values else None
        row[f"{name}_variance"] = float(np.var(values)) if values else None
    return row | {"seconds": round(counters.seconds, 1)}


class Stop:
    """SIGINT or SIGTERM asks the loop to end at the next frame; a second SIGINT (Ctrl-C) ends the process at once. A
    second SIGTERM does not: whoever stops a group of processes may send more than one."""

    def __init__(self):
        self.signum = 0
        for signum in (signal.SIGINT, signal.SIGTERM):
            signal.signal(signum, self)

    def __call__(self, signum: int, _frame) -> None:
        self.signum = signum
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


def bar_style() -> dict:
    """tqdm's settings: a live bar in a terminal, an update a minute in a log."""
    return dict(mininterval=0.5 if sys.stderr.isatty() else 60, dynamic_ncols=True, smoothing=0.05)


def attempt(what: str, write) -> bool:
    """Call write(); if the disk refuses, say so in one line and go on: it is tried again at the next occasion."""
    try:
        write()
        return True
    except OSError as error:
        reason = error.strerror or error
        tqdm.write(f"warning: {what} could not be written ({reason}); the run goes on", file=sys.stderr)
        return False


class Curves:
    """TensorBoard's event file. A full disk costs points of a curve, never the run."""

    def __init__(self, run_dir: Path, first_frame: int):
        # what a killed process logged after its last checkpoint is logged again: purge_step hides the first copy
        self.run_dir, self.purge_step, self.writer = run_dir, first_frame or None, None
        threading.excepthook = self.silence_full_disk

    @staticmethod
    def silence_full_disk(failure) -> None:
        """TensorBoard writes in a thread of its own: what the disk refuses it `attempt` says, not a traceback."""
        if not (issubclass(failure.exc_type, OSError) and type(failure.thread).__name__ == "_AsyncWriterThread"):
            threading.__excepthook__(failure)

    def write(self, add) -> None:
        """Call add(writer); after a failure the next call begins a new event file."""

        def open_and_add() -> None:
            self.writer = self.writer or SummaryWriter(self.run_dir, purge_step=self.purge_step)
            self.purge_step = None
            add(self.writer)

        if not attempt("a point of the curves", open_and_add):
            self.writer = None

    def add(self, scalars: dict[str, float], frame: int) -> None:
        """Log scalars at a frame."""
        self.write(lambda writer: [writer.add_scalar(name, value, frame) for name, value in scalars.items()])

    def add_table(self, name: str, rows: dict, frame: int) -> None:
        """Log a table of names and values."""
        text = "\n".join(["name | value", "--- | ---", *(f"{key} | {value}" for key, value in rows.items())])
        self.write(lambda writer: writer.add_text(name, text, frame))

    def flush(self) -> None:
        """Bring everything logged so far to the file."""
        self.write(lambda writer: writer.flush())


def write_atomically(path: Path, write) -> None:
    """write(file) into a temporary file beside `path`, bring it to the disk, then rename: a crash or a full disk leaves
    the old file or the new one, never a part. Raises OSError."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb+") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    if os.name == "posix":  # so that the rename outlives a power cut; Windows has no handle of a directory
        directory = os.open(path.parent, os.O_RDONLY)
        os.fsync(directory)
        os.close(directory)


def save_tensors(content: dict, file) -> None:
    """torch.save, whose RuntimeError for a write that the disk refused is made the OSError that it hides."""
    try:
        torch.save(content, file)
    except RuntimeError as error:
        raise error.__context__ if isinstance(error.__context__, OSError) else OSError(str(error)) from None


def write_json(path: Path, content: dict) -> None:
    """Atomically write an indented JSON file."""
    write_atomically(path, lambda file: file.write((json.dumps(content, indent=2) + "\n").encode()))


def write_csv(path: Path, rows: list[dict]) -> None:
    """Atomically write rows under one header."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, rows[0], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def environment_state(env: gym.Env) -> dict:
    """What the emulator and the wrappers remember between two frames, beside the history and the generators."""
    return {"emulator": env.unwrapped.ale.cloneState(include_rng=True).serialize(),
            "lives": wrapper(env, LifeLoss).lives,
            "screens": [torch.from_numpy(screen) for screen in wrapper(env, MaxPool).screens]}


def restore_environment(env: gym.Env, state: dict, history: tuple) -> None:
    """Put `env` where `environment_state` was taken."""
    env.reset()  # Gymnasium wants one before the first step; what it draws is overwritten with the generators
    env.unwrapped.ale.restoreState(ale_py.ALEState(state["emulator"]))
    wrapper(env, LifeLoss).lives = state["lives"]
    wrapper(env, MaxPool).screens.clear()
    wrapper(env, MaxPool).screens.extend(screen.numpy() for screen in state["screens"])
    env.history = history


def save_checkpoint(path: Path, state: dict, replay: ReplayMemory, history: tuple) -> None:
    """One file that torch.load(weights_only=True) reads, with the encoded frames, each once, as one more member of
    PyTorch's zip archive: they are streamed, so a million of them, LZ4 as they are, need no second copy in memory, and
    the archive's CRC-32 guards every member. Raises OSError."""
    blobs = []

    def add(code) -> int:
        blobs.append(to_bytes(code))
        return len(blobs) - 1

    def number(codes: tuple, before: tuple, row: list[int]) -> list[int]:
        """The places of `codes` in `blobs`. Only neighbours share frames, so the transition before is all to look at:
        after (a, b, c, d, e) at [0, 1, 2, 3, 4] comes (b, c, d, e, f) at [1, 2, 3, 4, 5], and only f is added; a new
        episode (g, g, g, g, h) is at [6, 6, 6, 6, 7]."""
        if row and all(map(operator.is_, codes, before[1:])):
            return [*row[1:], *map(add, codes[len(before) - 1 :])]
        places = {key: add(code) for key, code in {id(code): code for code in codes}.items()}
        return [places[id(code)] for code in codes]

    length, before, row = len(replay), (), []
    indices = np.empty((length, len(history) + 1), np.int32)
    for i, codes in enumerate(replay.frames[:length]):
        indices[i] = row = number(codes, before, row)
        before = codes
    last = (replay.added - 1) % replay.capacity
    now = number(history, replay.frames[last], indices[last].tolist()) if length else number(history, (), [])
    columns = {"indices": indices, "actions": replay.actions[:length], "rewards": replay.rewards[:length],
               "terminals": replay.terminals[:length], "lengths": np.fromiter(map(len, blobs), np.int32)}
    state = state | {"format": CHECKPOINT_FORMAT, "history": now, "added": replay.added,
                     "replay": {name: torch.from_numpy(column) for name, column in columns.items()}}

    def write(file) -> None:
        save_tensors(state, file)
        with zipfile.ZipFile(file, "a") as archive, archive.open("archive/frames", "w", force_zip64=True) as member:
            for start in range(0, len(blobs), 4096):
                member.write(b"".join(blobs[start : start + 4096]))

    write_atomically(path, write)


def load_checkpoint(path: Path) -> tuple[dict, list[bytes]]:
    """Return the state and the encoded frames that `save_checkpoint` wrote. Every member's checksum is compared first,
    and nothing in the file is run (weights_only). Raises ValueError with one line for whatever is no whole
    checkpoint."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
            if damaged:
                raise ValueError(f"the checksum of its member {damaged} is wrong")
            state = torch.load(path, map_location="cpu", weights_only=True)
            if state["format"] != CHECKPOINT_FORMAT:
                raise ValueError(f"its format is {state['format']!r}, this script reads {CHECKPOINT_FORMAT!r}")
            with io.BufferedReader(archive.open("archive/frames"), 1 << 20) as member:
                return state, [member.read(length) for length in state["replay"]["lengths"].tolist()]
    except Exception as error:  # a damaged file can raise anything; none of it is a reason to go on
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{path} cannot be resumed from: {reason}") from None


def restore_run(saved: dict, codes, replay: ReplayMemory, env: gym.Env, generators: list, learnt: dict) -> tuple:
    """Put everything where the checkpoint was taken; `codes` yields its frames, encoded for `replay`. Returns the
    state. Raises ValueError, with the part's name, for a part that does not fit."""
    part = "replay"
    try:
        codes = list(codes)
        columns = {name: column.numpy() for name, column in saved["replay"].items()}
        replay.added = saved["added"]
        for i, row in enumerate(columns["indices"].tolist()):
            replay.frames[i] = tuple(codes[number] for number in row)
        for name in ("actions", "rewards", "terminals"):
            getattr(replay, name)[: len(replay)] = columns[name]
        state = tuple(codes[number] for number in saved["history"])
        part = "environment"
        restore_environment(env, saved["environment"], state)
        for part, of_part in learnt.items():
            of_part.load_state_dict(saved[part])
        part = "generators"
        for generator, generator_state in zip(generators, saved["generators"], strict=True):
            generator.bit_generator.state = generator_state
    except Exception as error:  # whatever it is, it is no reason to go on from half a state
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"its {part} does not fit ({reason})") from None
    return state


def open_run(args: Args, script: str) -> tuple[Path, filelock.FileLock]:
    """The run directory, `args.resume` or a new one, and the lock on it, which the kernel releases when the process
    dies. Raises ValueError if it cannot be written or another process writes it."""
    name = f"{args.env_id.replace('/', '-')}__{script}__{args.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    run_dir = Path(args.resume) if args.resume else Path(args.runs_dir) / name
    if args.resume and not (run_dir / "args.json").is_file():
        raise ValueError(f"--resume {run_dir}: no run directory, it has no args.json")
    try:
        run_dir.mkdir(parents=True, exist_ok=bool(args.resume))
        lock = filelock.FileLock(run_dir / ".lock")
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise ValueError(f"another process is writing {run_dir}") from None
    except OSError as error:
        raise ValueError(f"the run directory {run_dir} cannot be written: {error.strerror or error}") from None
    return run_dir, lock


def resumed_args(args_class: type[Flags], run_dir: Path) -> Flags:
    """The flags of the run in `run_dir`, with --environment-train-frames-max raised if the command line does. Raises
    ValueError for any other flag that contradicts the run's own."""
    try:
        saved = args_class(**json.loads((run_dir / "args.json").read_text()))
        given = dataclasses.replace(tyro.cli(args_class, default=saved), resume="")
    except Exception as error:  # edited by hand it can hold anything
        raise ValueError(f"{run_dir / 'args.json'} is no record of this script's flags: {error}") from None
    for name, value in vars(given).items():
        own = getattr(saved, name)
        if value != own and not (name == "environment_train_frames_max" and value > own):
            raise ValueError(f"{flag(name)} {value} contradicts the run's own {own}; "
                             f"only --environment-train-frames-max may be raised")
    return given


def load_run(args: Args, run_dir: Path) -> tuple[dict, list[bytes]]:
    """The state and the encoded frames of the run in `run_dir`. Raises ValueError if there are none, or another's."""
    path = run_dir / "checkpoint.pt"
    if not path.exists():
        raise ValueError(f"--resume {run_dir}: it was stopped before its first checkpoint; start it anew")
    state, blobs = load_checkpoint(path)
    for name, value in vars(args).items():
        other = state["args"].get(name)
        if other != value and name != "environment_train_frames_max":
            raise ValueError(f"{path} is another run's: its {flag(name)} is {other}, args.json says {value}")
    return state, blobs


def gigabytes(count: float) -> str:
    """A number of bytes for people."""
    return f"{count / 1e9:.2f} GB"


def free_memory(device: torch.device) -> int:
    """Bytes that are free on an NVIDIA GPU, or on the machine for whatever shares its memory; a container's or a
    cluster's own limit is not known here."""
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else psutil.virtual_memory().available


def frame_bytes(args: Args) -> float:
    """Mean size of an LZ4 frame, over 200 frames of random play, as a Python object."""
    rng = np.random.default_rng(0)
    encode, _ = frame_encoding("lz4", args.environment_state_height, args.environment_state_width, torch.device("cpu"))
    env = preprocess(make_emulator(args.env_id), args, encode, rng, training=True)
    env.reset(seed=args.seed)
    sizes = []
    for _ in range(200):
        history, _, terminated, truncated, _ = env.step(int(rng.integers(env.action_space.n)))
        sizes.append(sys.getsizeof(history[-1]))
        if terminated or truncated:
            env.reset()
    env.close()
    return float(np.mean(sizes))


def choose_encoding(args: Args, device: torch.device) -> tuple[str, float]:
    """The replay encoding, and the bytes that a full memory needs with it. Raises ValueError if they are not free."""
    cpu = torch.device("cpu")
    transitions = min(args.agent_replay_buffer_maximum_length, args.environment_train_frames_max)
    pixels = args.environment_state_height * args.environment_state_width
    # frame_bytes in any case: it refuses an env_id that cannot be played before a run directory is made
    frame = {"lz4": frame_bytes(args), "raw": sys.getsizeof(np.empty(pixels, np.uint8)), "tensor": float(pixels)}
    name = args.replay_encoding
    if name == "auto":
        fits = device.type != "cpu" and transitions * frame["tensor"] < 0.8 * free_memory(device)
        name = "tensor" if fits else "lz4"
    references = sys.getsizeof((None,) * (args.agent_history_length + 1)) + 16 + 8  # tuple, allocator, list
    references += 8 + 4 + 1  # a, r, terminal
    need, free = transitions * (frame[name] + references), free_memory(device if name == "tensor" else cpu)
    if need > free:
        raise ValueError(f"a replay memory of {transitions:,} transitions needs {gigabytes(need)}, {gigabytes(free)} "
                         "are free; lower --agent-replay-buffer-maximum-length")
    return name, need


def choose_device(args: Args) -> tuple[torch.device, torch.dtype]:
    """The device, and the type of the numbers in the networks that act and learn."""
    name = args.device
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    by_itself = args.precision == "auto" and name == "cpu" and multiplies_bfloat16()
    return torch.device(name), torch.bfloat16 if args.precision == "bfloat16" or by_itself else torch.float32


# ---- main ------------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Algorithm 6, between what it needs and what it leaves behind."""
    stop, resumed, saved = Stop(), args.resume, None
    try:
        if resumed:
            run_dir, _lock = open_run(args, "")
            args = resumed_args(Args, run_dir)
        check_args(args)
        device, precision = choose_device(args)
        encoding_name, replay_bytes = choose_encoding(args, device)
        if resumed:
            saved, blobs = load_run(args, run_dir)
        else:
            run_dir, _lock = open_run(args, Path(__file__).stem)
    except ValueError as error:
        fail(str(error))
    counters = Counters(**saved["counters"]) if saved else Counters()
    try:
        tested = json.loads((run_dir / "test.json").read_text())["frames"]
    except (OSError, ValueError, LookupError, TypeError):  # no test yet, or no whole one: it is done again
        tested = None
    if tested == counters.frames >= args.environment_train_frames_max:
        print(f"{run_dir} has finished its {counters.frames:,} frames; --environment-train-frames-max trains on")
        return

    # 1  Initialize the Atari 2600 simulator.
    shape = args.environment_state_height, args.environment_state_width
    encode, decode = encoding = frame_encoding(encoding_name, *shape, device)
    seeds = np.random.SeedSequence(args.seed).spawn(3)
    exploration_rng, minibatch_rng, no_op_rng = generators = [np.random.default_rng(seed) for seed in seeds]
    env = preprocess(make_emulator(args.env_id), args, encode, no_op_rng, training=True)
    actions = wrapper(env, JoystickActions).meanings
    # 2  Initialize 𝒟.
    replay = ReplayMemory(min(args.agent_replay_buffer_maximum_length, args.environment_train_frames_max), decode)
    # 3  Initialize θ.
    torch.manual_seed(args.seed)
    q_network = QNetwork(args.agent_history_length, *shape, len(actions))
    initialize_orthogonal(q_network)
    q_network.to(device)
    optimizer = make_optimizer(args, q_network)
    working_network = working_copy(q_network, precision)
    # 4  θ⁻ = θ
    target_network = copy.deepcopy(working_network).requires_grad_(False)

    if saved:
        learnt = {"q_network": q_network, "target_network": target_network, "optimizer": optimizer}
        codes = (from_bytes(blob, encoding_name, shape, encode) for blob in blobs)
        try:
            state = restore_run(saved, codes, replay, env, generators, learnt)
        except ValueError as error:
            fail(f"{run_dir / 'checkpoint.pt'} cannot be resumed from: {error}")
        before = saved["target_network"]["layers.conv1.weight"].dtype
        if before != precision:
            print(f"note     trained in {before} so far, from here in {precision}: see --precision", flush=True)
        working_network.load_state_dict(q_network.state_dict())
        del saved, blobs
    else:
        state, _ = env.reset(seed=args.seed)
    try:
        write_json(run_dir / "args.json", vars(args))
    except OSError as error:
        fail(f"the run directory {run_dir} cannot be written: {error.strerror or error}")

    print(f"game     {args.env_id}: {len(actions)} actions, {' '.join(actions)}\n"
          f"device   {device}, {torch.get_num_threads()} threads; training in {str(precision).removeprefix('torch.')}\n"
          f"network  {sum(parameter.numel() for parameter in q_network.parameters()):,} parameters\n"
          f"replay   {replay.capacity:,} transitions as {encoding_name}: about {gigabytes(replay_bytes)} when full, "
          f"{gigabytes(free_memory(device if encoding_name == 'tensor' else torch.device('cpu')))} free; "
          f"learning starts with {args.agent_replay_buffer_initial:,}\n"
          f"run      {run_dir}" + (f", resumed at frame {counters.frames:,}" if resumed else ""), flush=True)

    if args.agent_replay_buffer_initial > args.environment_train_frames_max:
        print(f"note     learning starts at frame {args.agent_replay_buffer_initial:,}, this run ends at "
              f"{args.environment_train_frames_max:,}: it learns nothing; lower --agent-replay-buffer-initial",
              flush=True)

    curves = Curves(run_dir, counters.frames + 1 if resumed else 0)
    curves.add_table("hyperparameters", {flag(name): value for name, value in vars(args).items()}, counters.frames)
    process, dead, loss = psutil.Process(), set(), None
    # a multiple of the update frequency, so that every point has a fresh loss
    log_interval = math.ceil(LOG_INTERVAL / args.agent_update_frequency) * args.agent_update_frequency
    clock = checkpoint_time = time.monotonic()

    def stop_if_not_finite() -> None:
        """A NaN never leaves the weights again: end the run before one reaches a checkpoint."""
        if loss is not None and not all(tensor.isfinite().all() for tensor in (loss, *q_network.parameters())):
            bar.close()
            last = run_dir / "checkpoint.pt"
            print(f"error: the loss or a weight is not finite at frame {counters.frames:,}; the last checkpoint is "
                  f"{last if last.exists() else 'not yet written'}; lower --optimizer-learning-rate", file=sys.stderr)
            raise SystemExit(1)

    def count_seconds() -> None:
        nonlocal clock
        counters.seconds, clock = counters.seconds + time.monotonic() - clock, time.monotonic()

    def keep_evaluations() -> bool:
        return attempt("evaluations.csv", lambda: write_csv(run_dir / "evaluations.csv", counters.evaluation_rows))

    def now() -> tuple[float, int, int]:
        """Where a `window` begins, the frames whose rates are shown: no evaluation or checkpoint lies within one."""
        return time.monotonic(), counters.frames, counters.updates

    def checkpoint() -> bool:
        """Write q_network.pt, all that is needed to play, and checkpoint.pt, all that is needed to go on."""
        stop_if_not_finite()
        count_seconds()
        counters.peak_memory = max(counters.peak_memory, process.memory_info().rss)
        curves.flush()
        common = {"args": vars(args), "q_network": q_network.state_dict()}
        weights = common | {"format": Q_NETWORK_FORMAT, "actions": actions, "frames": counters.frames}
        everything = common | {
            "target_network": target_network.state_dict(), "optimizer": optimizer.state_dict(),
            "counters": dataclasses.asdict(counters), "environment": environment_state(env),
            "generators": [generator.bit_generator.state for generator in generators]}
        evaluated = not counters.evaluation_rows or keep_evaluations()  # again, for the disk may have been full
        playable = attempt("q_network.pt", lambda: write_atomically(
            run_dir / "q_network.pt", lambda file: save_tensors(weights, file)))
        resumable = attempt("checkpoint.pt", lambda: save_checkpoint(
            run_dir / "checkpoint.pt", everything, replay, state))
        return evaluated and playable and resumable

    bar = tqdm(total=args.environment_train_frames_max, initial=counters.frames, unit="frame", unit_scale=True,
               bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]", **bar_style())

    window = now()

    # 5-7 are `counters`; ε is a function of the frame. Evaluation stands first, so that one that was cut off is done
    # again when the run is resumed.
    # 8  while total_frames < number of frames to train
    while counters.frames < args.environment_train_frames_max:
        # 27-29  Evaluate the agent.
        if counters.episodes - counters.evaluation_episodes >= args.environment_evaluation_interval_episodes:
            finished = evaluate(args, q_network, encoding, counters.evaluations + 1, stop,
                                games=args.environment_evaluation_episodes)
            if finished is not None:
                counters.evaluations += 1
                counters.evaluation_episodes = counters.episodes
                count_seconds()
                row = evaluation_row(counters, finished)
                counters.evaluation_rows.append(row)
                keep_evaluations()
                columns = ("score_mean", "score_variance", "length_mean")
                curves.add({f"evaluation/{name}": row[name] for name in columns}, counters.frames)
                tqdm.write(f"evaluation {counters.evaluations} at frame {counters.frames:,}, "
                           f"update {counters.updates:,}, episode {counters.episodes:,}: "
                           f"score {row['score_mean']:.2f} (variance {row['score_variance']:.4g}), "
                           f"length {row['length_mean']:.1f} frames")
            window = now()
        if stop.signum:
            break
        if (counters.episodes - counters.checkpoint_episodes >= args.environment_checkpoint_interval_episodes
                or time.monotonic() - checkpoint_time >= 60 * args.checkpoint_interval_minutes):
            counters.checkpoint_episodes = counters.episodes
            checkpoint()
            checkpoint_time = time.monotonic()
            window = now()

        # 9-13  Perform an ε-greedy action, π(s) = argmax_a Q_θ(s, a); reduce ε; add (s, a, r, s') to 𝒟.
        epsilon = epsilon_at(counters.frames, args)
        if exploration_rng.random() < epsilon:
            action = int(exploration_rng.integers(len(actions)))
        else:
            action = greedy_action(working_network, decode(state))
        next_state, reward, terminated, truncated, info = env.step(action)
        replay.add(state, action, reward, next_state, terminated)
        state = next_state

        # 30  total_frames = total_frames + 1
        counters.frames += 1
        counters.game_length += 1
        counters.game_score += info["raw_reward"]

        # 14-17  If the episode has ended, reset.
        if terminated or truncated:
            counters.episodes += 1
            state, _ = env.reset()
            if info["game_over"]:
                curves.add({"charts/episodic_return": counters.game_score,
                            "charts/episodic_length": counters.game_length}, counters.frames)
                counters.recent_scores = [*counters.recent_scores, counters.game_score][-20:]
                counters.game_score, counters.game_length = 0.0, 0

        # 18-23  If |𝒟| ≥ initial, sample ℬ ⊆ 𝒟, compute y and perform one iteration of gradient descent.
        if len(replay) >= args.agent_replay_buffer_initial and counters.frames % args.agent_update_frequency == 0:
            minibatch = replay.sample(args.optimizer_minibatch_size, minibatch_rng)
            loss, q = update(q_network, working_network, target_network, optimizer, minibatch,
                             args.agent_discount_factor)
            counters.updates += 1

        # 24-26  θ⁻ = θ, in the precision of the working network
        if counters.frames % args.optimizer_q_network_parameter_update_interval_frames == 0:
            target_network.load_state_dict(q_network.state_dict())

        bar.update()
        if counters.frames % log_interval == 0:
            stop_if_not_finite()
            seconds, frames, updates = map(operator.sub, now(), window)
            window = now()
            scalars = {"charts/epsilon": epsilon, "charts/frames_per_second": frames / seconds}
            if loss is not None:
                scalars |= {"losses/huber": loss.item(), "losses/q_values": q.mean().item()}
                scalars |= diagnose(q_network, minibatch[0])
            curves.add(scalars, counters.frames)
            now_dead = {name for name, share in scalars.items() if "dead_units" in name and share == 1}
            for name in sorted(now_dead - dead):
                tqdm.write(f"warning: frame {counters.frames:,}: {name} is 1: Q is the same in every state, the "
                           "layers below learn no more; start again with a lower --optimizer-learning-rate",
                           file=sys.stderr)
            dead = now_dead
            counters.peak_memory = max(counters.peak_memory, process.memory_info().rss)
            score = f"{np.mean(counters.recent_scores):.1f}" if counters.recent_scores else "none yet"
            bar.set_postfix_str(f"{frames / seconds:.0f} frames/s, {updates / seconds:.0f} updates/s, "
                                f"ε {epsilon:.3f}, score {score}", refresh=False)

    # 32  return θ
    bar.close()
    saved_at_the_end = checkpoint()
    if not stop.signum:
        finished = evaluate(args, q_network, encoding, 0, stop, frames=args.environment_test_frames)
    curves.flush()
    if stop.signum and not saved_at_the_end:
        print(f"error: stopped at frame {counters.frames:,}, which {run_dir} could not keep", file=sys.stderr)
        raise SystemExit(1)
    if stop.signum:
        command = [sys.executable, sys.argv[0], "--resume", str(run_dir)]
        shell_line = shlex.join(command) if os.name == "posix" else subprocess.list2cmdline(command)
        print(f"stopped at frame {counters.frames:,}; go on with: {shell_line}")
        raise SystemExit(128 + stop.signum)

    count_seconds()
    result = evaluation_row(counters, finished)
    modules = (torch, np, gym, ale_py, cv2)
    saved_at_the_end = saved_at_the_end and attempt("test.json", lambda: write_json(run_dir / "test.json", result | {
        "scores": [score for score, _ in finished], "lengths": [length for _, length in finished],
        "seed": args.seed, "env_id": args.env_id, "device": f"{device}, {platform.machine()}, {os.cpu_count()} cores",
        "precision": str(precision).removeprefix("torch."), "threads": torch.get_num_threads(),
        "versions": {"python": platform.python_version()} | {module.__name__: module.__version__ for module in modules},
        "peak_memory_bytes": counters.peak_memory}))
    if not finished:
        print(f"no game ended within --environment-test-frames {args.environment_test_frames:,}")
    else:
        print(f"{'Game':<28}{'Episode Score Mean':>20}{'Variance':>12}{'Episode Length Mean':>21}{'Variance':>12}"
          f"{'Games':>7}\n{args.env_id:<28}{result['score_mean']:>20.5g}{result['score_variance']:>12.5g}"
          f"{result['length_mean']:>21.5g}{result['length_variance']:>12.5g}{len(finished):>7}")
    if not saved_at_the_end:
        raise SystemExit(1)


if __name__ == "__main__":
    main(parse_args(Args))
