"""Measure tabular_q_gridworld.py: whether it finds Figure 10, and when that is optimal.

    python benchmarks/gridworld.py seeds          # 20 seeds x 200,000 episodes against Q*
    python benchmarks/gridworld.py step-rewards   # where the optimal policy changes
"""

import itertools
import sys
from pathlib import Path

import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parent.parent / "algorithms"))
import tabular_q_gridworld as script

FIGURE_10 = ">>>*/^#<*/^<<<"  # rows from top to bottom; * ends the episode, # is the wall


def policy_map(Q: np.ndarray) -> str:
    """The policy of Q (11, 4) in one line, as FIGURE_10."""
    world = script.GridWorld()
    signs = {cell: "<^>v"[a] for cell, a in zip(world.cells, Q.argmax(axis=1), strict=True)}
    signs |= dict.fromkeys(world.terminals, "*")
    return "/".join("".join(signs.get((x, y), "#") for x in (1, 2, 3, 4)) for y in (3, 2, 1))


def optimal_policy(step_reward: float, discount: float = 1.0) -> str:
    """The optimal policy at slip 0.2."""
    model = script.GridWorld(step_reward=step_reward).P
    return policy_map(script.optimal_action_values(model, discount))


def seeds(number: int = 20, episodes: int = 200_000) -> None:
    """Learn with several seeds; exit code 1 unless each finds Figure 10's policy."""
    Q_star = script.optimal_action_values(script.GridWorld().P, 1.0)
    found, errors = 0, []
    for seed in range(number):
        args = script.Args(episodes=episodes, seed=seed)
        *_, (Q, _, _) = script.tabular_q_learning(script.make_world(args), args)
        Q = np.array(Q)  # (S, A)
        found += policy_map(Q) == FIGURE_10
        errors.append(np.abs(Q - Q_star).max())
        print(f"seed {seed:2}: {policy_map(Q)}, max |Q - Q*| = {errors[-1]:.4f}", flush=True)
    print(f"Figure 10: {found} of {number} seeds")
    print(f"max |Q - Q*|: {min(errors):.4f} to {max(errors):.4f}")
    raise SystemExit(found < number)


def step_rewards() -> None:
    """The optimal policies along the step reward, undiscounted; then, at 0, along the discount."""
    grid = np.append(np.arange(-1.8, -0.005, 0.005), -0.0001)
    for left, right in itertools.pairwise(grid):
        policy, low, high = optimal_policy(left), left, right
        while policy != optimal_policy(right) and high - low > 1e-5:  # bisection
            middle = (low + high) / 2
            if optimal_policy(middle) == policy:
                low = middle
            else:
                high = middle
        if high < right:
            note = "  <- Figure 10" if policy == FIGURE_10 else ""
            print(f"step reward up to {high:8.4f}: {policy}{note}")
    print(f"step reward up to   0.0000: {optimal_policy(-0.0001)}")
    found = [d for d in np.arange(0.05, 1, 0.05) if optimal_policy(0.0, d) == FIGURE_10]
    print(f"discounts 0.05, 0.10, … 0.95 at step reward 0, with Figure 10: {found or 'none'}")


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")
    commands = {"seeds": seeds, "step-rewards": step_rewards}
    tyro.extras.subcommand_cli_from_dict(commands, description=__doc__)
