"""tabular_q_gridworld.py: the world, Algorithm 5 and its traps, Q*, and the command line."""

import json

import gridworld_oracles
import gymnasium as gym
import numpy as np
import pytest
import tabular_q_gridworld as script
from gridworld_oracles import ACTING, ACTIONS, CELLS, ENDS, FIGURE_10, Transcript, outcomes, values
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit
from tabular_q_gridworld import Args, GridWorld
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def learn(env, **settings):
    *_, (Q, N, _) = script.tabular_q_learning(env, Args(**settings))
    return np.array(Q), np.array(N)


class Loop(gym.Env):
    """One state, from which every action comes back; action a pays a + 1."""

    observation_space = gym.spaces.Discrete(1)

    def __init__(self, actions=1, terminated=False):
        self.action_space, self.terminated = gym.spaces.Discrete(actions), terminated

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, action + 1.0, self.terminated, False, {}


class TestWorld:
    @pytest.mark.filterwarnings("error")
    def test_gymnasium_accepts_it(self):
        check_env(GridWorld(), skip_render_check=True)  # it has no render modes

    @pytest.mark.parametrize("slip", [0.0, 0.2, 1.0])
    def test_model_and_steps(self, slip):
        """Slips, wall, bounds, rewards and ends: of the model, and of 2,000 steps in two cells."""
        world = GridWorld(slip)
        assert world.cells == CELLS and CELLS[world.reset(seed=1)[0]] == (1, 1)
        for s in ACTING:
            for a, action in enumerate(ACTIONS):
                expected, found = outcomes(CELLS[s], action, slip), {}
                for p, s_next, r, terminated in world.P[s][a]:
                    found[CELLS[s_next], r] = found.get((CELLS[s_next], r), 0) + p
                    assert terminated == (CELLS[s_next] in ENDS)
                assert {key: p for key, p in found.items() if p} == pytest.approx(expected)
                counts = dict.fromkeys(expected, 0)
                for _ in range(2000 * (CELLS[s] in [(3, 2), (4, 1)])):
                    world.reset(options={"cell": CELLS[s]})
                    s_next, r, terminated, truncated, _ = world.step(a)
                    counts[CELLS[s_next], r] += 1 / 2000
                    assert terminated == (CELLS[s_next] in ENDS) and not truncated
                assert not any(counts.values()) or counts == pytest.approx(expected, abs=0.05)


class TestOptimum:
    @pytest.mark.parametrize(("slip", "step_reward", "discount"), [(0, -0.5, 1), (0.4, 0.1, 0.8)])
    def test_against_plain_sweeps(self, slip, step_reward, discount):
        V = script.optimal_action_values(GridWorld(slip, step_reward).P, discount).max(axis=1)
        assert V == pytest.approx(values(None, slip, step_reward, discount), abs=1e-9)

    @pytest.mark.parametrize(("step_reward", "at_32", "at_41"), [
        (-0.0275, "up", "left"), (-0.0273, "left", "left"), (-0.025, "left", "left"),
        (-0.0222, "left", "left"), (-0.0220, "left", "down")])
    def test_figure_10_is_optimal_just_between_the_published_breakpoints(
            self, step_reward, at_32, at_41):
        greedy = script.greedy(script.optimal_action_values(GridWorld(0.2, step_reward).P, 1.0))
        for s, action in (FIGURE_10 | {5: at_32, 3: at_41}).items():
            assert [ACTIONS[a] for a in np.flatnonzero(greedy[s])] == [action]


