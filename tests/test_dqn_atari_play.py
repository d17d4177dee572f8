"""dqn_atari_play.py: what it writes, against the game played again on the bare emulator from the trace's actions."""

import csv
import itertools
import json
import os
import pickle
import re
import shutil
import sys
from types import SimpleNamespace

import ale_py
import cv2
import dqn_atari as dqn
import dqn_atari_play as play
import gymnasium as gym
import lz4.block
import numpy as np
import pytest
import torch
from conftest import ROOT
from gymnasium.wrappers import TimeLimit

BREAKOUT, SEED, EPSILON = "BreakoutNoFrameskip-v4", 2, 0.8  # an untrained agent that seldom presses FIRE plays for ever
ACTIONS = {"NOOP": 0, "FIRE": 1, "RIGHT": 2, "LEFT": 3}  # of Breakout's emulator


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """The q_network.pt of a network that dqn_atari.py trained for 300 frames."""
    folder = tmp_path_factory.mktemp("training")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["dqn_atari.py"])
        patch.setattr(dqn.signal, "signal", lambda *_: None)  # pytest keeps its own handlers
        dqn.main(dqn.Args(env_id=BREAKOUT, environment_train_frames_max=300, agent_replay_buffer_initial=100,
                          optimizer_minibatch_size=8, agent_update_frequency=4, environment_test_frames=1,
                          runs_dir=str(folder)))
    return next(folder.glob("*/q_network.pt"))


@pytest.fixture
def copied(network, tmp_path):
    """A copy of the network in a run directory of its own."""
    (tmp_path / "runs" / "copy").mkdir(parents=True)
    path = tmp_path / "runs" / "copy" / "q_network.pt"
    path.write_bytes(network.read_bytes())
    return path


def saved(network) -> dict:
    return torch.load(network, weights_only=True)


def read_trace(folder) -> list[dict]:
    return list(csv.DictReader((folder / "trace.csv").open()))


def play_again(trace: list[dict]) -> SimpleNamespace:
    """Play the trace's actions on the bare emulator, with nothing of the script: every emulator frame, and per frame of
    the agent what it saw, its state, the reward and the lives."""
    gym.register_envs(ale_py)
    emulator = gym.make(BREAKOUT, frameskip=1, repeat_action_probability=0.0)
    screen, info = emulator.reset(seed=SEED)
    screens, seen, rewards, lives = [screen], [], [], []
    for _ in range(np.random.default_rng(np.random.SeedSequence(SEED).spawn(2)[1]).integers(31)):
        screens.append(emulator.step(0)[0])
    seen, over = [screens[-1]], False
    for row in trace:
        assert not over
        reward = 0.0
        for _ in range(4):
            screen, r, over, _, info = emulator.step(ACTIONS[row["action"]])
            screens.append(screen)
            reward += r
            if over:
                break
        seen.append(np.maximum(screens[-2], screens[-1]))
        rewards.append(reward)
        lives.append(info["lives"])
    assert over
    grey = [cv2.resize(cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY), (84, 84)) for screen in seen]
    states = [np.stack([grey[max(i, 0)] for i in range(t - 3, t + 1)]) for t in range(len(trace))]
    return SimpleNamespace(screens=screens, seen=seen, states=states, rewards=rewards, lives=lives)


@pytest.fixture(scope="module")
def episode(network):
    """One whole game, with the figures, the videos's panels and the printed text caught on the way."""
    figures, panels = {}, []
    with pytest.MonkeyPatch.context() as patch:
        draw, save = play.Panel.draw, play.save_figure_file
        patch.setattr(play, "save_figure_file", lambda path, figure: (figures.update({path.name: figure}),
                                                                      save(path, figure)))
        patch.setattr(play.Panel, "draw", lambda panel, t: panels.append(draw(panel, t)) or panels[-1])
        play.main(play.Args(str(network), epsilon=EPSILON, seed=SEED, show_layers=True))
    (folder,) = network.parent.glob("play-*")
    trace = read_trace(folder)
    return SimpleNamespace(folder=folder, figures=figures, panels=panels, trace=trace, again=play_again(trace))


def column(trace: list[dict], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in trace])


# ---- one game --------------------------------------------------------------------------------------


def test_it_leaves_its_files_beside_the_network(episode, network):
    assert episode.folder.parent == network.parent
    assert {path.name for path in episode.folder.iterdir()} == {
        "episode.webm", "values.png", "moments.png", "trace.csv", "filters.png"}
    for path in episode.folder.glob("*.png"):
        assert cv2.imread(str(path)).std() > 10


