# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "gymnasium>=1.1", "lz4", "matplotlib>=3.9", "numpy>=1.26", "opencv-python-headless",
#     "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
"""Watch a trained agent think: a video, and the pictures of §7.4 of the lecture (ECE 544NA, Lecture 27; Figures 20 to
32), for any network that dqn_atari.py has trained, of any game.

Run it
    python algorithms/dqn_atari_play.py                                      # the newest run under runs/
    python algorithms/dqn_atari_play.py runs/RUN/q_network.pt                # this network
    python algorithms/dqn_atari_play.py runs/RUN --seed 7 --moments 5 --show-layers --video-seconds 30
    python algorithms/dqn_atari_play.py runs/RUN --games 30                  # score and length, mean and variance

Without a run it plays the published Pong agent. Beside the network, in play-seed1-…/, it leaves
    episode.webm   every emulator frame of the first game, 60 a second, and beside it what the agent thinks
    values.png     Figure 20: the value, Q of every action and the best action against the frame
    moments.png    Figures 21, 22, 24, …: three consecutive frames where the value jumps most
    trace.csv      frame, value, Q of every action, action taken, greedy or random, reward, lives
    filters.png    (--show-layers) the filters of the first layer

Measured
    runs/published/pong, 3,000,000 frames of training, --seed 1: score 20 in 1,840 frames; the value lies between
    -0.57 and 1.42 and jumps most, by -1.05, at frame 1,762.

Deviations
    lecture                                this file                               why
    -------------------------------------  --------------------------------------  ------------------------------------
    the moments are chosen by hand         the largest changes of the value,       the same rule for every game; no
                                           no frame shown twice                    frame twice, or one event fills all
    the curves alone                       scores, lost lives and the moments are  what the value reacts to is read off
                                           marked on them                          the picture
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import difflib
import functools
import inspect
import io
import itertools
import math
import os
import pickle
import sys
import time
import types
import zipfile
from collections import OrderedDict, deque
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NoReturn, TypeVar

import ale_py
import cv2
import gymnasium as gym
import lz4.block
import matplotlib
import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from torch import nn
from tqdm import tqdm

Flags = TypeVar("Flags")

Q_NETWORK_FORMAT = "dqn_atari q_network 1"
FRAMES_PER_SECOND = 60  # of the emulator
COLOURS = matplotlib.colormaps["tab10"].colors  # of the actions, in every picture: RGB in [0, 1]


# ---- Args ------------------------------------------------------------------------------------------


@dataclasses.dataclass
class Args:
    """One unit of time: a FRAME is a frame that the agent observes = one action of the agent = 4 emulator frames, if it
    was trained with Table 3's action repeat."""

    network: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NETWORK]")] = ""
    """A q_network.pt, or the run directory that holds it; by default the newest under --runs-dir, else the published
    Pong agent."""
    games: int = 1
    """Games to play: the first is shown, all are in the mean and variance of score and length [Table 5]."""
    epsilon: float = 0.05
    """ε, probability of a random action [Table 3, agent_epsilon_greedy_epsilon_evaluation]."""
    seed: int = 1
    """Seed of the random actions and of the no-operations that a game begins with; same seed, same trace."""
    moments: int = 3
    """Largest drops or rises of the value to show, three frames each [Figures 21, 22, 24, …]."""
    video_seconds: float = math.inf
    """Length of the video, seconds from the game's beginning; inf shows the whole game."""
    show_layers: bool = False
    """Draw the filters of the first layer too, in filters.png [Table 2: 32 of 8×8 pixels, for each of 4 frames]."""
    runs_dir: str = "runs"
    """Folder in which the newest run is looked for."""


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


def check_flags(args: Args) -> None:
    """Raise ValueError, with the flag's name, for a value that no game can be played with."""
    if not 0 <= args.epsilon <= 1:
        raise ValueError(f"--epsilon must lie between 0 and 1, not {args.epsilon}")
    for name, least in (("games", 1), ("moments", 1), ("seed", 0)):
        if getattr(args, name) < least:
            raise ValueError(f"--{name} must be at least {least}, not {getattr(args, name)}")
    if not args.video_seconds > 0:
        raise ValueError(f"--video-seconds must be above 0, not {args.video_seconds}")


