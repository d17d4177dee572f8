"""dqn_atari.py: what silently breaks in DQN code, each against an oracle that shares nothing with the script."""

import copy
import csv
import dataclasses
import itertools
import json
import math
import re
import sys
from collections import OrderedDict

import ale_py
import dqn_atari as dqn
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

PONG, BREAKOUT = "PongNoFrameskip-v4", "BreakoutNoFrameskip-v4"
CPU = torch.device("cpu")
SHORT = dict(device="cpu", env_id=BREAKOUT, environment_train_frames_max=400, agent_replay_buffer_initial=100,
             optimizer_minibatch_size=8, agent_update_frequency=4, environment_test_frames=200)  # a run of two seconds

# Table 3 of the lecture, in its order
TABLE_3 = """
environment_train_frames_max 10000000
environment_evaluation_episodes 10
environment_evaluation_interval_episodes 500
environment_checkpoint_interval_episodes 500
environment_no_op_max 30
environment_reward_clip_limit 1.0
environment_frames_to_maxpool 2
environment_state_height 84
environment_state_width 84
agent_history_length 4
agent_action_repeat 4
agent_update_frequency 1
agent_discount_factor 0.99
agent_epsilon_greedy_epsilon_initial 1.0
agent_epsilon_greedy_epsilon_final 0.01
agent_epsilon_greedy_annealing 1000000
agent_epsilon_greedy_epsilon_evaluation 0.05
agent_replay_buffer_initial 100000
agent_replay_buffer_maximum_length 1000000
optimizer_name Adam
optimizer_minibatch_size 32
optimizer_q_network_parameter_update_interval_frames 1000
optimizer_learning_rate 0.0001
"""


@pytest.fixture
def train(tmp_path, monkeypatch):
    """Run main() in this process; returns the run directory, the replay memory and one record per update."""

    def run(**flags):
        memories, updates = [], []
        make_memory, original_update = dqn.ReplayMemory, dqn.update

        def remember(*arguments):
            memories.append(make_memory(*arguments))
            return memories[-1]

        def spy(q_network, working_network, target_network, *rest):
            result = original_update(q_network, working_network, target_network, *rest)
            updates.append({"added": memories[-1].added, "target": target_network.head.weight.clone(),
                            "online": q_network.head.weight.detach().clone()})
            return result

        with monkeypatch.context() as patch:
            patch.setattr(dqn, "ReplayMemory", remember)
            patch.setattr(dqn, "update", spy)
            patch.setattr(sys, "argv", ["dqn_atari.py"])
            before = set(tmp_path.glob("*/*"))
            runs_dir = tmp_path / f"runs{len(before)}"
            dqn.main(dqn.Args(**(SHORT | {"runs_dir": str(runs_dir)} | flags)))
        (run_dir,) = runs_dir.iterdir()
        return run_dir, memories[0], updates

    return run


def weights(run_dir) -> dict[str, torch.Tensor]:
    return torch.load(run_dir / "q_network.pt", weights_only=True)["q_network"]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def environment(training: bool, env_id: str = BREAKOUT, encoding: str = "lz4", cap: int | None = None, **flags):
    """A preprocessed game, its decoder and its arguments; `cap` cuts games off after so many emulator frames."""
    args = dqn.Args(env_id=env_id, **flags)
    encode, decode = dqn.frame_encoding(encoding, args.environment_state_height, args.environment_state_width, CPU)
    emulator = dqn.make_emulator(env_id)
    if cap:
        emulator = TimeLimit(emulator, cap)
    return dqn.preprocess(emulator, args, encode, np.random.default_rng(7), training), decode, args