def test_trace_is_the_game(episode, network):
    """Rewards, lives and length from the bare emulator; Q from the network that dqn_atari.py defines."""
    trace, again = episode.trace, episode.again
    assert ",".join(trace[0]) == "frame,value,q_NOOP,q_FIRE,q_RIGHT,q_LEFT,action,choice,reward,lives"
    assert [int(row["frame"]) for row in trace] == list(range(len(again.states)))
    assert column(trace, "reward").tolist() == again.rewards and sum(again.rewards) > 0
    assert column(trace, "lives").tolist() == again.lives and again.lives[-1] == 0
    q_network = dqn.QNetwork(4, 84, 84, 4)
    q_network.load_state_dict(saved(network)["q_network"])
    with torch.inference_mode():
        q = q_network(torch.from_numpy(np.stack(again.states))).numpy()
    written = np.stack([column(trace, f"q_{name}") for name in ACTIONS], axis=1)
    assert np.allclose(written, q, atol=1e-5) and written.std(axis=0).min() > 1e-4
    assert np.array_equal(column(trace, "value"), written.max(axis=1))
    for row, q_row in zip(trace, written, strict=True):
        if row["choice"] == "greedy":
            assert row["action"] == list(ACTIONS)[q_row.argmax()]


def test_random_actions_are_epsilon_of_all_and_uniform(episode):
    random = [row["action"] for row in episode.trace if row["choice"] == "random"]
    share, n = len(random) / len(episode.trace), len(episode.trace)
    assert abs(share - EPSILON) < 4 * np.sqrt(EPSILON * (1 - EPSILON) / n)
    assert all(abs(random.count(name) / len(random) - 1 / 4) < 4 * np.sqrt(3 / 16 / len(random)) for name in ACTIONS)


def test_video_holds_every_emulator_frame_in_order_and_colour(episode):
    video = cv2.VideoCapture(str(episode.folder / "episode.webm"))
    assert video.get(cv2.CAP_PROP_FPS) == 60
    screens, images = episode.again.screens, []
    for _ in screens:
        arrived, image = video.read()
        assert arrived and image.shape == (420, 720, 3)
        images.append(cv2.cvtColor(image[::2, :320:2], cv2.COLOR_BGR2RGB).astype(float))
    assert not video.read()[0]
    error = [np.abs(image - screen).mean() for image, screen in zip(images, screens, strict=True)]
    before = [np.abs(image - screen).mean() for image, screen in zip(images[1:], screens, strict=False)]
    after = [np.abs(image - screen).mean() for image, screen in zip(images, screens[1:], strict=False)]
    assert max(error) < 4  # of 255
    assert np.sum(error[1:]) < np.sum(before) and np.sum(error[:-1]) < np.sum(after)


def test_a_short_video_is_the_beginning_of_the_long_one(episode, network, tmp_path):
    copied = shutil.copy(network, tmp_path / "q_network.pt")
    play.main(play.Args(str(copied), epsilon=EPSILON, seed=SEED, video_seconds=1.51))
    (folder,) = tmp_path.glob("play-*")
    assert read_trace(folder) == episode.trace
    short, long = (cv2.VideoCapture(str(path / "episode.webm")) for path in (folder, episode.folder))
    for _ in range(91):  # 60 a second, and the begun one
        assert np.abs(short.read()[1].astype(float) - long.read()[1]).mean() < 4  # of 255: each is encoded anew
    assert not short.read()[0]