# ---- problem: the Atari environment and its wrappers -----------------------------------------------
#
#   emulator frame   1  2  3  4  5  6  7  8  9 10 11 12      60 a second, each in the video
#   action           a₁ ────────  a₂ ────────  a₃ ───────    repeated 4 times, rewards summed
#   max-pool               3∨4         7∨8       11∨12       of the last two: the coloured screens of moments.png
#   frame          x₀       x₁          x₂          x₃       grey, 84×84: what the agent observes, its unit of time
#   state           (x₀,x₀,x₀,x₁) (x₀,x₀,x₁,x₂) (x₀,x₁,x₂,x₃)


class Recorder(gym.Wrapper):
    """Directly round the emulator: keeps every emulator frame of the game that is being played, no-operations and the
    four of an action's repetition included, as (LZ4 of its (210, 160, 3) uint8 screen, score so far, lives). 108,000
    screens take 10.9 GB raw."""

    def keep(self, screen: np.ndarray, reward: float, info: dict) -> None:
        self.score += reward
        self.recording.append((lz4.block.compress(screen), self.score, info["lives"]))

    def reset(self, **kwargs):
        screen, info = self.env.reset(**kwargs)
        self.score, self.recording = 0.0, []
        self.keep(screen, 0.0, info)
        return screen, info

    def step(self, action: int):
        screen, reward, terminated, truncated, info = self.env.step(action)
        self.keep(screen, reward, info)
        return screen, reward, terminated, truncated, info


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


def evaluation_environment(env: gym.Env, args: types.SimpleNamespace, rng: np.random.Generator) -> gym.Env:
    """Stack the transformations in the order of Figure 17: dqn_atari.py's `preprocess` without what training adds."""
    env = JoystickActions(env)
    env = NoOpReset(env, args.environment_no_op_max, rng)
    env = MaxPool(env, args.environment_frames_to_maxpool)
    env = ActionRepeat(env, args.agent_action_repeat)
    env = Greyscale(env)
    env = Downsample(env, args.environment_state_height, args.environment_state_width)
    return FrameHistory(env, args.agent_history_length, torch.from_numpy)


def wrapper(env: gym.Env, kind: type[gym.Wrapper]) -> gym.Wrapper:
    """The wrapper of class `kind` in a stack."""
    while not isinstance(env, kind):
        env = env.env
    return env


# ---- memory: recorded screens ----------------------------------------------------------------------


def decode_screen(code: bytes) -> np.ndarray:
    """The (210, 160, 3) uint8 RGB screen that was kept as LZ4 bytes; a few games have 250 lines."""
    return np.frombuffer(lz4.block.decompress(code), np.uint8).reshape(-1, 160, 3)


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


def find_network(args: Args) -> Path:
    """The q_network.pt to play: the one that is named, the newest run's, or the published Pong agent's. Raises
    ValueError if there is none."""
    if args.network:
        path = Path(args.network)
        path = path / "q_network.pt" if path.is_dir() else path
        if not path.is_file():
            raise ValueError(f"there is no network {path}")
        return path
    runs = Path(args.runs_dir)  # an ablation's are a folder deeper
    found = [path for path in runs.rglob("q_network.pt") if "published" not in path.relative_to(runs).parts]
    if found:
        return max(found, key=lambda path: path.stat().st_mtime)
    for runs in (Path(args.runs_dir), Path(__file__).resolve().parent.parent / "runs"):
        path = runs / "published" / "pong" / "q_network.pt"
        if path.is_file():
            return path
    raise ValueError(f"no network to play: no run under {args.runs_dir} and no published agent; "
                     "name a q_network.pt, or train one with dqn_atari.py")


