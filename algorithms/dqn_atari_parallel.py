# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "gymnasium>=1.1", "lz4", "numpy>=1.26",
#     "opencv-python-headless", "pandas>=2.2", "tensorboard", "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
r"""Deep Q-Learning with many simulators, many processes and many GPUs (ECE 544NA, Lecture 27,
§7.3.2): dqn_atari.py, which waits for one simulator, made parallel. New are make_simulator,
ReplayShare, epsilon_greedy_batch, passed, learn and main; the rest is dqn_atari.py's, word for
word. It drops exact resume, the lock on a run, checksums, RMSProp, --threads, the choice of the
precision, all curves but those of games, and of test.json the speeds and the last evaluations.
[8] is Mnih et al., Nature 518 (2015). The flags up to --optimizer-learning-rate are Table 3's.

    simulators       | s, a -> r, s' | s, a -> r, s' |    N, each in a process; a step: a frame each
    learner       act|  updates   act|  updates   act|    N actions, one batch; it learns meanwhile
    torchrun starts more learners, its ranks, with N simulators and a part of 𝒟 each. θ is the same
    in all: the gradient of an update is the mean of theirs. Rank 0, the only one without torchrun,
    evaluates, logs and writes; the others wait. Table 3's counts are totals over the ranks.

Run it
    python algorithms/dqn_atari_parallel.py --num-simulators 8 --agent-update-frequency 4
    python algorithms/dqn_atari_parallel.py --resume runs/RUN
    torchrun --nproc-per-node 2 algorithms/dqn_atari_parallel.py    # 2 processes; not on Windows
    torchrun --nnodes 2 --nproc-per-node 2 --rdzv-backend c10d --rdzv-id 1 \
        --rdzv-endpoint MACHINE1:29400 algorithms/dqn_atari_parallel.py    # on both machines

Measured, on two cores of an AMD EPYC, bfloat16, one update in four
    frames a second: 335 with 8 simulators, 350 with 16; dqn_atari.py 307, most of it learning
    Breakout, 1,050,000 frames, other flags as dqn_atari.py's run: 60.84 after 58 minutes

Deviations, beside those of dqn_atari.py
    Algorithm 6                           this file                           why
    ------------------------------------  ----------------------------------  --------------------
    §7.3.2: asynchronously [6]            in step; learning overlaps          one θ, never stale
    an update follows its frame           updates sample 𝒟 without the        emulation and learn-
                                          frames that are under way           ing at the same time
    frames are counted one by one         N × ranks at a time; θ is copied    simulators step
                                          after the step's updates            together
    ℬ ⊆ 𝒟                                 each rank draws its share of ℬ      no transition travels
                                          from its part of 𝒟
    Σ over ℬ (line 22)                    Σ over ℬ / ranks                    Adam divides it out

A resumed run has its networks, optimizer and counts again, but an empty replay memory: it first
acts until that holds the initial number (these frames count), then learns on; its random numbers
start anew. GPUs and several machines, which must all see runs/RUN, are untested. 30 s after Ctrl-C
torchrun kills what still runs: an evaluation that takes longer ends without a new checkpoint.
"""

import copy
import dataclasses
import functools
import json
import math
import multiprocessing
import os
import signal
import sys
import time
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import ale_py
import cv2
import gymnasium as gym
import lz4.block
import numpy as np
import pandas as pd
import torch
import tyro
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.wrappers import ClipReward, RecordEpisodeStatistics, TransformObservation
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

