# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "gymnasium>=1.1", "lz4", "matplotlib>=3.9", "numpy>=1.26",
#     "opencv-python-headless", "pillow>=10.1", "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
"""Watch a trained agent play and think: the pictures of §7.4 (ECE 544NA, Lecture 27, Figures 20 to
32) and a video, for any game and any q_network.pt of dqn_atari.py or of the scripts made from it.

Run it
    python algorithms/dqn_atari_play.py --game pong        # an agent of runs/published
    python algorithms/dqn_atari_play.py runs/RUN           # a run, or its q_network.pt
    python algorithms/dqn_atari_play.py                    # the newest run under runs/
    python algorithms/dqn_atari_play.py --games 30         # only mean and variance of the score

In a new folder beside q_network.pt, or in --output:
    episode.webm   the game, 15 frames a second, with Q of every action and the value beside it
    play.gif       twelve seconds of the same
    values.png     Figure 20: value, Q of every action and best action against the frame
    moments.png    Figures 21, 22, 24, …: three frames around each large jump of the value
    trace.csv      frame, value, Q of every action, action, greedy or random, reward, lives

Measured
    TODO

Deviations
    lecture                        this file                            why
    -----------------------------  -----------------------------------  ----------------------------
    moments are chosen by hand     the largest changes of the value     one rule for every game
    curves alone                   scores and lost lives are marked     they explain the jumps
"""

import dataclasses
import io
import math
import os
import sys
import time
import types
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import ale_py
import cv2
import gymnasium as gym
import lz4.block
import numpy as np
import torch
import tyro
from gymnasium.wrappers import ClipReward, RecordEpisodeStatistics, TransformObservation
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import nn
from tqdm import tqdm

FRAMES_PER_SECOND = 15  # 60 emulator frames, each action repeated 4 times
GIF_SECONDS, GIF_BYTES = 12, 1_500_000  # a GIF that is larger gets shorter
PUBLISHED = Path(__file__).resolve().parent.parent / "runs" / "published"

# ---- Args ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Args:
    """A FRAME is what the agent observes: one action, 4 emulator frames."""

    run: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[RUN]")] = ""
    """run directory, or its q_network.pt; by default the newest under runs/, else published Pong"""
    game: str = ""
    """folder of runs/published to take instead, for example pong"""
    games: int = 1
    """games to play; more than one gives mean and variance of score and length, and no pictures"""
    epsilon: float = 0.05
    """ε, probability of a random action"""
    seed: int = 1
    """of the random actions and of the no-operations that a game starts with"""
    moments: int = 3
    """largest jumps of the value to show"""
    video_seconds: float = math.inf
    """length of episode.webm from the start of the game; 0 writes none"""
    gif_start: float = 0.0
    """second of the game at which play.gif starts"""
    output: str = ""
    """folder to write to, instead of a new one beside q_network.pt"""


# ---- problem: the Atari environment and its wrappers ---------------------------------------------
#
#   emulator frame   1  2  3  4  5  6  7  8  9 10 11 12   60 a second
#   action           a₁ ────────  a₂ ────────  a₃ ─────── repeated 4 times, rewards summed
#   max-pool               3∨4         7∨8       11∨12    some sprites are drawn every other frame
#   frame          x₀       x₁          x₂          x₃    grey, 84×84: the agent's unit of time
#   state           (x₀,x₀,x₀,x₁) (x₀,x₀,x₁,x₂) (x₀,x₁,x₂,x₃)


