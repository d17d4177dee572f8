"""tabular_q_gridworld.py: the world, Algorithm 5 and its traps, what is drawn and written, and what is refused."""

import json
import warnings
from fractions import Fraction

import gymnasium as gym
import numpy as np
import pytest
import tabular_q_gridworld as script
from gridworld_oracles import (
    ACTIONS,
    CELLS,
    DECIDING,
    FIGURE_10,
    OPTIMAL,
    PAID,
    Transcript,
    assert_refused,
    optimal_table,
    policy_map,
    run_main,
    scalars,
    transitions,
)
from gymnasium.utils.env_checker import check_env
from matplotlib.figure import Figure
from tabular_q_gridworld import Args, GridWorld


def learn(env, **settings):
    """The last evaluation of a run."""
    *_, last = script.tabular_q_learning(env, Args(**settings))
    return last


def q_star(world, discount=1.0):
    """Q* (S, A) by the script."""
    return script.optimal_action_values(*script.model_matrices(world.P, 11, 4), discount)


class Corridor(gym.Env):
    """One state; action a pays a + 1. By default there is no end: only a time limit stops an episode."""

    observation_space = gym.spaces.Discrete(1)

    def __init__(self, actions=1, terminated=False):
        self.action_space, self.terminated = gym.spaces.Discrete(actions), terminated

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return 0, {}

    def step(self, action):
        return 0, action + 1.0, self.terminated, False, {}