# ---- Args ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Args:
    """A FRAME is what the agent observes: one action, 4 emulator frames. Counts are in frames
    unless a flag says otherwise. An EPISODE is a life while training, a GAME ends with the last."""

    # Table 3, in its order
    environment_train_frames_max: int = 10_000_000
    """frames to train for, each an action of 4 emulator frames [8: 50,000,000]"""
    environment_evaluation_episodes: int = 10
    """games of an evaluation"""
    environment_evaluation_interval_episodes: int = 500
    """episodes between evaluations"""
    environment_checkpoint_interval_episodes: int = 500
    """episodes between two savings, of q_network.pt and checkpoint.pt, at most"""
    environment_no_op_max: int = 30
    """a game starts with up to this many no-operations, in emulator frames"""
    environment_reward_clip_limit: float = 1.0
    """while training, rewards are clipped to [-limit, limit]"""
    environment_frames_to_maxpool: int = 2
    """last emulator frames of an action, whose pixelwise maximum is the screen"""
    environment_state_height: int = 84
    """height of a frame, pixels, at least 36"""
    environment_state_width: int = 84
    """width of a frame, pixels, at least 36"""
    agent_history_length: int = 4
    """frames in a state"""
    agent_action_repeat: int = 4
    """emulator frames for which an action is repeated"""
    agent_update_frequency: int = 1
    """actions from one update to the next [8: 4]"""
    agent_discount_factor: float = 0.99
    """γ, per frame"""
    agent_epsilon_greedy_epsilon_initial: float = 1.0
    """ε, probability of a random action, at frame 0"""
    agent_epsilon_greedy_epsilon_final: float = 0.01
    """ε once annealed [8: 0.1]"""
    agent_epsilon_greedy_annealing: int = 1_000_000
    """frames over which ε falls linearly"""
    agent_epsilon_greedy_epsilon_evaluation: float = 0.05
    """ε while evaluating"""
    agent_replay_buffer_initial: int = 100_000
    """transitions in the replay memory before learning starts [8: 50,000]"""
    agent_replay_buffer_maximum_length: int = 1_000_000
    """transitions that the replay memory holds; the oldest give way"""
    optimizer_name: Literal["Adam"] = "Adam"
    """nothing else: the RMSProp of [8] is in dqn_atari.py alone"""
    optimizer_minibatch_size: int = 32
    """transitions in a minibatch"""
    optimizer_q_network_parameter_update_interval_frames: int = 1_000
    """frames between copies of θ to θ⁻ [8: 10,000 updates = 40,000 frames]"""
    optimizer_learning_rate: float = 0.0001
    """learning rate [8: 0.00025]"""

    # This script's own
    env_id: str = "PongNoFrameskip-v4"
    """game; ALE/Pong-v5 means the same as PongNoFrameskip-v4"""
    seed: int = 1
    """of the weights, exploration, minibatches, no-operations and evaluations"""
    environment_test_frames: int = 135_000
    """frames of the final test [§7.3.3], and the limit of an evaluation"""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """of the network; auto is CUDA if there is one, else the CPU"""
    precision: Literal["float32", "bfloat16"] = "float32"
    """of an update's layers"""
    num_simulators: int = 8
    """simulators of each rank"""
    checkpoint_interval_minutes: float = 10.0
    """minutes between two savings, at most"""
    resume: str = ""
    """run to go on with; only --environment-train-frames-max may be raised"""
    runs_dir: str = "runs"
    """folder for the run directory"""


def read_args() -> Args:
    """The flags, or those of the run to resume. Exits with one line where no run can use them."""
    args = tyro.cli(Args, description=__doc__.split("\n\n")[0])
    if args.resume:
        try:
            saved = json.loads((Path(args.resume) / "args.json").read_text())
            defaults = Args(**saved | {"resume": args.resume})
        except (OSError, ValueError, TypeError) as error:  # a TypeError: another script's flags
            raise SystemExit(f"error: {args.resume} is no run to resume: {error}") from None
        # Once more, with the run's own flags as defaults: whatever differs now was typed. It can
        # be a number of frames that is larger (a smaller one differs from `frames`), nothing else.
        args = tyro.cli(Args, default=defaults)
        frames = max(args.environment_train_frames_max, defaults.environment_train_frames_max)
        if args != dataclasses.replace(defaults, environment_train_frames_max=frames):
            raise SystemExit("error: --resume allows a larger --environment-train-frames-max alone")
    # ε and γ are in [0, 1], those named may be 0, a frame's sides are at least the 36 pixels that
    # Table 2's filters need, all others are above 0; NaN is refused, too.
    for name, value in vars(args).items():
        share = "epsilon_greedy_epsilon" in name or name == "agent_discount_factor"
        low = 0 if share or name in ("seed", "threads", "environment_no_op_max") else 1e-9
        low = 36 if "_state_" in name else low
        if type(value) in (int, float) and not low <= value <= (1 if share else 2**31):
            raise SystemExit(f"error: --{name.replace('_', '-')} cannot be {value}")
    if args.agent_replay_buffer_initial > args.agent_replay_buffer_maximum_length:
        raise SystemExit("error: --agent-replay-buffer-initial is above the maximum length")
    if args.device in ("cuda", "mps") and not torch.get_device_module(args.device).is_available():
        raise SystemExit(f"error: PyTorch finds no device for --device {args.device}")
    return args


# ---- problem: the Atari environment and its wrappers ---------------------------------------------
#
#   emulator frame  0 │ 1  2  3  4 │ 5  6  7  8 │ 9 10 11 12    60 a second
#   action            │ a₀ ─────── │ a₁ ─────── │ a₂ ────────   repeated 4 times, rewards summed
#   max-pool          │       3∨4  │       7∨8  │      11∨12    some sprites are in every other one
#   frame           x₀│         x₁ │         x₂ │         x₃    grey, 84×84: the unit of time
#   state             s₀ = (x₀, x₀, x₀, x₀), s₁ = (x₀, x₀, x₀, x₁), s₂ = (x₀, x₀, x₁, x₂), …