class JoystickActions(gym.ActionWrapper):
    """The game's minimal actions within NOOP, FIRE, UP, RIGHT, LEFT, DOWN (§7.3.3): `meanings`."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        minimal = env.unwrapped.get_action_meanings()
        joystick = ("NOOP", "FIRE", "UP", "RIGHT", "LEFT", "DOWN")
        self.meanings = [name for name in minimal if name in joystick]
        self.indices = [minimal.index(name) for name in self.meanings]
        self.action_space = gym.spaces.Discrete(len(self.meanings))

    def action(self, action: int) -> int:
        return self.indices[action]


class NoOpReset(gym.Wrapper):
    """A game starts with 0 to `no_op_max` no-operations, emulator frames, from `rng` (§7.2.1)."""

    def __init__(self, env: gym.Env, no_op_max: int, rng: np.random.Generator):
        super().__init__(env)
        self.no_op_max, self.rng = no_op_max, rng

    def reset(self, **kwargs):
        screen, info = self.env.reset(**kwargs)
        for _ in range(self.rng.integers(self.no_op_max + 1)):
            screen, _, _, _, info = self.env.step(0)
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
    it reset the emulator, the later lives would never be seen; if it stepped, a frame would be.
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
    """The game with the transformations of Figure 16 (training) or 17 (without the last `if`).

    Nothing is skipped or repeated at random; after 108,000 emulator frames a game is truncated.
    Exits with one line for a name that is no Atari game.
    """
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner
    gym.register_envs(ale_py)  # gives Gymnasium the names; the ROMs are in ale-py's wheel
    try:
        env = gym.make(args.env_id, frameskip=1, repeat_action_probability=0.0,
                       full_action_space=False, max_num_frames_per_episode=108_000)
    except (gym.error.Error, TypeError) as error:  # a TypeError: another kind of game
        raise SystemExit(f"error: {args.env_id} is no Atari game: {error}") from None
    env = JoystickActions(env)
    no_ops = args.environment_no_op_max if "NOOP" in env.meanings else 0
    env = NoOpReset(env, no_ops, no_op_rng)
    env = ActionRepeat(env, args.agent_action_repeat, args.environment_frames_to_maxpool)
    # Colour to luminance, 0.299 R + 0.587 G + 0.114 B; then bilinear downsampling.
    size = (args.environment_state_width, args.environment_state_height)
    pixels = gym.spaces.Box(0, 255, size[::-1], np.uint8)  # (84, 84)
    env = TransformObservation(env, lambda screen: cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY), None)
    env = TransformObservation(env, lambda grey: cv2.resize(grey, size), pixels)
    env = RecordEpisodeStatistics(env)  # a game's raw score, and its length in frames
    if training:
        limit = args.environment_reward_clip_limit
        env = LifeLoss(ClipReward(env, -limit, limit))
    return env

# ---- network -------------------------------------------------------------------------------------


class QNetwork(nn.Module):
    """Table 2: states (B, 4, 84, 84) uint8 to Q(s, ·; θ) (B, num_actions) float32."""

    def __init__(self, history_length: int, height: int, width: int, num_actions: int):
        super().__init__()
        for kernel, stride in ((8, 4), (4, 2), (3, 1)):  # 84 -> 20 -> 9 -> 7
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        self.layers = nn.Sequential(
            nn.Conv2d(history_length, 32, 8, stride=4), nn.ReLU(inplace=True),  # (B, 32, 20, 20)
            nn.Conv2d(32, 64, 4, stride=2), nn.ReLU(inplace=True),  # (B, 64, 9, 9)
            nn.Conv2d(64, 64, 3, stride=1), nn.ReLU(inplace=True), nn.Flatten(),  # (B, 3136)
            nn.Linear(64 * height * width, 512), nn.ReLU(inplace=True),  # (B, 512)
        )
        self.head = nn.Linear(512, num_actions)  # (B, num_actions)

    def forward(self, states: torch.Tensor) -> torch.Tensor:
        x = self.layers(states / 255)  # (B, 512)
        with torch.autocast(x.device.type, enabled=False):  # Q keeps float32's digits
            return self.head(x.float())


def find_q_network(args: Args) -> Path:
    """The q_network.pt that the flags name; by default the newest run's, else published Pong's."""
    if args.run:
        path = Path(args.run)
        return path / "q_network.pt" if path.is_dir() else path
    found = [path for path in Path("runs").rglob("q_network.pt") if "published" not in path.parts]
    if found and not args.game:
        return max(found, key=lambda path: path.stat().st_mtime)
    return PUBLISHED / (args.game or "pong") / "q_network.pt"


def load(path: Path) -> tuple[QNetwork, types.SimpleNamespace]:
    """The network and the flags that it was trained with. Nothing in the file is run. Exits with
    one line if it is not whole, or cannot play its game."""
    try:
        if zipfile.ZipFile(path).testzip():
            raise ValueError("a checksum is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
        trained = types.SimpleNamespace(**content["args"])
        if ":" in trained.env_id:  # Gymnasium would import what stands before it
            raise ValueError(f"{trained.env_id} is no name of a game")
        shape = trained.environment_state_height, trained.environment_state_width
        with torch.device("meta"):  # shapes alone, until they are known to be the file's
            q_network = QNetwork(trained.agent_history_length, *shape, len(content["actions"]))
        q_network.load_state_dict(content["q_network"], assign=True)
        q_network.float()  # published weights may be in half precision
        # A first frame tells whether the flags make an environment, and the network fits it.
        env = make_env(trained, np.random.default_rng(0), training=False)
        env = FrameHistory(env, trained.agent_history_length)
        env.reset()
        q = action_values(q_network, env.step(0)[0], trained)  # (num_actions,)
        if env.get_wrapper_attr("meanings") != content["actions"] or not np.isfinite(q).all():
            raise ValueError("its actions are not the game's, or its Q is no number")
    except Exception as error:  # a damaged or hostile file can raise anything
        reason = " ".join(str(error).split(". ")[0].split())
        reason = f"{type(error).__name__}: {reason:.150}"
        raise SystemExit(f"error: {path} cannot be played: {reason}") from None
    return q_network, trained


# ---- algorithm: the ε-greedy policy --------------------------------------------------------------


@torch.inference_mode()
def action_values(q_network: QNetwork, history: tuple, trained) -> np.ndarray:
    """Q(s, ·; θ) (num_actions,) float32 of the state whose LZ4 frames are `history`."""
    pixels = bytearray().join([lz4.block.decompress(frame) for frame in history])
    shape = 1, -1, trained.environment_state_height, trained.environment_state_width
    state = torch.frombuffer(pixels, dtype=torch.uint8).view(shape)  # (1, 4, 84, 84)
    return q_network(state).squeeze(0).numpy()  # (num_actions,)


@dataclasses.dataclass
class Frame:
    """What the agent saw and thought, what it did, and what that brought."""

    screen: bytes  # LZ4 of (210, 160, 3) uint8 RGB, before the action
    q: np.ndarray  # Q(s, ·; θ), (num_actions,) float32
    action: int
    greedy: bool  # False: drawn at random
    reward: float  # raw, of the action
    lives: int  # after the action
    score: float  # after the action


def play(env: gym.Env, q_network: QNetwork, trained, epsilon: float, rng) -> Iterator[Frame]:
    """One whole game, frame by frame, for raw reward. `env` has just been reset."""
    history, score, over = env.get_wrapper_attr("history"), 0.0, False
    while not over:
        screen = lz4.block.compress(env.unwrapped.ale.getScreenRGB())
        q = action_values(q_network, history, trained)  # (num_actions,)
        # π(s) = argmax_a Q(s, a; θ), with probability ε an action at random     (Equation 35)
        greedy = rng.random() >= epsilon
        action = int(q.argmax()) if greedy else int(rng.integers(len(q)))
        history, reward, terminated, truncated, info = env.step(action)
        score += reward
        over = terminated or truncated
        yield Frame(screen, q, action, greedy, reward, info["lives"], score)


def largest_jumps(values: np.ndarray, count: int) -> list[int]:
    """The frames t, in order of time, of the `count` largest |V(s_t) - V(s_{t-1})| of values (T,).
    They lie a second apart, or one event would fill all, and each has a frame before and after."""
    changes = np.abs(np.diff(values))[:-1]  # (T - 2,), into frames 1 to T - 2
    moments = []
    for t in 1 + np.argsort(-changes, kind="stable"):
        if len(moments) < count and all(abs(t - m) >= FRAMES_PER_SECOND for m in moments):
            moments.append(int(t))
    return sorted(moments)


# ---- report: table, figures, video ---------------------------------------------------------------


def as_csv(rows: list[dict]) -> str:
    """Rows under one header."""
    lines = [rows[0].keys(), *(row.values() for row in rows)]
    return "".join(",".join(map(str, line)) + "\n" for line in lines)


def trace(frames: list[Frame], actions: list[str]) -> list[dict]:
    """A row of trace.csv for every frame."""
    rows = []
    for t, frame in enumerate(frames):
        row = {"frame": t, "value": frame.q.max()}
        row |= {f"q_{name}": q for name, q in zip(actions, frame.q, strict=True)}
        row |= {"action": actions[frame.action], "choice": "greedy" if frame.greedy else "random"}
        rows.append(row | {"reward": frame.reward, "lives": frame.lives})
    return rows


def draw_values(frames: list[Frame], moments: list[int], actions: list[str], title: str) -> Figure:
    """Figure 20: value, Q of every action and best action, with scores and lost lives."""
    q = np.stack([frame.q for frame in frames])  # (T, num_actions)
    value, best = q.max(axis=1), q.argmax(axis=1)  # (T,) each
    rewards = np.array([frame.reward for frame in frames])  # (T,)
    lost = 1 + np.flatnonzero(np.diff([frame.lives for frame in frames]) < 0)

    figure = Figure(figsize=(14, 8), layout="constrained")
    figure.suptitle(title)
    top, middle, bottom = figure.subplots(3, sharex=True, height_ratios=(4, 4, 2))
    top.plot(value, color="0.2", linewidth=0.8, label="value")
    for label, marker, colour, t in (
        ("reward > 0", "^", "tab:green", np.flatnonzero(rewards > 0)),
        ("reward < 0", "v", "tab:red", np.flatnonzero(rewards < 0)),
    ):
        if len(t):
            top.plot(t, value[t], marker, color=colour, markersize=5, label=label)
    for number, t in enumerate(lost):
        for axes in (top, middle, bottom):
            label = "" if number else "lost life"
            axes.axvline(t, color="tab:red", linestyle="--", linewidth=0.8, label=label)
    for number, t in enumerate(moments, start=1):
        top.annotate(f"moment {number}", (t, value[t]), (0, 28), textcoords="offset points",
                     ha="center", fontsize=9, arrowprops={"arrowstyle": "->"})
    for number, name in enumerate(actions):
        middle.plot(q[:, number], color=f"C{number}", linewidth=0.8, label=name)
        t = np.flatnonzero(best == number)
        bottom.plot(t, np.full(len(t), number), "|", color=f"C{number}", markersize=8)
    top.set_ylabel("value  max Q(s, a)")
    top.margins(y=0.15)  # room for the arrows
    middle.set_ylabel("Q(s, a)")
    bottom.set(ylabel="best action", xlabel="frame", xlim=(0, len(frames)))
    bottom.set_yticks(range(len(actions)), actions)
    bottom.set_ylim(len(actions) - 0.5, -0.5)
    for axes in (top, middle):
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def draw_moments(frames: list[Frame], moments: list[int], actions: list[str], title: str) -> Figure:
    """Figures 21, 22, 24, …: a row for each moment, the frames before, at and after the jump."""
    figure = Figure(figsize=(9, 0.5 + 4.3 * len(moments)), layout="constrained")
    figure.suptitle(title)
    rows = figure.subplots(len(moments), 3, squeeze=False)
    for number, (moment, row) in enumerate(zip(moments, rows, strict=True), start=1):
        for t, axes in zip(range(moment - 1, moment + 2), row, strict=True):
            frame = frames[t]
            choice = actions[frame.action] if frame.greedy else f"{actions[frame.action]} (random)"
            axes.imshow(decode_screen(frame))
            axes.set(xticks=[], yticks=[])
            axes.set_title(f"frame {t}\nvalue {frame.q.max():.3f}\n{choice}", fontsize=11)
        jump = frames[moment].q.max() - frames[moment - 1].q.max()
        row[0].set_ylabel(f"moment {number}: value {jump:+.3f}", fontsize=12)
    return figure


def decode_screen(frame: Frame) -> np.ndarray:
    """The (210, 160, 3) uint8 RGB screen; a few games have 250 lines."""
    pixels = lz4.block.decompress(frame.screen)
    return np.frombuffer(pixels, np.uint8).reshape(-1, 160, 3)


def pictures(frames: list[Frame], shown: range, actions: list[str], title: str) -> Iterator:
    """A picture for every frame in `shown`: the screen, twice as large, and what the agent thinks.
    Bars start at Q = 0, the best action stands in a box, an arrow (red if random) is at the one
    taken; below is the value of the last 20 seconds. All have the scale of the whole game."""
    white, grey, red, dark = (255, 255, 255), (150, 156, 170), (255, 70, 70), (22, 24, 32)
    colours = [tuple(int(255 * c) for c in colour[:3]) for colour in colormaps["tab10"].colors]
    large, small = ImageFont.load_default(20), ImageFont.load_default(15)
    q = np.stack([frame.q for frame in frames])  # (T, num_actions)
    value = q.max(axis=1)  # (T,)
    height, width = 2 * len(decode_screen(frames[0])), 320
    top, bottom = 130 + 27 * len(actions), height - 14  # of the curve
    left, right = width + 104, width + 304  # of the bars
    zero, unit = min(q.min(), 0), (right - left) / (max(q.max(), 0) - min(q.min(), 0) + 1e-9)
    curve_left, curve_width = width + 20, 300
    rows = (top, bottom - 4)

    def level(v: float) -> float:
        """Row of a value on the curve."""
        share = (v - value.min()) / (value.max() - value.min() + 1e-9)
        return rows[1] - share * (rows[1] - rows[0])

    for t in shown:
        frame = frames[t]
        image = Image.new("RGB", (width + 400, height), dark)
        image.paste(Image.fromarray(decode_screen(frame)).resize((width, height), 0))
        draw = ImageDraw.Draw(image)
        draw.text((width + 20, 12), title, white, large)
        status = f"score {frame.score:g}     lives {frame.lives}     frame {t}"
        draw.text((width + 20, 44), status, grey, small)
        origin = left - zero * unit
        for a, name in enumerate(actions):
            y, best = 80 + 27 * a, a == q[t].argmax()
            ends = sorted((origin, origin + q[t, a] * unit))
            draw.rectangle((ends[0], y, ends[1], y + 15), colours[a])
            if best:
                draw.rectangle((left - 5, y - 4, right + 5, y + 19), None, white)
            colour = white if best else grey
            draw.text((width + 42, y - 1), name, colour, small)
            draw.text((right + 72, y - 1), f"{q[t, a]:.3f}", colour, small, anchor="ra")
            if a == frame.action:
                x = width + 20
                arrow = (x, y + 2), (x + 14, y + 8), (x, y + 14)
                draw.polygon(arrow, white if frame.greedy else red)
        draw.line((origin, 76, origin, 72 + 27 * len(actions)), grey)
        draw.text((width + 20, top - 30), f"value {value[t]:.3f}", white, small)
        for v, y in ((value.max(), rows[0]), (value.min(), rows[1])):
            draw.text((right + 72, y), f"{v:.2f}", grey, small, anchor="rm")
        past = np.arange(max(0, t - curve_width + 1), t + 1)
        points = [(curve_left + i, level(value[s])) for i, s in enumerate(past)]
        draw.line([*points, points[-1]], white, 2)
        x, y = points[-1]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), red)
        yield image


def open_video(path: Path, size: tuple[int, int]) -> cv2.VideoWriter:
    """A WebM in VP8, which browsers play. OpenCV remarks on VP8's tag, past Python's stderr."""
    stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        codec = cv2.VideoWriter_fourcc(*"VP80")
        return cv2.VideoWriter(str(path), codec, FRAMES_PER_SECOND, size)
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(nowhere)


def write_gif(path: Path, images: list[Image.Image]) -> None:
    """An endless GIF in one palette, taken from the first, middle and last image. It is shortened
    until it fits GIF_BYTES."""
    some = np.vstack([images[0], images[len(images) // 2], images[-1]])  # (3 H, W, 3)
    palette = Image.fromarray(some).quantize(64)
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    while True:
        file = io.BytesIO()
        images[0].save(file, "GIF", save_all=True, append_images=images[1:], loop=0,
                       duration=1000 // FRAMES_PER_SECOND)
        if file.tell() <= GIF_BYTES or len(images) == 1:
            break
        images = images[: int(0.95 * len(images) * GIF_BYTES / file.tell())]
    path.write_bytes(file.getvalue())


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Play, then show what the agent thought."""
    for name, low in (("epsilon", 0), ("seed", 0), ("games", 1), ("moments", 1),
                      ("video_seconds", 0), ("gif_start", 0)):
        if not low <= getattr(args, name) <= (1 if name == "epsilon" else math.inf):
            raise SystemExit(f"error: --{name.replace('_', '-')} cannot be {getattr(args, name)}")
    torch.set_num_threads(1)  # one state at a time gains nothing from more
    path = find_q_network(args)
    q_network, trained = load(path)
    seeds = np.random.SeedSequence(args.seed).spawn(2)
    exploration_rng, no_op_rng = [np.random.default_rng(seed) for seed in seeds]
    env = make_env(trained, no_op_rng, training=False)
    env = FrameHistory(env, trained.agent_history_length)
    actions = env.get_wrapper_attr("meanings")
    env.reset(seed=args.seed)
    print(f"{path}: {trained.env_id}, {' '.join(actions)}; ε {args.epsilon:g}, seed {args.seed}")

    results = []
    for game in range(1, args.games + 1):
        bar = tqdm(desc=f"game {game}", unit=" frames", delay=2, leave=False)
        frames = []
        for frame in play(env, q_network, trained, args.epsilon, exploration_rng):
            frames.append(frame)
            bar.update()
        bar.close()
        results.append((frames[-1].score, len(frames)))
        print(f"game {game}: score {frames[-1].score:g}, {len(frames):,} frames")
        if game < args.games:
            env.reset()
    if args.games > 1:
        for name, values in zip(("score", "length"), np.transpose(results), strict=True):
            print(f"{name:6}  mean {values.mean():.5g}, variance {values.var():.5g}")
        return

    folder = path.parent / f"play-seed{args.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = Path(args.output or folder)
    try:
        folder.mkdir(parents=True, exist_ok=bool(args.output))
    except OSError as error:
        raise SystemExit(f"error: {folder} cannot be made: {error}") from None
    moments = largest_jumps(np.array([frame.q.max() for frame in frames]), args.moments)
    title = f"{trained.env_id}, seed {args.seed}: score {frames[-1].score:g}"
    (folder / "trace.csv").write_text(as_csv(trace(frames, actions)))
    draw_values(frames, moments, actions, title).savefig(folder / "values.png", dpi=100)
    if moments:
        draw_moments(frames, moments, actions, title).savefig(folder / "moments.png", dpi=100)

    start = min(int(args.gif_start * FRAMES_PER_SECOND), len(frames) - 1)
    shown = range(start, min(start + GIF_SECONDS * FRAMES_PER_SECOND, len(frames)))
    write_gif(folder / "play.gif", list(pictures(frames, shown, actions, trained.env_id)))
    shown = range(math.ceil(min(args.video_seconds * FRAMES_PER_SECOND, len(frames))))
    images = pictures(frames, shown, actions, trained.env_id)
    video = None
    for image in tqdm(images, "video", len(shown), delay=2, leave=False):
        video = video or open_video(folder / "episode.webm", image.size)
        video.write(np.asarray(image)[:, :, ::-1])  # (420, 720, 3) uint8 BGR
    if video:
        video.release()
    print(f"written to {folder}: {', '.join(sorted(file.name for file in folder.iterdir()))}")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8", line_buffering=True)
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