def test_video_shows_score_lives_and_thoughts_at_their_frame(episode, monkeypatch):
    """The text that is drawn, emulator frame by emulator frame."""
    emulator = play.Recorder(play.make_emulator(BREAKOUT))
    emulator.reset(seed=1)
    rng, drawn, written = np.random.default_rng(0), [], []
    frames = []
    for t in range(90):
        q = rng.normal(size=4).astype(np.float32)
        frames.append(play.Frame(q, t % 4, True, 0.0, 5, b"", len(emulator.recording)))
        for _ in range(4):
            emulator.step(int(rng.integers(4)))

    class Writer:
        def __init__(self, *_):
            self.isOpened, self.release = (lambda: True), (lambda: None)

        def write(self, image):
            written.append((dict(drawn), image))

    def text(image, words, x, y, colour=None):
        drawn.append((words.split()[0], words))

    monkeypatch.setattr(play, "write_text", text)
    monkeypatch.setattr(play.cv2, "VideoWriter", Writer)
    monkeypatch.setattr(play.cv2, "VideoCapture", lambda _: SimpleNamespace(get=lambda _: len(written)))
    monkeypatch.setattr(play.os, "replace", lambda *_: None)
    play.save_video(episode.folder / "again.webm", emulator.recording, frames, list(ACTIONS), "Breakout")
    assert len(written) == 361
    for i, ((words, image), (code, score, lives)) in enumerate(zip(written, emulator.recording, strict=True)):
        assert (words["score"], words["lives"]) == (f"score {score:g}", f"lives {lives}")
        assert words["frame"] == f"frame {max(i - 1, 0) // 4}"  # the reset's screen is frame 0's, too
        assert np.array_equal(image[::2, :320:2, ::-1], play.decode_screen(code))


def test_panel_marks_the_best_action_and_the_taken_one():
    q = np.array([[0.5, -0.25, 1.0, 0.0], [0.5, 0.75, -0.5, 0.25]], np.float32)
    frames = [play.Frame(q[0], 1, True, 0.0, 0, b"", 1), play.Frame(q[1], 2, False, 0.0, 0, b"", 5)]
    panel = play.Panel(420, frames, list(ACTIONS), "game")
    for t, best in ((0, 2), (1, 1)):
        image = panel.draw(t)
        for number in range(4):
            y = panel.bars_top + number * panel.bar_step
            assert (image[y - 3, panel.left : panel.right].min() == 255) == (number == best)  # the white box
            zero, end = sorted(panel.left + round((x + 0.5) / 1.5 * (panel.right - panel.left))
                               for x in (0, q[t, number]))
            colour = [round(255 * channel) for channel in reversed(play.COLOURS[number])]
            bar = np.abs(image[y + 7, :, :].astype(int) - colour).max(axis=1) <= 1
            assert np.flatnonzero(bar).tolist() == list(range(zero, end + 1))
            arrow = image[y + 7, 8:20].max(axis=0).tolist()
            assert (arrow == list(play.DARK)) == (number != frames[t].action)
            if number == frames[t].action:
                assert arrow == list(play.WHITE if frames[t].greedy else play.RED)
    curve = (panel.background > 100).all(axis=2)[panel.top + 1 : panel.bottom, 11 : panel.right]
    assert curve.any(axis=0).mean() > 0.9  # from the first frame to the last


# ---- the pictures ----------------------------------------------------------------------------------