class JoystickActions(gym.ActionWrapper):
    """Of up to eighteen actions (§5.3) the game's minimal ones that are among NOOP, FIRE, UP,
    RIGHT, LEFT and DOWN (§7.3.3). `meanings` are their names."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        minimal = env.unwrapped.get_action_meanings()
        self.meanings = [name for name in minimal if name in "NOOP FIRE UP RIGHT LEFT DOWN".split()]
        self.indices = [minimal.index(name) for name in self.meanings]
        self.action_space = gym.spaces.Discrete(len(self.meanings))

    def action(self, action: int) -> int:
        return self.indices[action]


class NoOpReset(gym.Wrapper):
    """A game starts with 0 to `no_op_max` no-operations of an emulator frame each, drawn from `rng`
    (§7.2.1). FIRE is not pressed for the agent: it learns to."""

    def __init__(self, env: gym.Env, no_op_max: int, rng: np.random.Generator):
        super().__init__(env)
        self.no_op_max, self.rng = no_op_max, rng

    def reset(self, **kwargs):
        screen, info = self.env.reset(**kwargs)
        for _ in range(self.rng.integers(self.no_op_max + 1)):
            screen, _, _, _, info = self.env.step(0)  # NOOP
        return screen, info


class ActionRepeat(gym.Wrapper):
    """An action lasts `repeat` emulator frames, or until the game ends; its rewards are summed, and
    the pixelwise maximum of the last `pool` screens is the screen, colour by colour (§7.2.1)."""

    def __init__(self, env: gym.Env, repeat: int, pool: int):
        super().__init__(env)
        self.repeat, self.pool = repeat, pool

    def step(self, action: int):
        total_reward, screens = 0.0, []
        for _ in range(self.repeat):
            screen, reward, terminated, truncated, info = self.env.step(action)
            total_reward += reward
            screens.append(screen)  # (210, 160, 3) uint8
            if terminated or truncated:
                break
        screen = np.maximum.reduce(screens[-self.pool :])  # (210, 160, 3) uint8
        return screen, total_reward, terminated, truncated, info


class LifeLoss(gym.Wrapper):
    """A lost life terminates the episode, and the game goes on (§7.2.1, training only).

    Easy to get wrong: after a lost life reset() returns the frame that the episode ended with. If
    it reset the emulator, later lives would never be played; if it played on with a no-operation,
    that would be an action that the agent has not chosen.
    """

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
        return self.frame, reward, terminated or life_lost, truncated, self.info


class FrameHistory(gym.Wrapper):
    """The state: references to the last `length` frames, oldest first, as LZ4 bytes (§7.3.2). A
    frame is compressed once, when it arrives. An episode's first state repeats its first frame."""

    def __init__(self, env: gym.Env, length: int):
        super().__init__(env)
        self.length = length

    def reset(self, **kwargs):
        frame, info = self.env.reset(**kwargs)
        self.history = (lz4.block.compress(frame),) * self.length
        return self.history, info

    def step(self, action: int):
        frame, reward, terminated, truncated, info = self.env.step(action)
        self.history = (*self.history[1:], lz4.block.compress(frame))
        return self.history, reward, terminated, truncated, info


def make_env(args: Args, no_op_rng: np.random.Generator, training: bool) -> gym.Env:
    """The game with the transformations of Figure 16 (training) or 17 (evaluation: no clipping,
    no LifeLoss); FrameHistory comes on top.

    Nothing is skipped or repeated at random; after 108,000 emulator frames, half an hour, a game is
    truncated.
    Exits with one line for a name that is no Atari game.
    """
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner
    gym.register_envs(ale_py)  # gives Gymnasium the names; the ROMs are in ale-py's wheel
    try:
        # Of a name with a colon, Gymnasium would import the part before it as a module.
        env = gym.make(args.env_id.replace(":", " "), frameskip=1, repeat_action_probability=0.0,
                       full_action_space=False, max_num_frames_per_episode=108_000)
    except (gym.error.Error, ImportError, TypeError) as error:  # TypeError: another kind of game
        raise SystemExit(f"error: {args.env_id} is no Atari game: {error}") from None
    env = JoystickActions(env)
    no_ops = args.environment_no_op_max if "NOOP" in env.meanings else 0  # a few games lack it
    env = NoOpReset(env, no_ops, no_op_rng)
    env = ActionRepeat(env, args.agent_action_repeat, args.environment_frames_to_maxpool)
    size = (args.environment_state_width, args.environment_state_height)
    pixels = gym.spaces.Box(0, 255, size[::-1], np.uint8)  # (84, 84), the space of the result
    # Colour to luminance, 0.299 R + 0.587 G + 0.114 B; then bilinear downsampling. (None: the space
    # of observations is put right by the second.)
    env = TransformObservation(env, lambda screen: cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY), None)
    env = TransformObservation(env, lambda grey: cv2.resize(grey, size), pixels)
    env = RecordEpisodeStatistics(env)  # a game's raw score, and its length in frames
    limit = args.environment_reward_clip_limit
    return LifeLoss(ClipReward(env, -limit, limit)) if training else env


