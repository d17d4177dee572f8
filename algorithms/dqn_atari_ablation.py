# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "filelock", "gymnasium>=1.1", "lz4", "numpy>=1.26",
#     "opencv-python-headless", "pandas>=2.2", "tensorboard", "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
r"""Deep Q-Learning on Atari games, taken apart (ECE 544NA, Lecture 27, §7.5, Tables 4 and 6):
dqn_atari.py with three switches; `diff dqn_atari.py dqn_atari_ablation.py` shows them. The flags
are Table 3's up to --optimizer-learning-rate, then come the switches, then, from --env-id on, this
script's own.

    --initialization default|he|orthogonal   convolution weights (Table 4)
    --no-target-network                      θ⁻ is θ itself; still no gradient passes through y
    --no-replay-buffer                       ℬ is the last transitions, in their order

With none of them a run is bit for bit that of dqn_atari.py with the same --env-id and --precision
(which it else chooses by the clock). evaluations.csv has one column more: the mean of max Q(s, a)
over 500 held-out states. Without a target network it may run away.

Run it
    python algorithms/dqn_atari_ablation.py --no-target-network     # one arm, on Breakout
    python benchmarks/study.py ablation --seeds 3                   # all of Table 6
    python benchmarks/study.py tables                               # Tables 4 to 6 so far

Measured, Breakout, 500,000 frames, other flags as dqn_atari.py's run, mean score of the final test
    no switch 33.55, --no-target-network 17.30, --no-replay-buffer 2.029, both switches 6.789

Deviations
    The lecture does not say what "no replay buffer" trains on. Here it is the most recent
    transitions, as many as a minibatch holds. Everything else stays, the frames before learning
    starts, too. All other deviations are those of dqn_atari.py.
"""

import copy
import dataclasses
import json
import math
import signal
import sys
import time
import timeit
import types
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import ale_py
import cv2
import filelock
import gymnasium as gym
import lz4.block
import numpy as np
import pandas as pd
import torch
import tyro
from gymnasium.wrappers import ClipReward, RecordEpisodeStatistics, TransformObservation
from torch import nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

REPORT_INTERVAL = 2_000  # frames between two points of a curve

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
    """episodes between two writings of q_network.pt"""
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
    optimizer_name: Literal["Adam", "RMSprop"] = "Adam"
    """Adam, or the RMSProp of [8] with the constants of Figure 18"""
    optimizer_minibatch_size: int = 32
    """transitions in a minibatch"""
    optimizer_q_network_parameter_update_interval_frames: int = 1_000
    """frames between copies of θ to θ⁻ [8: 10,000 updates = 40,000 frames]"""
    optimizer_learning_rate: float = 0.0001
    """learning rate [8: 0.00025]"""

    # This script's own
    initialization: Literal["default", "he", "orthogonal"] = "orthogonal"
    """weights of the convolutions; all else is PyTorch's default [Table 4]"""
    target_network: bool = True
    """whether y is computed with θ⁻, a copy, or with θ itself [Table 6]"""
    replay_buffer: bool = True
    """draw minibatches from all transitions, not take the last ones [Table 6]"""
    env_id: str = "BreakoutNoFrameskip-v4"
    """game; ALE/Pong-v5 means the same as PongNoFrameskip-v4"""
    seed: int = 1
    """of the weights, exploration, minibatches, no-operations and evaluations"""
    environment_test_frames: int = 135_000
    """frames of the final test [§7.3.3], and the limit of an evaluation"""
    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """of the network; auto is CUDA if there is one, else the CPU"""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """of an update's layers; auto times both: bfloat16 if it saves a tenth"""
    threads: int = 0
    """CPU threads of PyTorch; 0 is PyTorch's own choice"""
    checkpoint_interval_minutes: float = 10.0
    """minutes between checkpoints, which hold everything"""
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


# ---- memory: lazy replay -------------------------------------------------------------------------