# ---- the whole script ------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [PONG, "ALE/Breakout-v5"])
def test_a_short_run_leaves_every_file(command_line, tmp_path, env_id):
    done = command_line("dqn_atari.py", "--env-id", env_id, "--environment-train-frames-max", 1100,
                        "--agent-replay-buffer-initial", 1000, "--agent-update-frequency", 4,
                        "--environment-test-frames", 1600,
                        "--environment-evaluation-interval-episodes", 1, "--environment-evaluation-episodes", 1,
                        "--agent-epsilon-greedy-epsilon-evaluation", 1)
    assert done.returncode == 0, done.stderr
    assert not re.search("warn|Traceback|A.L.E", done.stderr, re.IGNORECASE), done.stderr
    (run_dir,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(rf"{env_id.replace('/', '-')}__dqn_atari__1__\d{{8}}-\d{{6}}", run_dir.name)

    assert json.loads((run_dir / "args.json").read_text())["env_id"] == env_id
    rows = list(csv.DictReader((run_dir / "evaluations.csv").open()))
    assert ",".join(rows[0]) == "frames,updates,episodes,score_mean,score_variance,length_mean,length_variance,seconds"
    assert int(rows[0]["frames"]) < 1100
    test = json.loads((run_dir / "test.json").read_text())
    assert test.keys() >= {*rows[0], "scores", "lengths", "seed", "env_id", "versions", "device", "peak_memory_bytes"}
    assert (test["frames"], test["updates"]) == (1100, 26)  # frames 1000, 1004, …, 1100
    assert sum(test["lengths"]) <= 1600
    assert test["score_mean"] == pytest.approx(sum(test["scores"]) / len(test["scores"]))
    assert test["length_variance"] == pytest.approx(
        sum(n * n for n in test["lengths"]) / len(test["lengths"]) - test["length_mean"] ** 2)
    assert f"{test['score_mean']:.5g}" in done.stdout  # the row of Table 5
    saved = torch.load(run_dir / "q_network.pt", weights_only=True)
    assert saved["actions"] == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert same(saved["q_network"], torch.load(run_dir / "checkpoint.pt", weights_only=True)["q_network"])

    events = EventAccumulator(str(run_dir)).Reload()
    layers = ("conv1", "conv2", "conv3", "linear")
    assert set(events.Tags()["scalars"]) == {
        "charts/episodic_return", "charts/episodic_length", "charts/epsilon", "charts/frames_per_second",
        "losses/huber", "losses/q_values", "evaluation/score_mean", "evaluation/score_variance",
        "evaluation/length_mean",
        "diagnostics/q_spread", *(f"diagnostics/dead_units_{layer}" for layer in layers)}
    assert "hyperparameters/text_summary" in events.Tags()["tensors"]


def test_training_leaves_raw_scores_of_whole_games(train):
    run_dir, memory, _ = train()
    events = EventAccumulator(str(run_dir)).Reload()
    lengths = [event.value for event in events.Scalars("charts/episodic_length")]
    assert sum(lengths) <= 400
    assert memory.terminals[: len(memory)].sum() >= 5 * len(lengths) >= 5  # Breakout's five lives


# ---- Table 3, ε, counts ----------------------------------------------------------------------------


def test_first_flags_are_table_3():
    table = [line.split() for line in TABLE_3.split("\n") if line]
    fields = dataclasses.fields(dqn.Args)[: len(table)]
    assert [[field.name, str(field.default)] for field in fields] == table


def test_epsilon():
    args = dqn.Args()
    for frame, epsilon in ((0, 1.0), (100_000, 0.901), (500_000, 0.505), (1_000_000, 0.01), (2_000_000, 0.01)):
        assert dqn.epsilon_at(frame, args) == pytest.approx(epsilon, abs=1e-12)


def test_counts_of_updates_and_target_copies(train):
    _, _, updates = train(optimizer_q_network_parameter_update_interval_frames=150)
    # transitions 100, 104, …, 400; nothing learns before the replay memory holds agent_replay_buffer_initial
    assert [update["added"] for update in updates] == list(range(100, 401, 4))
    copies = [after["added"] for before, after in itertools.pairwise(updates)
              if not torch.equal(before["target"], after["target"])]
    assert copies == [152, 304]  # the first updates after the copies at frames 150 and 300
    assert torch.equal(updates[13]["target"], updates[12]["online"])  # copied at 150: what the update at 148 left


def test_same_seed_same_run_and_evaluation_leaves_training_untouched(train):
    plain, memory, _ = train()
    evaluated, memory_2, _ = train(environment_evaluation_interval_episodes=2, environment_evaluation_episodes=1,
                                   agent_epsilon_greedy_epsilon_evaluation=0.5)
    other, memory_3, _ = train(seed=2)
    assert (evaluated / "evaluations.csv").exists()
    assert same(weights(plain), weights(evaluated))
    assert memory.frames == memory_2.frames
    assert not same(weights(plain), weights(other))
    assert memory.frames != memory_3.frames
    tests = [json.loads((run_dir / "test.json").read_text()) for run_dir in (plain, evaluated)]
    assert tests[0]["scores"] == tests[1]["scores"]


@pytest.mark.parametrize("encoding", ["raw", "tensor"])
def test_every_encoding_gives_the_same_run(train, encoding):
    assert same(weights(train()[0]), weights(train(replay_encoding=encoding)[0]))


# ---- the environment -------------------------------------------------------------------------------


def naive_screen(screens: list[np.ndarray], height: int, width: int) -> np.ndarray:
    """Max per colour of the last two, luminance, bilinear with pixel centres at halves: loops over output pixels."""
    colour = np.maximum(screens[-1], screens[-2]).astype(float) if len(screens) > 1 else screens[-1].astype(float)
    grey = colour @ (0.299, 0.587, 0.114)
    frame = np.empty((height, width))
    for y in range(height):
        for x in range(width):
            v = min(max((y + 0.5) * grey.shape[0] / height - 0.5, 0), grey.shape[0] - 1)
            h = min(max((x + 0.5) * grey.shape[1] / width - 0.5, 0), grey.shape[1] - 1)
            i, j = int(v), int(h)
            i_next, j_next = min(i + 1, grey.shape[0] - 1), min(j + 1, grey.shape[1] - 1)
            frame[y, x] = ((1 - v + i) * (1 - h + j) * grey[i, j] + (1 - v + i) * (h - j) * grey[i, j_next]
                           + (v - i) * (1 - h + j) * grey[i_next, j] + (v - i) * (h - j) * grey[i_next, j_next])
    return frame


@pytest.mark.parametrize("env_id", ["SpaceInvadersNoFrameskip-v4", BREAKOUT])
def test_preprocessing_equals_a_computation_from_raw_screens(env_id):
    env, decode, args = environment(training=False, env_id=env_id)
    ale = ale_py.ALEInterface()
    state, _ = env.reset(seed=5)
    ale.setFloat("repeat_action_probability", 0.0)
    ale.loadROM(ale_py.roms.get_rom_path(env.unwrapped._game))
    for _ in range(int(np.random.default_rng(7).integers(31))):
        ale.act(ale_py.Action.NOOP)
    screens, actions = [ale.getScreenRGB()], np.random.default_rng(0)
    meanings = dqn.wrapper(env, dqn.JoystickActions).meanings
    for _ in range(60):
        newest = decode(state)[-1].numpy()
        assert np.abs(newest - naive_screen(screens, *newest.shape)).max() < 2  # fixed-point rounding, twice
        action = int(actions.integers(len(meanings)))
        state, reward, *_ = env.step(action)
        naive_reward = 0
        for _ in range(args.agent_action_repeat):
            naive_reward += ale.act(getattr(ale_py.Action, meanings[action]))
            screens.append(ale.getScreenRGB())
        assert reward == naive_reward


def test_actions_are_four_directions_and_fire_when_centred():
    assert dqn.wrapper(environment(False, "RiverraidNoFrameskip-v4")[0], dqn.JoystickActions).meanings == [
        "NOOP", "FIRE", "UP", "RIGHT", "LEFT", "DOWN"]
    env = environment(False, "EnduroNoFrameskip-v4")[0]
    joystick = dqn.wrapper(env, dqn.JoystickActions)
    assert joystick.meanings == ["NOOP", "FIRE", "RIGHT", "LEFT", "DOWN"]
    assert [env.unwrapped.get_action_meanings()[joystick.action(i)] for i in range(5)] == joystick.meanings


def test_games_without_noop_or_without_directions():
    env, _, _ = environment(False, "ALE/Backgammon-v5")  # its actions are FIRE, RIGHT, LEFT
    bare = dqn.make_emulator("ALE/Backgammon-v5")
    frame_numbers = []
    for game in (env, bare):
        game.reset(seed=1)
        frame_numbers.append(game.unwrapped.ale.getEpisodeFrameNumber())
    assert frame_numbers[0] == frame_numbers[1]  # nothing was pressed
    with pytest.raises(ValueError, match="ALE/VideoCheckers-v5 cannot be played"):
        environment(False, "ALE/VideoCheckers-v5")


def test_a_lost_life_neither_resets_nor_steps_the_game():
    env, _, _ = environment(training=True)
    env.reset(seed=3)
    ale, rng, lives = env.unwrapped.ale, np.random.default_rng(0), []
    while len(lives) < 6:
        state, _, terminated, truncated, info = env.step(int(rng.integers(4)))
        if terminated or truncated:
            frame_number = ale.getEpisodeFrameNumber()
            lives.append(ale.lives())
            first, _ = env.reset()
            if info["game_over"]:
                assert ale.getEpisodeFrameNumber() <= 30 and ale.lives() == 5
            else:
                assert ale.getEpisodeFrameNumber() == frame_number > 30
                assert first == (state[-1],) * 4  # the history begins with the life's last frame, four times
    assert lives == [4, 3, 2, 1, 0, 4]


def test_rewards_are_clipped_in_training_only():
    rewards = {}
    for training in (True, False):
        env, _, _ = environment(training, "SpaceInvadersNoFrameskip-v4")
        env.reset(seed=1)
        rng = np.random.default_rng(1)
        steps = [env.step(int(rng.integers(env.action_space.n))) for _ in range(150)]
        rewards[training] = [step[1] for step in steps]
        if training:
            raw = [step[4]["raw_reward"] for step in steps]
    assert max(rewards[True]) == 1.0 and max(raw) >= 5.0
    assert raw == rewards[False]


def test_the_emulator_is_asked_for_no_frame_skip_no_sticky_actions_and_108000_frames():
    env = dqn.make_emulator(PONG)
    assert env.spec.kwargs["max_num_frames_per_episode"] == 108_000
    assert env.spec.kwargs["repeat_action_probability"] == 0.0 and env.spec.kwargs["frameskip"] == 1


# ---- the replay memory -----------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["lz4", "raw", "tensor"])
def test_replay_returns_what_was_acted_on(encoding):
    """Across lost lives, game ends, truncation and overflow, on a real game, against a list of arrays."""
    env, decode, _ = environment(training=True, encoding=encoding, cap=800)
    memory, rng, naive, seen = dqn.ReplayMemory(300, decode), np.random.default_rng(0), [], set()
    state, _ = env.reset(seed=1)
    history = [decode(state)[-1].numpy()] * 4
    for _ in range(2000):
        acted_on = decode(state).numpy()
        assert acted_on.tobytes() == np.stack(history[-4:]).tobytes()
        action = int(rng.integers(env.action_space.n))
        next_state, reward, terminated, truncated, info = env.step(action)
        memory.add(state, action, reward, next_state, terminated)
        history.append(decode(next_state)[-1].numpy())
        naive.append((acted_on, action, reward, np.stack(history[-4:]), terminated))
        state = next_state
        if terminated or truncated:
            seen.add("truncation" if truncated else "game over" if info["game_over"] else "lost life")
            state, _ = env.reset()
            history = [decode(state)[-1].numpy()] * 4
    assert seen == {"truncation", "game over", "lost life"}
    assert len(memory) == 300
    for i, (s, a, r, s_next, terminal) in zip(range(1700, 2000), naive[-300:], strict=True):
        got = memory.gather(np.array([i % 300]))
        for expected, tensor in zip((s, a, r, s_next, terminal), got, strict=True):
            assert np.array_equal(expected, tensor[0].numpy())


def test_minibatches_are_uniform_with_replacement():
    encode, decode = dqn.frame_encoding("lz4", 2, 2, CPU)
    memory = dqn.ReplayMemory(4, decode)
    for i in range(6):  # 0 and 1 are overwritten
        code = encode(np.full((2, 2), i, np.uint8))
        memory.add((code,) * 4, i, 0.0, (code,) * 4, False)
    s, a, r, s_next, terminal = memory.sample(4000, np.random.default_rng(0))
    assert (s.shape, s.dtype) == ((4000, 4, 2, 2), torch.uint8) and s_next.shape == s.shape
    assert (a.dtype, r.dtype, terminal.dtype) == (torch.int64, torch.float32, torch.bool)
    assert torch.equal(s[:, 0, 0, 0].long(), a)
    counts = np.bincount(a.numpy(), minlength=6)
    assert list(counts[:2]) == [0, 0]
    assert all(abs(count - 1000) < 5 * math.sqrt(4000 * 0.25 * 0.75) for count in counts[2:])


def test_truncation_bootstraps_and_a_lost_life_does_not(train, monkeypatch):
    make = dqn.make_emulator
    monkeypatch.setattr(dqn, "make_emulator", lambda env_id: TimeLimit(make(env_id), 400))
    _, memory, _ = train(environment_no_op_max=0)  # cut off after 100 frames of the agent, in the second life or later
    starts = [i for i in range(1, 400) if len({id(code) for code in memory.frames[i][:4]}) == 1]
    ends = [i - 1 for i in starts]
    truncated = [i for i in ends if not memory.terminals[i]]
    assert truncated == [99, 199, 299]
    assert memory.terminals.sum() == len(ends) - len(truncated) > 3


def test_training_acts_in_lower_precision_and_evaluation_in_float32(train, monkeypatch):
    act, evaluate, evaluating, seen = dqn.greedy_action, dqn.evaluate, [], {True: set(), False: set()}

    def spy(network, state):
        seen[bool(evaluating)].add(network.layers.conv1.weight.dtype)
        return act(network, state)

    def spied_evaluate(*arguments, **limit):
        evaluating.append(True)
        finished = evaluate(*arguments, **limit)
        evaluating.pop()
        return finished

    monkeypatch.setattr(dqn, "greedy_action", spy)
    monkeypatch.setattr(dqn, "evaluate", spied_evaluate)
    train(precision="bfloat16", agent_epsilon_greedy_epsilon_initial=0.5)
    assert seen == {True: {torch.float32}, False: {torch.bfloat16}}


# ---- the network -----------------------------------------------------------------------------------


def test_network_is_table_2():
    torch.manual_seed(0)
    network, shapes = dqn.QNetwork(4, 84, 84, num_actions=6), []
    dqn.initialize_orthogonal(network)
    for layer in [*network.layers, network.head]:
        layer.register_forward_hook(lambda layer, _, output: shapes.append((
            type(layer).__name__, tuple(output.shape[1:]), sum(p.numel() for p in layer.parameters()))))
    q = network(torch.randint(0, 256, (2, 4, 84, 84), dtype=torch.uint8))
    assert shapes == [
        ("PixelConv2d", (32, 20, 20), 8224), ("ReLU", (32, 20, 20), 0),
        ("Conv2d", (64, 9, 9), 32832), ("ReLU", (64, 9, 9), 0),
        ("Conv2d", (64, 7, 7), 36928), ("ReLU", (64, 7, 7), 0), ("Flatten", (3136,), 0), ("Linear", (512,), 1606144),
        ("ReLU", (512,), 0), ("Linear", (6,), 512 * 6 + 6)]
    assert q.dtype == torch.float32
    assert [(layer.kernel_size[0], layer.stride[0]) for layer in network.layers if isinstance(layer, nn.Conv2d)] == [
        (8, 4), (4, 2), (3, 1)]
    for layer in network.layers:
        if isinstance(layer, nn.Conv2d):
            filters = layer.weight.detach().flatten(1)
            assert torch.allclose(filters @ filters.T, torch.eye(len(filters)), atol=1e-5)


def test_network_scales_its_pixels_to_0_1():
    network, outputs = dqn.QNetwork(4, 84, 84, 2), []
    conv1 = network.layers.conv1
    conv1.register_forward_hook(lambda *arguments: outputs.append(arguments[-1]))
    pixels = torch.randint(0, 256, (3, 4, 84, 84), dtype=torch.uint8)
    network(pixels)
    assert torch.allclose(outputs[0], nn.functional.conv2d(pixels / 255, conv1.weight, conv1.bias, stride=4), atol=1e-5)


# ---- the update ------------------------------------------------------------------------------------


class Table(nn.Module):
    """Q(s_j, ·) of the j-th state of a minibatch is the j-th row of a table, whatever the state."""

    def __init__(self, rows):
        super().__init__()
        self.rows = nn.Parameter(torch.tensor(rows))

    def forward(self, states):
        return self.rows[: len(states)]


def test_update_is_the_clipped_error_of_each_sample():
    q_table = [[0.0, 9.0], [0.5, 0.0], [7.0, 0.0], [-4.0, 1.0]]
    target_table = [[1.0, 2.0], [3.0, 0.1], [5.0, 5.0], [2.0, 8.0]]
    a, r, terminal = [0, 0, 1, 1], [0.5, 1.0, -1.0, 1.0], [False, True, False, True]
    discount, expected = 0.9, [row.copy() for row in q_table]
    for j in range(4):  # by hand: y, δ, one step of size 1 along the gradient of Σ huber(δ)
        y = r[j] if terminal[j] else r[j] + discount * max(target_table[j])
        expected[j][a[j]] -= min(max(q_table[j][a[j]] - y, -1.0), 1.0)
    q_network, target_network = Table(q_table), Table(target_table)
    states = torch.zeros((4, 4, 84, 84), dtype=torch.uint8)
    minibatch = (states, torch.tensor(a), torch.tensor(r), states, torch.tensor(terminal))
    optimizer = torch.optim.SGD(q_network.parameters(), lr=1.0)
    loss, q = dqn.update(q_network, q_network, target_network, optimizer, minibatch, discount)
    assert q.tolist() == [0.0, 0.5, 0.0, 1.0]
    assert torch.allclose(q_network.rows, torch.tensor(expected))
    assert target_network.rows.tolist() == Table(target_table).rows.tolist() and target_network.rows.grad is None
    errors = [0.0 - 2.3, 0.5 - 1.0, 0.0 - 3.5, 1.0 - 1.0]
    assert loss.item() == pytest.approx(sum(e * e / 2 if abs(e) < 1 else abs(e) - 0.5 for e in errors) / 4)


def test_bfloat16_updates_keep_float32_weights_and_nearly_the_same_gradient():
    torch.manual_seed(0)
    gradients = {}
    s, s_next = torch.randint(0, 256, (2, 32, 4, 84, 84), dtype=torch.uint8)
    minibatch = (s, torch.randint(0, 4, (32,)), torch.randn(32), s_next, torch.zeros(32, dtype=torch.bool))
    for precision in (torch.float32, torch.bfloat16):
        torch.manual_seed(1)
        q_network = dqn.QNetwork(4, 84, 84, 4)
        before = [parameter.detach().clone() for parameter in q_network.parameters()]
        working_network = dqn.working_copy(q_network, precision)
        target_network = copy.deepcopy(working_network).requires_grad_(False)
        optimizer = torch.optim.SGD(q_network.parameters(), lr=1e-3)
        dqn.update(q_network, working_network, target_network, optimizer, minibatch, 0.99)
        gradients[precision] = torch.cat([p.grad.flatten() for p in q_network.parameters()])
        for old, θ, working in zip(before, q_network.parameters(), working_network.parameters(), strict=True):
            assert θ.dtype == torch.float32
            # steps of about 1e-5, in weights of about 0.01: bfloat16's three digits would lose them
            assert torch.allclose(old - θ.detach(), 1e-3 * θ.grad, rtol=1e-3, atol=1e-8)
            assert torch.equal(working, θ.to(working.dtype))
    exact, rounded = gradients.values()
    assert rounded.dtype == torch.float32 and not torch.equal(exact, rounded)
    assert torch.cosine_similarity(exact, rounded, dim=0) > 0.999


@pytest.mark.skipif(not dqn.multiplies_bfloat16(), reason="only where the CPU multiplies bfloat16 is it used")
def test_onednn_layout_computes_what_the_layers_do():
    torch.manual_seed(0)
    states = torch.randint(0, 256, (8, 4, 84, 84), dtype=torch.uint8)
    working_network = dqn.working_copy(dqn.QNetwork(4, 84, 84, 4), torch.bfloat16)
    plain = copy.deepcopy(working_network)
    plain.layers = torch.nn.Sequential(OrderedDict(plain.layers.named_children()))
    values = []
    for network in (working_network, plain):
        values.append(network(states))
        values[-1].square().sum().backward()
    assert torch.allclose(*values, rtol=0.01, atol=0.001)
    assert working_network.state_dict().keys() == plain.state_dict().keys()
    for mine, theirs in zip(working_network.parameters(), plain.parameters(), strict=True):
        assert torch.cosine_similarity(mine.grad.flatten().float(), theirs.grad.flatten().float(), dim=0) > 0.999


def test_rmsprop_against_a_trace_by_hand():
    θ, g, n, trace = 1.0, 0.0, 0.0, []
    for gradient in (2.0, -0.3, 0.05):
        g, n = 0.95 * g + 0.05 * gradient, 0.95 * n + 0.05 * gradient**2
        θ -= 0.00025 * gradient / math.sqrt(n - g * g + 0.01)
        trace.append(θ)
    args = dqn.Args(optimizer_name="RMSprop", optimizer_learning_rate=0.00025)
    module = nn.Linear(1, 1, bias=False, dtype=torch.float64)
    nn.init.ones_(module.weight)
    optimizer = dqn.make_optimizer(args, module)
    for gradient, expected in zip((2.0, -0.3, 0.05), trace, strict=True):
        module.weight.grad = torch.tensor([[gradient]], dtype=torch.float64)
        optimizer.step()
        assert module.weight.item() == pytest.approx(expected, abs=1e-14)


@pytest.mark.parametrize("decays", [(0.0, 0.95), (0.95, 1.0)])
def test_rmsprop_stays_finite_with_unequal_decays(decays):
    module = nn.Linear(1, 1, bias=False)
    args = dqn.Args(optimizer_name="RMSprop", optimizer_gradient_momentum=decays[0],
                    optimizer_squared_gradient_momentum=decays[1])
    optimizer = dqn.make_optimizer(args, module)
    for _ in range(3):
        module.weight.grad = torch.ones(1, 1)
        optimizer.step()
    assert module.weight.isfinite().all()  # n - g² is negative here


def test_optimizers_differ(train):
    runs = [train(optimizer_name=name)[0] for name in ("Adam", "RMSprop")]
    assert not same(weights(runs[0]), weights(runs[1]))
    optimizer = torch.load(runs[1] / "checkpoint.pt", weights_only=True)["optimizer"]
    assert optimizer["param_groups"][0]["mean_decay"] == 0.95


# ---- evaluation ------------------------------------------------------------------------------------


def evaluate(number: int, seed: int = 1, **limit) -> list[tuple[float, int]]:
    args = dqn.Args(env_id="SpaceInvadersNoFrameskip-v4", seed=seed)
    torch.manual_seed(0)
    stop = type("NoStop", (), {"signum": 0})
    return dqn.evaluate(args, dqn.QNetwork(4, 84, 84, 4), dqn.frame_encoding("lz4", 84, 84, CPU), number, stop, **limit)


def test_every_purpose_has_random_numbers_of_its_own(train, monkeypatch):
    streams, make = [], np.random.default_rng

    def remember(seed):
        streams.append(tuple(make(seed).integers(2**60, size=4)))
        return make(seed)

    monkeypatch.setattr(dqn.np.random, "default_rng", remember)
    train(environment_evaluation_interval_episodes=4, environment_evaluation_episodes=1)
    assert len(streams) >= 8 and len(set(streams)) == len(streams)  # training, the memory's estimate, evaluations, test


def test_evaluation_plays_whole_games_for_raw_reward():
    games = evaluate(1, games=2)
    assert len(games) == 2
    assert all(length > 300 and score % 5 == 0 for score, length in games)  # three lives
    assert max(score for score, _ in games) >= 30  # unclipped: a dozen invaders at most
    assert evaluate(1, games=2) == games
    assert evaluate(2, games=2) != games
    frames = sum(length for _, length in games)
    assert evaluate(1, frames=frames) == games
    assert evaluate(1, frames=frames - 1) == games[:1]  # the unfinished game does not count


# ---- what a person sees ----------------------------------------------------------------------------


def test_a_dead_network_says_so(train, monkeypatch, capsys):
    update = dqn.update

    def kill(q_network, *rest):
        nn.init.constant_(q_network.layers.conv3.bias, -100)
        return update(q_network, *rest)

    monkeypatch.setattr(dqn, "LOG_INTERVAL", 50)
    monkeypatch.setattr(dqn, "update", kill)
    train()
    (warning,) = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]  # once, at once
    assert "frame 104" in warning and "dead_units_conv3" in warning