def make_simulator(args: Args, no_op_rng: np.random.Generator, learner_pid: int) -> gym.Env:
    """The game without FrameHistory, in a process of its own, which ends when its pipe is closed.
    AsyncVectorEnv makes one more in the learner's process, for its spaces."""
    if os.getpid() != learner_pid:
        # The learner answers signals, and reports an error in a step: it comes through the pipe.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        sys.stderr = open(os.devnull, "w")
    return make_env(args, no_op_rng, training=True)


# ---- memory: lazy replay -------------------------------------------------------------------------


class ReplayShare:
    """A rank's part of 𝒟, dqn_atari.py's ReplayMemory but for its state_dict: the last `capacity`
    transitions (§5.3). Each has references to its own 5 frames (s' is s moved on by one), so none
    mixes episodes or simulators; arrays are made when a minibatch is drawn (§7.3.2)."""

    def __init__(self, capacity: int, shape: tuple[int, int, int], device: str):
        self.capacity, self.shape, self.added = capacity, shape, 0
        # PyTorch need not wait until a copy has ended: before .to() returns, CUDA has taken
        # ordinary memory into a buffer of its own. (MPS has not.)
        self.transfer = {"device": device, "non_blocking": device == "cuda"}
        self.frames = np.empty((capacity, shape[0] + 1), object)  # x_{t-3} … x_{t+1}: LZ4 bytes
        self.numbers = np.zeros((capacity, 3), np.float32)  # a, r, terminal: one array to send

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, s: tuple, a: int, r: float, s_next: tuple, terminal: bool) -> None:
        """Store (s, a, r, s'). Easy to get wrong: truncation does not set `terminal`. Otherwise a
        game that was cut off teaches that its last state is worth nothing."""
        i = self.added % self.capacity
        self.frames[i] = (*s, s_next[-1])
        self.numbers[i] = a, r, terminal
        self.added += 1

    def gather(self, indices: np.ndarray) -> tuple[torch.Tensor, ...]:
        """The transitions at `indices` (B,): s (B, 4, 84, 84) uint8, a (B,) int64, r (B,) float32,
        s' like s, terminal (B,) bool, on the device."""
        # The frames that s and s' share are decompressed twice: once is no quicker.
        s = self.decode(self.frames[indices, :-1])  # (B, 4, 84, 84)
        s_next = self.decode(self.frames[indices, 1:])  # (B, 4, 84, 84)
        a, r, terminal = torch.from_numpy(self.numbers[indices]).to(**self.transfer).unbind(dim=1)
        return s, a.long(), r, s_next, terminal.bool()

    def decode(self, histories: Sequence[tuple]) -> torch.Tensor:
        """B histories of LZ4 frames, stacked: states (B, 4, 84, 84) uint8 on the device."""
        # The first frames of all histories are joined to one tall picture (B·84, 84), the second
        # ones to another, and so on. cv2.merge makes these 4 pictures the channels of a single one:
        # the 4 values of a pixel lie side by side (channels_last), as convolutions read them.
        joined = [b"".join(map(lz4.block.decompress, xs)) for xs in zip(*histories, strict=True)]
        tall = [np.frombuffer(pixels, np.uint8).reshape(-1, self.shape[2]) for pixels in joined]
        states = cv2.merge(tall).reshape(-1, *self.shape[1:], self.shape[0])  # (B, 84, 84, 4)
        return torch.from_numpy(states).to(**self.transfer).permute(0, 3, 1, 2)  # (B, 4, 84, 84)


# ---- network -------------------------------------------------------------------------------------


class QNetwork(nn.Module):
    """Table 2: states (B, 4, 84, 84) uint8 to Q(s, ·; θ) (B, num_actions) float32, in one pass for
    all actions (Figure 13)."""

    def __init__(self, history_length: int, height: int, width: int, num_actions: int):
        super().__init__()
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):  # one side: 84 -> 20 -> 9 -> 7
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        self.layers = nn.Sequential(
            nn.Conv2d(history_length, 32, 8, stride=4), nn.ReLU(inplace=True),  # (B, 32, 20, 20)
            nn.Conv2d(32, 64, 4, stride=2), nn.ReLU(inplace=True),  # (B, 64, 9, 9)
            nn.Conv2d(64, 64, 3, stride=1), nn.ReLU(inplace=True), nn.Flatten(),  # (B, 3136)
            nn.Linear(64 * height * width, 512), nn.ReLU(inplace=True),  # (B, 512)
        )
        self.head = nn.Linear(512, num_actions)  # (B, num_actions)

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        # Of uint8, float() makes a new array, which is divided in place: no third one. (A float32
        # input would itself be changed.)
        x = self.layers(states.float().div_(255))  # (B, 512)
        # In training, autocast may have switched the layers to bfloat16; Q stays float32.
        with torch.autocast(x.device.type, enabled=False):
            return self.head(x.float())  # (B, num_actions)