def load_q_network(path: Path) -> tuple[QNetwork, types.SimpleNamespace, int]:
    """The network that dqn_atari.py wrote to `path`, the flags that it was trained with and the frames that it was
    trained for. Nothing in the file is run (weights_only), and everything is checked before it is used. Raises
    ValueError with one line for whatever is no such network."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
            if damaged:
                raise ValueError(f"the checksum of its member {damaged} is wrong")
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:  # PyTorch's own message advises to run it
            raise ValueError("it holds objects that could run code; they were not loaded") from None
        if not isinstance(saved, dict):
            raise ValueError(f"it holds a {type(saved).__name__}")
        if saved["format"] != Q_NETWORK_FORMAT:
            raise ValueError(f"its format is {saved['format']!r}, this script plays {Q_NETWORK_FORMAT!r}")

        counts = {"environment_no_op_max": 0, "environment_frames_to_maxpool": 1, "agent_action_repeat": 1,
                  "agent_history_length": 1, "environment_state_height": 36, "environment_state_width": 36}
        for name, least in counts.items():
            value = saved["args"][name]
            if type(value) is not int or value < least:
                raise ValueError(f"its {name} is {value!r}")
        if type(saved["frames"]) is not int:
            raise ValueError(f"its frames are {saved['frames']!r}")
        trained = types.SimpleNamespace(**saved["args"])
        shape = trained.environment_state_height, trained.environment_state_width
        actions = JoystickActions(make_emulator(trained.env_id)).meanings
        if saved["actions"] != actions:
            raise ValueError(f"its actions are {saved['actions']}, those of {trained.env_id} are {actions}")

        with torch.device("meta"):  # shapes alone: a file's numbers allocate nothing
            q_network = QNetwork(trained.agent_history_length, *shape, len(actions))
        expected, found = q_network.state_dict(), saved["q_network"]
        if not isinstance(found, dict) or found.keys() != expected.keys():
            raise ValueError("its parameters are not those of Table 2")
        for name, tensor in found.items():
            if (tensor.shape, tensor.dtype) != (expected[name].shape, torch.float32):
                raise ValueError(f"its {name} is {tensor.dtype} {tuple(tensor.shape)}, a network of {len(actions)} "
                                 f"actions needs {torch.float32} {tuple(expected[name].shape)}")
            if not tensor.isfinite().all():
                raise ValueError(f"its {name} is not finite")
        q_network.load_state_dict(found, assign=True)
    except Exception as error:  # a damaged or hostile file can raise anything; none of it is a reason to go on
        reason = f"it lacks {error}" if isinstance(error, KeyError) else str(error) or "it is damaged"
        reason = reason.splitlines()[0]
        raise ValueError(f"{path} is no q_network.pt of dqn_atari.py: {reason}") from None
    return q_network, trained, saved["frames"]


# ---- algorithm: the ε-greedy policy ----------------------------------------------------------------


@torch.inference_mode()
def action_values(q_network: QNetwork, state: torch.Tensor) -> np.ndarray:
    """Q(s, ·; θ) of one state (4, 84, 84) uint8: (num_actions,) float32."""
    return q_network(state.unsqueeze(0)).squeeze(0).numpy()  # (num_actions,)


@dataclasses.dataclass
class Frame:
    """What the agent saw and thought in the state of one frame, what it did, and what that brought."""

    q: np.ndarray  # Q(s, ·; θ), (num_actions,) float32
    action: int
    greedy: bool  # False: drawn at random
    reward: float  # raw, of the action
    lives: int  # after the action
    screen: bytes  # what the agent saw, before the action: max-pooled, in colour, LZ4
    recorded: int  # emulator frames of the game so far, this one's included, the action's not

    @property
    def value(self) -> np.float32:
        # V(s) = max_a Q(s, a; θ)
        return self.q.max()

    @property
    def best(self) -> int:
        # π(s) = argmax_a Q(s, a; θ)                                                        (Equation 35)
        return int(self.q.argmax())


# ---- evaluation: a game, and where its value jumps -------------------------------------------------


def play(env: gym.Env, q_network: QNetwork, epsilon: float, exploration: np.random.Generator,
         state: tuple, bar: tqdm) -> list[Frame]:
    """Play one whole game from its first state, ε-greedily, for raw reward; returns its frames."""
    pool, recorder, frames = wrapper(env, MaxPool), wrapper(env, Recorder), []
    terminated = truncated = False
    while not (terminated or truncated):
        q = action_values(q_network, torch.stack(state))  # (num_actions,)
        greedy = exploration.random() >= epsilon
        action = int(q.argmax()) if greedy else int(exploration.integers(len(q)))
        screen = functools.reduce(np.maximum, pool.screens)  # (210, 160, 3) uint8
        recorded = len(recorder.recording)
        state, reward, terminated, truncated, info = env.step(action)
        frames.append(Frame(q, action, greedy, float(reward), info["lives"], lz4.block.compress(screen), recorded))
        bar.set_postfix_str(f"score {recorder.score:g}, value {q.max():.3f}", refresh=False)
        bar.update()
    return frames


def largest_jumps(values: np.ndarray, count: int) -> list[int]:
    """The frames t of the `count` largest |V(s_t) - V(s_{t-1})| of a game's values (T,), in order of time. The three
    frames t-1, t, t+1 of a moment appear in no other, so that one event is one moment; a jump into the last frame is
    shown with that frame as the third; T < 3 frames hold none."""
    changes = np.abs(np.diff(values))  # (T - 1,)
    moments: list[int] = []
    for before in np.argsort(-changes, kind="stable"):
        t = min(int(before) + 1, len(values) - 2)
        if t >= 1 and all(abs(t - other) >= 3 for other in moments):
            moments.append(t)
        if len(moments) == count:
            break
    return sorted(moments)


# ---- report and checkpoint -------------------------------------------------------------------------


def bar_style() -> dict:
    """tqdm's settings: a live bar in a terminal, an update a minute in a log."""
    return dict(mininterval=0.5 if sys.stderr.isatty() else 60, dynamic_ncols=True, smoothing=0.05)


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


