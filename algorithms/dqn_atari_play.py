# /// script
# requires-python = ">=3.10"
# dependencies = [
#     "ale-py>=0.12", "gymnasium>=1.1", "lz4", "matplotlib>=3.9", "numpy>=1.26",
#     "opencv-python-headless", "pandas>=2.2", "pillow>=10.4", "torch>=2.11", "tqdm", "tyro>=0.9",
# ]
# ///
"""Watch a trained agent play and think: the pictures of §7.4 (ECE 544NA, Lecture 27, Figures 20 to
32) and a video, for any game and any q_network.pt of dqn_atari.py or of the scripts made from it.

Run it
    python algorithms/dqn_atari_play.py --game pong        # an agent of runs/published
    python algorithms/dqn_atari_play.py runs/RUN           # a run, or its q_network.pt
    python algorithms/dqn_atari_play.py                    # the newest run under runs/
    python algorithms/dqn_atari_play.py --game pong --games 30   # mean and variance, no pictures

Written to the folder play-seed1 beside q_network.pt, or to --output, over an earlier game's files:
    episode.webm   the game, 15 frames a second, with Q of every action and the value beside it
    play.gif       its first twelve seconds; 0.4 to 0.7 MB, by game
    values.png     Figure 20: value, Q of every action and best action against the frame
    moments.png    Figures 21, 22, 24, …: three frames around each of three jumps of the value
    trace.csv      frame, value, Q of every action, action, greedy or random, reward, lives

Measured
    --game pong: score 20 in 1,942 frames. On one core of an AMD EPYC 18 seconds, video and all; 6
    seconds with --video-seconds 20.

Deviations
    lecture                      this file                              why
    ---------------------------  -------------------------------------  --------------------------
    moments are chosen by hand   largest jumps, at least 1 s apart       one rule for every game
    curves alone                 scores and lost lives are marked       they explain the jumps
"""

import dataclasses
import itertools
import os
import signal
import sys
import types
import zipfile
from collections.abc import Iterator
from pathlib import Path

import ale_py
import cv2
import gymnasium as gym
import lz4.block
import numpy as np
import pandas as pd
import torch
import tyro
from gymnasium.wrappers import TransformObservation
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from torch import nn
from tqdm import tqdm

FRAMES_PER_SECOND = 15  # 60 emulator frames, each action repeated 4 times
VIDEO_SIZE = 720, 420  # the screen, 320 wide, and beside it what the agent thinks
BARS = 440, 640  # x in the video from and to which bars of Q lie
GIF_FRAMES = 180  # the beginning of the video, 12 seconds
COLOURS = "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b"  # of the actions
PUBLISHED = Path(__file__).resolve().parent.parent / "runs" / "published"

# ---- Args ----------------------------------------------------------------------------------------


@dataclasses.dataclass
class Args:
    """A FRAME is what the agent observes: one action, 4 emulator frames."""

    run: tyro.conf.Positional[str] = ""
    """run directory, or its q_network.pt; by default the newest under runs/, else published Pong"""
    game: str = ""
    """folder of runs/published to take instead, for example pong"""
    games: int = 1
    """games to play; more than one gives mean and variance of score and length, and no pictures"""
    epsilon: float = 0.05
    """ε, probability of a random action"""
    seed: int = 1
    """of the random actions and of the no-operations that a game starts with"""
    video_seconds: float = 1_800.0
    """length of episode.webm, from the start; at action repeat 4 no game is longer"""
    output: str = ""
    """folder to write to, instead of the one beside q_network.pt"""


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


class KeepScreen(gym.ObservationWrapper):
    """Keeps in `screen` what the agent is about to see, while it still has its colours."""

    def observation(self, screen: np.ndarray) -> np.ndarray:
        self.screen = screen  # (210, 160, 3) uint8
        return screen


def make_evaluation_env(trained, no_op_rng: np.random.Generator) -> gym.Env:
    """The game with the transformations of Figure 17, as in dqn_atari.py: a whole game, raw reward.

    `trained` holds the flags of the training. Nothing is skipped or repeated at random; after
    108,000 emulator frames, half an hour, a game is truncated.
    """
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # no banner
    gym.register_envs(ale_py)  # gives Gymnasium the names; the ROMs are in ale-py's wheel
    env = gym.make(trained.env_id, frameskip=1, repeat_action_probability=0.0,
                   full_action_space=False, max_num_frames_per_episode=108_000)
    env = JoystickActions(env)
    no_ops = trained.environment_no_op_max if "NOOP" in env.meanings else 0
    env = NoOpReset(env, no_ops, no_op_rng)
    env = ActionRepeat(env, trained.agent_action_repeat, trained.environment_frames_to_maxpool)
    env = KeepScreen(env)
    # Colour to luminance, 0.299 R + 0.587 G + 0.114 B; then bilinear downsampling.
    size = (trained.environment_state_width, trained.environment_state_height)
    env = TransformObservation(env, lambda screen: cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY), None)
    env = TransformObservation(env, lambda grey: cv2.resize(grey, size), None)
    return FrameHistory(env, trained.agent_history_length)


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