class OneDNNLinear(nn.Linear):
    """nn.Linear; for speed alone, on a CPU oneDNN computes the float32 products of a minibatch, as
    it does for convolutions. PyTorch leaves them to MKL: on an AMD EPYC an update takes 16 to 18 %
    longer then (benchmarks/dqn_throughput.py). Other CPUs were not timed. For a single state it
    hardly matters."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        onednn = torch.backends.mkldnn.is_available() and x.is_cpu and x.dtype == torch.float32
        return super().forward(x.to_mkldnn() if onednn and len(x) > 1 else x).to_dense()


def initialize_orthogonal(q_network: QNetwork) -> None:
    """Orthogonal convolution filters (§7.5.1); everything else stays PyTorch's default."""
    for i in (0, 2, 4):  # the convolutions
        nn.init.orthogonal_(q_network.layers[i].weight)


# ---- algorithm: deep Q-learning ------------------------------------------------------------------


def epsilon_at(frame: int, args: Args) -> float:
    """ε: linear from ε_initial at frame 0 to ε_final at frame `annealing`, then constant."""
    initial = args.agent_epsilon_greedy_epsilon_initial
    final = args.agent_epsilon_greedy_epsilon_final
    return initial + min(frame / args.agent_epsilon_greedy_annealing, 1.0) * (final - initial)


@torch.inference_mode()
def epsilon_greedy(q_network, state: torch.Tensor, epsilon: float, rng) -> int:
    """A random action with probability ε, else argmax_a Q(s, a; θ) (Equation 35; line 9); `state`
    is (1, 4, 84, 84) uint8."""
    if rng.random() < epsilon:
        return int(rng.integers(q_network.head.out_features))
    return q_network(state).argmax(dim=1).item()


@torch.inference_mode()
def epsilon_greedy_batch(q_network, states: torch.Tensor, epsilon: float, rng) -> np.ndarray:
    """`epsilon_greedy` for each of the states (N, 4, 84, 84) uint8: N actions from one batch."""
    random = rng.integers(q_network.head.out_features, size=len(states))  # (N,)
    return np.where(rng.random(len(states)) < epsilon, random, q_network(states).argmax(1).cpu())


def update(q_network, target_network, optimizer, minibatch, discount: float, precision: str):
    """One step of gradient descent (Algorithm 6, lines 20-22). `minibatch` is what the replay
    memory's gather returns. bfloat16 is for the products in the layers alone; θ, Q, the loss and
    Adam stay float32. Returns the mean loss () and Q(s_j, a_j) (B,)."""
    s, a, r, s_next, terminal = minibatch
    with torch.autocast(s.device.type, torch.bfloat16, enabled=precision == "bfloat16"):
        # Q(s_j, a_j; θ): of the values of s_j that of a_j
        q = q_network(s).gather(1, a.unsqueeze(1)).squeeze(1)  # (B,)

        # y_j = r_j                                     if s_{j+1} is terminal
        #       r_j + γ max_a' Q(s_{j+1}, a'; θ⁻)       else                       (Equation 37)
        with torch.no_grad():
            y = r + discount * ~terminal * target_network(s_next).amax(dim=1)  # (B,)

    # Σ_j huber(Q(s_j, a_j; θ) - y_j): its gradient in Q is the error clipped to [-1, 1]. A sum, as
    # in Algorithm 6. A mean makes the gradient 32 times smaller: to Adam it is nearly the same, but
    # beside the 0.01 that the RMSProp of [8] adds to a variance it would be too small.
    # Easy to get wrong: a (B,) minus a (B, 1) is a (B, B), which pulls every Q to all B targets.
    assert q.shape == y.shape == r.shape
    loss = nn.functional.huber_loss(q, y, reduction="sum")  # ()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    return loss.detach() / len(r), q.detach()


def passed(count: int, step: int, interval: int) -> int:
    """How many multiples of `interval` `count` has come to, or past, by going up by `step`."""
    return count // interval - (count - step) // interval


# ---- evaluation ----------------------------------------------------------------------------------