def write_csv(path: Path, rows: list[dict]) -> None:
    """Atomically write rows under one header."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, rows[0], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def save_trace(path: Path, frames: list[Frame], actions: list[str]) -> None:
    """A row per frame; reward and lives are what the action brought."""
    write_csv(path, [
        {"frame": t, "value": frame.value} | {f"q_{name}": q for name, q in zip(actions, frame.q, strict=True)}
        | {"action": actions[frame.action], "choice": "greedy" if frame.greedy else "random", "reward": frame.reward,
           "lives": frame.lives} for t, frame in enumerate(frames)])


def save_figure_file(path: Path, figure: Figure) -> None:
    """Atomically write a PNG."""
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=100))


def save_values(path: Path, frames: list[Frame], moments: list[int], actions: list[str], title: str) -> None:
    """Figure 20: value, Q of every action and best action against the frame, with the game's events."""
    values = np.array([frame.value for frame in frames])  # (T,)
    q = np.stack([frame.q for frame in frames])  # (T, num_actions)
    rewards = np.array([frame.reward for frame in frames])  # (T,)
    lost = 1 + np.flatnonzero(np.diff([frame.lives for frame in frames]) < 0)  # frames whose action cost a life
    best = q.argmax(axis=1)  # (T,)

    figure = Figure(figsize=(15, 9), layout="constrained")
    figure.suptitle(title)
    top, middle, bottom = figure.subplots(3, sharex=True, height_ratios=(4, 4, 2))
    top.plot(values, color="black", linewidth=0.8, label="value")
    for label, marker, colour, scored in (("reward > 0", "^", "tab:green", rewards > 0),
                                          ("reward < 0", "v", "tab:red", rewards < 0)):
        if scored.any():
            top.plot(np.flatnonzero(scored), values[scored], marker, color=colour, markersize=5, label=label)
    for number, axes in itertools.product(range(len(lost)), (top, middle, bottom)):
        axes.axvline(lost[number], color="tab:red", linestyle="--", linewidth=0.8,
                     label="lost life" if axes is top and number == 0 else None)
    for number, t in enumerate(moments, start=1):
        top.annotate(f"moment {number}", (t, values[t]), (0, 24), textcoords="offset points", ha="center", fontsize=9,
                     arrowprops={"arrowstyle": "->"})
    top.margins(y=0.15)  # room for the arrows
    top.set_ylabel("value  max Q(s, a)")
    for number, name in enumerate(actions):
        middle.plot(q[:, number], color=COLOURS[number], linewidth=0.8, label=name)
        chosen = np.flatnonzero(best == number)
        bottom.plot(chosen, np.full(len(chosen), number), "|", color=COLOURS[number], markersize=7)
    middle.set_ylabel("Q(s, a)")
    bottom.set_yticks(range(len(actions)), actions)
    bottom.set_ylim(len(actions) - 0.5, -0.5)
    bottom.set_ylabel("best action")
    bottom.set_xlabel("frame")
    bottom.set_xlim(0, len(frames) - 1)
    for axes in (top, middle):
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    save_figure_file(path, figure)


