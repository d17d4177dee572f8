"""dqn_atari_play.py: what it writes, against the game played again on the bare emulator."""

import itertools
import os
from pathlib import Path
from types import SimpleNamespace

import ale_py
import cv2
import dqn_atari as dqn
import dqn_atari_play as play
import numpy as np
import pytest
import test_dqn_atari
import torch
from PIL import Image

PONG = play.PUBLISHED / "pong"
SEED, EPSILON, ACTIONS = 15, 0.8, ["NOOP", "FIRE", "RIGHT", "LEFT"]  # of Breakout


@pytest.fixture(scope="module")
def episode(tmp_path_factory):
    """A game of a network that dqn_atari.py wrote, and its actions on the bare emulator."""
    runs, returned, whole = tmp_path_factory.mktemp("runs"), [], play.play
    few = dict(env_id="ALE/Breakout-v5", environment_train_frames_max=1, environment_test_frames=1)
    dqn.main(dqn.Args(**test_dqn_atari.SHORT | few, runs_dir=str(runs)))
    torch.set_flush_denormal(False)
    (path,) = runs.glob("*/q_network.pt")
    saved = torch.load(path, weights_only=True)
    saved["q_network"] = {name: θ.half() for name, θ in saved["q_network"].items()}
    torch.save(saved, path)  # in half precision, like published ones
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(play, "play", lambda *a: returned.append(whole(*a)) or returned[-1])
        play.main(play.Args(str(path.parent), epsilon=EPSILON, seed=SEED, video_seconds=13.0))
    folder, (rows, _, screens) = path.parent / f"play-seed{SEED}", returned[0]
    trace = np.genfromtxt(folder / "trace.csv", None, delimiter=",", names=True, encoding="utf-8")
    ale = ale_py.ALEInterface()
    ale.setFloat("repeat_action_probability", 0.0)
    ale.loadROM(ale_py.roms.get_rom_path("breakout"))
    for _ in range(np.random.default_rng(np.random.SeedSequence(SEED).spawn(2)[1]).integers(31)):
        ale.act(ale_py.Action.NOOP)
    seen, rewards, lives = [ale.getScreenRGB()], [], []
    for action in trace["action"]:
        assert not ale.game_over()
        acted = [(ale.act(getattr(ale_py.Action, action)), ale.getScreenRGB()) for _ in range(4)]
        seen.append(np.maximum(acted[-2][1], acted[-1][1]))
        rewards.append(sum(reward for reward, _ in acted))
        lives.append(ale.lives())
    assert ale.game_over() and max(rewards) > 1
    return SimpleNamespace(path=path, folder=folder, trace=trace, screens=screens, seen=seen[:-1],
                           rewards=rewards, lives=lives, weights=saved["q_network"], rows=rows)


def test_trace_is_the_game(episode):
    trace, n = episode.trace, len(episode.rewards)
    assert trace["frame"].tolist() == list(range(n))
    assert (trace["reward"].tolist(), trace["lives"].tolist()) == (episode.rewards, episode.lives)
    grey = [cv2.resize(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY), (52, 44)) for x in episode.seen]
    states = np.array([[grey[max(i, 0)] for i in range(t - 3, t + 1)] for t in range(n)])
    q_network = dqn.QNetwork(4, 44, 52, 4)
    q_network.load_state_dict(episode.weights)
    q = np.stack([trace[f"q_{name}"] for name in ACTIONS], axis=1)
    assert np.allclose(q, q_network(torch.from_numpy(states)).detach(), atol=1e-5)
    assert np.array_equal(trace["value"], q.max(axis=1)) and q.std(axis=0).min() > 1e-4
    random = trace["choice"] == "random"
    assert np.array_equal(trace["action"][~random], np.take(ACTIONS, q.argmax(axis=1))[~random])
    assert abs(random.mean() - EPSILON) < 0.11 and {*trace["action"][random]} == {*ACTIONS}


def test_files_are_whole_and_the_video_is_the_game(episode):
    gif, video = (episode.folder / name for name in ("play.gif", "episode.webm"))
    assert Image.open(gif).n_frames == 180 and gif.stat().st_size <= 1_500_000
    for name in ("moments.png", "values.png"):
        assert cv2.imread(str(episode.folder / name)).std() > 10
    assert all(map(np.array_equal, map(play.picture, episode.screens), episode.seen))
    video = cv2.VideoCapture(str(video))
    images = [video.read()[1][::2, :320:2, ::-1].astype(np.int16) for _ in range(13 * 15)]
    errors = [np.abs(np.array(images[1:]) - episode.seen[d : d + 194]).mean() for d in range(3)]
    assert errors[1] == min(errors) < 4  # of 255, beside those of the frames before and after
    assert not video.read()[0] and video.get(cv2.CAP_PROP_FPS) == 15


def test_figures_show_the_game(episode):
    rows, value = episode.rows, episode.trace["value"]
    q = np.stack([episode.trace[f"q_{name}"] for name in ACTIONS], axis=1)
    top = play.draw_curves(rows, q, [9], play.load(episode.path)[1]).axes[0]
    rewarded, lost, _ = top.collections
    assert np.array_equal(top.lines[0].get_ydata(), value)
    assert np.array_equal(rewarded.get_offsets()[:, 0], np.flatnonzero(episode.rewards))
    ends = [path.vertices[0, 0] for path in lost.get_paths()]
    assert ends == [t for t in range(1, len(rows)) if episode.lives[t] < episode.lives[t - 1]]
    for t, axes in zip((8, 9, 10), play.draw_moments(rows, episode.screens, [9]).axes, strict=True):
        assert np.array_equal(axes.images[0].get_array(), episode.seen[t])
        assert axes.get_title().startswith(f"frame {t}\nvalue {value[t]:.3f}\n")