class ReplayMemory:
    """𝒟: the last `capacity` transitions (§5.3). Each has references to its own 5 frames (s' is s
    moved on by one), an action, a clipped reward, and whether s' is terminal. It takes none from
    its neighbours, which can be of other games. Arrays are made when a minibatch is drawn (§7.3.2).
    `shape` is that of a state, (4, 84, 84)."""

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

    def state_dict(self) -> dict:
        """For a checkpoint: every frame once, and per transition the places of its frames. Two
        transitions (A, B, C, D, E) and (B, C, D, E, F) become ABCDEF, 0 1 2 3 4 and 1 2 3 4 5."""
        stored = self.frames[: len(self)]  # (n, 5); a frame that transitions share is one object
        unique = {id(frame): frame for frames in stored for frame in frames}
        place = dict(zip(unique, range(len(unique)), strict=True))
        return {
            "added": self.added,
            # (n, 3) float32, (n, 5) int64; (frames,) int64, (bytes,) uint8: all frames, joined
            "numbers": torch.from_numpy(self.numbers[: len(self)]),
            "places": torch.tensor([[place[id(x)] for x in frames] for frames in stored]),
            "lengths": torch.tensor([len(frame) for frame in unique.values()]),
            "frames": torch.frombuffer(bytearray().join(unique.values()), dtype=torch.uint8),
        }

    def load_state_dict(self, saved: dict) -> None:
        """Take over what `state_dict` gave."""
        joined = memoryview(saved["frames"].numpy())
        ends = saved["lengths"].cumsum(dim=0).tolist()
        unique = [bytes(joined[i:j]) for i, j in zip([0, *ends[:-1]], ends, strict=True)]
        self.added = saved["added"]
        for i, places in enumerate(saved["places"].tolist()):
            self.frames[i] = [unique[place] for place in places]
        self.numbers[: len(self)] = saved["numbers"].numpy()


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


def initialize(q_network: QNetwork, name: str) -> None:
    """Convolution filters of Table 4 (§7.5.1); everything else stays PyTorch's default."""
    for i in (0, 2, 4):  # the convolutions
        if name == "orthogonal":
            nn.init.orthogonal_(q_network.layers[i].weight)
        elif name == "he":
            nn.init.kaiming_normal_(q_network.layers[i].weight, nonlinearity="relu")
        # "default": as PyTorch made them


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


class NatureRMSprop(torch.optim.Optimizer):
    """The RMSProp that [8] released (Figure 18): a step is the gradient over the root of its
    variance; g and n are running means of the gradient and its square. Figure 18 calls their decays
    momentum, 0.95 twice. torch.optim.RMSprop adds its constant to the root, not to the variance."""

    def __init__(self, parameters, lr: float, decay: float = 0.95, constant: float = 0.01):
        super().__init__(parameters, {"lr": lr, "decay": decay, "constant": constant})

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            for θ in group["params"]:
                state = self.state[θ]
                if not state:
                    state["g"], state["n"] = torch.zeros_like(θ), torch.zeros_like(θ)
                # g ← 0.95 g + 0.05 ∇    n ← 0.95 n + 0.05 ∇²    θ ← θ - lr ∇ / √(n - g² + 0.01)
                g = state["g"].lerp_(θ.grad, 1 - group["decay"])
                n = state["n"].lerp_(θ.grad.square(), 1 - group["decay"])
                # Rounding could make the variance, n - g², negative.
                root = ((n - g.square()).clamp_min(0) + group["constant"]).sqrt()
                θ.addcdiv_(θ.grad, root, value=-group["lr"])


def make_optimizer(args: Args, q_network: QNetwork) -> torch.optim.Optimizer:
    """Table 3's Adam (fused: one call for all weights), or Figure 18's RMSProp."""
    if args.optimizer_name == "Adam":
        return torch.optim.Adam(q_network.parameters(), lr=args.optimizer_learning_rate, fused=True)
    return NatureRMSprop(q_network.parameters(), lr=args.optimizer_learning_rate)