def evaluate(args: Args, q_network: QNetwork, decode: Callable, number: int) -> tuple:
    """Play whole games at ε_evaluation, for raw reward, in at most `environment_test_frames`
    frames. Evaluations number 1, 2, … stop after `environment_evaluation_episodes` games; number 0,
    the final test, does not. Seed and number alone decide all that is random. Returns [(score,
    length in frames), …] of the games that ended, and [score, length] so far of the one cut off."""
    games = args.environment_evaluation_episodes if number else math.inf
    # main's generators are made from [seed, 0, …], the test's from [seed, 1], an evaluation's from
    # [seed, number + 1].
    exploration_rng, no_op_rng = np.random.default_rng([args.seed, number + 1]).spawn(2)
    env = FrameHistory(make_env(args, no_op_rng, training=False), args.agent_history_length)
    state, _ = env.reset(seed=args.seed + number)
    finished, epsilon = [], args.agent_epsilon_greedy_epsilon_evaluation
    for _ in tqdm(range(args.environment_test_frames), "evaluation", leave=False, mininterval=1):
        action = epsilon_greedy(q_network, decode([state]), epsilon, exploration_rng)
        state, _, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            finished.append((float(info["episode"]["r"]), info["episode"]["l"]))
            state, _ = env.reset()
        if len(finished) == games:
            break
    # RecordEpisodeStatistics has counted the score and the length of the game that is cut off.
    return finished, [env.get_wrapper_attr(name) for name in ("episode_returns", "episode_lengths")]


# ---- report and checkpoint -----------------------------------------------------------------------


def summary(counters, finished: list[tuple[float, int]]) -> dict:
    """A row of evaluations.csv: mean and sample variance of the games' scores and lengths, the
    columns of Tables 4 to 6; NaN for no game, variance 0 for one."""
    row = {"frames": counters.frames, "updates": counters.updates, "episodes": counters.episodes}
    for i, name in enumerate(("score", "length")):
        values = [game[i] for game in finished] or [math.nan]
        row[f"{name}_mean"] = float(np.mean(values))
        row[f"{name}_variance"] = float(np.var(values, ddof=min(1, len(values) - 1)))
    return row | {"seconds": round(counters.seconds, 1)}


def write_file(path: Path, write: Callable[[Path], object]) -> None:
    """write(temporary path), then rename: if the program crashes or the disk is full, the old file
    or the new one is there, never a part. Exits with one line if the disk refuses."""
    temporary = path.absolute().with_name(path.name + ".tmp")  # absolute: pandas expands a ~
    try:
        write(temporary)
        temporary.replace(path)
    except (OSError, RuntimeError) as error:  # torch.save makes a RuntimeError of an OSError
        temporary.unlink(missing_ok=True)
        raise SystemExit(f"error: {path} could not be written: {error}") from None


# ---- main ----------------------------------------------------------------------------------------


