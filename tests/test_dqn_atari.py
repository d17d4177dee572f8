"""dqn_atari.py: what silently breaks in DQN code, against oracles that share nothing with it."""

import copy
import csv
import json
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import ale_py
import dqn_atari as dqn
import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import ALGORITHMS
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

BREAKOUT, PACMAN = "BreakoutNoFrameskip-v4", "MsPacmanNoFrameskip-v4"
SHORT = dict(  # a run of a second, with a small network
    env_id=BREAKOUT, environment_train_frames_max=400, agent_replay_buffer_initial=100,
    agent_update_frequency=4, optimizer_minibatch_size=8, threads=1, precision="float32",
    environment_test_frames=400, environment_state_height=44, environment_state_width=52,
    optimizer_learning_rate=2e-4, agent_discount_factor=0.9)
TABLE_3 = """
environment_train_frames_max 10000000  environment_evaluation_episodes 10
environment_evaluation_interval_episodes 500  environment_checkpoint_interval_episodes 500
environment_no_op_max 30  environment_reward_clip_limit 1.0  environment_frames_to_maxpool 2
environment_state_height 84  environment_state_width 84  agent_history_length 4
agent_action_repeat 4  agent_update_frequency 1  agent_discount_factor 0.99
agent_epsilon_greedy_epsilon_initial 1.0  agent_epsilon_greedy_epsilon_final 0.01
agent_epsilon_greedy_annealing 1000000  agent_epsilon_greedy_epsilon_evaluation 0.05
agent_replay_buffer_initial 100000  agent_replay_buffer_maximum_length 1000000  optimizer_name Adam
optimizer_minibatch_size 32  optimizer_q_network_parameter_update_interval_frames 1000
optimizer_learning_rate 0.0001
"""
decode = dqn.ReplayMemory(1, (4, 84, 84), "cpu").decode


def environment(training: bool, env_id: str = BREAKOUT, seed: int = 7, **flags) -> gym.Env:
    args = dqn.Args(env_id=env_id, **flags)
    env = dqn.make_env(args, np.random.default_rng(seed), training)
    return dqn.FrameHistory(env, args.agent_history_length)


@pytest.fixture
def games_of_800(monkeypatch):
    """Games are cut off after 800 emulator frames, not 108,000."""
    make, cap = gym.make, {"max_num_frames_per_episode": 800}
    monkeypatch.setattr(gym, "make", lambda env_id, **flags: make(env_id, **flags | cap))


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Run main here: its run directory, replay memory, updates, and frames of target copies."""

    def run(**flags):
        memories, updates, copies = [], [], []
        make, update, load = dqn.ReplayMemory, dqn.update, dqn.QNetwork.load_state_dict
        def seen(q_network, target_network, *rest):
            record = SimpleNamespace(frame=memories[0].added, network=q_network,
                                     target=target_network.head.weight.clone(),
                                     before=None if updates else copy.deepcopy(q_network))
            result = update(q_network, target_network, *rest)
            assert (rest[0].defaults["lr"], rest[2]) == (2e-4, 0.9)
            record.after = q_network.head.weight.detach().clone()
            updates.append(record)
            return result
        runs = tmp_path / f"runs{len(list(tmp_path.iterdir()))}"
        with monkeypatch.context() as patch:
            patch.setattr(dqn, "ReplayMemory", lambda *a: memories.append(make(*a)) or memories[-1])
            patch.setattr(dqn, "update", seen)
            patch.setattr(dqn, "epsilon_greedy", lambda network, *rest, act=dqn.epsilon_greedy: (
                act(network, *rest) if network.head.weight.requires_grad else pytest.fail("θ⁻")))
            patch.setattr(dqn.QNetwork, "load_state_dict", lambda network, θ: (
                copies.append(memories[0].added), load(network, θ)))
            dqn.main(dqn.Args(**SHORT | flags, runs_dir=str(runs)))
        return *runs.iterdir(), memories[0], updates, copies  # one run directory
    yield run
    torch.set_flush_denormal(False)


def weights(run_dir: Path) -> dict[str, torch.Tensor]:
    return torch.load(run_dir / "q_network.pt", weights_only=True)["q_network"]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def as_flags(args: dict) -> list[str]:
    return [text for name, value in args.items() for text in (f"--{name}", str(value))]


DRIVER = """
import dqn_atari as dqn, torch
update, write = dqn.update, dqn.write_file
def seen(*arguments):  # a million numbers: each of two threads has its share
    assert not torch.full((1_000_000,), 1e-39).mul(0.5).any(), "denormal numbers are not flushed"
    return update(*arguments)