def test_values_png_is_figure_20(episode):
    trace, again = episode.trace, episode.again
    top, middle, bottom = episode.figures["values.png"].axes
    lines = {line.get_label(): line for line in (*top.lines, *middle.lines)}
    assert np.array_equal(lines["value"].get_ydata(), column(trace, "value").astype(np.float32))
    for name in ACTIONS:
        assert np.array_equal(lines[name].get_ydata(), column(trace, f"q_{name}").astype(np.float32))
    assert lines["reward > 0"].get_xdata().tolist() == np.flatnonzero(np.array(again.rewards) > 0).tolist()
    assert "reward < 0" not in lines
    lost = [t for t in range(1, len(trace)) if again.lives[t] < again.lives[t - 1]]
    for axes in (top, middle, bottom):
        assert [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"] == lost
    assert len(lost) == 5 and "lost life" in lines
    best = np.stack([column(trace, f"q_{name}") for name in ACTIONS], axis=1).argmax(axis=1)
    for number, line in enumerate(line for line in bottom.lines if line.get_marker() == "|"):
        assert list(line.get_xdata()) == np.flatnonzero(best == number).tolist()
        assert set(line.get_ydata()) <= {number}
    assert [label.get_text() for label in bottom.get_yticklabels()] == list(ACTIONS)


def test_moments_png_shows_what_the_agent_saw(episode):
    trace, values = episode.trace, column(episode.trace, "value")
    axes = episode.figures["moments.png"].axes
    moments = play.largest_jumps(values.astype(np.float32), 3)
    shown = [i for t in moments for i in (t - 1, t, t + 1)]
    assert len(axes) == len(shown) == 9
    for i, panel in zip(shown, axes, strict=True):
        row = trace[i]
        assert panel.get_title().splitlines() == [
            f"frame {i}", f"value {values[i]:.3f}", row["action"] + " (random)" * (row["choice"] == "random")]
        assert np.array_equal(panel.images[0].get_array(), episode.again.seen[i])
    marked = [text.xy[0] for text in episode.figures["values.png"].axes[0].texts]
    assert marked == moments


@pytest.mark.parametrize("seed", range(20))
def test_largest_jumps_against_every_choice(seed):
    """Of all sets of windows that share no frame, the one whose changes, largest first, are the largest."""
    rng = np.random.default_rng(seed)
    values, count = rng.normal(size=rng.integers(4, 12)), int(rng.integers(1, 4))
    # the jump into frame t is in the window t-1, t, t+1; into the last frame, in the last window
    windows = {t: abs(values[t] - values[t - 1]) for t in range(1, len(values) - 1)}
    windows[len(values) - 2] = max(windows[len(values) - 2], abs(values[-1] - values[-2]))
    sets = (chosen for n in range(count + 1) for chosen in itertools.combinations(windows, n)
            if all(b - a >= 3 for a, b in itertools.pairwise(chosen)))
    best = max(sets, key=lambda chosen: sorted((windows[t] for t in chosen), reverse=True))
    assert play.largest_jumps(values, count) == list(best)


def test_jumps_are_drops_and_rises():
    assert play.largest_jumps(np.array([0, 0, 5, 5, 5, 5, -3, -3, -3, -3, -2.0]), 2) == [2, 6]
    assert play.largest_jumps(np.array([0, 0, 0, 0, 0, 9.0]), 1) == [4]  # into the last frame: shown as the third
    assert play.largest_jumps(np.array([0.0, 1.0]), 1) == []


def test_a_moment_at_the_end_is_labelled_with_the_jump_into_the_last_frame(tmp_path, monkeypatch):
    figures, screen = [], lz4.block.compress(np.zeros((210, 160, 3), np.uint8))
    frames = [play.Frame(np.array([value], np.float32), 0, True, 0.0, 0, screen, 0) for value in (0, 0, 0, 0, -9)]
    monkeypatch.setattr(play, "save_figure_file", lambda _, figure: figures.append(figure))
    play.save_moments(tmp_path / "moments.png", frames, [1, 3], ["NOOP"], "two moments")
    labels = [axes.get_ylabel() for axes in figures[0].axes if axes.get_ylabel()]
    assert labels == ["moment 1: value +0.000", "moment 2: value -9.000"]


def test_filters_png_draws_all_32_filters(episode, network):
    weights = saved(network)["q_network"]["layers.conv1.weight"].numpy()
    panels = [axes for axes in episode.figures["filters.png"].axes if axes.images]
    assert len(panels) == 32
    for axes, filters in zip(panels, weights, strict=True):
        image = axes.images[0].get_array().filled(np.nan)
        for i, patch in enumerate(filters):
            assert np.array_equal(image[:, 9 * i : 9 * i + 8], patch)
        assert axes.images[0].norm.vmin == -axes.images[0].norm.vmax


# ---- the command -----------------------------------------------------------------------------------


@pytest.fixture
def quickly(monkeypatch):
    """Games cut off after 200 emulator frames, without pictures."""
    make = play.make_emulator
    monkeypatch.setattr(play, "make_emulator", lambda env_id: TimeLimit(make(env_id), 200))
    monkeypatch.setattr(play, "save_figure_file", lambda *_: None)


def test_the_terminal_shows_score_length_and_progress_only(command_line, copied):
    """As its users run it, with no argument: the newest run, ε as given, nothing of the encoder's."""
    done = command_line("dqn_atari_play.py", "--epsilon", 1, "--seed", 5)
    assert done.returncode == 0, done.stderr
    (folder,) = copied.parent.glob("play-seed5-*")
    trace = read_trace(folder)
    score = column(trace, "reward").sum()
    assert f"score {score:g}, length {len(trace):,} frames" in done.stdout
    assert not (folder / "filters.png").exists()
    for line in re.split(r"[\r\n]+", done.stderr.strip()):
        assert re.match(r"(game 1 of 1|video): ", line), done.stderr
    assert f"{len(trace)}/{len(trace)}" in done.stderr


def test_same_seed_same_trace(copied, quickly, monkeypatch):
    monkeypatch.setattr(play, "save_video", lambda *_: None)
    traces = {}
    for name, flags in {"first": {}, "same": {}, "games": dict(games=2), "seed": dict(seed=2),
                        "greedy": dict(epsilon=0.0)}.items():
        play.main(play.Args(str(copied), **(dict(epsilon=EPSILON) | flags)))
        (folder,) = copied.parent.glob("play-*")
        traces[name] = (folder / "trace.csv").read_text()
        folder.rename(copied.parent / name)
    assert traces["first"] == traces["same"] == traces["games"]
    assert len(set(traces.values())) == 3
    assert "random" in traces["first"] and "random" not in traces["greedy"]


def test_games_give_mean_and_variance(copied, capsys, monkeypatch):
    for name in ("save_video", "save_figure_file"):
        monkeypatch.setattr(play, name, lambda *_: None)
    play.main(play.Args(str(copied), games=3, epsilon=1.0))
    out = capsys.readouterr().out
    games = [(float(score), int(length.replace(",", "")))
             for score, length in re.findall(r"score (\S+), length (\S+) frames", out)]
    assert len(set(games)) == 3
    n, (scores, lengths) = 3, zip(*games, strict=True)
    table = re.search(rf"^{BREAKOUT} +(\S+) +(\S+) +(\S+) +(\S+) +3$", out, re.MULTILINE)
    for values, mean, variance in ((scores, table[1], table[2]), (lengths, table[3], table[4])):
        assert float(mean) == pytest.approx(sum(values) / n, rel=1e-4)
        assert float(variance) == pytest.approx(sum(v * v for v in values) / n - (sum(values) / n) ** 2, rel=1e-4)


@pytest.mark.parametrize("env_id", ["PongNoFrameskip-v4", "ALE/Enduro-v5", "ALE/AirRaid-v5"])  # AirRaid has 250 lines
def test_any_game(env_id, network, tmp_path, monkeypatch):
    make = play.make_emulator
    monkeypatch.setattr(play, "make_emulator", lambda env_id: TimeLimit(make(env_id), 40))
    actions = dqn.JoystickActions(make(env_id)).meanings
    args = saved(network)["args"] | {"env_id": env_id}
    weights = dqn.QNetwork(4, 84, 84, len(actions)).state_dict()
    torch.save(saved(network) | {"args": args, "actions": actions, "q_network": weights}, tmp_path / "q_network.pt")
    play.main(play.Args(str(tmp_path), seed=1))  # the folder will do
    (folder,) = tmp_path.glob("play-*")
    video = cv2.VideoCapture(str(folder / "episode.webm"))
    assert sum(1 for _ in iter(lambda: video.read()[0], False)) == 41
    assert [name for name in read_trace(folder)[0] if name.startswith("q_")] == [f"q_{name}" for name in actions]


def test_without_an_argument_it_takes_the_newest_run_then_the_published_one(tmp_path):
    args = play.Args(runs_dir=str(tmp_path))
    published = tmp_path / "published" / "pong" / "q_network.pt"
    for path in (published, published.parent.parent / "breakout" / "q_network.pt"):
        path.parent.mkdir(parents=True)
        path.touch()
    assert play.find_network(args) == published
    for age, name in ((50, "b"), (10, "a"), (90, "c")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "q_network.pt").touch()
        os.utime(tmp_path / name / "q_network.pt", (1e9 - age, 1e9 - age))
    (tmp_path / "d").mkdir()  # a run without a checkpoint yet
    assert play.find_network(args) == tmp_path / "a" / "q_network.pt"
    (tmp_path / "no-target-network" / "e").mkdir(parents=True)  # an ablation's runs are a folder deeper
    (tmp_path / "no-target-network" / "e" / "q_network.pt").touch()
    assert play.find_network(args) == tmp_path / "no-target-network" / "e" / "q_network.pt"


def test_interruption_and_a_full_disk_leave_no_broken_video(copied, quickly, monkeypatch, capsys):
    def run(writer) -> int:
        open_writer = cv2.VideoWriter
        with monkeypatch.context() as patch, pytest.raises(SystemExit) as stopped:
            patch.setattr(play.cv2, "VideoWriter", lambda *arguments: writer(open_writer(*arguments)))
            play.main(play.Args(str(copied), epsilon=1.0))
        (folder,) = copied.parent.glob("play-*")
        assert [path.name for path in folder.iterdir()] == ["trace.csv"]
        shutil.rmtree(folder)
        return stopped.value.code

    def interrupted(writer):
        def write(image):
            raise KeyboardInterrupt

        return SimpleNamespace(isOpened=writer.isOpened, release=writer.release, write=write)

    def full(writer):
        frames = itertools.count()
        return SimpleNamespace(isOpened=writer.isOpened, release=writer.release,
                               write=lambda image: next(frames) < 100 and writer.write(image))

    def closed(writer):
        return SimpleNamespace(isOpened=lambda: False, release=writer.release)

    assert run(interrupted) == 130
    assert run(full) == 1
    assert "of 201 frames 100 reached the disk" in capsys.readouterr().err
    assert run(closed) == 1
    assert "cannot write" in capsys.readouterr().err


# ---- bad input -------------------------------------------------------------------------------------


class RunsCode:
    """An object whose unpickling makes a file."""

    def __reduce__(self):
        return os.mkdir, ("pwned",)


def edited(network, **changes) -> dict:
    return saved(network) | changes


def weight(network, name: str, change) -> dict:
    weights = saved(network)["q_network"]
    return edited(network, q_network=weights | {name: change(weights[name])})


def setting(network, **changes) -> dict:
    return edited(network, args=saved(network)["args"] | changes)


BAD_FILES = {  # what the file holds: bytes, or what torch.save is given; and a word of the line
    "empty": (lambda path: b"", "not a zip file"),
    "text": (lambda path: b"weights", "not a zip file"),
    "truncated": (lambda path: path.read_bytes()[:-5000], "not a zip file"),
    "one bit": (lambda path: (lambda raw: raw[:300_000] + bytes([raw[300_000] ^ 1]) + raw[300_001:])(path.read_bytes()),
                "checksum"),
    "checkpoint.pt": (lambda path: (path.parent / "checkpoint.pt").read_bytes(), "dqn_atari checkpoint 1"),
    "other format": (lambda path: edited(path, format="dqn_atari q_network 2"), "its format"),
    "bare weights": (lambda path: saved(path)["q_network"], "lacks 'format'"),
    "list": (lambda path: [1, 2], "holds a list"),
    "tensor": (lambda path: torch.zeros(3), "holds a Tensor"),
    "a pickle that runs code": (lambda path: pickle.dumps(RunsCode()), "not a zip file"),
    "an object that runs code": (lambda path: edited(path, format=RunsCode()), "could run code"),
    "no args": (lambda path: {k: v for k, v in saved(path).items() if k != "args"}, "lacks 'args'"),
    "empty args": (lambda path: edited(path, args={}), "lacks 'environment_no_op_max'"),
    "args no table": (lambda path: edited(path, args=3), "no q_network.pt"),
    "no-ops below 0": (lambda path: setting(path, environment_no_op_max=-1), "environment_no_op_max is -1"),
    "no maxpool": (lambda path: setting(path, environment_frames_to_maxpool=0), "environment_frames_to_maxpool is 0"),
    "repeat as text": (lambda path: setting(path, agent_action_repeat="4"), "agent_action_repeat is '4'"),
    "other history": (lambda path: setting(path, agent_history_length=3), "conv1.weight"),
    "gigantic": (lambda path: setting(path, environment_state_height=10**7), "linear.weight"),
    "frames as text": (lambda path: edited(path, frames="many"), "frames"),
    "no Atari game": (lambda path: setting(path, env_id="CartPole-v1"), "no Atari game"),
    "unknown game": (lambda path: setting(path, env_id="Pnog"), "unknown game"),
    "another game's": (lambda path: setting(path, env_id="ALE/Enduro-v5"), "its actions are"),
    "no weights": (lambda path: edited(path, q_network={}), "Table 2"),
    "weights as list": (lambda path: edited(path, q_network=[1]), "Table 2"),
    "a layer more": (lambda path: edited(path, q_network=saved(path)["q_network"] | {"x": torch.ones(1)}), "Table 2"),
    "other head": (lambda path: weight(path, "head.bias", lambda w: w[:3]), "head.bias"),
    "no tensor": (lambda path: weight(path, "head.bias", lambda w: 3), "no q_network.pt"),
    "half precision": (lambda path: weight(path, "head.bias", lambda w: w.half()), "float16"),
    "NaN": (lambda path: weight(path, "head.bias", lambda w: w * torch.nan), "not finite"),
}


def refused(capsys, monkeypatch, *flags: str) -> str:
    """The one line that the script says when it refuses `flags`."""
    monkeypatch.setattr(sys, "argv", ["dqn_atari_play.py", *flags])
    with pytest.raises(SystemExit) as stopped:
        play.main(play.parse_args(play.Args))
    streams = capsys.readouterr()
    assert stopped.value.code == 2
    assert re.fullmatch(r"error: [^\n]+\n", streams.err) and streams.out == ""
    return streams.err


@pytest.mark.parametrize("what", BAD_FILES)
def test_what_is_no_network_is_refused_in_one_line(what, network, tmp_path, monkeypatch, capsys):
    make, word = BAD_FILES[what]
    path, content = tmp_path / "q_network.pt", make(network)
    path.write_bytes(content) if isinstance(content, bytes) else torch.save(content, path)
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, monkeypatch, "q_network.pt")
    assert word in line and "q_network.pt" in line and len(line) < 300
    assert [file.name for file in tmp_path.iterdir()] == ["q_network.pt"]