def test_dead_units_and_spread_are_counted():
    network = dqn.QNetwork(4, 84, 84, 2)
    nn.init.constant_(network.layers.conv2.weight[:16], 0)
    nn.init.constant_(network.layers.conv2.bias[:16], -1)
    states = torch.randint(0, 256, (8, 4, 84, 84), dtype=torch.uint8)
    scalars = dqn.diagnose(network, states)
    assert scalars["diagnostics/dead_units_conv2"] >= 16 / 64
    assert scalars["diagnostics/dead_units_conv1"] < 0.5
    assert scalars["diagnostics/q_spread"] == pytest.approx(network(states).std(dim=0, correction=0).mean().item())


def test_a_nan_stops_the_run_and_names_frame_and_checkpoint(train, monkeypatch, capsys, tmp_path):
    update = dqn.update

    def poison(q_network, *rest):
        loss, q = update(q_network, *rest)
        nn.init.constant_(q_network.head.bias, math.nan)
        return loss, q

    monkeypatch.setattr(dqn, "update", poison)
    with pytest.raises(SystemExit) as stopped:
        train(environment_checkpoint_interval_episodes=1)
    assert stopped.value.code == 1
    (run_dir,) = tmp_path.glob("*/*")
    error = capsys.readouterr().err
    assert re.search(r"error: .*not finite at frame \d+", error) and str(run_dir / "checkpoint.pt") in error
    assert all(tensor.isfinite().all() for tensor in weights(run_dir).values())  # the last one before the NaN