def find_q_network(args: Args) -> Path:
    """The q_network.pt that the flags name; by default the newest run's, else published Pong's."""
    if args.run and args.game:
        raise SystemExit("error: a run or --game, not both")
    if args.run or args.game:
        path = PUBLISHED / args.game if args.game else Path(args.run)
        return path / "q_network.pt" if path.is_dir() else path
    found = [path for path in Path("runs").rglob("q_network.pt") if "published" not in path.parts]
    return max(found, key=os.path.getmtime, default=PUBLISHED / "pong" / "q_network.pt")


def load(path: Path) -> tuple[QNetwork, types.SimpleNamespace]:
    """The network, and the flags that it was trained with and `actions`, the names of its actions.
    Nothing in the file is run. Exits with one line if it is not whole, or cannot play its game."""
    try:
        if zipfile.ZipFile(path).testzip():
            raise ValueError("a checksum is wrong")
        content = torch.load(path, map_location="cpu", weights_only=True)
        trained = types.SimpleNamespace(**content["args"], actions=content["actions"])
        no_ops, repeat = trained.environment_no_op_max, trained.agent_action_repeat
        # Against hostile files: Gymnasium imports the module before a colon in env_id, and billions
        # of no-operations would never end.
        if ":" in trained.env_id or no_ops > 1_000 or repeat > 100:
            raise ValueError("its game has a module's name, or too many no-operations or repeats")
        shape = trained.environment_state_height, trained.environment_state_width
        with torch.device("meta"):  # shapes alone; the file's tensors are assigned if they fit
            q_network = QNetwork(trained.agent_history_length, *shape, len(trained.actions))
        q_network.load_state_dict(content["q_network"], assign=True)
        q_network.float()  # published weights may be in half precision
        # A first frame tells whether the flags make an environment, and the network fits it.
        env = make_evaluation_env(trained, np.random.default_rng(0))
        env.reset()
        q = action_values(q_network, env.step(0)[0], trained)  # (num_actions,)
        if env.get_wrapper_attr("meanings") != trained.actions or not np.isfinite(q).all():
            raise ValueError("its actions are not the game's, or its Q is not finite")
    except Exception as error:  # a damaged or hostile file can raise anything
        raise SystemExit(f"error: {path} cannot be played: {error!r:.200}") from None
    return q_network, trained


# ---- algorithm: the ε-greedy policy --------------------------------------------------------------


@torch.inference_mode()
def action_values(q_network: QNetwork, state: tuple, trained) -> np.ndarray:
    """Q(s, ·; θ) (num_actions,) float32 of a state, which is its 4 frames as LZ4 bytes."""
    pixels = bytearray().join([lz4.block.decompress(frame) for frame in state])
    shape = 1, -1, trained.environment_state_height, trained.environment_state_width
    states = torch.frombuffer(pixels, dtype=torch.uint8).view(shape)  # (1, 4, 84, 84)
    return q_network(states).squeeze(0).numpy()  # (num_actions,)


def play(env: gym.Env, q_network: QNetwork, trained, epsilon: float, rng, seed: int) -> tuple:
    """One whole game, for raw reward. Returns, frame by frame, the rows of trace.csv, Q(s, ·; θ)
    (T, num_actions) float32, and the screens before the action, as LZ4 bytes."""
    rows, q_values, screens = [], [], []
    state, _ = env.reset(seed=seed)
    for frame in tqdm(itertools.count(), "game", unit=" frames", delay=2, leave=False):
        screens.append(lz4.block.compress(env.get_wrapper_attr("screen")))
        q = action_values(q_network, state, trained)  # (num_actions,)
        # π(s) = argmax_a Q(s, a; θ), with probability ε an action at random     (Equation 35)
        greedy = rng.random() >= epsilon
        action = int(q.argmax()) if greedy else int(rng.integers(len(q)))
        state, reward, terminated, truncated, info = env.step(action)
        row = {"frame": frame, "value": q.max()}
        row |= {f"q_{name}": q_a for name, q_a in zip(trained.actions, q, strict=True)}
        row |= {"action": trained.actions[action], "choice": "greedy" if greedy else "random"}
        rows.append(row | {"reward": reward, "lives": info["lives"]})
        q_values.append(q)
        if terminated or truncated:
            return rows, np.stack(q_values), screens