def test_panel_marks_the_best_and_the_taken_action(episode):
    def draw(best: int, taken: int, choice: str = "greedy") -> np.ndarray:
        row = {"action": ACTIONS[taken], "choice": choice, "reward": 0.0}
        q = 0.2 + 1e-6 * np.eye(4)[[best]]
        return np.array(next(play.pictures([row], q, episode.screens, play.load(episode.path)[1])))
    marks = [[np.flatnonzero((draw(*moved) != draw(0, 0)).any(axis=(1, 2)))  # rows of the picture
              for moved in ((0, a), (a, 0))] for a in (1, 2, 3)]  # the box is taller
    assert all(abs(dot.mean() - box.mean()) < 2 and len(box) > len(dot) for dot, box in marks)
    assert np.diff([dot.mean() for dot, _ in marks]).min() > 10
    assert (draw(0, 0) != draw(0, 0, "random")).any()


@pytest.mark.parametrize("seed", range(20))
def test_largest_jumps_against_every_choice(seed):
    values = np.random.default_rng(seed).normal(size=3 * seed)
    jumps = {t: abs(values[t] - values[t - 1]) for t in range(1, len(values) - 1)}
    sets = (s for n in range(4) for s in itertools.combinations(jumps, n)
            if all(b - a >= 15 for a, b in itertools.pairwise(s)))
    best = max(sets, key=lambda s: sorted((jumps[t] for t in s), reverse=True))
    assert play.largest_jumps(values) == list(best)


@pytest.mark.parametrize("game, modest", [("pong", 9), ("breakout", 10), ("space_invaders", 350),
                                          ("enduro", 99), ("riverraid", 1800)])
def test_published_agents_play_and_games_have_mean_and_variance(game, modest, capsys, monkeypatch):
    folder = PONG.parent / game
    played, whole, before = [], play.play, sorted(folder.rglob("*"))
    monkeypatch.setattr(play, "play", lambda *a: played.append(whole(*a)) or played[-1])
    play.main(play.Args(game=game, games=2))
    scores = [sum(row["reward"] for row in rows) for rows, _, _ in played]
    assert min(scores) >= modest and sorted(folder.rglob("*")) == before
    out = capsys.readouterr().out
    for a, b in (scores, [len(rows) for rows, _, _ in played]):
        assert f"mean {(a + b) / 2:,.2f}, variance {(a - b) ** 2 / 2:,.1f}\n" in out


def test_the_newest_run_is_found_else_the_published_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert play.find_q_network(play.Args()) == PONG / "q_network.pt"
    for age, folder in ((5, "runs/b"), (1, "runs/arm/a"), (9, "runs/c"), (0, "runs/published/d")):
        Path(folder).mkdir(parents=True)
        Path(folder, "q_network.pt").touch()
        os.utime(f"{folder}/q_network.pt", (1e9 - age, 1e9 - age))
    assert play.find_q_network(play.Args()) == Path("runs/arm/a/q_network.pt")


@pytest.mark.parametrize("bad", [  # the file; flags of the training; flags of play
    {"file": lambda raw, s: b""}, {"file": lambda raw, s: raw[:-5000]},
    {"file": lambda raw, s: raw[:300_000] + bytes([raw[300_000] ^ 1]) + raw[300_001:]},
    {"file": lambda raw, s: s["q_network"]}, {"file": lambda _, s: s | {"actions": ACTIONS[::-1]}},
    {"file": lambda raw, s: s | {"frames": Path("its unpickling could run code")}},
    {"file": lambda raw, s: (s["q_network"]["head.bias"].fill_(torch.nan), s)[1]},
    {"env_id": "this:Pong-v5"}, {"env_id": "CartPole-v1"}, {"environment_state_height": 10**7},
    {"environment_no_op_max": 10**12}, {"agent_action_repeat": 101}, {"agent_action_repeat": 0},
    {"epsilon": 1.5}, {"epsilon": float("nan")}, {"games": 0}, {"seed": -1},
    {"video_seconds": 0.0}, {"game": "pong"}, {"run": "nowhere"}, {"output": "q_network.pt"}])
def test_bad_input_is_one_line_and_nothing_is_written(bad, episode, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    change = bad.get("file", lambda raw, s: s | {"args": s["args"] | bad})
    content = change(episode.path.read_bytes(), torch.load(episode.path, weights_only=True))
    torch.save(content, "q_network.pt")
    if isinstance(content, bytes):
        Path("q_network.pt").write_bytes(content)
    flags = {name: value for name, value in bad.items() if hasattr(play.Args, name)}
    with pytest.raises(SystemExit) as stopped:
        play.main(play.Args(**{"run": "q_network.pt", "epsilon": 1.0} | flags))
    assert isinstance(stopped.value.code, str) and "\n" not in stopped.value.code
    assert "output" in bad or capsys.readouterr() == ("", "")  # an imported `this` prints
    assert [path.name for path in tmp_path.iterdir()] == ["q_network.pt"]