dqn.update, dqn.REPORT_INTERVAL = seen, 450
dqn.write_file = lambda path, *rest: (print(path.name), write(path, *rest))
dqn.main(dqn.read_args())
"""


def test_a_run_leaves_every_file_and_flushes_denormals(tmp_path):
    flags = as_flags(SHORT | dict(
        env_id="ALE/Breakout-v5", environment_train_frames_max=900, environment_test_frames=900,
        threads=2, agent_replay_buffer_initial=880, agent_epsilon_greedy_epsilon_evaluation=1,
        environment_evaluation_interval_episodes=2, environment_evaluation_episodes=1,
        environment_checkpoint_interval_episodes=3))
    done = subprocess.run([sys.executable, "-c", DRIVER, *flags], cwd=tmp_path, timeout=120,
                          env=os.environ | {"PYTHONPATH": str(ALGORITHMS)}, capture_output=True)
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr.decode()
    (run_dir,) = (tmp_path / "runs").iterdir()
    rows = list(csv.DictReader((run_dir / "evaluations.csv").read_text().splitlines()))
    assert ",".join(rows[0]) == ("frames,updates,episodes,score_mean,score_variance,length_mean,"
                                 "length_variance,seconds")
    test = json.loads((run_dir / "test.json").read_text())
    assert [int(row["episodes"]) for row in rows] == list(range(2, test["episodes"] + 1, 2))
    assert test.keys() >= {*rows[0], "last_evaluations_score_mean",
                           "frames_per_second_first_tenth", "frames_per_second_last_tenth"}
    assert (test["frames"], test["updates"]) == (900, 6)  # an update at 880, 884, …, 900
    scores, lengths = test["scores"], test["lengths"]
    assert 900 - sum(lengths) == test["unfinished_score_and_length"][1] and len(scores) > 1
    assert test["score_mean"] == pytest.approx(sum(scores) / len(lengths))
    last = [float(row["score_mean"]) for row in rows[-5:]]
    assert test["last_evaluations_score_mean"] == pytest.approx(sum(last) / 5) and len(rows) > 5
    assert done.stdout.count(b"q_network.pt") == test["episodes"] // 3 + 1
    assert torch.load(run_dir / "q_network.pt")["actions"] == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert same(weights(run_dir), torch.load(run_dir / "checkpoint.pt")["q_network"])
    events = EventAccumulator(str(run_dir)).Reload()
    assert max(game.value for game in events.Scalars("charts/episodic_return")) > 1  # a game's sum
    losses = [event.value for event in events.Scalars("losses/td_loss")]
    assert math.isnan(losses[0]) and losses[1] > 0  # at 450 and 900; the first update is at 880
    games = [event.value for event in events.Scalars("charts/episodic_length")]
    assert 1 <= len(games) <= 7 and sum(games) <= 900  # games, of about 180 frames, not lives


def test_same_seed_same_run_and_an_evaluation_disturbs_nothing(train):
    plain, memory, updates, _ = train()
    evaluated, memory_2, *_ = train(environment_evaluation_interval_episodes=2,
                                    environment_evaluation_episodes=1)
    other, _, updates_3, _ = train(seed=2)
    assert not same(updates[0].before.state_dict(), updates_3[0].before.state_dict())
    assert (evaluated / "evaluations.csv").exists()
    tests = [json.loads((run_dir / "test.json").read_text()) for run_dir in (plain, evaluated)]
    assert tests[0]["scores"] == tests[1]["scores"] != []
    assert same(weights(plain), weights(evaluated)) and (memory.frames == memory_2.frames).all()
    assert not same(weights(plain), weights(other))
    rngs = [torch.load(run_dir / "checkpoint.pt")["rngs"] for run_dir in (plain, other)]
    assert len({rng["state"]["inc"] for both in rngs for rng in both}) == 6  # no two are the same


def test_first_flags_are_table_3():
    assert TABLE_3.split() == [str(x) for pair in [*vars(dqn.Args()).items()][:23] for x in pair]


@pytest.mark.parametrize("frame, epsilon", [(0, 0.9), (10**5, 0.811), (10**6, 0.01), (10**7, 0.01)])
def test_epsilon(frame, epsilon):
    args = dqn.Args(agent_epsilon_greedy_epsilon_initial=0.9)
    assert dqn.epsilon_at(frame, args) == pytest.approx(epsilon, abs=1e-12)


@pytest.mark.parametrize("frequency", [1, 4])
def test_counts_of_updates_target_copies_first_weights_and_epsilon(train, frequency):
    _, memory, updates, copies = train(
        environment_train_frames_max=200, agent_update_frequency=frequency,
        optimizer_q_network_parameter_update_interval_frames=50,
        agent_epsilon_greedy_annealing=1, agent_epsilon_greedy_epsilon_final=0.0)
    best = updates[0].before(memory.gather(np.arange(99))[0]).argmax(dim=1).numpy()
    assert (best == memory.numbers[:99, 0]).tolist() == [False, *[True] * 98]  # ε is 1, then 0
    assert [update.frame for update in updates] == list(range(100, 201, frequency))
    assert copies == [50, 100, 150, 200]
    first = updates[0].before  # Adam's first step is as long as the learning rate, AdamW's longer
    assert (updates[0].after - first.head.weight).abs().max().item() == pytest.approx(2e-4, 1e-4)
    for update in updates:  # the target is what the last update before the copy left
        left = [past.after for past in updates if past.frame <= (update.frame - 1) // 50 * 50]
        assert torch.equal(update.target, left[-1] if left else first.head.weight)
    assert type(updates[0].network.layers[7]) is dqn.OneDNNLinear
    for i in (0, 2, 4):
        for weight in (first.layers[i].weight, updates[0].network.layers[i].weight):
            assert weight.is_contiguous(memory_format=torch.channels_last)
        filters = first.layers[i].weight.detach().flatten(1)
        assert torch.allclose(filters @ filters.T, torch.eye(len(filters)), atol=1e-5)


@pytest.mark.parametrize("env_id, repeat, pool, limit, size", [
    (PACMAN, 3, 3, 7, (44, 52)), ("ALE/Breakout-v5", 4, 2, 1, (84, 84))])
def test_a_game_against_the_bare_emulator(env_id, repeat, pool, limit, size):
    """Training and evaluation play the same game by the same actions, and so does the emulator."""
    flags = dict(agent_action_repeat=repeat, environment_frames_to_maxpool=pool,
                 environment_reward_clip_limit=limit, environment_state_height=size[0],
                 environment_state_width=size[1])
    train, test = environment(True, env_id, **flags), environment(False, env_id, **flags)
    ale, decode = ale_py.ALEInterface(), dqn.ReplayMemory(1, (4, *size), "cpu").decode

    def naive_frame(screens: list[np.ndarray]) -> np.ndarray:  # by colour, luminance, bilinear
        grey = torch.tensor(np.max(screens[-pool:], axis=0) @ (0.299, 0.587, 0.114))
        return nn.functional.interpolate(grey[None, None], size, mode="bilinear")[0, 0].numpy()
    (state, _), (test_state, _) = train.reset(seed=5), test.reset(seed=5)
    ale.setFloat("repeat_action_probability", 0.0)
    ale.loadROM(ale_py.roms.get_rom_path(train.unwrapped._game))
    for _ in range(train.unwrapped.ale.getEpisodeFrameNumber()):
        ale.act(ale_py.Action.NOOP)
    meanings, rng = train.get_wrapper_attr("meanings"), np.random.default_rng(0)
    history, rewards, lives, lost = [naive_frame([ale.getScreenRGB()])] * 4, [], [ale.lives()], 0
    while not ale.game_over():
        assert abs(decode([state])[0].numpy() - history[-4:]).max() < 1.1  # rounded twice
        action = int(rng.integers(len(meanings)))
        name = getattr(ale_py.Action, meanings[action])
        acted = [(ale.act(name), ale.getScreenRGB()) for _ in range(repeat) if not ale.game_over()]
        history.append(naive_frame([screen for _, screen in acted]))
        raw = sum(reward for reward, _ in acted)
        rewards.append(raw)
        lives.append(ale.lives())
        state, reward, terminated, truncated, info = train.step(action)
        test_state, test_reward, test_terminated, _, test_info = test.step(action)
        assert test_reward == raw and reward == np.clip(raw, -limit, limit)
        assert terminated == (lives[-1] < lives[-2]) and test_terminated == ale.game_over()
        assert not truncated and state[-1] == test_state[-1]
        if terminated and not ale.game_over():
            assert "episode" not in info
            number = train.unwrapped.ale.getEpisodeFrameNumber()
            state, last = train.reset()[0], state[-1]
            assert train.unwrapped.ale.getEpisodeFrameNumber() == number and state == (last,) * 4
            history, lost = [history[-1]] * 4, lost + 1
    assert lost == lives[0] - 1 > 1 and (max(rewards) > 1 or "Breakout" in env_id)
    for statistics in (info["episode"], test_info["episode"]):
        assert (statistics["r"], statistics["l"]) == (sum(rewards), len(rewards))
    train.reset()
    ale = train.unwrapped.ale
    assert ale.lives() == lives[0] and ale.getEpisodeFrameNumber() <= 30
    assert ale.getInt("max_num_frames_per_episode") == 108_000
    train.set_wrapper_attr("lives", lives[0] - 1)
    assert not train.step(0)[2]  # a life more, a bonus, ends no episode


def test_actions_are_four_directions_and_fire_when_centred():
    for game, names in (("Riverraid", "NOOP FIRE UP RIGHT LEFT DOWN"),
                        ("Enduro", "NOOP FIRE RIGHT LEFT DOWN")):
        meanings = environment(False, f"{game}NoFrameskip-v4").get_wrapper_attr("meanings")
        assert meanings == names.split()


def test_no_ops_are_0_to_30_from_the_seed():
    def no_ops(count: int, seed: int, **flags) -> list[int]:
        env = environment(False, seed=seed, **flags)
        return [(env.reset(), env.unwrapped.ale.getEpisodeFrameNumber())[1] for _ in range(count)]
    first = no_ops(150, 1)
    assert (min(first), max(first), len(set(first)) > 25) == (0, 30, True)
    assert first[:9] == no_ops(9, 1) != no_ops(9, 2)
    assert {*no_ops(9, 1, environment_no_op_max=0)} == {0}
    assert len({*no_ops(9, 1, env_id="ALE/Backgammon-v5")}) == 1  # it has no NOOP


@pytest.mark.parametrize("length", [1, 4, 5])
def test_states_are_stacked_frames_laid_out_as_convolutions_read_them(length):
    pixels = np.random.default_rng(0).integers(256, size=(3, length, 44, 52), dtype=np.uint8)
    histories = [tuple(map(dqn.lz4.block.compress, frames)) for frames in pixels]
    replay = dqn.ReplayMemory(3, (length, 44, 52), "cpu")
    replay.add(histories[0], 1, 0.0, histories[1], False)
    s, _, _, s_next, _ = replay.gather(np.array([0, 0]))
    assert (s.numpy() == pixels[0]).all() and s.is_contiguous(memory_format=torch.channels_last)
    assert (s_next.numpy() == [*pixels[0, 1:], pixels[1, -1]]).all()
    assert not dqn.ReplayMemory(1, (4, 44, 52), "mps").transfer["non_blocking"]  # corrupts there


def test_replay_returns_what_was_acted_on(games_of_800):
    """Across lost lives, ends of games, truncation and overflow, against a list of arrays."""
    env, memory = environment(training=True), dqn.ReplayMemory(300, (4, 84, 84), "cpu")
    rng, naive, seen, sizes = np.random.default_rng(0), [], set(), {}
    state, _ = env.reset(seed=1)
    for n in range(1, 1301):
        action = int(rng.integers(4))
        s = decode([state])[0]
        state_next, reward, terminated, truncated, info = env.step(action)
        memory.add(state, action, reward, state_next, terminated)
        naive.append((s, action, reward, decode([state_next])[0], terminated))
        sizes |= {id(x): sys.getsizeof(x) for x in (*state, *state_next)} if n <= 250 else {}
        state = state_next
        if terminated or truncated:
            assert not (terminated and truncated)
            seen.add("cut" if truncated else "game over" if "episode" in info else "life lost")
            state, _ = env.reset()
        if n == 250:
            assert len(memory) == 250
            size = sum(sizes.values()) + memory.frames[:250].nbytes
            assert size / 250 + memory.numbers[0].nbytes < 1500
        if n in (250, 300, 301, 650, 1300):
            copied = dqn.ReplayMemory(300, (4, 84, 84), "cpu")
            saved = memory.state_dict()
            copied.load_state_dict(saved)
            frames = set(map(id, memory.frames[: len(memory)].flat))
            assert len(saved["lengths"]) == len(frames) == len(
                set(map(id, copied.frames[: len(copied)].flat)))
            kept, places = naive[-300:], np.arange(max(n - 300, 0), n) % 300
            for replay in (memory, copied):
                got = replay.gather(places)
                dtypes = [torch.uint8, torch.int64, torch.float32, torch.uint8, torch.bool]
                assert [column.dtype for column in got] == dtypes
                for column, expected in zip(got, zip(*kept, strict=True), strict=True):
                    expected = torch.stack([torch.as_tensor(value) for value in expected])
                    assert torch.equal(column, expected.to(column.dtype))
    assert seen == {"cut", "game over", "life lost"}


def test_in_a_run_truncation_bootstraps_and_a_lost_life_does_not(train, games_of_800):
    _, memory, _, _ = train(environment_train_frames_max=650, environment_no_op_max=0)
    frames, terminal = memory.frames, memory.numbers[:, 2]
    ends = [i - 1 for i in range(1, 650) if len({id(x) for x in frames[i][:4]}) == 1]
    cut = [i for i in ends if not terminal[i] and frames[i][4] != frames[i + 1][0]]
    assert 1 <= len(cut) <= 3 < terminal.sum() and set(ends) >= set(np.flatnonzero(terminal[:-1]))


def test_minibatches_are_drawn_from_all_of_the_memory(train, monkeypatch):
    drawn, gather = [], dqn.ReplayMemory.gather
    monkeypatch.setattr(dqn, "update", lambda *_: (torch.zeros(()), torch.zeros(8)))
    monkeypatch.setattr(dqn.ReplayMemory, "gather",
                        lambda self, indices: drawn.append(indices) or gather(self, indices))
    train(agent_replay_buffer_maximum_length=100, agent_update_frequency=1)
    counts = np.bincount(np.concatenate(drawn), minlength=100)  # 301 minibatches of 8
    mean = 301 * 8 / 100
    assert len(counts) == 100 and counts.min() > 0
    assert np.square(counts - mean).sum() / mean < 99 + 5 * math.sqrt(2 * 99)  # chi-squared
    assert sum(len(set(indices)) < 8 for indices in drawn) > 30  # with replacement: of 301, 75


def test_network_is_table_2():
    torch.manual_seed(0)
    network, shapes, inputs = dqn.QNetwork(4, 84, 84, num_actions=6), [], []
    before = {name: θ.clone() for name, θ in network.state_dict().items()}
    dqn.initialize_orthogonal(network)
    changed = {name for name, θ in network.state_dict().items() if not torch.equal(θ, before[name])}
    assert changed == {"layers.0.weight", "layers.2.weight", "layers.4.weight"}
    for name, fan_in in (("layers.7.weight", 3136), ("layers.0.bias", 256), ("head.bias", 512)):
        assert 0.5 < before[name].abs().max() * fan_in**0.5 <= 1  # PyTorch's default
    network.layers[0].register_forward_pre_hook(lambda _, x: inputs.append(x[0]))
    for layer in [*network.layers, network.head]:
        layer.register_forward_hook(lambda layer, _, out: shapes.append((
            type(layer).__name__, tuple(out.shape), sum(θ.numel() for θ in layer.parameters()))))
    q = network(pixels := torch.randint(0, 256, (2, 4, 84, 84), dtype=torch.uint8))
    assert shapes == [
        ("Conv2d", (2, 32, 20, 20), 8224), ("ReLU", (2, 32, 20, 20), 0),
        ("Conv2d", (2, 64, 9, 9), 32832), ("ReLU", (2, 64, 9, 9), 0),
        ("Conv2d", (2, 64, 7, 7), 36928), ("ReLU", (2, 64, 7, 7), 0),
        ("Flatten", (2, 3136), 0), ("Linear", (2, 512), 1606144), ("ReLU", (2, 512), 0),
        ("Linear", (2, 6), 512 * 6 + 6)]
    assert torch.equal(inputs[0], pixels / 255)
    assert torch.allclose(q, network.head(network.layers(pixels / 255)))


class Table(nn.Module):
    """Q(s, ·) is a row of a table, the one that the first pixel of s names."""

    def __init__(self, rows: list):
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows))

    def forward(self, states):
        return self.rows[states[:, 0, 0, 0].long()]


def test_update_is_equation_37_by_hand():
    q = Table([[1.0, 2.0], [0.0, -1.0], [0.2, 0.5], [0.0, 0.0]])
    target = Table([[-1.0, -2.0], [1.0, 0.0], [2.0, 4.0], [0.5, 3.0]])  # s' of the first: state 3
    s = torch.arange(4, dtype=torch.uint8).view(4, 1, 1, 1).expand(4, 4, 84, 84)
    r, terminal = torch.tensor([1.0, 0.0, -1.0, 0.25]), torch.tensor([False, True, False, False])
    minibatch = s, torch.tensor([0, 1, 1, 0]), r, s.flip(0), terminal
    before, sgd = q.rows.detach().clone(), torch.optim.SGD(q.parameters(), lr=0.1)
    loss, values = dqn.update(q, target, sgd, minibatch, 0.9, "float32")
    # y = 1 + 0.9·3, 0, -1 + 0.9·1, 0.25 - 0.9·1; Q - y = -2.7, -1, 0.6, 0.65
    gradient = torch.tensor([[-1, 0], [0, -1], [0, 0.6], [0.65, 0]])  # clipped; of the sum
    assert torch.allclose(q.rows.grad, gradient)
    assert torch.allclose(q.rows, before - 0.1 * gradient)
    assert target.rows.grad is None
    assert loss.item() == pytest.approx((2.2 + 0.5 + 0.18 + 0.21125) / 4)
    assert values.tolist() == [1, -1, 0.5, 0] and values.shape == (4,)
    dqn.update(q, target, sgd, minibatch, 0.9, "float32")  # gradients start from zero
    assert torch.allclose(q.rows.grad[:2], gradient[:2], atol=0.2)


def test_update_in_bfloat16_is_close_to_float32():
    torch.manual_seed(0)
    network, rng = dqn.QNetwork(4, 84, 84, 6), torch.Generator().manual_seed(1)
    dqn.initialize_orthogonal(network)
    s, s_next = torch.randint(0, 256, (2, 32, 4, 84, 84), dtype=torch.uint8, generator=rng)
    r = torch.randint(-1, 2, (32,), generator=rng).float()
    minibatch = s, torch.arange(32) % 6, r, s_next, r < 0
    results, dtypes, ways = [], [], []
    linear, onednn = nn.Linear, dqn.OneDNNLinear
    for precision, kind in (("float32", linear), ("float32", onednn), ("bfloat16", onednn)):
        q = copy.deepcopy(network)
        q.layers[7].__class__ = kind
        assert torch.equal(q(s[:1]), network(s[:1]))  # one state is never oneDNN's
        q.layers[2].register_forward_hook(lambda *arguments: dtypes.append(arguments[-1].dtype))
        q.layers[7].register_forward_hook(lambda _, x, y: ways.append(str(y.grad_fn)[1:6]))
        sgd = torch.optim.SGD(q.parameters(), lr=1)
        loss, values = dqn.update(q, copy.deepcopy(network), sgd, minibatch, 0.99, precision)
        assert values.dtype == loss.dtype == torch.float32
        assert all(θ.dtype == θ.grad.dtype == torch.float32 for θ in q.parameters())
        results.append((values, torch.cat([θ.grad.flatten() for θ in q.parameters()])))
    assert dtypes == [torch.float32, torch.float32, torch.bfloat16]
    assert ways == ["Addmm", "ToDen" if torch.backends.mkldnn.is_available() else "Addmm", "Addmm"]
    dqn.update(q, q, sgd, minibatch, 0.99, "bfloat16")  # without a target network
    assert all(θ.grad.any() for θ in q.parameters())
    (q_32, gradient_32), (q_onednn, gradient_onednn), (q_16, gradient_16) = results
    assert torch.allclose(q_32, q_onednn, atol=1e-5)
    assert torch.allclose(gradient_32, gradient_onednn, rtol=1e-3, atol=1e-5)
    assert torch.allclose(q_32, q_16, atol=0.02) and not torch.equal(q_32, q_16)
    assert torch.cosine_similarity(gradient_32, gradient_16, dim=0) > 0.99
    assert gradient_32.norm() > 20  # it is not clipped


def test_rmsprop_is_the_one_that_nature_released():
    θ = torch.tensor([1.0, -2.0], requires_grad=True)
    args = dqn.Args(optimizer_name="RMSprop", optimizer_learning_rate=0.1)
    optimizer = dqn.make_optimizer(args, SimpleNamespace(parameters=lambda: [θ]))
    naive, g, n = [1.0, -2.0], [0.0, 0.0], [0.0, 0.0]
    for gradient in ([1.0, -0.5], [0.0, 3.0], [-2.0, 1e-4]):
        θ.grad = torch.tensor(gradient)
        optimizer.step()
        for i, d in enumerate(gradient):
            g[i] = 0.95 * g[i] + 0.05 * d
            n[i] = 0.95 * n[i] + 0.05 * d * d
            naive[i] -= 0.1 * d / math.sqrt(n[i] - g[i] ** 2 + 0.01)
        assert θ.tolist() == pytest.approx(naive, rel=1e-5)
        saved, optimizer = optimizer.state_dict(), type(optimizer)([θ], lr=9)
        optimizer.load_state_dict(saved)  # a run that is stopped, and resumed


@pytest.mark.parametrize("bfloat16, choice", [(0.5, "bfloat16"), (0.95, "float32"), (2, "float32")])
def test_bfloat16_only_where_it_is_quicker_by_a_clear_margin(monkeypatch, bfloat16, choice):
    seconds, seen, update = {"float32": 1.0, "bfloat16": bfloat16}, [], dqn.update
    monkeypatch.setattr(dqn, "update", lambda *all: seen.append(all[-1]) or update(*all))
    monkeypatch.setattr(dqn.timeit, "timeit", lambda work, **_: (work(), seconds[seen[-1]])[1])
    q_network, shape = dqn.QNetwork(4, 36, 36, 6), (4, 36, 36)
    assert dqn.choose_precision(dqn.Args(device="cpu"), q_network, shape) == choice


class Scripted(gym.Env):
    """Games of 5, 9, 4, 5, 9, 4, … frames, each frame worth 2 points."""

    action_space, observation_space = gym.spaces.Discrete(4), gym.spaces.Box(0, 255, (84, 84))

    def __init__(self):
        self.games, self.actions = -1, []

    def reset(self, **_):
        self.games, self.left = self.games + 1, (5, 9, 4)[(self.games + 1) % 3]
        return np.zeros((84, 84), np.uint8), {}

    def step(self, action):
        self.actions.append(action)
        self.left -= 1
        ends = (self.left == 0, False)[:: -1 if self.games % 3 == 1 else 1]  # 9: cut off
        return np.zeros((84, 84), np.uint8), 2.0, *ends, {}


@pytest.fixture
def evaluated(monkeypatch):
    """evaluate() of a network that likes action 2, on scripted games; its result, the actions."""
    network = Table([[0.0, 1.0, 3.0, 2.0]])
    network.head = SimpleNamespace(out_features=4)

    def run(number: int, games: int, frames: int, seed: int = 1) -> tuple:
        env = Scripted()
        envs = {False: gym.wrappers.RecordEpisodeStatistics(env)}  # none for training
        monkeypatch.setattr(dqn, "make_env", lambda args, no_op_rng, training: envs[training])
        args = dqn.Args(environment_evaluation_episodes=games, environment_test_frames=frames,
                        seed=seed)
        return dqn.evaluate(args, network, decode, number), env.actions
    return run


@pytest.mark.parametrize("number, games, frames, finished, unfinished", [
    (1, 2, 1000, [(10, 5), (18, 9)], [0, 0]),  # so many games
    (1, 9, 16, [(10, 5), (18, 9)], [4, 2]),  # a limit of frames
    (0, 1, 24, [(10, 5), (18, 9), (8, 4), (10, 5)], [2, 1]),  # the test: what the frames hold
])
def test_evaluation_counts_finished_games(evaluated, number, games, frames, finished, unfinished):
    ended, actions = evaluated(number, games, frames)
    assert (*ended, len(actions)) == (finished, unfinished, 14 if games == 2 else frames)


def test_evaluation_acts_at_random_in_1_of_20_frames_and_is_reproducible(evaluated):
    actions = evaluated(0, 10, 6000)[1]
    share = np.bincount(actions, minlength=4) / 6000
    assert share == pytest.approx([0.0125, 0.0125, 0.9625, 0.0125], abs=0.008)
    assert actions == evaluated(0, 10, 6000)[1] != evaluated(0, 10, 6000, seed=2)[1]
    assert actions[:900] != evaluated(1, 999, 900)[1] != evaluated(2, 999, 900)[1]


def test_dead_units_are_0_in_all_states():
    q_network = SimpleNamespace(layers=lambda x: (x == 1).all() * torch.tensor([[0.0, 0], [0, 3]]))
    assert dqn.dead_units(q_network, torch.full((2,), 255)) == 0.5  # the first of the two


def test_mean_variance_and_first_and_last_tenth_by_hand(tmp_path):
    counters = SimpleNamespace(frames=3, updates=2, episodes=1, seconds=1.25, evaluations=[],
                               speeds=[*range(20)])
    row = dqn.summary(counters, [(1.0, 10), (4.0, 20), (7.0, 60)])
    assert row == {"frames": 3, "updates": 2, "episodes": 1, "score_mean": 4, "score_variance": 9,
                   "length_mean": 30, "length_variance": pytest.approx(700), "seconds": 1.2}
    assert dqn.summary(counters, [(1.0, 10)])["score_variance"] == 0
    dqn.write_test(tmp_path / "test.json", counters, [], [2.0, 1])
    test = json.loads((tmp_path / "test.json").read_text())
    assert [test[f"frames_per_second_{x}_tenth"] for x in ("first", "last")] == [0.5, 18.5]
    assert test["score_mean"] is None  # for strict readers of JSON