def choose_precision(args: Args, q_network: QNetwork, shape: tuple[int, int, int]) -> str:
    """Time 30 updates of zeros in float32 and bfloat16: bfloat16 if it saves a tenth. They change
    `q_network`, a copy; `shape` is that of a state."""
    optimizer = make_optimizer(args, q_network)
    s = torch.zeros((args.optimizer_minibatch_size, *shape), dtype=torch.uint8, device=args.device)
    s = s.to(memory_format=torch.channels_last)  # (B, 4, 84, 84), as gather gives it
    a = torch.zeros(len(s), dtype=torch.int64, device=args.device)  # (B,); r and terminal like it
    inputs = (q_network, copy.deepcopy(q_network), optimizer, (s, a, a.float(), s, a.bool()), 0.99)

    def seconds(precision: str) -> float:
        return timeit.timeit(lambda: update(*inputs, precision)[0].item(), number=1)

    # In turns: a slow moment of the machine meets both. The best of 30 counts.
    turns = [(seconds("float32"), seconds("bfloat16")) for _ in range(30)]
    float32, bfloat16 = np.min(turns, axis=0)
    print(f"an update: {1000 * float32:.1f} ms in float32, {1000 * bfloat16:.1f} ms in bfloat16")
    return "bfloat16" if bfloat16 < 0.9 * float32 else "float32"


@torch.no_grad()
def dead_units(q_network: QNetwork, states: torch.Tensor) -> float:
    """The share of the linear layer's 512 units that are 0 in all of the states (B, 4, 84, 84).
    They get no gradient. A share that grows tells of too large a learning rate."""
    return (q_network.layers(states / 255) == 0).all(dim=0).float().mean().item()


# ---- evaluation ----------------------------------------------------------------------------------


def held_out_states(args: Args, decode: Callable) -> torch.Tensor:
    """500 states (500, 4, 84, 84) uint8, every fourth of a random policy's play. The seed alone
    decides them, so a resumed run has the same ones."""
    policy_rng, no_op_rng = np.random.default_rng([args.seed, 0, 1]).spawn(2)
    env = FrameHistory(make_env(args, no_op_rng, training=True), args.agent_history_length)
    state, _ = env.reset(seed=args.seed)
    states = []
    while len(states) < 500:
        for _ in range(4):
            action = int(policy_rng.integers(env.action_space.n))
            state, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                state, _ = env.reset()
        states.append(state)
    env.close()
    return decode(states)


@torch.no_grad()
def max_q_mean(q_network: QNetwork, states: torch.Tensor) -> float:
    """The mean of max_a Q(s, a; θ) over the states (B, 4, 84, 84)."""
    return q_network(states).amax(dim=1).mean().item()


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


def write_test(path: Path, counters, finished: list, unfinished: list) -> None:
    """test.json: the final test, how fast the first and the last tenth of the learning frames were,
    and the mean of the last five evaluations: one θ is a noisy result."""
    evaluations = [row["score_mean"] for row in counters.evaluations[-5:]] or [math.nan]
    tenth = math.ceil(len(counters.speeds) / 10)  # a run that slows down shows here
    result = summary(counters, finished) | {
        "frames_per_second_first_tenth": float(np.median(counters.speeds[:tenth] or [math.nan])),
        "frames_per_second_last_tenth": float(np.median(counters.speeds[-tenth:] or [math.nan])),
        "unfinished_score_and_length": unfinished,  # of the game that was cut off: not counted
        "last_evaluations_score_mean": float(np.mean(evaluations)),
    }
    print("\n".join(f"{name:32}{value}" for name, value in result.items()))
    games = {"scores": [score for score, _ in finished], "lengths": [n for _, n in finished]}
    text = json.dumps(result | games, indent=2).replace("NaN", "null")  # JSON has no NaN
    write_file(path, lambda p: p.write_text(text))


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


def environment_state(env: gym.Env) -> dict:
    """What the emulator, FrameHistory, LifeLoss and RecordEpisodeStatistics remember. The rest of
    LifeLoss is not saved: the next step sets it before it is read."""
    emulator = env.unwrapped.ale.cloneState(include_rng=True).serialize()
    names = ("history", "lives", "episode_returns", "episode_lengths")
    return {"emulator": emulator} | {name: env.get_wrapper_attr(name) for name in names}