BAD_FLAGS = {
    "--env-id PongNoFrameskp-v4": "PongNoFrameskip-v4",
    "--env-id CartPole-v1": "no Atari game",
    "--env-id ": "unknown game",
    "--agent-epsilon-greedy-epsilon-final 1.5": "between 0 and 1",
    "--agent-epsilon-greedy-epsilon-initial -0.1": "between 0 and 1",
    "--agent-epsilon-greedy-epsilon-evaluation nan": "between 0 and 1",
    "--agent-discount-factor 2": "between 0 and 1",
    "--optimizer-minibatch-size 0": "above 0",
    "--optimizer-learning-rate -1": "above 0",
    "--optimizer-learning-rate inf": "above 0",
    "--agent-history-length 0": "above 0",
    "--agent-action-repeat 0": "above 0",
    "--environment-train-frames-max 0": "above 0",
    "--environment-no-op-max -1": "at least 0",
    "--environment-state-height 20": "at least 36",
    "--seed -1": "at least 0",
    "--optimizer-minibatch-size 200000": "--agent-replay-buffer-initial",
    "--agent-replay-buffer-initial 2000000": "--agent-replay-buffer-maximum-length",
    "--optimizer-name SGD": "'Adam'",
    "--optimizer-minibatch-size many": "--optimizer-minibatch-size",
    "--device cuda": "sees no such device",
    "--no-such-flag 1": "--no-such-flag",
    f"--agent-replay-buffer-maximum-length {10**15} --environment-train-frames-max {10**15}": "lower --agent-replay",
    "--runs-dir occupied": "cannot be written",
    "--resume nowhere": "no run directory",
}