BAD_FLAGS = {
    "--epsilon 1.5": "between 0 and 1", "--epsilon nan": "between 0 and 1", "--epsilon -0.1": "between 0 and 1",
    "--games 0": "--games must be at least 1", "--video-seconds 0": "--video-seconds must be above 0",
    "--video-seconds nan": "--video-seconds must be above 0", "--moments 0": "--moments must be at least 1",
    "--seed -1": "--seed must be at least 0", "--games many": "--games", "--no-such-flag 1": "--no-such-flag",
    "nowhere/q_network.pt": "there is no network nowhere", "runs/empty": "there is no network runs",
}


@pytest.mark.parametrize("flags", BAD_FLAGS)
def test_bad_flags_are_one_line_and_exit_code_2(flags, copied, tmp_path, monkeypatch, capsys):
    (tmp_path / "runs" / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert BAD_FLAGS[flags] in refused(capsys, monkeypatch, *flags.split())
    assert sorted(tmp_path.rglob("*")) == before


def test_no_run_at_all_and_no_place_to_write(copied, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(play, "__file__", str(tmp_path / "elsewhere" / "algorithms" / "dqn_atari_play.py"))
    assert "no network to play" in refused(capsys, monkeypatch, "--runs-dir", str(tmp_path / "nothing"))
    monkeypatch.setattr(play.time, "strftime", lambda _: "now")
    (copied.parent / "play-seed1-now").touch()
    assert "cannot be made" in refused(capsys, monkeypatch, str(copied))


def test_help_names_every_flag(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["dqn_atari_play.py", "--help"])
    with pytest.raises(SystemExit) as stopped:
        play.parse_args(play.Args)
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    for flag in ("--games", "--epsilon", "--seed", "--moments", "--show-layers", "--runs-dir", "[NETWORK]"):
        assert flag in text


# ---- the published agent ---------------------------------------------------------------------------

PUBLISHED = ROOT / "runs" / "published" / "pong"


def test_the_published_agent_plays_pong(tmp_path, capsys):
    """One whole game at ε = 0.05, seed 1: it wins by 15 points or more, of 21."""
    copied = shutil.copy(PUBLISHED / "q_network.pt", tmp_path / "q_network.pt")
    play.main(play.Args(str(copied), video_seconds=1.0))
    assert float(re.search(r"game 1   score (-?\d+)", capsys.readouterr().out)[1]) >= 15


def test_without_any_run_the_published_agent_is_found(tmp_path):
    assert play.find_network(play.Args(runs_dir=str(tmp_path / "none"))) == PUBLISHED / "q_network.pt"


def test_readme_says_what_the_published_run_measured():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    test = json.loads((PUBLISHED / "test.json").read_text())
    assert test["score_mean"] == pytest.approx(np.mean(test["scores"])) and sum(test["lengths"]) <= 135_000
    for words in (f"{test['score_mean']:.2f}", f"{test['frames']:,} frames", f"{test['updates']:,} updates",
                  f"{len(test['scores'])} games"):
        assert words in readme
    args = json.loads((PUBLISHED / "args.json").read_text())
    default = vars(dqn.Args())
    for name, value in args.items():
        if value != default[name]:
            assert f"{dqn.flag(name)} {value} " in " ".join(readme.replace("\\", " ").split())
    events = sum(path.stat().st_size for path in PUBLISHED.glob("events*"))
    assert 0 < events < 5e6 and (PUBLISHED / "q_network.pt").stat().st_size <= 7e6