def save_moments(path: Path, frames: list[Frame], moments: list[int], actions: list[str], title: str) -> None:
    """Figures 21, 22, 24, …: three consecutive frames of every moment, as the agent saw them but in colour, each with
    its number, its value and the action taken."""
    figure = Figure(figsize=(10, 0.6 + 4.6 * len(moments)), layout="constrained")
    figure.suptitle(title)
    rows = figure.subplots(len(moments), 3, squeeze=False)
    for number, (t, row) in enumerate(zip(moments, rows, strict=True), start=1):
        for i, axes in zip((t - 1, t, t + 1), row, strict=True):
            frame = frames[i]
            axes.imshow(decode_screen(frame.screen))
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_title(f"frame {i}\nvalue {frame.value:.3f}\n{actions[frame.action]}"
                           + ("" if frame.greedy else " (random)"), fontsize=11)
        jump = frames[t].value - frames[t - 1].value
        if t == len(frames) - 2:  # it stands for the jump into the last frame too
            jump = max(jump, frames[t + 1].value - frames[t].value, key=abs)
        row[0].set_ylabel(f"moment {number}: value {jump:+.3f}", fontsize=12)
    save_figure_file(path, figure)


def save_filters(path: Path, q_network: QNetwork, title: str) -> None:
    """The first layer's 32 filters (32, 4, 8, 8), each as its four 8×8 patches, from the oldest frame to the newest."""
    filters = q_network.layers.conv1.weight.detach().numpy()  # (32, 4, 8, 8)
    limit = np.abs(filters).max()
    figure = Figure(figsize=(16, 10), layout="constrained")
    figure.suptitle(f"{title}: filters of the first layer, each over {filters.shape[1]} frames, oldest to newest")
    figure.get_layout_engine().set(wspace=0.08)
    panels = figure.subplots(8, 4)  # 32 filters
    for number, (axes, patches) in enumerate(zip(panels.flat, filters, strict=True)):
        framed = np.pad(patches, ((0, 0), (0, 0), (0, 1)), constant_values=np.nan)  # (4, 8, 9)
        image = axes.imshow(np.hstack(framed)[:, :-1], cmap="RdBu_r", vmin=-limit, vmax=limit)  # (8, 35)
        axes.set_axis_off()
        axes.set_title(f"{number + 1}", fontsize=9, pad=2)
    figure.colorbar(image, ax=panels, shrink=0.5, label="weight")
    save_figure_file(path, figure)


