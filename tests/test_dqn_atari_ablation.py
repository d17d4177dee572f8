"""dqn_atari_ablation.py: without its switches it is dqn_atari.py, each switch does one thing."""

import copy
import difflib
import itertools
from pathlib import Path

import dqn_atari
import dqn_atari_ablation as ablation
import dqn_atari_parallel as parallel
import numpy as np
import pandas as pd
import pytest
import test_dqn_atari
import torch
from test_dqn_atari import weights
from test_suite import ALGORITHMS, definitions

SHORT = test_dqn_atari.SHORT | dict(
    environment_train_frames_max=700, environment_evaluation_interval_episodes=4,
    environment_evaluation_episodes=1, agent_replay_buffer_maximum_length=300,
    agent_replay_buffer_initial=200, optimizer_q_network_parameter_update_interval_frames=100)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a script's main in this process: its run directory, every update's arguments."""
    monkeypatch.setattr(ablation, "max_q_mean", lambda network, states, mean=ablation.max_q_mean: (
        mean(network, states) if network.head.weight.requires_grad else pytest.fail("of θ⁻")))

    def call(script, **flags) -> tuple[Path, list]:
        calls, update = [], script.update
        monkeypatch.setattr(script, "update", lambda q_network, target_network, *rest: (
            calls.append((q_network, target_network, rest[1])),
            update(q_network, target_network, *rest))[1])
        runs = tmp_path / f"{script.__name__}{len(list(tmp_path.iterdir()))}"
        script.main(script.Args(**SHORT | flags, runs_dir=str(runs)))
        return *runs.iterdir(), calls  # one run directory
    return call


def test_without_switches_it_is_dqn_atari(run):
    one, other = run(dqn_atari)[0], run(ablation)[0]
    assert all(torch.equal(θ, weights(other)[name]) for name, θ in weights(one).items())
    tables = [pd.read_csv(x / "evaluations.csv", index_col="frames") for x in (one, other)]
    few, more = (table.drop(columns="seconds") for table in tables)
    assert few.equals(more[[*few]]) and {*more} - {*few} == {"held_out_max_q_mean"}
    assert len(more) and np.isfinite(more["held_out_max_q_mean"]).all()


def test_diff_shows_the_switches_and_nothing_else():
    one, other = (definitions(ALGORITHMS / f"dqn_atari{end}.py") for end in ("", "_ablation"))
    assert one.keys() - other == {"initialize_orthogonal"}
    assert other.keys() - one == {"initialize", "held_out_states", "max_q_mean"}
    lines = (difflib.ndiff(one[x].splitlines(), other[x].splitlines()) for x in ("Args", "main"))
    assert [line[2:].strip() for line in itertools.chain(*lines) if line.startswith("- ")] == [
        'env_id: str = "PongNoFrameskip-v4"', "initialize_orthogonal(q_network)",
        "counters.evaluations.append(summary(counters, finished))"]
    for Args in (ablation.Args, parallel.Args):  # first stand Table 3's
        assert list(vars(Args()).items())[:23] == list(vars(dqn_atari.Args()).items())[:23]


def test_without_target_network_y_comes_from_the_online_network(run):
    _, calls = run(ablation, target_network=False, initialization="he")
    assert calls and all(q is target for q, target, _ in calls)
    assert calls[0][0].layers[4].weight.std() > 0.05  # He's; orthogonal is 0.042
    assert all(θ.requires_grad for θ in calls[0][0].parameters())
    _, calls = run(ablation)
    assert all(q is not target for q, target, _ in calls)


def test_without_replay_buffer_the_minibatch_is_the_last_transitions(run, monkeypatch):
    stored, stored_when, add = [], [], ablation.ReplayMemory.add

    def noted(self, s, a, r, s_next, terminal):
        stored.append((self.decode([s])[0], a, r, self.decode([s_next])[0], terminal))
        add(self, s, a, r, s_next, terminal)
        stored_when.append(len(stored))
    monkeypatch.setattr(ablation.ReplayMemory, "add", noted)
    _, calls = run(ablation, replay_buffer=False)
    ends = [n for n in stored_when if n >= 200 and n % 4 == 0]  # past 300 the memory wraps
    assert len(calls) == len(ends)
    for (_, _, minibatch), end in zip(calls, ends, strict=True):
        last = zip(*stored[end - 8 : end], strict=True)
        for column, expected in zip(minibatch, last, strict=True):
            tensors = [torch.as_tensor(value) for value in expected]
            assert torch.equal(column, torch.stack(tensors).to(column.dtype))


@pytest.mark.parametrize("name", ["default", "he", "orthogonal"])
def test_initialization(name):
    torch.manual_seed(1)
    q_network = ablation.QNetwork(4, 84, 84, 4)
    before = copy.deepcopy(q_network.state_dict())
    ablation.initialize(q_network, name)
    changed = {key: θ for key, θ in q_network.state_dict().items() if not θ.equal(before[key])}
    convolutions = {"layers.0.weight", "layers.2.weight", "layers.4.weight"}
    assert changed.keys() == (set() if name == "default" else convolutions)
    for weight in (θ.flatten(1) for θ in changed.values()):  # (filters, inputs)
        if name == "he":
            assert weight.std().item() == pytest.approx((2 / weight.shape[1]) ** 0.5, rel=0.05)
        else:
            assert torch.allclose(weight @ weight.T, torch.eye(len(weight)), atol=1e-4)


def test_held_out_states_are_the_seeds_own():
    replay = ablation.ReplayMemory(1, (4, 84, 84), "cpu")
    first, again, other = (ablation.held_out_states(ablation.Args(seed=seed), replay.decode)
                           for seed in (1, 1, 2))
    assert first.shape == (500, 4, 84, 84) and first.dtype == torch.uint8
    assert torch.equal(first, again) and not torch.equal(first, other)
    q_network = ablation.QNetwork(4, 84, 84, 4)
    expected = np.mean([max(q_network(state[None])[0].tolist()) for state in first[:20]])
    assert ablation.max_q_mean(q_network, first[:20]) == pytest.approx(expected, rel=1e-4)