def learn(args: Args, envs, exploration_rng, minibatch_rng, rank: int, ranks: int) -> None:
    """Algorithm 6 in one of `ranks` processes. Rank 0 evaluates, logs and writes."""
    # For speed alone: where a unit gets no gradient any more, Adam's moments fade, and numbers
    # below 1e-38 (denormal) make many CPUs slow. From here on such numbers count as 0; on Linux in
    # PyTorch's threads, too, which are started later.
    torch.set_flush_denormal(True)
    # For speed alone, on Linux: once a block of 30 MB (at most 32) has been freed, the C library
    # keeps up to 60 MB that are free. Else it gives an update's memory back to the system, and the
    # next one pays for that with page faults.
    torch.empty(30 * 2**20, dtype=torch.uint8)

    # 1  Initialize the Atari 2600 simulators; simulator i of all has the seed `seed` + i.
    actions = envs.get_attr("meanings")[0]
    x, _ = envs.reset(seed=args.seed + rank * args.num_simulators)  # (N, 84, 84) uint8
    # N histories of LZ4 bytes, as FrameHistory's, but made here: a frame crosses once.
    s = [(lz4.block.compress(frame),) * args.agent_history_length for frame in x]
    # 2  Initialize 𝒟.
    shape = (args.agent_history_length, args.environment_state_height, args.environment_state_width)
    replay = ReplayShare(args.agent_replay_buffer_maximum_length // ranks, shape, args.device)
    # 3  Initialize θ.
    torch.manual_seed(args.seed)  # the same θ in all ranks
    q_network = QNetwork(*shape, len(actions))
    initialize_orthogonal(q_network)
    q_network.to(args.device, memory_format=torch.channels_last)
    q_network.layers[7].__class__ = OneDNNLinear  # the linear layer: the same weights, quicker
    optimizer = torch.optim.Adam(q_network.parameters(), args.optimizer_learning_rate, fused=True)
    # 4  θ⁻ = θ
    target_network = copy.deepcopy(q_network).requires_grad_(False)
    # 5-7  ε is computed from the frame, in the loop; the rest is counted.
    counters = types.SimpleNamespace(frames=0, updates=0, episodes=0, seconds=0.0, evaluations=[])

    parts = {"q_network": q_network, "target_network": target_network, "optimizer": optimizer}
    name = f"{args.env_id}__dqn_atari_parallel__{args.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    run_dir = Path(args.resume or Path(args.runs_dir) / name.replace("/", "-"))
    if args.resume:
        try:  # weights_only: nothing in the file is run
            saved = torch.load(run_dir / "checkpoint.pt", map_location="cpu", weights_only=True)
            for name, part in parts.items():
                part.load_state_dict(saved[name])
            vars(counters).update(saved["counters"])
        except Exception as error:  # a damaged file can raise anything
            raise SystemExit(f"error: {run_dir} cannot be resumed from: {error!r:.200}") from None
    # The same θ, under a wrapper that averages the gradients of all ranks in backward().
    shared_network = DistributedDataParallel(q_network) if ranks > 1 else q_network
    if rank == 0:
        run_dir.mkdir(parents=True, exist_ok=bool(args.resume))
        text = json.dumps(vars(args) | {"resume": ""}, indent=2)
        write_file(run_dir / "args.json", lambda path: path.write_text(text))
        if counters.frames < args.environment_train_frames_max:
            (run_dir / "test.json").unlink(missing_ok=True)  # of the run before it was lengthened
        # Purged: TensorBoard's points after the checkpoint, whose numbers come once more.
        writer = SummaryWriter(run_dir, purge_step=counters.frames + 1 if args.resume else None)
        print(f"{args.env_id}: {' '.join(actions)}; {args.precision} on {args.device}; {run_dir}")

    def save() -> None:
        """Of rank 0: q_network.pt, what it takes to play, and checkpoint.pt, to learn on."""
        if not all(θ.isfinite().all() for θ in q_network.parameters()):  # a NaN stays
            raise SystemExit("error: a weight is NaN or infinite; lower --optimizer-learning-rate")
        writer.flush()
        content = {"args": vars(args), "actions": actions, "frames": counters.frames,
                   "q_network": q_network.state_dict()}
        write_file(run_dir / "q_network.pt", lambda path: torch.save(content, path))
        content = {name: part.state_dict() for name, part in parts.items()}
        content["counters"] = vars(counters)
        write_file(run_dir / "checkpoint.pt", lambda path: torch.save(content, path))

    bar = tqdm(total=args.environment_train_frames_max, initial=counters.frames, disable=rank > 0)
    started = time.monotonic() - counters.seconds
    save_time, stopping = time.monotonic(), 0
    step = args.num_simulators * ranks  # frames: one of each simulator of each rank
    batch_size = args.optimizer_minibatch_size // ranks
    signals = []  # to this rank: with one to any, the loop ends after the step, or the evaluation
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))

    # 8, 30  while total_frames < number of frames to train
    while counters.frames < args.environment_train_frames_max and not stopping:
        # 9-13  Perform ε-greedy actions, π(s) = argmax_a Q(s, a; θ), one in each simulator.
        epsilon = epsilon_at(counters.frames, args)
        a = epsilon_greedy_batch(q_network, replay.decode(s), epsilon, exploration_rng)  # (N,)
        envs.step_async(a)
        counters.frames += step

        # 18-23  If |𝒟| ≥ initial: sample ℬ ⊆ 𝒟, gradient descent, once for every multiple of the
        # update frequency. 𝒟 lacks this step's transitions: the simulators step meanwhile.
        if replay.added * ranks >= args.agent_replay_buffer_initial:
            for _ in range(passed(counters.frames, step, args.agent_update_frequency)):
                minibatch = replay.gather(minibatch_rng.integers(len(replay), size=batch_size))
                update(shared_network, target_network, optimizer, minibatch,
                       args.agent_discount_factor, args.precision)
                counters.updates += 1

        # 24-26  θ⁻ = θ
        if passed(counters.frames, step, args.optimizer_q_network_parameter_update_interval_frames):
            target_network.load_state_dict(q_network.state_dict())

        # 10, 14-17  Add (s, a, r, s') to 𝒟. A simulator whose episode has ended has reset itself.
        x, r, terminated, truncated, info = envs.step_wait()  # (N, 84, 84) uint8, (N,) each
        ended = terminated | truncated
        for i in range(args.num_simulators):
            # After an end x[i] is the next episode's first frame (AutoresetMode.SAME_STEP, in
            # main), and the last frame of s' is in info.
            s_next = (*s[i][1:], lz4.block.compress(info["final_obs"][i] if ended[i] else x[i]))
            replay.add(s[i], a[i], r[i], s_next, terminated[i])
            s[i] = (lz4.block.compress(x[i]),) * args.agent_history_length if ended[i] else s_next

        # The ranks agree on the number of episodes, and whether one of them is to stop: then all
        # leave the loop together.
        sums = torch.tensor([ended.sum(), len(signals)])
        if ranks > 1:
            distributed.all_reduce(sums)
        ends, stopping = sums.tolist()  # episodes that have ended now; signals so far
        counters.episodes += ends
        if rank > 0:
            continue  # the rest is rank 0's

        # Log rank 0's games that are over: "_episode" is True where not only a life has ended.
        games = info.get("final_info", {})
        for i in np.flatnonzero(games.get("_episode", ())):
            score, length = games["episode"]["r"][i], games["episode"]["l"][i]
            writer.add_scalar("charts/episodic_return", score, counters.frames)
            writer.add_scalar("charts/episodic_length", length, counters.frames)
            bar.set_postfix_str(f"score {score:g}, ε {epsilon:.2f}", refresh=False)

        # 27-29  Evaluate the agent.
        if passed(counters.episodes, ends, args.environment_evaluation_interval_episodes):
            finished, _ = evaluate(args, q_network, replay.decode, len(counters.evaluations) + 1)
            counters.evaluations.append(summary(counters, finished))
            table = pd.DataFrame(counters.evaluations).set_index("frames")
            write_file(run_dir / "evaluations.csv", table.to_csv)
            mean = counters.evaluations[-1]["score_mean"]
            tqdm.write(f"frame {counters.frames:,}, update {counters.updates:,}: score {mean}")

        bar.update(step)
        counters.seconds = time.monotonic() - started
        due = passed(counters.episodes, ends, args.environment_checkpoint_interval_episodes)
        if due or time.monotonic() - save_time > 60 * args.checkpoint_interval_minutes:
            save()
            save_time = time.monotonic()

    # 32  return θ
    bar.close()
    if rank == 0:
        save()
        print(f"frame {counters.frames:,}; to go on: --resume {run_dir}")
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # all is saved: the test may be cut off
    if rank == 0 and not (stopping or signals):
        finished, unfinished = evaluate(args, q_network, replay.decode, number=0)
        test = summary(counters, finished) | {"unfinished_score_and_length": unfinished}
        print("\n".join(f"{name:32}{value}" for name, value in test.items()))
        test |= {"scores": [score for score, _ in finished], "lengths": [n for _, n in finished]}
        text = json.dumps(test, indent=2).replace("NaN", "null")  # JSON has no NaN
        write_file(run_dir / "test.json", lambda path: path.write_text(text))
    if ranks > 1:
        # All wait for rank 0: of a stopped run each ends with a code above 0, and with the first
        # torchrun kills the rest.
        distributed.barrier()
        distributed.destroy_process_group()
    if stopping or signals:  # the shell's code for a signal, if it was another rank's, SIGTERM
        raise SystemExit(128 + max(signals, default=signal.SIGTERM))