class TestAlgorithm:
    @pytest.mark.parametrize(("terminated", "value"), [(True, 0.75), (False, 0.975)])
    def test_equation_34(self, terminated, value):
        """Q = (1 - α) Q + α (r + γ max Q) twice; r alone after an end, not after a time limit."""
        env = TimeLimit(Loop(terminated=terminated), 1)
        Q, _ = learn(env, episodes=2, discount=0.9, learning_rate=0.5, learning_rate_exponent=0)
        assert Q[0, 0] == pytest.approx(value)  # 0.5, then 0.5 · 0.5 + 0.5 · (1 + 0.9 · 0.5)

    def test_table_is_the_update_of_the_transitions(self):
        env = Transcript(TimeLimit(GridWorld(), 5))
        Q, N = learn(env, episodes=300, discount=0.9)
        expected, visits = np.zeros((11, 4)), np.zeros((11, 4))
        for s, a, r, s_next, terminated in env.transitions:
            visits[s, a] += 1
            target = r + (0 if terminated else 0.9 * expected[s_next].max())
            expected[s, a] += 0.7 * visits[s, a] ** -0.85 * (target - expected[s, a])
        assert Q == pytest.approx(expected, abs=1e-12) and (N == visits).all()
        assert (Q[[6, 10]] == 0).all() and (N[[6, 10]] == 0).all()  # terminals

    def test_epsilon_is_annealed(self):
        """The best of 4 actions is taken with probability 1 - 3ε/4; ε falls from 0.9 to 0.1."""
        env = Transcript(Loop(actions=4, terminated=True))
        learn(env, episodes=30_000, epsilon_initial=0.9, epsilon_final=0.1)
        greedy = np.array([a == 3 for _, a, *_ in env.transitions]).reshape(15, 2000).mean(axis=1)
        assert greedy[[0, 7, 14]] == pytest.approx([0.345, 0.625, 0.905], abs=0.04)

    def test_ties_are_broken_at_random(self):
        first = []
        for seed in range(100):
            env = Transcript(TimeLimit(GridWorld(), 1))
            learn(env, episodes=1, seed=seed, epsilon_initial=0, epsilon_final=0)
            first.append(env.transitions[0][1])
        assert (np.bincount(first, minlength=4) > 10).all()

    def test_exploration_does_not_draw_the_slips_numbers(self):
        env = Transcript(Loop(actions=4))
        learn(TimeLimit(env, 50), episodes=1, epsilon_initial=1, epsilon_final=1, seed=11)
        drawn = np.random.default_rng(env.unwrapped.np_random_seed).random(100)[1::2]
        assert [a for _, a, *_ in env.transitions] != (drawn * 4).astype(int).tolist()

    def test_seeds(self):
        tables = [learn(GridWorld(), episodes=50, seed=seed)[0] for seed in (7, 7, 8)]
        assert (tables[0] == tables[1]).all() and (tables[0] != tables[2]).any()

    def test_finds_figure_10(self):
        Q, _ = learn(script.make_world(Args()), episodes=60_000)
        assert {s: ACTIONS[Q[s].argmax()] for s in ACTING} == FIGURE_10
        assert Q.max(axis=1) == pytest.approx(values(), abs=0.05)


class TestCommandLine:
    def test_gridworld(self, command_line, tmp_path):
        done = command_line("tabular_q_gridworld.py", "--episodes", 300)
        assert done.returncode == 0 and "Warning" not in done.stderr, done.stderr
        (run,) = (tmp_path / "runs").glob("GridWorld__tabular_q_gridworld__0__*")
        table = json.loads((run / "q_table.json").read_text())
        assert len(table["action_values"]) == 9
        for cell, Q in table["action_values"].items():
            assert table["policy"][cell] == max(Q, key=Q.get)
            assert all(f"{q:.3f}" in done.stdout for q in Q.values())
        assert json.loads((run / "args.json").read_text())["episodes"] == 300
        assert (run / "figure.png").read_bytes().startswith(b"\x89PNG")
        error = EventAccumulator(str(run)).Reload().Scalars("max |Q - Q*|")[-1]
        Q = np.array([[*values.values()] for values in table["action_values"].values()])  # (9, 4)
        gap = np.abs(Q - script.optimal_action_values(GridWorld().P, 1)[ACTING]).max()
        assert (error.step, error.value) == (300, pytest.approx(gap, rel=1e-5))
        optimal = sum(map(str.__eq__, table["policy"].values(), FIGURE_10.values()))
        assert 0 < optimal < 9 and f"optimal in {optimal} of 9" in done.stdout
        signs = [sign for sign in done.stdout.split("Q*")[1] if sign in "←↑→↓"]  # from the top
        assert signs == [*"→→→↑←↑←←←"]

    def test_cliff_walking_is_learnt_exactly(self, command_line):
        flags = "--env-id CliffWalking-v1 --learning-rate-exponent 0 --episodes 300".split()
        done = command_line("tabular_q_gridworld.py", *flags)
        assert "max |Q - Q*| = 0.0000, optimal in 37 of 37" in done.stdout, done.stderr

    def test_without_a_model(self, tmp_path, monkeypatch):
        gym.register("Loop-v0", Loop)
        flags = ["--env-id", "Loop-v0", "--episodes", "2", "--runs-dir", str(tmp_path)]
        monkeypatch.setattr("sys.argv", ["", *flags])
        script.main()
        del gym.registry["Loop-v0"]
        events = EventAccumulator(str(next(tmp_path.iterdir()))).Reload()
        assert events.Tags()["scalars"] == ["mean return"]
        assert events.Scalars("mean return")[-1].value == 1000  # the time limit: 1,000 steps

    def test_environment_arguments(self):
        env = script.make_world(Args(env_id="FrozenLake-v1", env_kwargs="is_slippery=false"))
        assert len(env.unwrapped.P[0][0]) == 1

    @pytest.mark.parametrize("flags", [
        "--episodes 0", "--discount nan", "--learning-rate 2", "--epsilon-final -1", "--seed -1",
        "--slip-probability 1.1", "--step-reward nan", "--step-reward 0.1", "--no-such-flag",
        "--env-id NoSuchWorld-v0", "--env-id CartPole-v1", "--env-id Blackjack-v1",
        "--env-id FrozenLake-v1 --env-kwargs no_such=1", "--runs-dir file"])
    def test_bad_input(self, flags, tmp_path, monkeypatch):
        gridworld_oracles.assert_refused(script, flags.split(), tmp_path, monkeypatch)
