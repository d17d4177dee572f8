"""Measure tabular_q_gridworld.py: how fast it learns, whether it finds Figure 10, which step rewards make that optimal.

    python benchmarks/gridworld.py speed          # steps per second on one core, and the environment's share of them
    python benchmarks/gridworld.py seeds          # 20 seeds x 200,000 episodes, Q and policy against value iteration
    python benchmarks/gridworld.py step-rewards   # the step rewards at which the optimal policy changes
"""

import dataclasses
import platform
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))
import tabular_q_gridworld as script

FIGURE_10 = {(2, 1): "left", (3, 1): "left", (4, 1): "left", (3, 2): "left"}  # what §5.2 says of the lost picture


class Recorder(gym.Wrapper):
    """Keeps the actions of every episode."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.episodes = []

    def reset(self, **kwargs):
        self.episodes.append([])
        return self.env.reset(**kwargs)

    def step(self, action):
        self.episodes[-1].append(action)
        return self.env.step(action)


def learn(env: gym.Env, args: script.Args) -> script.Evaluation:
    """Learn to the end."""
    *_, last = script.tabular_q_learning(env, args)
    return last


def usual_numpy_table(env: gym.Env, args: script.Args) -> int:
    """The same algorithm as most tutorials write it, with a NumPy array for Q; returns the number of steps."""
    rng = np.random.default_rng(args.seed + 1)
    Q = np.zeros((env.observation_space.n, env.action_space.n))
    visits = np.zeros_like(Q)
    steps = 0
    env.reset(seed=args.seed)
    for episode in range(1, args.episodes + 1):
        s, _ = env.reset()
        ended = False
        while not ended:
            if rng.random() < script.annealed_epsilon(episode, args):
                a = env.action_space.sample()
            else:
                a = rng.choice(np.flatnonzero(Q[s] == Q[s].max()))
            s_next, r, terminated, truncated, _ = env.step(int(a))
            visits[s, a] += 1
            alpha = args.learning_rate * visits[s, a] ** -args.learning_rate_exponent
            Q[s, a] += alpha * (r + (not terminated) * args.discount * np.max(Q[s_next]) - Q[s, a])
            s, ended, steps = s_next, terminated or truncated, steps + 1
    return steps


def speed(episodes: int = 50_000, repeats: int = 3) -> None:
    """Processor time of the learning loop as the script runs it, and of the environment alone with the same actions."""
    args = script.Args(episodes=episodes)
    versions = f"Python {platform.python_version()}, Gymnasium {gym.__version__}"
    print(f"{platform.machine()}, {versions}, {episodes:,} episodes")
    recorder = Recorder(script.make_environment(args))
    steps = learn(recorder, args).steps
    env, whole, alone = script.make_environment(args), [], []
    for _ in range(repeats):
        began = time.process_time()
        learn(env, args)
        whole.append(time.process_time() - began)
        seed = np.random.SeedSequence(args.seed).generate_state(2).tolist()[0]
        began = time.process_time()
        for episode, actions in enumerate(recorder.episodes):
            env.reset(seed=None if episode else seed)
            for action in actions:
                env.step(action)
        alone.append(time.process_time() - began)
    whole, alone = min(whole), min(alone)
    print(f"tabular_q_learning: {steps:,} steps in {whole:.2f} s (best of {repeats}), {steps / whole:,.0f} per second")
    print(f"the environment alone, same actions: {alone:.2f} s = {alone / whole:.0%} of that")
    began = time.process_time()
    steps = usual_numpy_table(env, dataclasses.replace(args, episodes=episodes // 10))
    print(f"the usual NumPy table: {steps / (time.process_time() - began):,.0f} steps per second")


def one_seed(args: script.Args) -> tuple[int, int, int, float, float]:
    """Learn with one seed; returns it, in how many cells Q is right (Figure 10's, all), max |Q - Q*|, CPU seconds."""
    env = script.make_environment(args)
    world = env.unwrapped
    Q_star = script.optimal_action_values(*script.model_matrices(world.P, 11, 4), args.discount)  # (11, 4)
    began = time.process_time()
    Q = learn(env, args).Q  # (11, 4)
    deciding = [s for s, cell in enumerate(world.cells) if cell not in world.terminals]
    greedy = {cell: np.flatnonzero(best) for cell, best in zip(world.cells, script.greedy_actions(Q), strict=True)}
    named = sum(list(greedy[cell]) == [world.actions.index(action)] for cell, action in FIGURE_10.items())
    optimal = int(script.optimal_states(Q, Q_star)[deciding].sum())
    return args.seed, named, optimal, float(np.abs(Q - Q_star)[deciding].max()), time.process_time() - began


def seeds(number: int = 20, first: int = 0, episodes: int = 200_000, processes: int = 1) -> None:
    """Learn with several seeds and default flags; ends in exit code 1 if fewer than 19 of 20 find the policy
    or any ends 0.03 or more from Q*."""
    runs = [script.Args(episodes=episodes, seed=seed) for seed in range(first, first + number)]
    found = near = 0
    with ProcessPoolExecutor(processes) as pool:
        for seed, named, optimal, error, seconds in pool.map(one_seed, runs):
            print(f"seed {seed:3}: Figure 10 in {named} of 4 cells, optimal in {optimal} of 9, "
                  f"max |Q - Q*| = {error:.4f}, {seconds:.1f} s", flush=True)
            found += named == 4 and optimal == 9
            near += error < 0.03
    print(f"Figure 10's policy, optimal in all nine cells: {found} of {number} seeds")
    print(f"max |Q - Q*| < 0.03: {near} of {number} seeds")
    raise SystemExit(found < 0.95 * number or near < number)


def optimal_policy(step_reward: float, discount: float = 1.0) -> str:
    """The optimal policy at slip 0.2, as rows of arrows from top to bottom; `*` terminal, `#` wall."""
    world = script.GridWorld(step_reward=step_reward)
    Q = script.optimal_action_values(*script.model_matrices(world.P, 11, 4), discount)  # (11, 4)
    arrows = {cell: "<^>v"[best] for cell, best in zip(world.cells, Q.argmax(axis=1), strict=True)}
    arrows |= dict.fromkeys(world.terminals, "*")
    return "/".join("".join(arrows.get((x, y), "#") for x in range(1, 5)) for y in (3, 2, 1))


def changes(low: float, high: float, policies: tuple[str, str], width: float = 1e-7) -> list[float]:
    """Where, between two step rewards with these two policies, the optimal policy changes; by bisection."""
    if policies[0] == policies[1]:
        return []
    middle = (low + high) / 2
    if high - low < width:
        return [middle]
    between = optimal_policy(middle)
    return [*changes(low, middle, (policies[0], between)), *changes(middle, high, (between, policies[1]))]


def step_rewards() -> None:
    """The intervals of the step reward with their optimal policies (no discount); the discounts at step reward 0."""
    grid = np.append(np.arange(-1.8, 0, 0.01), -1e-4).tolist()
    policies = [optimal_policy(step_reward) for step_reward in grid]
    ends = []
    for i in range(len(grid) - 1):
        ends += changes(grid[i], grid[i + 1], (policies[i], policies[i + 1]))
    for low, high in zip([-2.0, *ends], [*ends, 0.0], strict=True):
        figure_10 = "   <- Figure 10" if optimal_policy((low + high) / 2).endswith("#<*/^<<<") else ""
        print(f"step reward up to {high:8.4f}: {optimal_policy((low + high) / 2)}{figure_10}")
    found = [d for d in np.arange(0.01, 1, 0.01) if optimal_policy(0.0, d).endswith("#<*/^<<<")]
    print(f"discounts 0.01, 0.02, … 0.99 at step reward 0 with the policy of Figure 10: {found or 'none'}")


if __name__ == "__main__":
    commands = {"speed": speed, "seeds": seeds, "step-rewards": step_rewards}
    tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