def restore_environment(env: gym.Env, saved: dict) -> None:
    """Put `env`, which has been reset, where `environment_state` was taken."""
    # An emulator that has never acted goes on differently after restoreState (seen in Q*bert and
    # Tetris).
    env.step(0)
    env.unwrapped.ale.restoreState(ale_py.ALEState(saved.pop("emulator")))
    for name, value in saved.items():
        env.set_wrapper_attr(name, value)


def restore(path: Path, parts: dict, env: gym.Env, rngs: list, counters) -> None:
    """Put everything back to where the checkpoint was taken. weights_only, as a pickle can run a
    program. Exits with one line if the file is not whole, or does not fit this run."""
    try:
        if zipfile.ZipFile(path).testzip():
            raise ValueError("a checksum is wrong")
        saved = torch.load(path, map_location="cpu", weights_only=True)
        for name, part in parts.items():
            part.load_state_dict(saved[name])
        restore_environment(env, saved["environment"])
        for rng, state in zip(rngs, saved["rngs"], strict=True):
            rng.bit_generator.state = state
        for name in vars(counters):
            setattr(counters, name, saved["counters"][name])
    except Exception as error:  # a damaged file can raise anything
        raise SystemExit(f"error: {path} cannot be resumed from: {error!r:.200}") from None