@contextlib.contextmanager
def silent_stderr() -> Iterator[None]:
    """OpenCV's encoder writes to file descriptor 2, about its codec tag every time, and no flag keeps that back."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


WHITE, GREY, DARK, RED = (255, 255, 255), (150, 150, 150), (30, 30, 30), (80, 80, 255)  # of the panel: BGR


def write_text(image: np.ndarray, text: str, x: int, y: int, colour: tuple[int, int, int] = WHITE) -> None:
    """Draw one line of ASCII text, its left end on the base line at (x, y)."""
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)


class Panel:
    """The picture beside the game: what the agent thinks, and the curve of its value so far. The axes are those of the
    whole game, so nothing is drawn twice: a frame adds one segment to the curve."""

    width, left, right, bars_top, bar_step = 400, 100, 330, 78, 24

    def __init__(self, height: int, frames: list[Frame], actions: list[str], title: str):
        self.frames, self.actions = frames, actions
        q = np.stack([frame.q for frame in frames])  # (T, num_actions)
        self.q_low, self.q_high = min(q.min(), 0), max(q.max(), 1e-6)
        self.low, self.high = q.max(axis=1).min(), q.max(axis=1).max()
        self.top, self.bottom = self.bars_top + self.bar_step * len(actions) + 36, height - 16
        self.background = np.full((height, self.width, 3), DARK, np.uint8)  # (height, 400, 3) BGR
        write_text(self.background, title, 10, 22)
        cv2.line(self.background, (self.column(0), self.bars_top - 6),
                 (self.column(0), self.bars_top + self.bar_step * len(actions) - 4), GREY)  # Q = 0
        write_text(self.background, "value", 10, self.top - 12, GREY)
        write_text(self.background, f"{self.high:.2f}", self.right + 8, self.top + 6, GREY)
        write_text(self.background, f"{self.low:.2f}", self.right + 8, self.bottom, GREY)
        cv2.rectangle(self.background, (10, self.top), (self.right, self.bottom), GREY)

    def point(self, t: int) -> tuple[int, int]:
        """Pixel of frame t on the curve."""
        across = t / max(len(self.frames) - 1, 1)
        up = (self.frames[t].value - self.low) / max(self.high - self.low, 1e-6)
        return round(10 + across * (self.right - 10)), round(float(self.bottom - up * (self.bottom - self.top)))

    def column(self, q: float) -> int:
        """Column of the end of a bar that shows q; all bars begin at that of 0."""
        return round(float(self.left + (q - self.q_low) / (self.q_high - self.q_low) * (self.right - self.left)))

    def draw(self, t: int) -> np.ndarray:
        """The panel at frame t, (height, 400, 3) uint8 BGR, without the score; t must go up from 0 by one."""
        frame = self.frames[t]
        cv2.line(self.background, self.point(max(t - 1, 0)), self.point(t), WHITE, 1, cv2.LINE_AA)
        image = self.background.copy()  # (height, 400, 3)
        cv2.circle(image, self.point(t), 3, RED, -1, cv2.LINE_AA)
        write_text(image, f"{frame.value:.3f}", 60, self.top - 12)
        write_text(image, f"frame {t}", 250, 50)

        for number, (name, q) in enumerate(zip(self.actions, frame.q, strict=True)):
            y, best = self.bars_top + number * self.bar_step, number == frame.best
            colour = tuple(255 * channel for channel in reversed(COLOURS[number]))
            cv2.rectangle(image, (self.column(0), y), (self.column(q), y + 14), colour, -1)
            if best:
                cv2.rectangle(image, (self.left - 3, y - 3), (self.right + 3, y + 17), WHITE)
            write_text(image, f"{q:.3f}", self.right + 10, y + 12, WHITE if best else GREY)
            write_text(image, name, 28, y + 12, WHITE if best else GREY)
            if number == frame.action:  # a red arrow: the agent did not choose this one
                cv2.arrowedLine(image, (8, y + 7), (24, y + 7), WHITE if frame.greedy else RED, 2, tipLength=0.5)
        return image


def save_video(path: Path, recording: list[tuple], frames: list[Frame], actions: list[str], title: str) -> None:
    """VP8 in WebM: every emulator frame, twice as large, beside the panel of the agent's frame that it belongs to: the
    state's screen shows the action before, so the panel changes when the action starts. Raises OSError."""
    height, screen_width = (2 * side for side in decode_screen(recording[0][0]).shape[:2])
    panel = Panel(height, frames, actions, title)
    ends = [*(frame.recorded for frame in frames[1:] if frame.recorded < len(recording)), len(recording)]
    temporary = path.with_name("unfinished-" + path.name)
    with silent_stderr():
        writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"VP80"), FRAMES_PER_SECOND,
                                 (screen_width + panel.width, height))
    try:
        if not writer.isOpened():
            raise OSError(f"OpenCV cannot write {path} in VP8")
        first = 0
        for t, end in enumerate(tqdm(ends, desc="video", unit="frame", **bar_style())):
            thought = panel.draw(t)  # (height, 400, 3)
            with silent_stderr():
                for code, score, lives in recording[first:end]:
                    screen = decode_screen(code).repeat(2, axis=0).repeat(2, axis=1)  # (420, 320, 3) RGB
                    image = np.hstack([cv2.cvtColor(screen, cv2.COLOR_RGB2BGR), thought])  # (420, 720, 3) BGR
                    write_text(image, f"score {score:g}", screen_width + 10, 50)
                    write_text(image, f"lives {lives}", screen_width + 140, 50)
                    writer.write(image)
            first = end
        with silent_stderr():
            writer.release()
            written = cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written != len(recording):  # the encoder raises nothing on a full disk
            raise OSError(f"{path}: of {len(recording)} frames {max(written, 0):g} reached the disk; is it full?")
        os.replace(temporary, path)
    finally:
        writer.release()  # before the file is removed, which Windows refuses for an open one
        temporary.unlink(missing_ok=True)