class TestWorld:
    @pytest.mark.parametrize("mode", [None, "ansi", "rgb_array"])
    def test_gymnasium_accepts_it(self, mode):
        gym.register("GridWorldUnderTest-v0", lambda **kwargs: GridWorld(**kwargs))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                check_env(gym.make("GridWorldUnderTest-v0", render_mode=mode).unwrapped)
        finally:
            del gym.registry["GridWorldUnderTest-v0"]

    @pytest.mark.parametrize("slip", ["0", "1/5", "1/2", "1"])
    def test_model_is_the_lectures(self, slip):
        expected = transitions(slip, "-1/40")
        world = GridWorld(float(Fraction(slip)), -0.025)
        assert world.cells == CELLS and world.actions == ACTIONS
        for (cell, action), outcomes in expected.items():
            found = {}
            for probability, s_next, reward, terminated in world.P[CELLS.index(cell)][ACTIONS.index(action)]:
                assert probability > 0 and terminated == (CELLS[s_next] in PAID)
                found[CELLS[s_next], reward] = found.get((CELLS[s_next], reward), 0) + probability
            if cell in PAID:
                assert found == {(cell, 0.0): 1.0}
            else:
                positive = {(c, float(r)): float(p) for (c, r), p in outcomes.items() if p}
                assert found == pytest.approx(positive)

    def test_steps_follow_the_model(self):
        world = GridWorld()
        world.reset(seed=3)
        for cell in [(1, 1), (3, 2), (4, 1), (3, 3)]:
            for a in range(4):
                counts = np.zeros(11)
                for _ in range(2000):
                    world.reset(options={"cell": cell})
                    s_next, reward, terminated, truncated, _ = world.step(a)
                    counts[s_next] += 1
                    assert reward == PAID.get(CELLS[s_next], -0.025) and terminated == (CELLS[s_next] in PAID)
                    assert not truncated
                expected = np.zeros(11)
                for (target, _), probability in transitions("1/5", "-1/40")[cell, ACTIONS[a]].items():
                    expected[CELLS.index(target)] = probability
                assert counts / 2000 == pytest.approx(expected, abs=0.045)  # 5 standard deviations

    def test_deterministic_world_of_figure_3(self):
        world = GridWorld(slip_probability=0)
        s, _ = world.reset(seed=0)
        path = [CELLS[s]]
        for action in ["left", "up", "right", "up", "right", "right", "right"]:
            s, reward, terminated, _, _ = world.step(ACTIONS.index(action))
            path.append(CELLS[s])
        assert path == [(1, 1), (1, 1), (1, 2), (1, 2), (1, 3), (2, 3), (3, 3), (4, 3)]
        assert (reward, terminated) == (1.0, True)

    def test_same_seed_same_walk(self):
        def walk(seed):
            world = GridWorld()
            return [world.reset(seed=seed)[0], *(world.step(i % 4)[0] for i in range(30))]

        assert walk(1) == walk(1) != walk(2)

    def test_text_shows_robot_wall_and_terminals(self):
        world = GridWorld(render_mode="ansi")
        world.reset(options={"cell": (3, 1)})
        lines = world.render().splitlines()
        assert [line.split("|")[1:5] for line in lines if "|" in line] == [
            ["       ", "       ", "       ", "  +1   "],
            ["       ", "#######", "       ", "  -1   "],
            ["       ", "       ", " robot ", "       "],
        ]
        assert lines[-1].split() == ["x=1", "x=2", "x=3", "x=4"]

    def test_image_shows_the_robot_where_it_is(self):
        world = GridWorld(render_mode="rgb_array")
        images = []
        for cell in [(1, 1), (3, 3)]:
            world.reset(options={"cell": cell})
            images.append(world.render())
        assert images[0].shape == (300, 400, 3) and images[0].dtype == np.uint8
        rows, columns = np.nonzero((images[0] != images[1]).any(axis=2))
        assert {(c // 100 + 1, 3 - r // 100) for r, c in zip(rows, columns, strict=True)} == {(1, 1), (3, 3)}

    @pytest.mark.parametrize("settings", [{"slip_probability": 1.1}, {"slip_probability": float("nan")},
                                          {"step_reward": float("inf")}, {"render_mode": "human"}])
    def test_refuses_what_it_cannot_be(self, settings):
        with pytest.raises(ValueError, match=next(iter(settings)).replace("_", "[-_]")):
            GridWorld(**settings)

    @pytest.mark.parametrize("cell", [(2, 2), (4, 3), (0, 1)])
    def test_refuses_a_start_where_nobody_stands(self, cell):
        with pytest.raises(ValueError, match="cannot start"):
            GridWorld().reset(options={"cell": cell})


class TestOptimum:
    @pytest.mark.parametrize(("slip", "step_reward", "discount"), [
        ("1/5", "-1/40", 1.0), ("1/5", "-1/25", 1.0), ("0", "-1/40", 1.0), ("1/5", "0", 0.9), ("2/5", "1/10", 0.8),
    ])  # fmt: skip
    def test_value_iteration_against_plain_sweeps(self, slip, step_reward, discount):
        world = GridWorld(float(Fraction(slip)), float(Fraction(step_reward)))
        assert q_star(world, discount) == pytest.approx(optimal_table(slip, step_reward, discount), abs=1e-10)

    def test_published_values_at_minus_4_hundredths(self):
        V = dict(zip(CELLS, q_star(GridWorld(step_reward=-0.04)).max(axis=1), strict=True))
        published = [[0.8516, 0.9078, 0.9578], [0.8016, None, 0.7003], [0.7453, 0.6953, 0.6514, 0.4279]]
        for y, row in zip((3, 2, 1), published, strict=True):
            for x, value in enumerate(row, start=1):
                assert value is None or V[x, y] == pytest.approx(value, abs=5e-5)

    @pytest.mark.parametrize(("below", "above", "step_reward"), [
        (">>>*/^#>*/>>>^", ">>>*/^#^*/>>>^", -1.6497), (">>>*/^#^*/>>>^", ">>>*/^#^*/>>^^", -1.5643),
        (">>>*/^#^*/>>^^", ">>>*/^#^*/^>^^", -0.7311), (">>>*/^#^*/^>^^", ">>>*/^#^*/^>^<", -0.4526),
        (">>>*/^#^*/^>^<", ">>>*/^#^*/^<^<", -0.0850), (">>>*/^#^*/^<^<", ">>>*/^#^*/^<<<", -0.0448),
        (">>>*/^#^*/^<<<", ">>>*/^#<*/^<<<", -0.0274), (">>>*/^#<*/^<<<", ">>>*/^#<*/^<<v", -0.0221),
    ])  # fmt: skip
    def test_published_breakpoints(self, below, above, step_reward):
        assert policy_map(q_star(GridWorld(step_reward=step_reward - 6e-5))) == below
        assert policy_map(q_star(GridWorld(step_reward=step_reward + 6e-5))) == above

    def test_default_step_reward_is_figure_10s_and_no_discount_at_0_is(self):
        assert policy_map(q_star(GridWorld())) == ">>>*/^#<*/^<<<"
        assert Args().step_reward == -0.025 and Args().slip_probability == 0.2
        for discount in np.arange(0.05, 1, 0.05):
            assert not policy_map(q_star(GridWorld(step_reward=0.0), discount)).endswith("#<*/^<<<")

    def test_an_infinite_optimum_is_not_an_answer(self):
        world = GridWorld(step_reward=0.1)
        with pytest.raises(ValueError, match="not converged"):
            script.optimal_action_values(*script.model_matrices(world.P, 11, 4), 1.0, max_sweeps=1000)

    def test_decision_states_leave_out_ends_and_what_nobody_reaches(self):
        world = GridWorld(slip_probability=0.2)
        P, _ = script.model_matrices(world.P, 11, 4)
        assert np.flatnonzero(script.decision_states(P, world.initial_state_distrib)).tolist() == DECIDING
        lake = gym.make("FrozenLake-v1").unwrapped
        P, _ = script.model_matrices(lake.P, 16, 4)
        found = script.decision_states(P, lake.initial_state_distrib)
        assert np.flatnonzero(found).tolist() == [0, 1, 2, 3, 4, 6, 8, 9, 10, 13, 14]  # neither holes nor goal

    def test_a_tie_is_optimal_only_if_both_actions_are(self):
        Q_star = np.array([[1.0, 1.0, 0.0]] * 4)
        Q = np.array([[2.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        assert script.optimal_states(Q, Q_star).tolist() == [True, True, False, False]


class TestAlgorithm:
    @pytest.mark.parametrize("settings", [
        {}, {"discount": 0.9, "learning_rate": 0.1, "learning_rate_exponent": 0.0}, {"max_episode_steps": 5},
    ])  # fmt: skip
    def test_table_is_the_update_rule_on_the_transitions(self, settings):
        """A second implementation replays the transitions: Q += α (target - Q), r alone only if terminated."""
        args = Args(episodes=300, seed=4, **settings)
        env = Transcript(script.make_environment(args))
        *_, last = script.tabular_q_learning(env, args)
        Q, N = np.zeros((11, 4)), np.zeros((11, 4), dtype=int)
        for s, a, r, s_next, terminated in env.transitions:
            N[s, a] += 1
            future = 0.0 if terminated else np.max(Q[s_next])
            alpha = args.learning_rate / N[s, a] ** args.learning_rate_exponent
            Q[s, a] += alpha * (r + args.discount * future - Q[s, a])
        assert last.Q == pytest.approx(Q, abs=1e-12)
        assert (last.visits == N).all() and last.steps == len(env.transitions)
        assert (last.episode, len(env.seeds)) == (300, 300)

    def test_a_terminals_row_stays_0(self):
        last = learn(script.make_environment(Args()), episodes=500)
        ends = [CELLS.index(cell) for cell in PAID]
        assert (last.Q[ends] == 0).all() and (last.visits[ends] == 0).all()

    def test_a_time_limit_bootstraps(self):
        """One reward a step for ever, γ = 1/2, is worth 2; taking the cut for an end would leave it near 1 + 1/2 + …"""
        env = gym.wrappers.TimeLimit(Corridor(), max_episode_steps=1)
        last = learn(env, episodes=400, discount=0.5, learning_rate=0.5, learning_rate_exponent=0.0)
        assert last.Q[0, 0] == pytest.approx(2, abs=1e-9)

    def test_the_target_is_r_alone_only_where_an_episode_terminates(self):
        """The last observation may be a state with a row of its own, as in Blackjack-v1."""
        last = learn(Corridor(terminated=True), episodes=20, learning_rate=1.0, learning_rate_exponent=0.0)
        assert last.Q[0, 0] == 1.0

    def test_ties_are_broken_at_random(self):
        """Without exploration and with nothing learnt yet, each action is tried, and the robot leaves (1,1)."""
        first = []
        for seed in range(200):
            args = Args(episodes=1, seed=seed, epsilon_initial=0.0, epsilon_final=0.0, step_reward=0.0)
            env = Transcript(script.make_environment(args))
            last = learn(env, **vars(args))
            first.append(env.transitions[0][1])
            assert last.steps < 1000  # not cut short
        assert (np.bincount(first, minlength=4) > 30).all()  # 50 each is expected, 30 is 3.3 standard deviations below

    def test_exploration_and_greed_are_epsilons(self):
        env = Transcript(Corridor(actions=4, terminated=True))
        learn(env, episodes=4000, epsilon_initial=0.4, epsilon_final=0.4)
        counts = np.bincount([a for _, a, *_ in env.transitions], minlength=4)
        assert counts / 4000 == pytest.approx([0.1, 0.1, 0.1, 0.7], abs=0.03)  # 1 - ε + ε/4 for the best, ε/4 else

    def test_epsilon_is_annealed_and_then_stays(self):
        args = Args(episodes=101, epsilon_initial=0.9, epsilon_final=0.1, epsilon_annealing=0.5)
        found = [script.annealed_epsilon(episode, args) for episode in range(1, 102)]
        assert found[0] == 0.9 and found[-1] == pytest.approx(0.1) and found[51:] == pytest.approx([0.1] * 50)
        assert (np.diff(found) <= 1e-15).all() and np.ptp(np.diff(found[:50])) < 1e-12
        for share in (0.0, 1.0):
            args = Args(episodes=10, epsilon_annealing=share)
            assert script.annealed_epsilon(10, args) == pytest.approx(args.epsilon_final)
        assert script.annealed_epsilon(1, Args(episodes=1)) == 1.0

    def test_same_seed_same_table(self):
        tables = [learn(script.make_environment(Args()), episodes=50, seed=seed).Q for seed in (7, 7, 8)]
        assert (tables[0] == tables[1]).all() and (tables[0] != tables[2]).any()

    def test_exploration_does_not_draw_the_slips_numbers(self):
        """With one stream for both, ε-greedy would explore exactly when the first slip draw is below ε."""
        args = Args(epsilon_initial=1.0, seed=11)
        env = Transcript(script.make_environment(args))
        learn(env, episodes=1, seed=11)
        actions = [a for _, a, *_ in env.transitions]
        for seed in (11, env.seeds[0]):  # at ε = 1 every second number would choose an action
            own = np.random.default_rng(seed).random(2 * len(actions))[1::2]
            assert len(actions) > 5 and actions != (own * 4).astype(int).tolist()

    @pytest.mark.parametrize("seed", [0, 1])
    def test_finds_figure_10(self, seed):
        """The 20-seed demand, on two seeds: `python benchmarks/gridworld.py seeds` runs all of them."""
        last = learn(script.make_environment(Args()), episodes=200_000, seed=seed)
        expected = optimal_table("1/5", "-1/40", 1.0)
        for s in DECIDING:
            name = "({},{})".format(*CELLS[s])
            assert ACTIONS[last.Q[s].argmax()] == OPTIMAL[name], name
        assert OPTIMAL.items() >= FIGURE_10.items()
        assert np.abs(last.Q - expected)[DECIDING].max() < 0.03


class TestOtherEnvironments:
    def test_frozen_lake_comes_near_its_model(self):
        args = Args(env_id="FrozenLake-v1", env_kwargs="is_slippery=false", discount=0.9, episodes=1000,
                    learning_rate=1.0, learning_rate_exponent=0.0)  # fmt: skip
        env = script.make_environment(args)
        *_, last = script.tabular_q_learning(env, args)
        assert last.Q[0].max() == pytest.approx(0.9**5)  # six steps to the goal
        assert env.unwrapped.spec.kwargs["is_slippery"] is False

    def test_retired_versions_have_a_successor(self, capsys):
        env = script.make_environment(Args(env_id="Taxi-v3"))
        assert env.unwrapped.spec.id.startswith("Taxi-v") and env.observation_space.n == 500

    def test_tuples_are_numbered_one_to_one(self):
        env = script.make_environment(Args(env_id="Blackjack-v1"))
        assert isinstance(env.observation_space, gym.spaces.Discrete) and env.observation_space.n == 32 * 11 * 2
        seen = {env.observation((i, j, k)) for i in range(32) for j in range(11) for k in range(2)}
        assert seen == set(range(704))

    def test_spaces_that_do_not_start_at_0(self):
        class Shifted(Corridor):
            observation_space = gym.spaces.Discrete(2, start=5)

            def __init__(self):
                self.action_space = gym.spaces.Discrete(3, start=-1)

            def reset(self, *, seed=None, options=None):
                return 5, {}

            def step(self, action):
                assert action in self.action_space
                return 6, float(action), True, False, {}

        last = learn(script.numbered(Shifted()), episodes=60, learning_rate=1.0, learning_rate_exponent=0.0)
        assert last.Q.tolist() == [[-1.0, 0.0, 1.0], [0.0, 0.0, 0.0]]

    def test_one_part_spaces_are_numbered_too(self):
        for space in (gym.spaces.MultiDiscrete([3]), gym.spaces.Tuple([gym.spaces.Discrete(3)])):
            env = Corridor()
            env.observation_space = space
            numbered = script.numbered(env)
            assert numbered.observation_space.n == 3 and numbered.observation((2,)) == 2

    def test_time_limit_flag(self):
        assert script.make_environment(Args(env_id="CliffWalking-v1", max_episode_steps=7)).spec.max_episode_steps == 7
        for limit, steps in ((7, 7), (0, 1000)):
            env = script.make_environment(Args(slip_probability=0.0, max_episode_steps=limit))
            env.reset(seed=0)
            cuts = [env.step(ACTIONS.index("left"))[3] for _ in range(steps)]
            assert cuts == [False] * (steps - 1) + [True]


class TestCommandLine:
    def test_defaults_show_figures_9_and_10(self, command_line, tmp_path):
        done = command_line("tabular_q_gridworld.py")
        assert done.returncode == 0, done.stderr
        assert "Warning" not in done.stderr and "WARN" not in done.stderr
        (run,) = (tmp_path / "runs").iterdir()
        assert run.name.startswith("GridWorld__tabular_q_gridworld__0__")
        result = json.loads((run / "q_table.json").read_text(encoding="utf-8"))
        assert result["episodes"] == 1000
        assert "Q after 1,000 episodes" in done.stdout and "Q* by value iteration" in done.stdout
        for name, values in result["action_values"].items():  # four per cell, each on its own side
            x, y = eval(name)
            rows = [line.split("|")[1:5] for line in done.stdout.splitlines() if line.count("|") == 5]
            top, middle, bottom = (row[x - 1].split() for row in rows[3 * (3 - y) :][:3])
            shown = dict(left=middle[0], up=top[0], right=middle[1], down=bottom[0])
            assert {action: f"{values[action]:.3f}" for action in ACTIONS} == shown
            assert result["policy"][name] == max(values, key=values.get)
        arrows = dict(left="←", up="↑", right="→", down="↓")
        policies = done.stdout.split("Policy learnt:")[1].split("Optimal policy:")
        for text, policy in zip(policies, (result["policy"], OPTIMAL), strict=True):
            rows = [line.split("|")[1:5] for line in text.splitlines() if line.count("|") == 5]
            assert {name: rows[3 - eval(name)[1]][eval(name)[0] - 1].strip() for name in policy} == {
                name: arrows[action] for name, action in policy.items()}
        curves = scalars(run)
        Q = np.array([[result["action_values"]["({},{})".format(*CELLS[s])][a] for a in ACTIONS] for s in DECIDING])
        error = np.abs(Q - optimal_table("1/5", "-1/40", 1.0)[DECIDING]).max()
        assert result["max_error"] == pytest.approx(error) == pytest.approx(curves["evaluation/max_error"][-1][1])
        agree = sum(result["policy"][name] == OPTIMAL[name] for name in OPTIMAL)
        assert result["optimal_states"] == agree == curves["evaluation/optimal_states"][-1][1]
        assert f"an optimal action in {agree} of 9 states" in done.stdout
        assert [step for step, _ in curves["training/epsilon"]][-1] == 1000
        assert (run / "figure.png").read_bytes().startswith(b"\x89PNG")
        assert json.loads((run / "args.json").read_text())["step_reward"] == -0.025

    def test_without_a_model_there_is_no_q_star(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        flags = ("--env-id", "Blackjack-v1", "--episodes", "200", "--output-json", "q.json", "--figure", "q.svg")
        code, out, err = run_main(script, monkeypatch, capsys, *flags)
        assert code == 0 and "Q*" not in out and "mean return" in out, err
        (run,) = (tmp_path / "runs").iterdir()
        assert sorted(scalars(run)) == ["training/epsilon", "training/mean_length", "training/mean_return"]
        result = json.loads((tmp_path / "q.json").read_text())
        assert "max_error" not in result and None in result["values"].values()
        assert (tmp_path / "q.svg").is_file() and not (run / "figure.png").exists()

    def test_model_of_another_environment(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        code, out, _ = run_main(script, monkeypatch, capsys, "--env-id", "FrozenLake-v1", "--episodes", "20")
        assert code == 0 and "of 11 states" in out
        assert "Tie in" in out  # nothing is paid until the goal is found: every visited state ties

    def test_ties_are_named(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        code, out, _ = run_main(script, monkeypatch, capsys, "--episodes", "1", "--seed", "3")
        assert code == 0 and "have the same Q" in out
        result = json.loads(next(tmp_path.glob("runs/*/q_table.json")).read_text())
        for name, tied in result["ties"].items():
            values = result["action_values"][name]
            assert tied == [action for action in ACTIONS if values[action] == max(values.values())]
            assert f"Tie in {name}: {', '.join(tied)} have the same Q." in out
        for name, values in result["action_values"].items():
            assert (name in result["ties"]) == (list(values.values()).count(max(values.values())) > 1)

    def test_two_runs_in_one_second_have_two_folders(self, tmp_path):
        folders = {script.make_run_dir(tmp_path, "A/B-v0", "s", 0) for _ in range(3)}
        assert len(folders) == 3 and all(folder.parent == tmp_path for folder in folders)

    @pytest.mark.parametrize(("flags", "words"), [
        (["--episodes", "0"], ["episodes", "at least 1"]),
        (["--episodes", "many"], ["episodes"]),
        (["--discount", "1.5"], ["discount"]),
        (["--discount", "nan"], ["discount"]),
        (["--learning-rate", "0"], ["learning-rate"]),
        (["--learning-rate-exponent", "-1"], ["learning-rate-exponent"]),
        (["--epsilon-initial", "2"], ["epsilon-initial"]),
        (["--epsilon-final", "0.5", "--epsilon-initial", "0.1"], ["epsilon-final"]),
        (["--epsilon-annealing", "1.1"], ["epsilon-annealing"]),
        (["--max-episode-steps", "-1"], ["max-episode-steps"]),
        (["--seed", "-1"], ["seed"]),
        (["--slip-probability", "1.01"], ["slip-probability"]),
        (["--step-reward", "nan"], ["step-reward"]),
        (["--step-reward", "0.1"], ["never to end"]),
        (["--no-such-flag"], ["no-such-flag"]),
        (["--env-id", "NoSuchWorld-v0"], ["NoSuchWorld"]),
        (["--env-id", "CartPole-v1"], ["discrete observations"]),
        (["--env-id", "FrozenLake-v1", "--slip-probability", "0.1"], ["belong to GridWorld"]),
        (["--env-id", "FrozenLake-v1", "--env-kwargs", "is_slippery"], ["name=value"]),
        (["--env-id", "FrozenLake-v1", "--env-kwargs", "no_such=1"], ["FrozenLake-v1"]),
        (["--env-kwargs", "a=1"], ["--env-id"]),
        (["--output-json", "missing/q.json"], ["missing"]),
        (["--figure", "."], ["folder"]),
        (["--figure", "q.txt"], [".png"]),
    ])  # fmt: skip
    def test_bad_input_is_one_line(self, flags, words, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        assert_refused(run_main(script, monkeypatch, capsys, *flags), tmp_path, *words)

    def test_a_runs_folder_that_is_a_file(self, monkeypatch, capsys, tmp_path):
        monkeypatch.chdir(tmp_path)
        file = tmp_path / "runs"
        file.write_text("mine")
        code, out, err = run_main(script, monkeypatch, capsys, "--episodes", "1")
        assert code == 2 and err.count("\n") == 1 and file.read_text() == "mine" and out == ""


class TestPictures:
    def test_q_values_are_drawn_on_a_scale_centred_at_0(self):
        world, axes = GridWorld(), Figure().add_subplot()
        Q = q_star(world)
        script.draw_action_values(axes, world, Q, "Q*")
        labels = sorted(text.get_text() for text in axes.texts)
        assert labels == sorted([*(script.number(q) for q in Q[DECIDING].ravel()), "+1", "-1"])
        triangles = [patch for patch in axes.patches if isinstance(patch, script.Polygon)]
        assert len(triangles) == 36 and sum(patch.get_hatch() is not None for patch in axes.patches) == 1
        for triangle in triangles:
            (x, y) = triangle.get_xy()[:3].mean(axis=0)
            s = world.cells.index((round(x), round(y)))
            dx, dy = x - round(x), y - round(y)
            a = ACTIONS.index(("left" if dx < 0 else "right") if abs(dx) > abs(dy) else ("down" if dy < 0 else "up"))
            red, _, blue, _ = triangle.get_facecolor()
            assert (blue > red) == (Q[s, a] > 0)

    def test_policy_has_an_arrow_for_every_greedy_action(self):
        world, axes = GridWorld(), Figure().add_subplot()
        greedy = np.zeros((11, 4), dtype=bool)
        greedy[DECIDING, 0] = greedy[0, 2] = True
        script.draw_policy(axes, world, np.zeros(11), greedy, "π")
        arrows = [text for text in axes.texts if hasattr(text, "arrow_patch") and text.arrow_patch]
        assert len(arrows) == 10
        assert sorted(np.sign(arrow.xy[0] - arrow.xyann[0]) for arrow in arrows) == [-1] * 9 + [1]