def open_run(args: Args, script: str) -> tuple[Path, filelock.FileLock]:
    """The run directory, `args.resume` or a new one, and the lock on it, which ends with the
    process. Exits with one line if it cannot be written or another process writes it."""
    name = f"{args.env_id}__{script}__{args.seed}__{time.strftime('%Y%m%d-%H%M%S')}"
    run_dir = Path(args.resume or Path(args.runs_dir) / name.replace("/", "-"))
    lock = filelock.FileLock(run_dir / ".lock", timeout=0)
    try:
        run_dir.mkdir(parents=True, exist_ok=bool(args.resume))
        lock.acquire()
    except (OSError, filelock.Timeout) as error:
        raise SystemExit(f"error: {run_dir} is in use or cannot be written: {error}") from None
    return run_dir, lock


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Algorithm 6 (its line numbers head the comments), and what it needs and leaves behind."""
    # For speed alone: where a unit gets no gradient any more, Adam's moments fade, and numbers
    # below 1e-38 (denormal) make many CPUs slow. From here on such numbers count as 0; on Linux in
    # PyTorch's threads, too, which are started later.
    torch.set_flush_denormal(True)
    # For speed alone, on Linux: once a block of 30 MB (at most 32) has been freed, the C library
    # keeps up to 60 MB that are free. Else it gives an update's memory back to the system, and the
    # next one pays for that with page faults.
    torch.empty(30 * 2**20, dtype=torch.uint8)
    torch.set_num_threads(args.threads or torch.get_num_threads())
    args.threads = torch.get_num_threads()  # into args.json: a resumed run has as many
    if args.device == "auto":
        args.device = "cuda" if torch.cuda.is_available() else "cpu"
    rngs = np.random.default_rng([args.seed, 0]).spawn(3)
    exploration_rng, minibatch_rng, no_op_rng = rngs

    # 1  Initialize the Atari 2600 simulator.
    env = FrameHistory(make_env(args, no_op_rng, training=True), args.agent_history_length)
    actions = env.get_wrapper_attr("meanings")
    # 2  Initialize 𝒟.
    shape = (args.agent_history_length, args.environment_state_height, args.environment_state_width)
    replay = ReplayMemory(args.agent_replay_buffer_maximum_length, shape, args.device)
    # 3  Initialize θ.
    torch.manual_seed(args.seed)
    q_network = QNetwork(*shape, len(actions))
    initialize(q_network, args.initialization)
    q_network.to(args.device, memory_format=torch.channels_last)  # quicker convolutions
    q_network.layers[7].__class__ = OneDNNLinear  # the linear layer: the same weights, quicker
    if args.precision == "auto":
        args.precision = choose_precision(args, copy.deepcopy(q_network), shape)
    optimizer = make_optimizer(args, q_network)
    # 4  θ⁻ = θ
    target_network = copy.deepcopy(q_network).requires_grad_(False)
    if not args.target_network:
        target_network = q_network
    held_out = held_out_states(args, replay.decode)  # (500, 4, 84, 84)
    # 5-7  ε is computed from the frame, in the loop; the rest is counted.
    # `seconds` is without the pauses between stop and resume; `evaluations` holds the rows of
    # evaluations.csv, `speeds` the frames a second of every REPORT_INTERVAL.
    counters = types.SimpleNamespace(frames=0, updates=0, episodes=0, seconds=0.0, evaluations=[],
                                     speeds=[])
    s, _ = env.reset(seed=args.seed)

    run_dir, _lock = open_run(args, Path(__file__).stem)  # locked for as long as there is _lock
    parts = {"q_network": q_network, "target_network": target_network, "optimizer": optimizer,
             "replay": replay}
    if args.resume:
        restore(run_dir / "checkpoint.pt", parts, env, rngs, counters)
        s = env.get_wrapper_attr("history")
    text = json.dumps(vars(args) | {"resume": ""}, indent=2)
    write_file(run_dir / "args.json", lambda path: path.write_text(text))
    if counters.frames < args.environment_train_frames_max:
        (run_dir / "test.json").unlink(missing_ok=True)  # of the run before it was lengthened
    # Purged: TensorBoard's points after the checkpoint, whose frames are played once more.
    writer = SummaryWriter(run_dir, purge_step=counters.frames + 1 if args.resume else None)
    print(f"{args.env_id}: {' '.join(actions)}; {args.precision} on {args.device}; {run_dir}")
    print(f"Frames are slower once learning starts, at {args.agent_replay_buffer_initial:,}.")
    loss = q = torch.tensor(math.nan)  # () until the first update, of a resumed run, too

    def save_q_network() -> None:
        """What it takes to play."""
        if not all(θ.isfinite().all() for θ in q_network.parameters()):  # a NaN stays
            raise SystemExit("error: a weight is NaN or infinite; lower --optimizer-learning-rate")
        content = {"args": vars(args), "actions": actions, "frames": counters.frames,
                   "q_network": q_network.state_dict()}
        write_file(run_dir / "q_network.pt", lambda path: torch.save(content, path))

    def save_checkpoint() -> None:
        """Everything: on a CPU a resumed run is bit for bit the run that never stopped."""
        save_q_network()
        writer.flush()
        content = {name: part.state_dict() for name, part in parts.items()}
        content["environment"] = environment_state(env)
        content["rngs"] = [rng.bit_generator.state for rng in rngs]
        content["counters"] = vars(counters)
        write_file(run_dir / "checkpoint.pt", lambda path: torch.save(content, path))

    bar = tqdm(total=args.environment_train_frames_max, initial=counters.frames, mininterval=1)
    started = time.perf_counter() - counters.seconds
    checkpoint_time = window_time = time.perf_counter()
    window_frames = counters.frames
    stop = []  # signals so far: with one, the loop ends after the frame, or the evaluation
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))

    # 8, 30  while total_frames < number of frames to train
    while counters.frames < args.environment_train_frames_max and not stop:
        # 9-13  Perform an ε-greedy action, π(s) = argmax_a Q(s, a; θ). Add (s, a, r, s') to 𝒟.
        epsilon = epsilon_at(counters.frames, args)
        counters.frames += 1  # the number of the frame that is played now
        a = epsilon_greedy(q_network, replay.decode([s]), epsilon, exploration_rng)
        s_next, r, terminated, truncated, info = env.step(a)
        replay.add(s, a, r, s_next, terminated)

        # 14-17  If the episode has ended, reset.
        episode_ended = terminated or truncated
        counters.episodes += episode_ended
        s = env.reset()[0] if episode_ended else s_next
        # A game, not only a life, is over: RecordEpisodeStatistics, which writes "episode", is
        # inside LifeLoss. The curves' names are CleanRL's.
        if "episode" in info:
            writer.add_scalar("charts/episodic_return", info["episode"]["r"], counters.frames)
            writer.add_scalar("charts/episodic_length", info["episode"]["l"], counters.frames)
            bar.set_postfix_str(f"score {info['episode']['r']:g}, ε {epsilon:.2f}", refresh=False)

        # 18-23  If |𝒟| ≥ initial: sample ℬ ⊆ 𝒟, one iteration of gradient descent.
        learning = len(replay) >= args.agent_replay_buffer_initial
        if learning and counters.frames % args.agent_update_frequency == 0:
            indices = minibatch_rng.integers(len(replay), size=args.optimizer_minibatch_size)
            if not args.replay_buffer:  # the last ones
                first = max(0, replay.added - len(indices))
                indices = np.arange(first, replay.added) % replay.capacity
            minibatch = replay.gather(indices)
            loss, q = update(q_network, target_network, optimizer, minibatch,
                             args.agent_discount_factor, args.precision)
            counters.updates += 1

        # 24-26  θ⁻ = θ
        if counters.frames % args.optimizer_q_network_parameter_update_interval_frames == 0:
            target_network.load_state_dict(q_network.state_dict())

        # 27-29  Evaluate the agent.
        if episode_ended and counters.episodes % args.environment_evaluation_interval_episodes == 0:
            finished, _ = evaluate(args, q_network, replay.decode, len(counters.evaluations) + 1)
            row = summary(counters, finished)
            row["held_out_max_q_mean"] = max_q_mean(q_network, held_out)
            counters.evaluations.append(row)
            table = pd.DataFrame(counters.evaluations).set_index("frames")
            write_file(run_dir / "evaluations.csv", table.to_csv)
            mean = counters.evaluations[-1]["score_mean"]
            writer.add_scalar("evaluation/score_mean", mean, counters.frames)
            held_out_max_q = row["held_out_max_q_mean"]
            writer.add_scalar("evaluation/held_out_max_q_mean", held_out_max_q, counters.frames)
            tqdm.write(f"frame {counters.frames:,}, update {counters.updates:,}: score {mean}")

        if episode_ended and counters.episodes % args.environment_checkpoint_interval_episodes == 0:
            save_q_network()

        bar.update()
        counters.seconds = time.perf_counter() - started
        if counters.frames % REPORT_INTERVAL == 0:
            # SPS: frames a second; evaluations count, writing checkpoints does not. td_loss: the
            # last minibatch's mean Huber loss; q_values: the mean of its Q(s_j, a_j).
            speed = (counters.frames - window_frames) / (time.perf_counter() - window_time)
            # A generator of its own: what is logged changes nothing that is learnt.
            some = np.random.default_rng(counters.frames).integers(len(replay), size=512)
            scalars = {"charts/SPS": speed, "charts/epsilon": epsilon,
                       "losses/td_loss": loss.item(), "losses/q_values": q.mean().item(),
                       "diagnostics/dead_units": dead_units(q_network, replay.gather(some)[0])}
            for name, value in scalars.items():
                writer.add_scalar(name, value, counters.frames)
            if learning:
                counters.speeds.append(speed)
            if time.perf_counter() - checkpoint_time > 60 * args.checkpoint_interval_minutes:
                save_checkpoint()
                checkpoint_time = time.perf_counter()
            window_time, window_frames = time.perf_counter(), counters.frames

    # 32  return θ
    bar.close()
    save_checkpoint()
    if stop:
        print(f"frame {counters.frames:,}; go on with: python {sys.argv[0]} --resume {run_dir}")
        raise SystemExit(128 + stop[0])  # the shell's code for a signal
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)  # all is saved: the test may be cut off
    finished, unfinished = evaluate(args, q_network, replay.decode, number=0)
    write_test(run_dir / "test.json", counters, finished, unfinished)


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8", line_buffering=True)
    try:
        main(read_args())
    except (OSError, MemoryError, KeyboardInterrupt) as error:  # of Ctrl-C outside the loop
        raise SystemExit(f"error: {str(error) or type(error).__name__}") from None