@pytest.mark.parametrize("flags", BAD_FLAGS)
def test_bad_input_is_one_line_and_exit_code_2(flags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "occupied").write_text("a file where the folder should be")
    monkeypatch.setattr(sys, "argv", ["dqn_atari.py", *flags.split(" ")])
    with pytest.raises(SystemExit) as stopped:
        dqn.main(dqn.parse_args(dqn.Args))
    streams = capsys.readouterr()
    assert stopped.value.code == 2
    assert re.fullmatch(r"error: [^\n]+\n", streams.err) and streams.out == ""
    assert BAD_FLAGS[flags] in streams.err
    assert [path.name for path in tmp_path.iterdir()] == ["occupied"]


def test_memory_that_is_not_free_is_refused_with_numbers():
    args = dqn.Args(agent_replay_buffer_maximum_length=10**15, environment_train_frames_max=10**15)
    with pytest.raises(ValueError, match=r"1(,000){5} transitions needs [\d.]+ GB, [\d.]+ GB are free"):
        dqn.choose_encoding(args, CPU)
    name, need = dqn.choose_encoding(dqn.Args(), CPU)
    assert name == "lz4" and 0.2e9 < need < 0.8e9  # a million frames of Pong


def test_help_names_every_flag_with_its_source(command_line):
    done = command_line("dqn_atari.py", "--help")
    assert done.returncode == 0
    text = " ".join(done.stdout.split())
    for field in dataclasses.fields(dqn.Args):
        assert dqn.flag(field.name) in text
    assert text.count("[Table 3") >= 23