def largest_jumps(values: np.ndarray, count: int = 3) -> list[int]:
    """The `count` frames t with the largest |V(s_t) - V(s_{t-1})| in values (T,), in order of time.
    They are at least a second apart, for different events; each has a frame before and after."""
    changes = np.abs(np.diff(values))[:-1]  # (T - 2,): index t - 1 is the jump into frame t
    moments = []
    for t in 1 + np.argsort(-changes, kind="stable"):
        if len(moments) < count and all(abs(t - m) >= FRAMES_PER_SECOND for m in moments):
            moments.append(int(t))
    return sorted(moments)


# ---- report: table, figures, video ---------------------------------------------------------------


def draw_curves(rows: list[dict], q: np.ndarray, moments: list[int], trained) -> Figure:
    """Figure 20: value, Q of every action and best action, with scores and lost lives."""
    value, best = q.max(axis=1), q.argmax(axis=1)  # (T,) each
    rewards = np.array([row["reward"] for row in rows])  # (T,)
    lost = 1 + np.flatnonzero(np.diff([row["lives"] for row in rows]) < 0)  # by this frame's action

    figure = Figure(figsize=(13, 7.5), layout="constrained")
    figure.suptitle(f"{trained.env_id}: score {rewards.sum():g}")
    top, middle, bottom = figure.subplots(3, sharex=True, height_ratios=(4, 4, 2))
    top.plot(value, color="0.2", linewidth=0.8, label="value")
    t = np.flatnonzero(rewards)
    signs = np.where(rewards[t] > 0, "tab:green", "tab:red")
    top.scatter(t, value[t], 20, signs, zorder=3, label="reward (red: below 0)")
    full_height = top.get_xaxis_transform()  # x in frames, y from 0 to 1
    top.vlines(lost, 0, 1, "tab:red", label="lost life" if len(lost) else "", transform=full_height)
    top.vlines(moments, 0, 1, "black", "dotted", label="moments.png", transform=full_height)
    for number, name in enumerate(trained.actions):
        middle.plot(q[:, number], color=COLOURS[number], linewidth=0.8, label=name)
    bottom.scatter(np.arange(len(best)), best, 60, np.take(COLOURS, best), marker="|", lw=1)
    top.set_ylabel("value  max Q(s, a)")
    middle.set_ylabel("Q(s, a)")
    bottom.set(ylabel="best action", xlabel="frame", xlim=(0, len(rows)))
    bottom.set_yticks(range(len(trained.actions)), trained.actions)
    bottom.set_ylim(len(trained.actions) - 0.5, -0.5)  # the first on top
    figure.legend(loc="outside right upper")
    return figure


def draw_moments(rows: list[dict], screens: list[bytes], moments: list[int]) -> Figure:
    """Figures 21, 22, 24, …: a row for each moment, the frames before, at and after the jump."""
    figure = Figure(figsize=(6.6, 3.6 * len(moments)), layout="constrained")
    panels = figure.subplots(len(moments), 3, squeeze=False)
    for moment, line in zip(moments, panels, strict=True):
        for t, axes in zip(range(moment - 1, moment + 2), line, strict=True):
            row = rows[t]
            title = f"frame {t}\nvalue {row['value']:.3f}\n{row['action']}, {row['choice']}"
            axes.imshow(picture(screens[t]))
            axes.set(xticks=[], yticks=[], title=title)
        jump = rows[moment]["value"] - rows[moment - 1]["value"]
        line[0].set_ylabel(f"value {jump:+.3f}", fontsize=12)
    return figure


def picture(screen: bytes) -> Image.Image:
    """A screen of LZ4 bytes: 160 wide, 210 high; a few games have 250 lines."""
    pixels = np.frombuffer(lz4.block.decompress(screen), np.uint8)  # (210·160·3,)
    return Image.fromarray(pixels.reshape(-1, 160, 3))