def main(args: Args) -> None:
    """A learner: its place among the others, as torchrun tells it, its simulators, and `learn`."""
    rank, ranks = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    if args.device == "cuda":
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", 0)))
    if args.optimizer_minibatch_size % ranks:
        raise SystemExit(f"error: --optimizer-minibatch-size is not a multiple of {ranks} ranks")
    if ranks > 1:  # gloo for CPUs, NCCL for GPUs: they wait 30 minutes for an evaluation
        distributed.init_process_group("cpu:gloo,cuda:nccl" if args.device == "cuda" else "gloo")

    rngs = np.random.default_rng([args.seed, 0, rank]).spawn(2 + args.num_simulators)
    makers = [functools.partial(make_simulator, args, rng, os.getpid()) for rng in rngs[2:]]
    # Not "fork": the copy of a process whose threads hold locks can hang. A server forks instead.
    # Each simulator imports this file; the server has imported its slow modules once for all.
    # (Without a server, by "spawn", each imports them for itself, into 0.3 GB of memory.)
    multiprocessing.set_forkserver_preload(["gymnasium", "pandas", "torch.utils.tensorboard"])
    envs = AsyncVectorEnv(makers, context="forkserver" if sys.platform == "linux" else "spawn",
                          autoreset_mode=AutoresetMode.SAME_STEP)
    try:
        learn(args, envs, *rngs[:2], rank, ranks)
    except Exception as error:
        lost = isinstance(error, (EOFError, ConnectionError, distributed.DistError))
        if lost or "by peer" in str(error):  # gloo's RuntimeError: "Connection closed by peer"
            raise SystemExit(f"error: a process of the run has died: {error!r:.120}") from None
        raise
    finally:
        for process in envs.processes:
            process.kill()
        envs.closed = True  # its own close() would first talk to them, dead ones, too


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8", line_buffering=True)
    try:
        main(read_args())
    # A full disk or memory; a simulator that dies as it starts; Ctrl-C before or after the loop.
    except (OSError, EOFError, MemoryError, KeyboardInterrupt) as error:
        raise SystemExit(f"error: {str(error) or 'Ctrl-C, no memory, or simulator died'}") from None