# ---- main ------------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Play, then show what the agent thought."""
    try:
        check_flags(args)
        path = find_network(args)
        q_network, trained, trained_frames = load_q_network(path)
        folder = path.parent / f"play-seed{args.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
        try:
            folder.mkdir()
        except OSError as error:
            raise ValueError(f"{folder} cannot be made: {error.strerror or error}") from None
    except ValueError as error:
        fail(str(error))

    torch.set_num_threads(1)  # one state at a time gains nothing from more, and their number would round Q differently
    exploration, no_ops = (np.random.default_rng(seed) for seed in np.random.SeedSequence(args.seed).spawn(2))
    env = evaluation_environment(Recorder(make_emulator(trained.env_id)), trained, no_ops)
    actions, recorder = wrapper(env, JoystickActions).meanings, wrapper(env, Recorder)
    print(f"network  {path}: {trained.env_id}, trained for {trained_frames:,} frames\n"
          f"actions  {' '.join(actions)}; epsilon {args.epsilon:g}, seed {args.seed}", flush=True)

    try:
        finished = []
        for number in range(1, args.games + 1):
            state, _ = env.reset(seed=args.seed if number == 1 else None)
            with tqdm(desc=f"game {number} of {args.games}", unit="frame", **bar_style()) as bar:
                played = play(env, q_network, args.epsilon, exploration, state, bar)
            finished.append((recorder.score, len(played)))
            print(f"game {number}   score {recorder.score:g}, length {len(played):,} frames", flush=True)
            if number == 1:
                frames, recording = played, recorder.recording
        if args.games > 1:
            print(f"{'Game':<28}{'Episode Score Mean':>20}{'Variance':>12}{'Episode Length Mean':>21}{'Variance':>12}"
                  f"{'Games':>7}")
            scores, lengths = zip(*finished, strict=True)
            print(f"{trained.env_id:<28}{np.mean(scores):>20.5g}{np.var(scores):>12.5g}{np.mean(lengths):>21.5g}"
                  f"{np.var(lengths):>12.5g}{args.games:>7}")

        score, title = finished[0][0], f"{trained.env_id}, seed {args.seed}"
        moments = largest_jumps(np.array([frame.value for frame in frames]), args.moments)
        save_trace(folder / "trace.csv", frames, actions)
        save_values(folder / "values.png", frames, moments, actions, f"{title}: score {score:g}, {len(frames)} frames")
        if moments:
            save_moments(folder / "moments.png", frames, moments, actions, f"{title}: where the value jumps")
        if args.show_layers:
            save_filters(folder / "filters.png", q_network, trained.env_id)
        shown = recording[: math.ceil(min(args.video_seconds * FRAMES_PER_SECOND, len(recording)))]
        save_video(folder / "episode.webm", shown, frames, actions, trained.env_id)
    except KeyboardInterrupt:
        print(f"stopped; what was finished is in {folder}", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    print(f"wrote    {folder}: {', '.join(sorted(file.name for file in folder.iterdir()))}")


if __name__ == "__main__":
    main(parse_args(Args))