def pictures(rows: list, q: np.ndarray, screens: list, trained) -> Iterator[Image.Image]:
    """A picture for every row: the screen, and beside it Q of every action. Bars start at Q = 0,
    the best action is framed, a dot marks the one taken (red: drawn at random). Below, the value of
    the last 12 seconds, with dots at rewards (red: below 0). The scales are the whole game's."""
    large, small = ImageFont.load_default(24), ImageFont.load_default(16)
    value = q.max(axis=1)  # (T,)
    bar_scale, curve_scale = (min(q.min(), 0), max(q.max(), 0)), (value.min(), value.max())
    zero, top = np.interp(0, bar_scale, BARS), 122 + 28 * len(trained.actions)
    for t, row in enumerate(tqdm(rows, "video", delay=2, leave=False)):
        image = Image.new("RGB", VIDEO_SIZE, "#16181f")
        image.paste(picture(screens[t]).resize((320, 420), Image.Resampling.NEAREST))
        draw = ImageDraw.Draw(image)
        draw.text((340, 12), trained.env_id, "white", large)
        for a, name in enumerate(trained.actions):
            y = 76 + 28 * a
            ink = "white" if a == q[t].argmax() else "darkgray"
            draw.line((zero, y, np.interp(q[t, a], bar_scale, BARS), y), COLOURS[a], 15)
            draw.text((364, y), name, ink, small, anchor="lm")
            draw.text((704, y), f"{q[t, a]:.3f}", ink, small, anchor="rm")
            if a == q[t].argmax():
                draw.rectangle((BARS[0] - 6, y - 12, BARS[1] + 6, y + 12), outline="white")
            if name == row["action"]:
                draw.circle((347, y), 6, "white" if row["choice"] == "greedy" else "tomato")
        draw.line((zero, 62, zero, top - 60), "darkgray")
        draw.text((340, top - 44), f"frame {t}     value {value[t]:.3f}", "white", small)
        first = max(0, t + 1 - GIF_FRAMES)
        heights = np.interp(value[first : t + 1], curve_scale, (404, top))
        curve = [(340 + 2 * i, y) for i, y in enumerate(heights)]  # 2 pixels a frame
        draw.line(curve, "white", 2)
        for point, past in zip(curve, rows[first : t + 1], strict=True):
            if past["reward"]:
                draw.circle(point, 4, "limegreen" if past["reward"] > 0 else "tomato")
        draw.circle(curve[-1], 4, "white")
        yield image


def write_video(folder: Path, images: Iterator[Image.Image]) -> None:
    """episode.webm, in VP8, which browsers play; and play.gif, its beginning as an endless loop, in
    the colours of its first and last image."""
    stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)  # OpenCV has a needless remark on VP8
    codec = cv2.VideoWriter_fourcc(*"VP80")
    video = cv2.VideoWriter(str(folder / "episode.webm"), codec, FRAMES_PER_SECOND, VIDEO_SIZE)
    os.dup2(stderr, 2)
    os.close(stderr)
    os.close(nowhere)
    if not video.isOpened():
        raise OSError("OpenCV does not open episode.webm")
    beginning = []
    for image in images:
        video.write(np.asarray(image)[:, :, ::-1])  # (420, 720, 3) uint8 BGR
        if len(beginning) < GIF_FRAMES:
            beginning.append(image)
    video.release()
    palette = Image.fromarray(np.vstack([beginning[0], beginning[-1]])).quantize(64)
    gif = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in beginning]
    # A GIF counts in hundredths of a second.
    gif[0].save(folder / "play.gif", save_all=True, append_images=gif[1:], loop=0, duration=70)


# ---- main ----------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Play, then show what the agent thought."""
    bounds = {"epsilon": (0, 1), "games": (1, 1e6), "seed": (0, 1e9), "video_seconds": (1, 1_800)}
    for name, (low, high) in bounds.items():
        if not low <= getattr(args, name) <= high:
            raise SystemExit(f"error: --{name.replace('_', '-')} must be from {low} to {high:.0f}")
    torch.set_num_threads(1)  # one state at a time gains nothing from more
    path = find_q_network(args)
    q_network, trained = load(path)
    exploration_rng, no_op_rng = np.random.default_rng(args.seed).spawn(2)
    env = make_evaluation_env(trained, no_op_rng)
    print(f"{path}: {trained.env_id}, {' '.join(trained.actions)}; ε {args.epsilon:g}")

    results = []
    for seed in range(args.seed, args.seed + args.games):
        rows, q, screens = play(env, q_network, trained, args.epsilon, exploration_rng, seed)
        results.append((sum(row["reward"] for row in rows), len(rows)))
        print(f"game {len(results)}: score {results[-1][0]:,.0f}, {len(rows):,} frames")
    if args.games > 1:
        for name, values in zip(("score", "length"), np.transpose(results), strict=True):
            print(f"{name:6}  mean {values.mean():,.2f}, variance {values.var(ddof=1):,.1f}")
        return

    folder = Path(args.output or path.parent / f"play-seed{args.seed}")
    moments = largest_jumps(q.max(axis=1))
    shown = rows[: int(args.video_seconds * FRAMES_PER_SECOND)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        trace = folder.absolute() / "trace.csv"  # absolute: pandas expands a ~
        pd.DataFrame(rows).to_csv(trace, index=False, float_format="%.6g")
        draw_curves(rows, q, moments, trained).savefig(folder / "values.png", dpi=100)
        draw_moments(rows, screens, moments).savefig(folder / "moments.png", dpi=100)
        write_video(folder, pictures(shown, q, screens, trained))
    except OSError as error:
        raise SystemExit(f"error: {folder} cannot be written: {error}") from None
    print(f"written to {folder}: episode.webm, moments.png, play.gif, trace.csv, values.png")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8", line_buffering=True)
    signal.signal(signal.SIGINT, lambda *_: sys.exit("error: interrupted"))  # Ctrl-C
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
